"use strict";
// The page never builds HTML from what photos or layers say: text goes in as text.
const $ = (id) => document.getElementById(id);
const map = L.map("map", { zoomControl: true, maxZoom: 25, preferCanvas: true }).setView([0, 0], 2);
L.control.scale({ imperial: false }).addTo(map);
map.createPane("first").style.zIndex = 240;
map.createPane("second").style.zIndex = 250;
const state = { layers: new Map(), photos: new Map(), last: 0, rule: "", mode: null, points: [], overlays: new Map(), fitted: false, info: null };
const outlines = L.layerGroup(), trails = L.layerGroup().addTo(map), drawn = L.layerGroup().addTo(map), marked = L.layerGroup().addTo(map);
const colours = ["#0047b3", "#b30059", "#006644", "#8a4b00", "#5a00b3", "#00707a"];

const element = (tag, text, cls) => {
  const e = document.createElement(tag);
  if (text !== undefined) e.textContent = text;
  if (cls) e.className = cls;
  return e;
};
const say = (text) => { $("said").textContent = text; $("said").hidden = false; clearTimeout(say.t); say.t = setTimeout(() => { $("said").hidden = true; }, 8000); };
const pressed = (id, on) => $(id).setAttribute("aria-pressed", String(on));
const isPressed = (id) => $(id).getAttribute("aria-pressed") === "true";
const writing = (more) => ({ ...more, ...($("token").value ? { "X-Token": $("token").value } : {}) });

// -- maps ---------------------------------------------------------------------------------------------------
// A tile that changes is fetched first and swapped then: nothing flickers while the map grows.
const Growing = L.GridLayer.extend({
  createTile(coords, done) {
    const img = element("img");
    img.alt = "";
    img.onload = () => done(null, img);
    img.onerror = () => { img.removeAttribute("src"); done(null, img); };
    this.fill(img, coords, () => done(null, img));
    return img;
  },
  fill(img, { x, y, z }, empty) {
    const url = `/tiles/${z}/${x}/${y}?layer=${encodeURIComponent(this.options.layer)}&v=${state.last}`;
    fetch(url).then((r) => r.status === 200 ? r.blob() : null).then((blob) => {
      if (!blob) { img.removeAttribute("src"); img.style.visibility = "hidden"; if (empty) empty(); return; }
      const address = URL.createObjectURL(blob), next = new Image();
      next.onload = () => { img.src = address; img.style.visibility = "inherit"; setTimeout(() => URL.revokeObjectURL(address), 1000); if (!empty) window.drawnTiles = (window.drawnTiles || 0) + 1; };
      next.src = address;
    }).catch(() => { if (empty) empty(); });
  },
  refresh(boxes) {
    for (const key of Object.keys(this._tiles)) {
      const tile = this._tiles[key], place = this._tileCoordsToBounds(tile.coords);
      if (boxes.some((box) => place.overlaps(box))) this.fill(tile.el, this._wrapCoords(tile.coords), null);
    }
  },
});
const growing = (name, pane) => new Growing({ layer: name, pane, maxZoom: 25, updateWhenZooming: false, keepBuffer: 1 });
let first = null, second = null, base = null;

const shownName = () => {
  const name = $("layer").value, newest = `${name}-newest`;
  return state.rule && state.layers.has(newest) ? newest : name;
};
const showMap = () => {
  const name = shownName();
  if (!name || (first && first.options.layer === name)) return;
  if (first) first.remove();
  first = growing(name, "first").addTo(map);
};
const showSecond = () => {
  if (second) { second.remove(); second = null; }
  const on = isPressed("swipe") && $("other").value;
  $("other").hidden = !isPressed("swipe");
  $("handle").hidden = !on;
  if (on) second = growing($("other").value, "second").addTo(map);
  clip();
};
let cut = 0.5;
const clip = () => {
  map.getPane("first").style.clip = "";
  if (!second) return;
  const box = map.getContainer().getBoundingClientRect(), x = cut * box.width;
  $("handle").style.left = `${box.left + x}px`;
  const part = (from, to) => {
    const a = map.containerPointToLayerPoint([from, 0]), b = map.containerPointToLayerPoint([to, box.height]);
    return `rect(${a.y}px,${b.x}px,${b.y}px,${a.x}px)`;
  };
  map.getPane("first").style.clip = part(0, x);
  map.getPane("second").style.clip = part(x, box.width);
};
map.on("move zoom resize", clip);
$("handle").addEventListener("pointerdown", (e) => {
  $("handle").setPointerCapture(e.pointerId);
  $("handle").onpointermove = (m) => { const box = map.getContainer().getBoundingClientRect(); cut = Math.min(0.98, Math.max(0.02, (m.clientX - box.left) / box.width)); clip(); };
});
$("handle").addEventListener("pointerup", () => { $("handle").onpointermove = null; });
$("handle").addEventListener("keydown", (e) => { if (e.key === "ArrowLeft" || e.key === "ArrowRight") { cut = Math.min(0.98, Math.max(0.02, cut + (e.key === "ArrowLeft" ? -0.05 : 0.05))); clip(); } });

