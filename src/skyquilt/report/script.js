(() => {
  const map = document.querySelector(".map"), svg = map.querySelector("svg"), world = svg.querySelector(".world");
  const overlay = svg.querySelector(".overlay"), tip = map.querySelector(".tip"), place = map.querySelector(".place");
  const facts = JSON.parse(document.getElementById("facts").textContent), [W0, H0] = [svg.viewBox.baseVal.width, svg.viewBox.baseVal.height];
  const start = world.transform.baseVal[0].matrix, first = [start.a, start.e, start.f];
  const outlines = document.getElementById("layer-footprints")?.children, touches = new Map();
  let W, H, k, x, y, home = true;  // a point (e, s) in m lies at (x + k e, y + k s) px

  const nice = raw => { const b = 10 ** Math.floor(Math.log10(raw)); return [5, 2, 1].map(f => f * b).find(v => v <= raw * 1.0001); };
  const written = (v, step) => v.toLocaleString("en", {minimumFractionDigits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)),
    maximumFractionDigits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9))}).replaceAll(",", "\u202f");

  function reset() { const f = W / W0; [k, x, y] = first.map(v => v * f); home = true; draw(); }
  function resize() {
    const old = W; W = map.clientWidth; H = map.clientHeight; svg.setAttribute("viewBox", `0 0 ${W} ${H}`);
    if (home || !old) reset(); else { k *= W / old; x *= W / old; y *= W / old; draw(); }
  }
  function draw() {
    world.setAttribute("transform", `matrix(${k} 0 0 ${k} ${x} ${y})`);
    const length = nice(140 / k), b = H - 16;
    overlay.innerHTML = `<g class="ticks">${ticks()}</g><g class="furniture">` +
      `<path class="bar-casing" d="M16 ${b}h${length * k}"/><path class="bar-line" d="M16 ${b}h${length * k}"/><text x="16" y="${b - 8}">${written(length, length)} ${facts.unit}</text>` +
      (facts.crs ? `<g transform="translate(${W - 30} 34)"><path class="needle" d="M0 -20L8 6L0 0L-8 6Z"/><text y="22" class="mid">N</text></g>` : "") + "</g>";
  }
  function ticks() {
    const step = nice(170 / k), out = [];
    const tick = (d, tx, ty, words, cls) => out.push(`<path class="under" d="${d}"/><path d="${d}"/><text x="${tx}" y="${ty}" class="${cls}">${words}</text>`);
    for (let e = Math.ceil((facts.west - x / k) / step) * step, px; (px = x + (e - facts.west) * k) < W - 60; e += step)
      if (px > 90) tick(`M${px} 0v6`, px, 19, written(e, step) + (facts.crs ? "\u202fE" : ""), "mid");
    for (let n = Math.floor((facts.north + y / k) / step) * step, py; (py = y + (facts.north - n) * k) < H - 50; n -= step)
      if (py > 60) tick(`M${W} ${py}h-6`, W - 10, py + 4, written(n, step) + (facts.crs ? "\u202fN" : ""), "end");
    return out.join("");
  }
  function zoom(factor, px = W / 2, py = H / 2) {
    factor = Math.min(Math.max(factor, first[0] * W / W0 / 4 / k), first[0] * 400 / k);
    x = px - (px - x) * factor; y = py - (py - y) * factor; k *= factor; home = false; draw();
  }
  function pan(dx, dy) { x += dx; y += dy; home = false; draw(); }
  function point(event) { const r = map.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; }

  function hover([px, py]) {
    const step = nice(4 / k), unit = facts.crs ? ["\u202fE", "\u202fN"] : ["", ""];
    place.textContent = `${written(facts.west + (px - x) / k, step)}${unit[0]}, ${written(facts.north - (py - y) / k, step)}${unit[1]}`;
    let best = null, least = 28;
    for (const shot of facts.shots) { const d = Math.hypot(x + shot[2] * k - px, y + shot[3] * k - py); if (d < least) { least = d; best = shot; } }
    tip.hidden = !best;
    const ring = best && outlines?.[best[0]]?.getAttribute("d") || "";
    for (const path of world.querySelectorAll(".hit,.hit-casing")) path.setAttribute("d", ring);
    if (!best) return;
    const name = document.createElement("b"); name.textContent = best[1]; tip.replaceChildren(name, best[4]);
    const tx = x + best[2] * k, ty = y + best[3] * k;
    tip.style.left = Math.max(4, Math.min(tx + 12, W - tip.offsetWidth - 4)) + "px";
    tip.style.top = (ty > H - 80 ? ty - tip.offsetHeight - 12 : ty + 12) + "px";
  }
  map.addEventListener("wheel", event => {
    if (!map.contains(document.activeElement) && !event.ctrlKey) { place.textContent = "Click the map, then scroll to zoom"; return; }
    event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0018)), ...point(event));
  }, {passive: false});
  map.addEventListener("pointerdown", event => {
    if (event.target.closest("button")) return;
    if (event.pointerType === "touch" && !map.contains(document.activeElement)) return hover(point(event));
    map.setPointerCapture(event.pointerId); touches.set(event.pointerId, point(event)); map.classList.add("moving");
  });
  map.addEventListener("pointermove", event => {
    const now = point(event), last = touches.get(event.pointerId);
    if (!last) return hover(now);
    const other = [...touches].find(([id]) => id !== event.pointerId)?.[1];
    touches.set(event.pointerId, now);
    if (!other) return pan(now[0] - last[0], now[1] - last[1]);
    const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
    zoom(apart(now) / Math.max(apart(last), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  });
  for (const kind of ["pointerup", "pointercancel"]) map.addEventListener(kind, event => { touches.delete(event.pointerId); map.classList.remove("moving"); });
  map.addEventListener("pointerleave", () => { tip.hidden = true; place.textContent = ""; });
  map.addEventListener("keydown", event => {
    const act = {"+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), "0": reset,
      ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60)}[event.key];
    if (act && event.target === map) { event.preventDefault(); act(); }
  });
  map.querySelector(".tools").addEventListener("click", event => {
    const kind = event.target.dataset.zoom; if (kind) kind === "home" ? reset() : zoom(kind === "in" ? 1.6 : 1 / 1.6);
  });
  for (const box of document.querySelectorAll("[data-layer]")) {
    const show = () => { for (const part of [document.getElementById("on-" + box.dataset.layer), document.querySelector(`[data-for="${box.dataset.layer}"]`)]) part?.classList.toggle("off", !box.checked); };
    box.addEventListener("change", show); show();
  }
  new ResizeObserver(resize).observe(map);
})();
