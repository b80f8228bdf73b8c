"use strict";
// What the survey says of itself, and news while it grows.
const readInfo = async () => {
  const info = await asked("info"), finished = !info.growing;
  const done = state.info && state.info.finish !== "done" && info.finish === "done";
  state.info = info;
  state.layers = new Map(info.layers.map((l) => [l.name, l]));
  state.last = Math.max(state.last, info.event);
  document.title = `${info.title} – Skyquilt`;
  $("title").textContent = info.title;
  listLayers();
  $("finish").hidden = finished;
  $("finish").disabled = info.finish === "asked" || info.finish === "running";
  $("finish").textContent = $("finish").disabled ? "Final map is being made" : "Finish flight";
  $("dropwords").textContent = finished ? "Drop or choose GeoJSON" : "Drop photos, GeoJSON, KML, GeoPackage or a zipped Shapefile, or choose";
  $("token").hidden = !(info.token && (info.growing || info.control));
  for (const name of ["profile", "volume"]) $(name).hidden = !info.heights;
  $("counts").textContent = Object.entries(info.counts).filter(([, n]) => n).map(([k, n]) => `${n} ${k}`).join(", ");
  showMap();
  showSecond();
  follow();
  explain();
  readMeasures();
  if (done) await openFinal();
};
// After the flight: the final map is opened, with its files.
const openFinal = async () => {
  if (!state.layers.has("finished")) return readFiles();  // of photos without positions
  $("layer").value = "finished";
  $("layer").onchange();
  const everywhere = [L.latLngBounds([-90, -180], [90, 180])];
  for (const layer of [first, second]) if (layer && layer.options.layer.startsWith("finished")) layer.refresh(everywhere);
  fit();
  await readFiles();
};
// Instead of an empty map: what is missing, and what to do.
const explain = () => {
  const some = boundsOf() !== null;
  $("empty").hidden = some;
  // nothing is shown that cannot be used
  for (const id of ["export", "fit", "distance", "area", "prints", "tracks"]) $(id).hidden = !some;
  $("layer").parentElement.hidden = !some;
  $("fade").hidden = !some;
  const { growing, counts, finish } = state.info, waiting = counts.waiting || 0;
  if (!some && !waiting) $("finish").hidden = true;
  if (some) return;
  const placeless = ["This map has no place on Earth", "Its photos have no positions. The report shows it."];
  const [head, text] = !growing ? placeless
    : finish === "done" ? ["The final map has no place on Earth", "Its photos have no positions. It is under Downloads, with its report."]
    : waiting ? ["No photo has a position so far", "The map begins with the first photo that has one. A flight without any is mapped at its end: Finish flight."]
    : ["No photo is on the map yet", "Copy photos into the watched folder, send them over HTTP, or drop them here. The map begins with the first photo that has a position; others wait until they can be linked to it."];
  $("empty").replaceChildren(element("h2", head), element("p", text));
};
let again = null;
const readInfoSoon = () => { if (!again) again = setTimeout(() => { again = null; readInfo().catch(() => {}); }, 400); };

const told = (kind, use) => (e) => { state.last = Math.max(state.last, Number(e.lastEventId) || 0); use(JSON.parse(e.data)); };
const photoNews = (p) => {
  const known = state.photos.get(p.id) || {}, { time, ...rest } = p;
  state.photos.set(p.id, { received: Date.now() / 1000, ...known, ...(p.state !== known.state ? { reason: "" } : {}), ...rest, time: known.time || (time ? Date.parse(/[zZ]|[+-]\d\d:?\d\d$/.test(time) ? time : `${time}Z`) / 1000 : null) });
  listSoon(); readInfoSoon();
};
const listen = () => {
  const news = new EventSource(`events?after=${state.last}`);
  news.onopen = () => { $("link").textContent = state.info && state.info.growing ? "live" : "open"; $("link").className = "live"; catchUp(); };
  news.onerror = () => { $("link").textContent = "lost, trying"; $("link").className = "lost"; if (news.readyState === 2) setTimeout(listen, 1000); };
  news.addEventListener("photo", told("photo", photoNews));
  news.addEventListener("tiles", told("tiles", (t) => {
    const boxes = (t.boxes || [t.bounds]).map(([west, south, east, north]) => L.latLngBounds([south, west], [north, east]));
    readInfoSoon();
    for (const layer of [first, second]) if (layer && layer.options.layer === t.layer) layer.refresh(boxes);
  }));
  news.addEventListener("layer", told("layer", (l) => showOverlay(l.name)));
  news.addEventListener("refused", told("refused", (r) => { (state.refused = state.refused || []).unshift(r); listSoon(); readInfoSoon(); }));
  news.addEventListener("finish", told("finish", (f) => { say(f.text || `final map: ${f.state}`); readInfoSoon(); }));
  news.addEventListener("map", told("map", readInfoSoon));
};
const catchUp = () => Promise.all([readInfo(), readPhotos(), readOverlays(), readFiles(), readControl()]).catch(() => {});
readInfo().catch(() => say("the server does not answer")).then(listen);
window.skyquilt = { map, state };