const boundsOf = () => {
  const all = [...state.layers.values()].filter((l) => l.bounds).map((l) => L.latLngBounds([l.bounds[1], l.bounds[0]], [l.bounds[3], l.bounds[2]]));
  return all.length ? all.reduce((a, b) => a.extend(b), all[0]) : null;
};
const fit = () => { const b = boundsOf(); if (b) { map.fitBounds(b, { maxZoom: 23 }); state.fitted = true; } };
const option = (select, names) => {
  const old = select.value;
  select.replaceChildren(...names.map((n) => { const o = element("option", n); o.value = n; return o; }));
  if (names.includes(old)) select.value = old;
};
const readInfo = async () => {
  const info = await (await fetch("/info")).json();
  state.info = info;
  state.layers = new Map(info.layers.map((l) => [l.name, l]));
  state.last = Math.max(state.last, info.event);
  const names = info.layers.map((l) => l.name), plain = names.filter((n) => !n.endsWith("-newest"));
  option($("layer"), plain);
  option($("other"), names.filter((n) => n !== $("layer").value));
  $("rule").disabled = !names.some((n) => n.endsWith("-newest"));
  $("finish").hidden = !info.growing;
  $("drop").hidden = !info.growing;
  $("token").hidden = !info.token;
  $("counts").textContent = Object.entries(info.counts).map(([k, n]) => `${n} ${k}`).join(", ");
  showMap();
  if (!state.fitted) fit();
};
let again = null;
const readInfoSoon = () => { if (!again) again = setTimeout(() => { again = null; readInfo().catch(() => {}); }, 400); };

// -- photos -------------------------------------------------------------------------------------------------
const until = () => {
  const all = [...state.photos.values()].map((p) => p.received || 0).filter(Boolean), share = Number($("time").value) / 1000;
  if (share === 1 || !all.length) { $("until").textContent = "now"; return Infinity; }
  const low = Math.min(...all), high = Math.max(...all), t = low + share * (high - low);
  $("until").textContent = new Date(t * 1000).toLocaleTimeString();
  return t;
};
const listPhotos = () => {
  const limit = until(), rows = [];
  outlines.clearLayers(); trails.clearLayers();
  const bySource = new Map(), photos = [...state.photos.values()];
  for (const p of photos) {
    if ((p.received || 0) > limit || p.state === "superseded") continue;
    if (p.ring && p.ring.length) L.polygon(p.ring.map(([x, y]) => [y, x]), { color: "#000", weight: 1, fill: false, interactive: false }).addTo(outlines);
    if (p.at) { if (!bySource.has(p.source)) bySource.set(p.source, []); bySource.get(p.source).push([p.at[1], p.at[0]]); }
  }
  let k = 0;
  for (const line of bySource.values()) {
    const color = colours[k++ % colours.length];
    L.polyline(line, { color, weight: 3, interactive: false }).addTo(trails);
    for (const at of line.slice(-400)) L.circleMarker(at, { radius: 4, color, interactive: false }).addTo(trails);
  }
  for (const p of [...photos].reverse().slice(0, 300)) {
    const li = element("li"), left = element("span", p.name), right = element("span", p.state, `state ${p.state}`);
    if (p.reason) left.append(element("small", p.reason));
    li.append(left, right);
    if (p.at) { li.tabIndex = 0; li.onclick = () => map.panTo([p.at[1], p.at[0]]); }
    rows.push(li);
  }
  for (const p of (state.refused || []).slice(0, 100)) {
    const li = element("li"), left = element("span", p.name);
    left.append(element("small", p.reason));
    li.append(left, element("span", "refused", "state refused"));
    rows.unshift(li);
  }
  $("photos").replaceChildren(...rows);
};
let listing = null;
const listSoon = () => { if (!listing) listing = setTimeout(() => { listing = null; listPhotos(); }, 250); };
const readPhotos = async () => {
  const said = await (await fetch("/photos")).json();
  state.photos = new Map(said.photos.map((p) => [p.id, p]));
  state.refused = said.refused;
  listPhotos();
};
const photosHere = async (at) => {
  const said = await (await fetch(`/photos?lon=${at.lng}&lat=${at.lat}`)).json();
  $("here").hidden = false;
  const mark = (p, li) => {
    for (const other of $("covering").children) other.classList.remove("chosen");
    li.classList.add("chosen");
    marked.clearLayers();
    L.circleMarker(at, { radius: 8, color: "#ff9d00", weight: 4 }).addTo(marked);
    L.polygon(p.ring.map(([x, y]) => [y, x]), { color: "#ff9d00", weight: 4, fill: false }).addTo(marked);
  };
  const rows = said.photos.map((p) => {
    const li = element("li"), open = element("a", "full size", "button");
    open.href = `/photos/${p.id}/file`; open.target = "_blank"; open.rel = "noopener";
    li.append(element("span", p.name), open);
    li.tabIndex = 0;
    li.onclick = () => mark(p, li);
    return li;
  });
  $("covering").replaceChildren(...(rows.length ? rows : [element("li", "no photo covers this point")]));
  if (rows.length) mark(said.photos[0], rows[0]);
};

