"use strict";
// The plan on the map: points as they turn, coverage, areas drawn here, follow-up plans.
(() => {
  const { map, state } = window.skyquilt;
  const colours = { planned: "#2563eb", taken: "#15803d", missing: "#dc2626", unsharp: "#d97706" };
  const words = { planned: "planned", taken: "taken", missing: "missing", unsharp: "unsharp" };
  const make = (tag, text, cls) => { const e = document.createElement(tag); if (text !== undefined) e.textContent = text; if (cls) e.className = cls; return e; };
  const button = (text, id) => { const b = make("button", text); b.id = id; b.type = "button"; return b; };
  const token = () => document.getElementById("token");
  const headers = (more) => ({ ...more, ...(token() && token().value ? { "X-Token": token().value } : {}) });
  const said = make("output", ""); said.id = "plan-said";

  // -- the panel
  const section = make("section"); section.id = "mission";
  const share = make("p", "", "share"), drones = make("ul"), legend = make("p", "", "plan-legend"), plans = make("ul");
  share.id = "coverage-share"; drones.id = "drones"; plans.id = "plans";
  for (const [kind, colour] of Object.entries(colours)) { const dot = make("i"); dot.style.background = colour; const entry = make("span"); entry.append(dot, words[kind]); legend.append(entry, " "); }
  const showPoints = button("Points", "plan-points"), showCover = button("Coverage", "plan-coverage"), fill = button("Plan what is missing", "plan-fill");
  const drawArea = button("Draw area", "draw-area"), drawClosed = button("Draw keep-out", "draw-closed"), clear = button("Clear", "draw-clear"), go = button("Plan these", "plan-go");
  for (const [b, on] of [[showPoints, true], [showCover, false], [drawArea, false], [drawClosed, false]]) b.setAttribute("aria-pressed", String(on));
  const field = (id, label, value, size) => { const l = make("label", label), i = make("input"); i.id = id; i.value = value; i.size = size; l.append(i); return l; };
  const row = (...parts) => { const r = make("div", undefined, "row"); r.append(...parts); return r; };
  const asking = row(field("plan-camera", "Camera ", "FC6310", 7), field("plan-height", "Height, m ", "60", 3), field("plan-drones", "Drones ", "1", 2));
  section.append(make("h2", "Plan"), share, drones, legend, row(showPoints, showCover, fill), row(drawArea, drawClosed, clear, go), asking, said, plans);
  const panel = document.getElementById("panel"), at = document.getElementById("here");
  panel.insertBefore(section, at);

  // -- the plan
  const points = L.layerGroup().addTo(map), ways = L.layerGroup().addTo(map), follow = L.layerGroup().addTo(map), sketch = L.layerGroup().addTo(map);
  const marks = new Map();
  let cover = null, known = null, sharing = "";
  const draw = (plan, states) => {
    points.clearLayers(); ways.clearLayers(); marks.clear();
    if (!plan) return;
    L.geoJSON(plan.area, { style: { color: "#2563eb", weight: 2, fill: false }, interactive: false }).addTo(ways);
    for (const k of plan.keep_out) L.geoJSON(k.geometry, { style: { color: "#dc2626", weight: 2, fillOpacity: 0.25 }, interactive: false }).addTo(ways);
    for (const way of plan.ways) L.polyline(way.map(([x, y]) => [y, x]), { color: "#64748b", weight: 1.5, opacity: 0.8, interactive: false }).addTo(ways);
    for (const [id, lon, lat] of plan.points) {
      const mark = L.circleMarker([lat, lon], { radius: 5, weight: 2, fillOpacity: 0.9, interactive: false }).addTo(points);
      marks.set(id, mark);
    }
    turn(states);
    if (!state.fitted && plan.points.length) { map.fitBounds(plan.points.map(([, x, y]) => [y, x]), { padding: [30, 30] }); state.fitted = true; }
  };
  const turn = (states) => {
    for (const [id, mark] of marks) {
      const kind = states[id] || "planned";
      mark.setStyle({ color: colours[kind], fillColor: kind === "planned" ? "#fff" : colours[kind] });
    }
  };
  const minutes = (s) => `${Math.floor(s / 60)}:${String(Math.round(s % 60)).padStart(2, "0")}`;
  const read = async () => {
    const told = await asked("plan").catch((error) => { section.hidden ||= error.refused; throw error; }), key = JSON.stringify(told.plan && [told.plan.points.length, told.plan.points[0]]);
    if (key !== known) { known = key; draw(told.plan, told.states); } else turn(told.states);
    legend.hidden = showPoints.hidden = fill.hidden = !told.plan;
    drones.replaceChildren(...told.drones.map((d) => make("li", `${d.name}: ${d.taken} of ${d.planned} photos, ${minutes(d.seconds_left)} left`)));
    plans.replaceChildren(...told.plans.map((p) => {
      const li = make("li"), open = make("a", p.name);
      open.href = `plans/${encodeURIComponent(p.name)}/plan.html`; open.target = "_blank"; open.rel = "noopener";
      li.append(open, " ");
      for (const file of p.files.filter((f) => /^\d\d-/.test(f))) {
        const link = make("a", file.replace(/^.*\./, ""));
        link.href = `plans/${encodeURIComponent(p.name)}/${encodeURIComponent(file)}`; link.title = file; link.download = file; link.className = "file";
        li.append(link, " ");
      }
      return li;
    }));
  };
  const readCover = async () => {
    const told = await asked("coverage");
    share.textContent = told.bounds ? `${(100 * told.share).toFixed(1)} % of the area has ${told.views} views` : "";
    sharing = told;
    if (cover) { cover.remove(); cover = null; }
    if (told.bounds && showCover.getAttribute("aria-pressed") === "true") {
      const [west, south, east, north] = told.bounds;
      cover = L.imageOverlay(`coverage.png?v=${Date.now()}`, [[south, west], [north, east]], { opacity: 0.75, zIndex: 260, interactive: false }).addTo(map);
    }
  };
  const soon = (name, work, wait) => { let t = null; return () => { if (!t) t = setTimeout(() => { t = null; quietly(name, work); }, wait); }; };
  const readSoon = soon("plan", read, 300), coverSoon = soon("coverage", readCover, 600);
  showPoints.onclick = () => { const on = showPoints.getAttribute("aria-pressed") !== "true"; showPoints.setAttribute("aria-pressed", String(on)); for (const l of [points, ways]) on ? l.addTo(map) : l.remove(); };
  showCover.onclick = () => { showCover.setAttribute("aria-pressed", String(showCover.getAttribute("aria-pressed") !== "true")); coverSoon(); };

  // -- areas drawn here; they are kept in the survey's folder
  let shapes = [], open = null;
  const collection = () => ({ type: "FeatureCollection", features: shapes.map((s) => ({ type: "Feature", properties: s.closed ? { keep_out: true } : {}, geometry: { type: "Polygon", coordinates: [[...s.ring, s.ring[0]].map(([y, x]) => [x, y])] } })) });
  const readAreas = async () => {
    const told = await asked("areas");
    if (open) return;
    const polygons = told.features.filter((f) => f.geometry.type === "Polygon");
    shapes = polygons.map((f) => ({ closed: Boolean(f.properties.keep_out), ring: f.geometry.coordinates[0].slice(0, -1).map(([x, y]) => [y, x]) }));
    show();
  };
  const keep = async () => {
    const answer = await fetch("areas", { method: "PUT", body: JSON.stringify(collection()), headers: headers({ "Content-Type": "application/json" }) }).catch(() => null);
    if (answer && answer.ok) return;
    const told = answer ? await answer.json().catch(() => ({})) : {};
    said.textContent = `The areas are not kept: ${typeof told.detail === "string" ? told.detail : "the server does not answer"}`;
  };
  const show = () => {
    sketch.clearLayers();
    for (const s of [...shapes, ...(open ? [open] : [])]) L.polygon(s.ring, { color: s.closed ? "#dc2626" : "#2563eb", weight: 3, dashArray: s === open ? "6 4" : null, interactive: false }).addTo(sketch);
    if (open) for (const p of open.ring) L.circleMarker(p, { radius: 4, interactive: false }).addTo(sketch);
    go.disabled = !shapes.some((s) => !s.closed);
  };
  const done = () => {
    if (open && open.ring.length > 2) { shapes.push(open); keep(); }
    open = null;
    state.picking = null;
    document.getElementById("cross").hidden = !state.mode;
    drawArea.setAttribute("aria-pressed", "false"); drawClosed.setAttribute("aria-pressed", "false");
    map.getContainer().style.cursor = ""; map.doubleClickZoom.enable();
    show();
  };
  const begin = (closed, b) => () => {
    const on = b.getAttribute("aria-pressed") === "true";
    done();
    if (on) return;
    if (state.mode) setMode(null);
    open = { closed, ring: [] };
    state.picking = ({ lat, lng }) => { open.ring.push([lat, lng]); show(); };
    document.getElementById("cross").hidden = false;
    b.setAttribute("aria-pressed", "true");
    map.getContainer().style.cursor = "crosshair"; map.doubleClickZoom.disable();
    said.textContent = "Click or tap the corners, or press Enter for the middle of the map; press the button again to end.";
  };
  drawArea.onclick = begin(false, drawArea); drawClosed.onclick = begin(true, drawClosed);
  clear.onclick = () => { shapes = []; open = null; keep(); done(); said.textContent = ""; };
  // Backspace takes the last corner back, Escape the whole area
  document.addEventListener("keydown", (e) => {
    if (!open) return;
    if (e.key === "Escape") { open = null; done(); said.textContent = ""; }
    if (e.key === "Backspace" && e.target === map.getContainer()) { open.ring.pop(); show(); }
  });
  const sent = async (url, body) => {
    const answer = await fetch(url, { method: "POST", body, headers: headers({ "Content-Type": "application/json" }) }).catch(() => null);
    if (!answer) { said.textContent = "the server does not answer"; return; }
    const told = await answer.json().catch(() => ({}));
    said.textContent = answer.ok ? "The plan is being computed ..." : (typeof told.detail === "string" ? told.detail : "this cannot be planned");
  };
  go.onclick = () => {
    done();
    const value = (id) => encodeURIComponent(document.getElementById(id).value);
    sent(`plan?camera=${value("plan-camera")}&height=${value("plan-height")}&drones=${value("plan-drones")}`, JSON.stringify(collection()));
  };
  fill.onclick = () => sent("plan/missing", "");
  const ready = async (name) => {
    const [places, ways] = await Promise.all(["points", "routes"].map((what) => asked(`plans/${encodeURIComponent(name)}/${what}.geojson`)));
    follow.clearLayers();
    L.geoJSON(ways, { style: { color: "#7c3aed", weight: 2 }, interactive: false }).addTo(follow);
    L.geoJSON(places, { pointToLayer: (f, p) => L.circleMarker(p, { radius: 5, color: "#7c3aed", weight: 2, fillOpacity: 0.4, interactive: false }) }).addTo(follow);
  };

  // -- photos placed by their metadata alone: pale, with a dashed outline, until they are refined
  const provisional = L.layerGroup().addTo(map), pale = L.layerGroup().addTo(map);
  const turning = (ring) => ring.reduce((sum, [x, y], k) => { const [u, v] = ring[(k + 1) % ring.length]; return sum + x * v - u * y; }, 0);
  const unsure = () => {
    provisional.clearLayers(); pale.clearLayers();
    const rings = [...state.photos.values()].filter((p) => p.state === "placed" && p.ring && p.ring.length > 2).map((p) => { const ring = p.ring.map(([x, y]) => [y, x]); return turning(ring) < 0 ? ring.reverse() : ring; });
    if (!rings.length) return;
    // one shape, so that places that many photos show are no paler than others
    L.polygon(rings.map((ring) => [ring]), { stroke: false, fillColor: "#fff", fillOpacity: 0.22, fillRule: "nonzero", interactive: false }).addTo(pale);
    for (const ring of rings) L.polygon(ring, { color: "#fff", weight: 2, dashArray: "4 5", fill: false, interactive: false }).addTo(provisional);
  };
  document.addEventListener("photoslisted", unsure);
  unsure();

  // -- news
  document.addEventListener("plan", ({ detail: told }) => {
    if (told.text) said.textContent = told.text;
    if (told.state === "ready") quietly("plan made", () => ready(told.name));
    readSoon();
  });
  document.addEventListener("coverage", coverSoon);
  document.addEventListener("areas", () => quietly("areas", readAreas));
  // a finished map has no plan
  section.hidden = true;
  document.addEventListener("connected", () => {
    section.hidden = !state.info || !state.info.growing;
    for (const [name, work] of section.hidden ? [] : [["plan", read], ["coverage", readCover], ["areas", readAreas]]) quietly(name, work);
  });
  show();
  window.skyquilt.plan = { shapes: () => shapes, marks, cover: () => sharing, provisional };
})();
