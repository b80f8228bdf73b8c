"use strict";
// What all parts of the page share. The page never builds HTML from what photos or layers say: text goes in as text.
const $ = (id) => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const map = L.map("map", { zoomControl: true, maxZoom: 25, preferCanvas: true, inertia: !still }).setView([0, 0], 2);
if (still) map.panBy = (by, options) => L.Map.prototype.panBy.call(map, by, { ...options, animate: false });
L.control.scale({ imperial: false }).addTo(map);
map.createPane("first").style.zIndex = 240;
map.createPane("second").style.zIndex = 250;
const state = { layers: new Map(), photos: new Map(), last: 0, rule: "", mode: null, points: [], overlays: new Map(), fitted: false, moved: false, info: null };
const outlines = L.layerGroup(), trails = L.layerGroup().addTo(map), drawn = L.layerGroup().addTo(map), marked = L.layerGroup().addTo(map);
const colours = ["#0047b3", "#b30059", "#006644", "#8a4b00", "#5a00b3", "#00707a"];

const element = (tag, text, cls) => {
  const e = document.createElement(tag);
  if (text !== undefined) e.textContent = text;
  if (cls) e.className = cls;
  return e;
};
const button = (text, work) => { const b = element("button", text); b.type = "button"; b.onclick = work; return b; };
const say = (text) => { $("said").textContent = text; $("said").hidden = false; clearTimeout(say.t); say.t = setTimeout(() => { $("said").hidden = true; }, 8000); };
const pressed = (id, on) => $(id).setAttribute("aria-pressed", String(on));
const isPressed = (id) => $(id).getAttribute("aria-pressed") === "true";
const writing = (more) => ({ ...more, ...($("token").value ? { "X-Token": $("token").value } : {}) });
// The map shows its focus, and its middle, to those who use the keyboard.
document.addEventListener("keydown", (e) => { if (e.key === "Tab") document.body.classList.add("keys"); }, true);
document.addEventListener("pointerdown", () => document.body.classList.remove("keys"), true);
// Browsers hand on a touch as a mouse, too: nothing lies under a finger's cursor once the finger is gone.
for (const name of ["pointerdown", "pointermove"]) document.addEventListener(name, (e) => { state.touched = e.pointerType === "touch"; }, true);
// An item of a list that can be chosen: by mouse anywhere, by keyboard and screen reader as the button that its name becomes.
const choosable = (li, work) => {
  const name = li.querySelector("span"), go = element("button", undefined, "quiet");
  go.type = "button";
  go.append(...name.childNodes);
  name.replaceChildren(go);
  li.onclick = work;
  return li;
};
// Longest time in ms that an answer may take. What hangs on a weak link would keep others from the few connections of a browser.
const PATIENCE_MS = 60000;
const asked = async (url, options) => {
  const answer = await fetch(url, options || { signal: AbortSignal.timeout(PATIENCE_MS) }).catch(() => { throw new Error("the server does not answer"); });
  const said = await answer.json().catch(() => ({}));
  if (!answer.ok) throw Object.assign(new Error(typeof said.detail === "string" ? said.detail : `the server answers ${answer.status}`), { refused: answer.status < 500 && ![408, 425, 429].includes(answer.status) });
  return said;
};
// What does not come over a weak link, and was not refused, is read again later, by its name (`readMissed`).
const missed = new Map();
const surely = (name, read) => { missed.delete(name); return read().catch((error) => { if (!error.refused) missed.set(name, read); throw error; }); };
const quietly = (name, read) => surely(name, read).catch(() => {});
const readMissed = () => { for (const [name, read] of [...missed]) quietly(name, read); };
const inSize = (n) => n > 1e6 ? `${(n / 1e6).toFixed(1)} MB` : `${Math.max(1, Math.round(n / 1e3))} kB`;
const saveText = (name, text) => {
  const a = element("a");
  a.href = URL.createObjectURL(new Blob([text], { type: "application/geo+json" }));
  a.download = name;
  a.click();
  setTimeout(() => URL.revokeObjectURL(a.href), 5000);
};