// -- measuring ----------------------------------------------------------------------------------------------
const measure = () => {
  drawn.clearLayers();
  const p = state.points;
  if (!state.mode) { $("measured").textContent = ""; return; }
  (state.mode === "area" ? L.polygon : L.polyline)(p, { color: "#c20000", weight: 4 }).addTo(drawn);
  for (const at of p) L.circleMarker(at, { radius: 6, color: "#c20000" }).addTo(drawn);
  $("measured").textContent = state.mode === "area" ? Measure.inSquare(Measure.area(p)) : Measure.inMetres(Measure.length(p));
};
const setMode = (mode) => {
  state.mode = state.mode === mode ? null : mode;
  state.points = [];
  pressed("distance", state.mode === "distance"); pressed("area", state.mode === "area");
  map.getContainer().style.cursor = state.mode ? "crosshair" : "";
  measure();
};
$("distance").onclick = () => setMode("distance");
$("area").onclick = () => setMode("area");
map.on("click", (e) => { if (state.mode) { state.points.push(e.latlng); measure(); } else photosHere(e.latlng).catch(() => say("the server does not answer")); });

// -- layers and photos handed in ----------------------------------------------------------------------------
const overlayLabel = (properties) => Object.entries(properties || {}).slice(0, 8).map(([k, v]) => `${k}: ${v}`).join("\n");
const showOverlay = async (name) => {
  const answer = await fetch(`/layers/${encodeURIComponent(name)}`);
  if (state.overlays.has(name)) { state.overlays.get(name).remove(); state.overlays.delete(name); }
  if (answer.ok) {
    const layer = L.geoJSON(await answer.json(), {
      style: { color: "#c20000", weight: 3 }, pointToLayer: (f, at) => L.circleMarker(at, { radius: 8, color: "#c20000" }),
      onEachFeature: (f, l) => l.bindPopup(element("pre", overlayLabel(f.properties))),
    }).addTo(map);
    state.overlays.set(name, layer);
  }
  $("overlays").replaceChildren(...[...state.overlays].map(([n, l]) => {
    const li = element("li", n), toggle = element("button", "on");
    toggle.onclick = () => { const on = map.hasLayer(l); on ? l.remove() : l.addTo(map); toggle.textContent = on ? "off" : "on"; };
    li.append(toggle);
    return li;
  }));
};
const readOverlays = async () => { for (const { name } of (await (await fetch("/layers")).json()).layers) await showOverlay(name); };
const handIn = async (files) => {
  for (const file of files) {
    const layer = /\.(geo)?json$/i.test(file.name);
    const url = layer ? `/layers?name=${encodeURIComponent(file.name)}` : `/photos?name=${encodeURIComponent(file.name)}&source=browser`;
    const answer = await fetch(url, { method: "POST", body: file, headers: writing({ "Content-Type": "application/octet-stream" }) }).catch(() => null);
    if (!answer) { say(`${file.name}: the server does not answer`); continue; }
    const said = await answer.json().catch(() => ({}));
    if (!answer.ok) say(`${file.name}: ${said.detail || said.reason || answer.status}`);
  }
};
$("files").onchange = () => handIn([...$("files").files]);
for (const name of ["dragover", "dragleave", "drop"]) document.addEventListener(name, (e) => {
  e.preventDefault();
  $("drop").classList.toggle("over", name === "dragover");
  if (name === "drop" && e.dataTransfer) handIn([...e.dataTransfer.files]);
});
$("finish").onclick = async () => {
  if (!window.confirm("Adjust all photos together and draw the final map at full resolution?")) return;
  const answer = await fetch("/finish", { method: "POST", headers: writing({}) });
  say(answer.ok ? "The final map is being made; this one stays." : (await answer.json()).detail);
};

