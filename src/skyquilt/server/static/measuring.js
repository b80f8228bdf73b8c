"use strict";
// Distances, areas, profiles and volumes: drawn by mouse or keyboard, kept under names, saved as GeoJSON.
const MODES = ["distance", "area", "profile", "volume"];
const closed = (mode) => mode === "area" || mode === "volume";
const inCubic = (v) => `${v.toFixed(Math.abs(v) < 100 ? 2 : 1)} m³`;
const pairs = (points) => points.map((p) => `${p.lng.toFixed(8)},${p.lat.toFixed(8)}`).join(";");
state.measures = [];
let reading = 0;
const graph = (said) => {
  const known = said.height_m.filter((z) => z !== null);
  $("graph").hidden = !known.length;
  if (!known.length) return;
  const low = Math.min(...known), high = Math.max(...known), w = 300, h = 110, ns = "http://www.w3.org/2000/svg";
  const far = said.distance_m[said.distance_m.length - 1], span = Math.max(high - low, 0.1);
  let path = "", pen = "M";
  said.height_m.forEach((z, k) => {
    if (z === null) { pen = "M"; return; }
    path += `${pen}${(said.distance_m[k] / far * w).toFixed(1)} ${(h - 4 - (z - low) / span * (h - 8)).toFixed(1)}`;
    pen = "L";
  });
  const svg = document.createElementNS(ns, "svg"), line = document.createElementNS(ns, "path");
  svg.setAttribute("viewBox", `0 0 ${w} ${h}`); svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", `heights from ${low.toFixed(2)} to ${high.toFixed(2)} m over ${far.toFixed(1)} m`);
  line.setAttribute("d", path); line.setAttribute("class", "line");
  svg.append(line);
  $("graph").replaceChildren(element("small", `${high.toFixed(2)} ${said.unit}`), svg, element("small", `${low.toFixed(2)} ${said.unit} · ${Measure.inMetres(far)} long`));
};
const finding = async (mode, points) => {
  if (mode === "distance") return { text: Measure.inMetres(Measure.length(points)), length_m: Measure.length(points) };
  if (mode === "area") return { text: Measure.inSquare(Measure.area(points)), area_m2: Measure.area(points) };
  if (mode === "profile") {
    if (points.length < 2) return { text: "" };
    const said = await asked(`profile?line=${pairs(points)}`);
    return { text: Measure.inMetres(said.distance_m[said.distance_m.length - 1]), length_m: said.distance_m[said.distance_m.length - 1], said };
  }
  if (points.length < 3) return { text: "" };
  const said = await asked(`volume?ring=${pairs(points)}`);
  const gap = said.unknown_m2 > 0.01 * said.area_m2 ? `, ${Measure.inSquare(said.unknown_m2)} without heights` : "";
  return { text: `${inCubic(said.above_m3)} above, ${inCubic(said.below_m3)} below the plane through the edge; ${Measure.inSquare(said.area_m2)}${gap}`, ...said };
};
const measure = async () => {
  drawn.clearLayers();
  const p = state.points, mode = state.mode, mine = ++reading;
  $("keep").hidden = !mode || !p.length;
  if (!mode) { $("measured").textContent = ""; $("graph").hidden = true; return; }
  (closed(mode) ? L.polygon : L.polyline)(p, { color: "#c20000", weight: 4 }).addTo(drawn);
  for (const at of p) L.circleMarker(at, { radius: 6, color: "#c20000" }).addTo(drawn);
  if (!p.length) { $("measured").textContent = "Click or tap on the map; with the keyboard, Enter sets a point in its middle."; $("graph").hidden = true; return; }
  try {
    const found = await finding(mode, p);
    if (mine !== reading) return;
    $("measured").textContent = found.text;
    mode === "profile" && found.said ? graph(found.said) : ($("graph").hidden = true);
    state.found = found;
  } catch (error) { if (mine === reading) $("measured").textContent = error.message; }
};
const setMode = (mode) => {
  state.mode = state.mode === mode ? null : mode;
  state.points = [];
  for (const name of MODES) pressed(name, state.mode === name);
  map.getContainer().style.cursor = state.mode ? "crosshair" : "";
  $("cross").hidden = !state.mode;
  state.mode ? map.doubleClickZoom.disable() : map.doubleClickZoom.enable();  // two quick points are no zoom
  measure();
};
for (const name of MODES) $(name).onclick = () => setMode(name);
const addPoint = (at) => { state.points.push(at); measure(); };
const undoPoint = () => { state.points.pop(); measure(); };
$("undo").onclick = undoPoint;
const feature = (m) => ({
  type: "Feature", properties: { name: m.name, kind: m.mode, ...m.figures },
  geometry: closed(m.mode) ? { type: "Polygon", coordinates: [[...m.points, m.points[0]]] } : { type: "LineString", coordinates: m.points },
});
const keyOf = () => `skyquilt measures ${location.host} ${state.info ? state.info.title : ""}`;
const keptMeasures = () => {
  try { localStorage.setItem(keyOf(), JSON.stringify(state.measures)); } catch { /* a browser that stores nothing */ }
  listMeasures();
};
const readMeasures = () => {
  if (state.measuresRead) return;
  state.measuresRead = true;
  try { state.measures = JSON.parse(localStorage.getItem(keyOf()) || "[]"); } catch { state.measures = []; }
  listMeasures();
};
const keptLayer = L.layerGroup().addTo(map);
const listMeasures = () => {
  keptLayer.clearLayers();
  $("geojson").hidden = !state.measures.length;
  $("measures").replaceChildren(...state.measures.map((m, k) => {
    const li = element("li"), left = element("span", m.name), points = m.points.map(([x, y]) => L.latLng(y, x));
    left.append(element("small", m.text));
    const shape = (closed(m.mode) ? L.polygon : L.polyline)(points, { color: "#0047b3", weight: 3 }).addTo(keptLayer);
    const gone = button("✕", (e) => { e.stopPropagation(); state.measures.splice(k, 1); keptMeasures(); });
    gone.setAttribute("aria-label", `remove ${m.name}`);
    li.append(left, gone);
    return choosable(li, () => map.fitBounds(shape.getBounds(), { maxZoom: 22 }));
  }));
};
$("save").onclick = () => {
  const least = closed(state.mode) ? 3 : 2;
  if (state.points.length < least || !state.found || !state.found.text) { say(`${least} points are needed`); return; }
  const { text, said, unit, ...figures } = state.found;
  const name = $("name").value.trim() || `${state.mode} ${state.measures.length + 1}`;
  state.measures.push({ name, mode: state.mode, text, figures, points: state.points.map((p) => [p.lng, p.lat]) });
  $("name").value = "";
  setMode(null);
  keptMeasures();
};
$("name").onkeydown = (e) => { if (e.key === "Enter") $("save").onclick(); };
$("geojson").onclick = () => saveText("measures.geojson", JSON.stringify({ type: "FeatureCollection", features: state.measures.map(feature) }));
// Keyboard: Enter sets a point in the middle of the map, Backspace takes the last one back, Escape ends.
map.getContainer().addEventListener("keydown", (e) => {
  if (e.target !== map.getContainer()) return;
  if (e.key === "Enter") { chosen(map.getCenter()); }
  if (e.key === "Backspace" && state.mode) undoPoint();
});
document.addEventListener("keydown", (e) => { if (e.key === "Escape" && !$("big").open) { if (!state.picking && !state.mode) leaveHere(); if (state.picking) stopPicking(); if (state.mode) setMode(null); marked.clearLayers(); } });
// The photos of a place are put away; the focus does not get lost with them.
const leaveHere = () => {
  if ($("here").contains(document.activeElement)) map.getContainer().focus();
  $("here").hidden = true;
  marked.clearLayers();
};
map.getContainer().addEventListener("focus", () => { $("cross").hidden = !(state.mode || state.picking || document.body.classList.contains("keys")); });
map.getContainer().addEventListener("blur", () => { $("cross").hidden = !(state.mode || state.picking); });
const clicked = (at) => {
  if (state.info && state.info.placeless) return;  // no photo is told to show a place
  photosHere(at).catch((error) => say(error.message));
};
const chosen = (at) => { state.picking ? state.picking(at) : state.mode ? addPoint(at) : clicked(at); };
map.on("click", (e) => chosen(e.latlng));
