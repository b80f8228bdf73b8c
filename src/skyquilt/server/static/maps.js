"use strict";
// A tile that changes is fetched first and swapped then: nothing flickers while the map grows.
const Growing = L.GridLayer.extend({
  // Where the view jumps, too, what is shown stays, moved or enlarged, until tiles of the new view are there: a weak link takes seconds.
  getEvents() {
    const events = L.GridLayer.prototype.getEvents.call(this);
    delete events.viewprereset;
    return events;
  },
  createTile(coords, done) {
    const img = element("img");
    img.alt = "";
    img.onload = () => done(null, img);
    img.onerror = () => { img.removeAttribute("src"); done(null, img); };
    img.empty = () => done(null, img);
    this.fill(img, coords, img.empty);
    return img;
  },
  fill(img, { x, y, z }, empty) {
    // one at a time: an answer that comes late must not replace a newer one, and a flood of changes is one request
    if (img.asking) { img.changed = true; return; }
    const url = `tiles/${z}/${x}/${y}?layer=${encodeURIComponent(this.options.layer)}`;
    img.asking = true;
    img.lost = img.changed = false;
    fetch(url, { signal: AbortSignal.timeout(PATIENCE_MS) }).then((r) => {
      if (!r.ok && r.status !== 404) throw new Error(r.status);
      return r.status === 200 ? r.blob() : null;
    }).then((blob) => {
      if (!blob) { img.removeAttribute("src"); img.style.visibility = "hidden"; if (empty) empty(); return; }
      const address = URL.createObjectURL(blob), next = new Image();
      next.onload = () => { img.src = address; img.style.visibility = "inherit"; setTimeout(() => URL.revokeObjectURL(address), 1000); if (!empty) window.drawnTiles = (window.drawnTiles || 0) + 1; };
      next.src = address;
    }).catch(() => { img.lost = true; }).then(() => {  // not done: what was shown there before stays
      img.asking = false;
      if (img.changed && img.isConnected) this.fill(img, { x, y, z }, img.lost ? img.empty : null);
    });
  },
  // What did not come over a weak link is asked for again.
  again() { for (const { el, coords } of Object.values(this._tiles)) if (el.lost) this.fill(el, this._wrapCoords(coords), el.empty); },
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
  if (!name || (first && first.options.layer === name)) { legends(); return; }
  if (first) first.remove();
  first = growing(name, "first").addTo(map);
  legends();
};
const showSecond = () => {
  if (isPressed("swipe") && !$("other").value) $("other").selectedIndex = 1;
  const name = $("other").value, on = isPressed("swipe") && name;
  if (second && second.options.layer !== name) { second.remove(); second = null; }
  if (!second && name) second = growing(name, "second").addTo(map);
  $("handle").hidden = !on;
  $("fade").hidden = !name && !first;
  fade();
  clip();
  legends();
};
// Opacity is that of the upper map, or, where there is one alone, of the map itself.
const fade = () => {
  const share = Number($("opacity").value) / 100;
  if (first) first.setOpacity(second ? 1 : share);
  if (second) second.setOpacity(share);
};
const legend = (box, name) => {
  const layer = state.layers.get(name), told = layer && layer.legend;
  box.hidden = !told;
  if (!told) return;
  const bar = element("i");
  bar.style.background = `linear-gradient(to right, ${told.colours.join(",")})`;
  const digits = told.high - told.low < 50 ? 1 : 0;
  box.replaceChildren(element("span", told.low.toFixed(digits)), bar, element("span", `${told.high.toFixed(digits)} ${told.unit}`));
};
const legends = () => { legend($("legend"), shownName()); legend($("legend2"), $("other").value); };
let cut = 0.5;
const clip = () => {
  for (const name of ["first", "second"]) map.getPane(name).style.clip = "";
  if (!second || !isPressed("swipe")) return;
  const box = map.getContainer().getBoundingClientRect(), x = cut * box.width;
  $("handle").style.left = `${box.left + x}px`;
  $("handle").style.height = `${box.height}px`;
  $("handle").setAttribute("aria-valuenow", String(Math.round(100 * cut)));
  const part = (from, to) => {
    const a = map.containerPointToLayerPoint([from, 0]), b = map.containerPointToLayerPoint([to, box.height]);
    return `rect(${a.y}px,${b.x}px,${b.y}px,${a.x}px)`;
  };
  map.getPane("first").style.clip = part(0, x);
  map.getPane("second").style.clip = part(x, box.width);
};
map.on("move zoom resize", clip);
const cutAt = (share) => { cut = Math.min(0.98, Math.max(0.02, share)); clip(); };
$("handle").addEventListener("pointerdown", (e) => {
  $("handle").setPointerCapture(e.pointerId);
  $("handle").onpointermove = (m) => { const box = map.getContainer().getBoundingClientRect(); cutAt((m.clientX - box.left) / box.width); };
});
$("handle").addEventListener("pointerup", () => { $("handle").onpointermove = null; });
$("handle").addEventListener("keydown", (e) => { if (e.key === "ArrowLeft" || e.key === "ArrowRight") cutAt(cut + (e.key === "ArrowLeft" ? -0.05 : 0.05)); });

const boundsOf = () => {
  const all = [...state.layers.values()].filter((l) => l.bounds && l.name !== "base").map((l) => L.latLngBounds([l.bounds[1], l.bounds[0]], [l.bounds[3], l.bounds[2]]));
  return all.length ? all.reduce((a, b) => a.extend(b), all[0]) : null;
};
const fit = () => { const b = boundsOf(); if (b) { fit.own = true; map.fitBounds(b, { maxZoom: 23, animate: false }); fit.own = false; state.fitted = true; state.moved = false; } };
// The growing map stays in view until somebody moves it.
const follow = () => { const b = boundsOf(); if (b && (!state.fitted || (!state.moved && state.info.growing && !map.getBounds().contains(b)))) fit(); };
map.on("dragstart zoomstart", () => { if (!fit.own && state.fitted) state.moved = true; });
const option = (select, names, none) => {
  const old = select.value;
  const rows = names.map((n) => { const o = element("option", (state.layers.get(n) || {}).title || n); o.value = n; return o; });
  if (none) { const o = element("option", "nothing"); o.value = ""; rows.unshift(o); }
  select.replaceChildren(...rows);
  if (names.includes(old)) select.value = old;
};
const listLayers = () => {
  const names = [...state.layers.keys()];
  option($("layer"), names.filter((n) => !n.endsWith("-newest")));
  option($("other"), names.filter((n) => n !== $("layer").value), true);
  $("rule").hidden = !names.includes(`${$("layer").value}-newest`);
  $("swipe").hidden = names.length < 2;
  $("other").parentElement.hidden = names.length < 2;
};
$("layer").onchange = () => { listLayers(); showMap(); showSecond(); };
$("rule").onclick = () => { state.rule = state.rule ? "" : "-newest"; pressed("rule", Boolean(state.rule)); showMap(); };
$("swipe").onclick = () => { pressed("swipe", !isPressed("swipe")); if (!isPressed("swipe")) $("other").value = ""; showSecond(); };
$("other").onchange = () => { if (!$("other").value) pressed("swipe", false); showSecond(); };
$("opacity").oninput = fade;
const toggle = (id, layer) => { $(id).onclick = () => { const on = !isPressed(id); pressed(id, on); on ? layer.addTo(map) : layer.remove(); }; };
toggle("prints", outlines); toggle("tracks", trails);
$("base").onclick = () => {
  const on = !isPressed("base");
  pressed("base", on);
  if (base) { base.remove(); base = null; }
  if (on) { base = L.tileLayer("https://tile.openstreetmap.org/{z}/{x}/{y}.png", { maxNativeZoom: 19, maxZoom: 25, zIndex: 0, attribution: "© OpenStreetMap contributors" }).addTo(map); base.once("tileerror", () => say("the base map cannot be reached; everything else works without")); }
};
$("fit").onclick = fit;
const fold = (folded) => { document.body.classList.toggle("folded", folded); $("fold").setAttribute("aria-expanded", String(!folded)); map.invalidateSize(); };
$("fold").onclick = () => fold(!document.body.classList.contains("folded"));
document.querySelector(".skip").onclick = () => fold(false);
$("export").onclick = () => { const b = map.getBounds(); $("export").href = `export?bbox=${[b.getWest(), b.getSouth(), b.getEast(), b.getNorth()].join(",")}&layer=${encodeURIComponent(shownName())}`; };

// -- coordinates and height under the cursor ------------------------------------------------------------------
const degrees = (at) => `${Math.abs(at.lat).toFixed(6)}° ${at.lat < 0 ? "S" : "N"} ${Math.abs(at.lng).toFixed(6)}° ${at.lng < 0 ? "W" : "E"}`;
const valueText = (v) => `${v.title} ${v.value}${v.unit ? ` ${v.unit}` : ""}`;
const placeText = (said) => {
  if (said.crs === null) return "";
  const numbers = [said.x, said.y].map((v) => v.toFixed(2)).join(" "), high = said.values.find((v) => /heights$/.test(v.layer)), warm = said.values.find((v) => /thermal/.test(v.layer));
  return [`${said.crs} ${numbers}`, high && `height ${high.value.toFixed(2)} ${high.unit}`, warm && `${warm.value.toFixed(1)} ${warm.unit}`].filter(Boolean).join(" · ");
};
let hover = null, hovering = false;
const readPlace = async () => {
  if (hovering || !hover) return;
  const at = hover;
  hover = null; hovering = true;
  try { const said = await asked(`at?lon=${at.lng}&lat=${at.lat}`); $("where").textContent = [degrees(at), placeText(said)].filter(Boolean).join(" · "); } catch { /* the degrees stay */ }
  setTimeout(() => { hovering = false; readPlace(); }, 120);
};
map.on("mousemove", (e) => { if (!state.fitted || state.info.placeless || state.touched) return; $("where").textContent = degrees(e.latlng); hover = e.latlng; readPlace(); });
map.on("mouseout", () => { hover = null; $("where").textContent = ""; });
