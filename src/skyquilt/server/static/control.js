"use strict";
// Control points: listed or added, marked in the photos that should show them, saved, and used by a run beside.
const VIEW = 300;  // side of a loupe in px
const control = { crs: "", points: [], marks: [], chosen: null, zoom: 120, undo: [], dirty: false, run: null, rows: [] };
const marksOf = (name) => control.marks.filter((m) => m.point === name);
const markIn = (name, photo) => control.marks.find((m) => m.point === name && m.photo === photo);
const keepUndo = () => { control.undo.push(JSON.stringify([control.points, control.marks])); control.undo = control.undo.slice(-100); control.dirty = true; };
const controlLayer = L.layerGroup().addTo(map);

const readControl = async () => {
  if (!state.info || !state.info.control || control.read) return;
  control.read = true;
  const said = await asked("control").catch((error) => { control.read = false; throw error; });
  Object.assign(control, { crs: said.crs, points: said.points, marks: said.marks, run: said.run, photos: said.photos });
  $("control").hidden = false;
  drawControl();
  if (control.run && control.run.state === "running") watchRun();
};
// A list that was chosen or dropped: gcp_list.txt or CSV.
const handControl = async (file) => {
  if (!/\.(txt|csv)$/i.test(file.name) || !state.info.control) return false;
  try {
    const said = await asked(`control/read?crs=${encodeURIComponent(control.crs)}`, { method: "POST", body: file });
    keepUndo();
    Object.assign(control, { crs: said.crs, points: said.points, marks: said.marks, chosen: null, open: true });
    drawControl();
    say(`${file.name}: ${said.points.length} points, ${said.marks.length} marks`);
  } catch (error) { say(`${file.name}: ${error.message}`); }
  return true;
};
const field = (text, value, kind) => {
  const label = element("label", text), input = element("input");
  input.value = value; input.type = kind || "text"; input.style.width = "100%";
  label.append(input);
  return [label, input];
};
// A place taken from the map by a click, or by Enter in its middle.
const picking = (pick) => {
  const on = Boolean(state.picking);
  pick.setAttribute("aria-pressed", String(on));
  map.getContainer().style.cursor = on ? "crosshair" : "";
  $("cross").hidden = !on;
  if (on) { if (state.mode) setMode(null); $("cross").hidden = false; say("Click the place on the map; with the keyboard, Enter takes its middle."); }
};
const stopPicking = () => { state.picking = null; const pick = $("controlpick"); if (pick) picking(pick); };
const addForm = () => {
  const form = element("form");
  const [nameBox, name] = field("Name", `P${control.points.length + 1}`), [xBox, x] = field("Easting or longitude", ""), [yBox, y] = field("Northing or latitude", ""), [zBox, z] = field("Height in m, empty if unknown", "");
  const check = element("input"), checkBox = element("label", " Check point: judges the map, is not used");
  check.type = "checkbox"; checkBox.prepend(check);
  const about = element("small", `Coordinates in ${control.crs}.`), pick = button("Take from the map", () => {
    state.picking = state.picking ? null : async (at) => {
      try {
        const said = await asked(`at?lon=${at.lng}&lat=${at.lat}&crs=${encodeURIComponent(control.crs)}`), digits = Math.abs(said.y) <= 90 && Math.abs(said.x) <= 180 ? 8 : 3;
        x.value = said.x.toFixed(digits); y.value = said.y.toFixed(digits);
        about.textContent = `Coordinates in ${control.crs}, as the map shows them: put what was surveyed in their place.`;
        controlLayer.clearLayers();
        L.circleMarker(at, { radius: 9, color: "#00a0c8", weight: 4 }).addTo(controlLayer);
      } catch (error) { say(error.message); }
      stopPicking();
      x.focus();
    };
    picking(pick);
  });
  pick.id = "controlpick";
  pick.setAttribute("aria-pressed", "false");
  form.append(nameBox, pick, xBox, yBox, zBox, checkBox, about);
  const done = element("button", "Add");
  done.type = "submit";
  form.append(done, button("Cancel", () => { stopPicking(); control.adding = false; drawControl(); }));
  form.onsubmit = (e) => {
    e.preventDefault();
    const label = name.value.replace(/\s+/g, "");
    const numbers = [x.value, y.value, z.value || "0"].map((v) => Number(v.replace(",", ".")));
    if (!label || control.points.some((p) => p.name === label)) { say("each point needs a name of its own"); return; }
    if (!x.value || !y.value || numbers.some((v) => !Number.isFinite(v))) { say("easting and northing are numbers"); return; }
    keepUndo();
    control.points.push({ name: label, x: numbers[0], y: numbers[1], z: z.value ? numbers[2] : null, check: check.checked });
    Object.assign(control, { adding: false, chosen: label });
    stopPicking();
    drawControl(); lookUp();
  };
  return form;
};
const saveControl = async () => {
  await asked("control", { method: "PUT", headers: writing({ "Content-Type": "application/json" }), body: JSON.stringify({ crs: control.crs, points: control.points, marks: control.marks }) });
  control.dirty = false;
};
const trying = (work) => async () => { try { await work(); } catch (error) { say(error.message); } };
const listText = () => {
  const rows = control.marks.map((m) => { const p = control.points.find((q) => q.name === m.point); return [p.x, p.y, p.z === null ? "NaN" : p.z, m.x.toFixed(3), m.y.toFixed(3), m.photo, p.name, ...(p.check ? ["check"] : [])].join("\t"); });
  return `${[control.crs, ...rows].join("\n")}\n`;
};
const drawControl = () => {
  const box = $("control"), head = element("h2", "Control points");
  if (!control.open) {
    const open = button(control.points.length ? `Control points (${control.points.length})` : "Control points", () => { control.open = true; drawControl(); });
    box.replaceChildren(open);
    return;
  }
  const rows = control.points.map((p) => {
    const li = element("li", undefined, p.name === control.chosen ? "chosen" : ""), left = element("span", p.name), n = marksOf(p.name).length;
    left.append(element("small", `${p.check ? "check point, " : ""}${n} ${n === 1 ? "mark" : "marks"}`));
    const gone = button("✕", (e) => { e.stopPropagation(); keepUndo(); control.points = control.points.filter((q) => q !== p); control.marks = control.marks.filter((m) => m.point !== p.name); if (control.chosen === p.name) control.chosen = null; drawControl(); });
    gone.setAttribute("aria-label", `remove ${p.name}`);
    const role = button(p.check ? "check" : "control", (e) => { e.stopPropagation(); keepUndo(); p.check = !p.check; drawControl(); });
    role.setAttribute("aria-label", `${p.name} is a ${p.check ? "check" : "control"} point; change`);
    li.append(left, role, gone);
    return choosable(li, () => { control.chosen = p.name; drawControl(); lookUp(); });
  });
  const list = element("ul");
  list.append(...rows);
  const input = element("input"), upload = button("Load a list", () => input.click());
  input.type = "file"; input.accept = ".txt,.csv"; input.hidden = true; input.id = "controlfile";
  input.onchange = () => { handControl(input.files[0]); input.value = ""; };
  const row = element("div", undefined, "row"), undo = button("Undo", () => { const last = control.undo.pop(); if (last) { [control.points, control.marks] = JSON.parse(last); control.dirty = true; drawControl(); drawLoupes(); } });
  undo.disabled = !control.undo.length; undo.id = "controlundo";
  const save = button("Save", trying(async () => { await saveControl(); drawControl(); say("saved as control/gcp_list.txt in the folder of the run"); }));
  save.id = "controlsave"; save.disabled = !control.dirty;
  row.append(button("Add a point", () => { control.adding = true; drawControl(); box.querySelector("form input").focus(); }), upload, input, undo, save);
  if (control.marks.length) row.append(button("Download gcp_list.txt", () => saveText("gcp_list.txt", listText())));
  const parts = [head, element("small", control.photos ? "Choose a point, mark it in two photos or more: control points hold the map, check points judge it." : "The photos are not where they were: start skyquilt view with --photos.")];
  parts.push(control.adding ? addForm() : list, row);
  const loupes = element("div"); loupes.id = "loupes";
  parts.push(loupes, runPart());
  box.replaceChildren(...parts);
  drawLoupes();
};
// -- the run beside ---------------------------------------------------------------------------------------------
const runPart = () => {
  const box = element("div"), run = control.run || { state: "none" }, start = button("Make the map with these points", trying(async () => { await saveControl(); control.run = await asked("control/run", { method: "POST", headers: writing({}) }); drawControl(); watchRun(); }));
  start.id = "controlrun";
  start.disabled = !control.marks.length || run.state === "running";
  box.append(start);
  if (run.state === "running") box.append(element("p", `skyquilt mosaic is running: ${run.stage}`));
  if (run.state === "failed") box.append(element("p", `no map: ${run.text}`));
  if (run.state === "done") box.append(element("p", `Done: ${run.folder}. skyquilt view shows it.`), residuals(run.control));
  return box;
};
const residuals = (points) => {
  const table = element("table"), head = element("tr"), body = element("tbody");
  table.id = "residuals";
  for (const text of ["Point", "East, cm", "North, cm", "Up, cm", "Photos"]) head.append(element("th", text));
  const cm = (v) => v === null || v === undefined ? "–" : (100 * v).toFixed(1);
  for (const p of points) {
    const tr = element("tr");
    tr.append(element("td", p.check ? `${p.name} (check)` : p.name), ...[p.dx_m, p.dy_m, p.dz_m].map((v) => element("td", cm(v))), element("td", String(p.sightings)));
    body.append(tr);
  }
  table.append(element("caption", "Solution minus survey"), head, body);
  return table;
};
const watchRun = () => { setTimeout(async () => { try { control.run = await asked("control/run"); } catch { /* asked again */ } drawControl(); if (control.run.state === "running") watchRun(); }, 1500); };
// -- photos of the chosen point -----------------------------------------------------------------------------------
const lookUp = async (propose) => {
  const point = control.points.find((p) => p.name === control.chosen);
  if (!point) return;
  const marked = marksOf(point.name)[0], photo = marked && [...state.photos.values()].find((p) => p.name === marked.photo);
  const more = photo ? `&marked=${photo.id}&px=${marked.x}&py=${marked.y}${propose ? "&propose=true" : ""}` : "";
  try {
    const said = await asked(`control/photos?x=${point.x}&y=${point.y}&crs=${encodeURIComponent(control.crs)}${more}`);
    if (control.chosen !== point.name) return;
    control.rows = said.photos;
    if (propose) {
      keepUndo();
      let n = 0;
      for (const row of said.photos) if (row.proposed && !markIn(point.name, row.name)) { control.marks.push({ point: point.name, photo: row.name, x: row.proposed[0], y: row.proposed[1] }); n += 1; }
      say(n ? `${n} proposed: look at each, and take away what is wrong` : "no other photo looks like the marked place");
      drawControl();
    } else drawLoupes();
    controlLayer.clearLayers();
    L.circleMarker([said.lat, said.lon], { radius: 9, color: "#00a0c8", weight: 4 }).bindTooltip(point.name, { permanent: true }).addTo(controlLayer);
    if (!map.getBounds().contains([said.lat, said.lon])) map.panTo([said.lat, said.lon]);
  } catch (error) { control.rows = []; drawLoupes(); say(error.message); }
};
const drawLoupes = () => {
  const box = $("loupes");
  if (!box) return;
  const point = control.points.find((p) => p.name === control.chosen);
  if (!point) { box.replaceChildren(); return; }
  // its buttons stay when an answer arrives: a press on one that is replaced before it ends is lost
  const row = box.querySelector(":scope > .row") || loupeTools(), rows = control.rows.map((r) => loupe(point, r));
  row.querySelector("select").value = control.zoom;
  row.querySelector("#propose").disabled = !marksOf(point.name).length;
  if (!row.parentNode) box.replaceChildren(row);
  while (row.nextSibling) row.nextSibling.remove();
  row.after(...(rows.length ? rows : [element("p", "No photo of the map shows this place; check its coordinates.")]));
};
const loupeTools = () => {
  const row = element("div", undefined, "row"), zoom = element("select"), propose = button("Propose the others", () => lookUp(true));
  zoom.setAttribute("aria-label", "size of the detail");
  for (const n of [60, 120, 300, 800]) { const o = element("option", `${n} px of the photo`); o.value = n; zoom.append(o); }
  zoom.onchange = () => { control.zoom = Number(zoom.value); drawLoupes(); };
  propose.id = "propose";
  row.append(zoom, propose);
  return row;
};
// Browsers tell a click in whole pixels of the screen: what was meant is the middle of one.
const middle = (at) => (Number.isInteger(at) ? at + 0.5 : at);
const loupe = (point, r) => {
  const mark = markIn(point.name, r.name), about = mark || r, k = control.zoom / VIEW;
  const figure = element("figure"), stage = element("div", undefined, "loupe"), img = element("img");
  img.src = `photos/${r.id}/detail?x=${about.x.toFixed(2)}&y=${about.y.toFixed(2)}&size=${control.zoom}&shown=${VIEW}`;
  img.alt = `${r.name} about the ${mark ? "marked" : "predicted"} place`;
  img.loading = "lazy";
  stage.append(img, element("i", undefined, mark ? "mark" : "guess"));
  const put = (x, y) => { keepUndo(); control.marks = control.marks.filter((m) => m !== mark); control.marks.push({ point: point.name, photo: r.name, x, y }); const first = marksOf(point.name).length === 1; drawControl(); if (first) lookUp(); };
  stage.onclick = (e) => { const b = img.getBoundingClientRect(); put(about.x + ((middle(e.clientX) - b.left) * VIEW / b.width - VIEW / 2) * k, about.y + ((middle(e.clientY) - b.top) * VIEW / b.height - VIEW / 2) * k); };
  stage.tabIndex = 0;
  stage.setAttribute("role", "button");
  stage.setAttribute("aria-label", `${r.name}: click where ${point.name} is; Enter marks the middle, arrow keys move the mark by a quarter of a pixel`);
  stage.dataset.photo = r.name;
  stage.onkeydown = (e) => {
    const steps = { ArrowLeft: [-0.25, 0], ArrowRight: [0.25, 0], ArrowUp: [0, -0.25], ArrowDown: [0, 0.25], Enter: [0, 0] };
    if (!(e.key in steps)) return;
    e.preventDefault();
    put(about.x + steps[e.key][0], about.y + steps[e.key][1]);
    const again = document.querySelector(`.loupe[data-photo="${CSS.escape(r.name)}"]`);
    if (again) again.focus();
  };
  const words = element("figcaption", `${r.name}${mark ? ": marked" : ""}${r.score ? ` (${Math.round(100 * r.score)} % alike)` : ""}`);
  figure.append(stage, words);
  if (mark) figure.append(button("Take the mark away", () => { keepUndo(); control.marks = control.marks.filter((m) => m !== mark); drawControl(); }));
  return figure;
};
