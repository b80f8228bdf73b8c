"use strict";
// Layers and photos handed in. Where nothing may be written, GeoJSON is shown on this page alone.
const overlayLabel = (properties) => Object.entries(properties || {}).slice(0, 8).map(([k, v]) => `${k}: ${v}`).join("\n");
const drawOverlay = (name, data) => {
  if (state.overlays.has(name)) { state.overlays.get(name).remove(); state.overlays.delete(name); }
  if (data) {
    const layer = L.geoJSON(data, {
      style: { color: "#c20000", weight: 3 }, pointToLayer: (f, at) => L.circleMarker(at, { radius: 8, color: "#c20000" }),
      onEachFeature: (f, l) => l.bindPopup(element("pre", overlayLabel(f.properties))),
    }).addTo(map);
    state.overlays.set(name, layer);
  }
  $("overlays").replaceChildren(...[...state.overlays].map(([n, l]) => {
    const li = element("li", n), toggle = button("on", () => { const on = map.hasLayer(l); on ? l.remove() : l.addTo(map); toggle.textContent = on ? "off" : "on"; });
    toggle.setAttribute("aria-label", `show or hide ${n}`);
    li.append(toggle);
    return li;
  }));
};
const showOverlay = async (name) => {
  const data = await asked(`layers/${encodeURIComponent(name)}`, {}).catch((error) => { if (error.refused) return null; throw error; });
  drawOverlay(name, data);
};
const readOverlays = async () => { for (const { name } of (await asked("layers")).layers) await quietly(`layer ${name}`, () => showOverlay(name)); };
const showHere = async (file) => {
  try {
    const data = JSON.parse(await file.text());
    drawOverlay(file.name, data);
    const box = state.overlays.get(file.name).getBounds();
    if (box.isValid() && !map.getBounds().intersects(box)) map.fitBounds(box);
  } catch (error) { say(`${file.name} is not GeoJSON (${error.message})`); }
};
const handIn = async (files) => {
  if (!state.info) { say("the server does not answer"); return; }
  const photos = [];
  for (const file of files) {
    const plain = /\.(geo)?json$/i.test(file.name), layer = plain || /\.(kml|kmz|gpkg|zip)$/i.test(file.name);
    if (!state.info.growing) {
      if (plain) await showHere(file);
      else if (!(await handControl(file))) say(`${file.name}: here, GeoJSON and lists of control points can be shown`);
      continue;
    }
    if (!layer) { photos.push(file); continue; }
    const answer = await fetch(`layers?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file, headers: writing({ "Content-Type": "application/octet-stream" }) }).catch(() => null);
    if (!answer) { say(`${file.name}: the server does not answer`); continue; }
    const said = await answer.json().catch(() => ({}));
    if (!answer.ok) say(`${file.name}: ${said.detail || said.reason || answer.status}`);
  }
  if (photos.length) send(photos);
};
$("files").onchange = () => { handIn([...$("files").files]); $("files").value = ""; };
$("drop").onkeydown = (e) => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); $("files").click(); } };
for (const name of ["dragover", "dragleave", "drop"]) document.addEventListener(name, (e) => {
  e.preventDefault();
  $("drop").classList.toggle("over", name === "dragover");
  if (name === "drop" && e.dataTransfer) filesIn(e.dataTransfer).then(handIn);
});
$("finish").onclick = async () => {
  if (!window.confirm("Adjust all photos together and draw the final map at full resolution?")) return;
  await asked("finish", { method: "POST", headers: writing({}) }).then(() => say("The final map is being made; this one stays."), (error) => say(error.message));
};
// -- files of the finished map ----------------------------------------------------------------------------------
const readFiles = async () => {
  const { files } = await asked("files");
  $("final").hidden = !files.length;
  const row = (f) => {
    const li = element("li"), a = element("a", f.name === "report.html" ? "Report" : f.what === "export" ? f.name : f.what[0].toUpperCase() + f.what.slice(1));
    a.href = `files/${f.name.split("/").map(encodeURIComponent).join("/")}`;
    if (f.name === "report.html") { a.target = "_blank"; a.rel = "noopener"; } else a.download = "";
    li.append(a, element("small", `${f.name}, ${inSize(f.bytes)}`));
    return li;
  };
  const main = ["mosaic.tif", "dsm.tif", "thermal.tif", "bands.tif", "ndvi.tif", "report.html"];
  $("downloads").replaceChildren(...main.map((n) => files.find((f) => f.name === n)).filter(Boolean).map(row));
  const rest = files.filter((f) => !main.includes(f.name));
  $("more").hidden = !rest.length;
  $("allfiles").replaceChildren(...rest.map(row));
};