// -- buttons ------------------------------------------------------------------------------------------------
$("layer").onchange = () => { option($("other"), [...state.layers.keys()].filter((n) => n !== $("layer").value)); showMap(); showSecond(); };
$("rule").onclick = () => { state.rule = state.rule ? "" : "-newest"; pressed("rule", Boolean(state.rule)); showMap(); };
$("swipe").onclick = () => { pressed("swipe", !isPressed("swipe")); showSecond(); };
$("other").onchange = showSecond;
const toggle = (id, layer) => { $(id).onclick = () => { const on = !isPressed(id); pressed(id, on); on ? layer.addTo(map) : layer.remove(); }; };
toggle("prints", outlines); toggle("tracks", trails);
$("base").onclick = () => {
  const on = !isPressed("base");
  pressed("base", on);
  if (base) { base.remove(); base = null; }
  if (on) { base = L.tileLayer("https://tile.openstreetmap.org/{z}/{x}/{y}.png", { maxNativeZoom: 19, maxZoom: 25, zIndex: 0, attribution: "© OpenStreetMap contributors" }).addTo(map); base.once("tileerror", () => say("the base map cannot be reached; everything else works without")); }
};
$("fit").onclick = fit;
$("time").oninput = listPhotos;
$("fold").onclick = () => { document.body.classList.toggle("folded"); map.invalidateSize(); };
$("export").onclick = () => { const b = map.getBounds(); $("export").href = `/export?bbox=${[b.getWest(), b.getSouth(), b.getEast(), b.getNorth()].join(",")}&layer=${encodeURIComponent(shownName())}`; };

// -- news ---------------------------------------------------------------------------------------------------
const told = (kind, use) => (e) => { state.last = Math.max(state.last, Number(e.lastEventId) || 0); use(JSON.parse(e.data)); };
const listen = () => {
  const news = new EventSource(`/events?after=${state.last}`);
  news.onopen = () => { $("link").textContent = state.info && state.info.growing ? "live" : "open"; $("link").className = "live"; catchUp(); };
  news.onerror = () => { $("link").textContent = "lost, trying"; $("link").className = "lost"; if (news.readyState === 2) setTimeout(listen, 1000); };
  news.addEventListener("photo", told("photo", (p) => { state.photos.set(p.id, { received: Date.now() / 1000, ...(state.photos.get(p.id) || {}), ...p }); listSoon(); readInfoSoon(); }));
  news.addEventListener("tiles", told("tiles", (t) => {
    const boxes = (t.boxes || [t.bounds]).map(([west, south, east, north]) => L.latLngBounds([south, west], [north, east]));
    if (!state.layers.has(t.layer) || !state.fitted) readInfoSoon();
    for (const layer of [first, second]) if (layer && layer.options.layer === t.layer) layer.refresh(boxes);
  }));
  news.addEventListener("layer", told("layer", (l) => showOverlay(l.name)));
  news.addEventListener("refused", told("refused", (r) => { (state.refused = state.refused || []).unshift(r); listSoon(); readInfoSoon(); }));
  news.addEventListener("finish", told("finish", (f) => { say(f.text || `final map: ${f.state}`); readInfoSoon(); }));
  news.addEventListener("map", told("map", readInfoSoon));
};
const catchUp = () => Promise.all([readInfo(), readPhotos(), readOverlays()]).catch(() => {});
readInfo().catch(() => say("the server does not answer")).then(listen);
window.skyquilt = { map, state };
