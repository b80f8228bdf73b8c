"use strict";
// What the survey says of itself, and news while it grows.
const readInfo = async () => {
  const info = await asked("info"), finished = !info.growing, survey = `${info.title} ${info.began}`;
  if (state.survey !== undefined && state.survey !== survey) { otherSurvey(); return; }
  state.survey = survey;
  const done = state.info && state.info.finish !== "done" && info.finish === "done";
  // a map that gets its place, or loses it, lies elsewhere in the page
  if (state.info && state.info.placeless !== info.placeless) state.fitted = false;
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
  showCounts();
  showMap();
  showSecond();
  follow();
  explain();
  readMeasures();
  if (!gone && news) showLink();
  if (done) await openFinal();
};
// The server was started for another survey: nothing that is shown here belongs to it.
const otherSurvey = () => {
  if (!sending.now) { location.reload(); return; }
  $("stale").textContent = "The server shows another survey now, this page the former one. Reload it once all is sent.";
};
// How many photos are in which state, and, while the map grows, when the last one came.
const showCounts = () => {
  const counts = Object.entries(state.info.counts).filter(([, n]) => n).map(([k, n]) => `${n} ${k}`);
  // by numbers, which rise as photos come: a clock that was set back would leave a time in the future
  const { received: came } = [...state.photos.values()].reduce((a, p) => (p.id > a.id ? p : a), { id: 0 });
  if (state.info.growing && came) counts.push(`last came ${new Date(came * 1000).toLocaleTimeString()}`);
  $("counts").textContent = counts.join(", ");
};
document.addEventListener("photoslisted", () => { if (state.info) showCounts(); });
// After the flight: the final map is opened, with its files.
const openFinal = async () => {
  if (!state.layers.has("finished")) return quietly("files", readFiles);  // of photos without positions
  $("layer").value = "finished";
  $("layer").onchange();
  const everywhere = [L.latLngBounds([-90, -180], [90, 180])];
  for (const layer of [first, second]) if (layer && layer.options.layer.startsWith("finished")) layer.refresh(everywhere);
  fit();
  await quietly("files", readFiles);
};
// Instead of an empty map: what is missing, and what to do.
const explain = () => {
  const some = boundsOf() !== null;
  $("empty").hidden = some;
  const { growing, counts, finish, placeless } = state.info, waiting = counts.waiting || 0;
  // nothing is shown that cannot be used
  for (const id of ["export", "distance", "area", "prints", "tracks"]) $(id).hidden = !some || placeless;
  for (const id of ["fit", "fade"]) $(id).hidden = !some;
  $("layer").parentElement.hidden = !some;
  $("base").hidden = placeless;
  if (placeless && isPressed("base")) $("base").onclick();
  if (placeless && state.mode) setMode(null);
  document.body.classList.toggle("placeless", placeless);
  $("placeless").hidden = !placeless;
  $("placeless").textContent = "No photo has a position so far: this map has no place and no scale, and its north may be wrong. Once a photo with a position overlaps it, it is begun again with its place."
    + (finish === "done" ? " The final map is under Downloads." : "");
  if (!some && !waiting) $("finish").hidden = true;
  if (some) return;
  const nowhere = ["This map has no place on Earth", "Its photos have no positions. The report shows it."];
  const [head, text] = !growing ? nowhere
    : finish === "done" ? ["The final map has no place on Earth", "Its photos have no positions. It is under Downloads, with its report."]
    : waiting ? ["No photo has a position so far", "The map begins with the first photo that has one, or, without a place, with four that overlap."]
    : ["No photo is on the map yet", "Copy photos into the watched folder, send them over HTTP, or drop them here. The map begins with the first photo that has a position, or with four that overlap; others wait until they can be linked to it."];
  $("empty").replaceChildren(element("h2", head), element("p", text));
};
let again = null;
const readInfoSoon = () => { if (!again) again = setTimeout(() => { again = null; quietly("info", readInfo); }, 400); };

const told = (kind, use) => (e) => { heard = Date.now(); state.last = Math.max(state.last, Number(e.lastEventId) || 0); use(JSON.parse(e.data)); };
const photoNews = (p) => {
  if (state.meanwhile) state.meanwhile.push(p);
  const known = state.photos.get(p.id) || {}, { time, ...rest } = p;
  if (!state.photos.has(p.id)) state.refused = (state.refused || []).filter((r) => r.name !== p.name || r.source !== p.source);  // it came whole after all
  state.photos.set(p.id, { received: Date.now() / 1000, ...known, ...(p.state !== known.state ? { reason: "" } : {}), ...rest, time: known.time || (time ? Date.parse(/[zZ]|[+-]\d\d:?\d\d$/.test(time) ? time : `${time}Z`) / 1000 : null) });
  listSoon(); readInfoSoon();
};
// -- the connection ---------------------------------------------------------------------------------------------
// The server says every 5 s that it is there. So silence is a lost connection, also where a weak network drops it without a word.
const SILENT_MS = 15000;
let news = null, heard = Date.now(), tried = 0, mended = 0, gone = false;
const mend = () => { mended = Date.now(); for (const layer of [first, second]) if (layer) layer.again(); };
const lost = () => {
  if (gone) return;
  gone = true;
  $("link").textContent = "lost, trying";
  $("link").className = "lost";
  const since = new Date(heard).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  $("stale").textContent = `No connection since ${since}: ${state.info && state.info.growing ? "the map is as it was then." : "what is not loaded yet is missing."}`;
};
const back = () => {
  heard = Date.now();
  if (gone) say("Connected again.");
  gone = false;
  $("stale").textContent = "";
  showLink();
  mend();
  catchUp();
};
const showLink = () => {
  $("link").textContent = state.info && state.info.growing ? "live" : "open";
  $("link").className = "live";
};
const listen = () => {
  if (news) news.close();
  tried = Date.now();
  news = new EventSource(`events?after=${state.last}`);
  news.onopen = back;
  news.onerror = lost;
  news.addEventListener("here", () => { heard = Date.now(); });
  for (const kind of ["plan", "coverage", "areas"]) news.addEventListener(kind, told(kind, (said) => document.dispatchEvent(new CustomEvent(kind, { detail: said }))));
  news.addEventListener("photo", told("photo", photoNews));
  news.addEventListener("tiles", told("tiles", (t) => {
    const boxes = (t.boxes || [t.bounds]).map(([west, south, east, north]) => L.latLngBounds([south, west], [north, east]));
    readInfoSoon();
    for (const layer of [first, second]) if (layer && layer.options.layer === t.layer) layer.refresh(boxes);
  }));
  news.addEventListener("layer", told("layer", (l) => quietly(`layer ${l.name}`, () => showOverlay(l.name))));
  news.addEventListener("refused", told("refused", (r) => { (state.refused = state.refused || []).unshift(r); listSoon(); readInfoSoon(); }));
  news.addEventListener("finish", told("finish", (f) => { say(f.text || `final map: ${f.state}`); readInfoSoon(); }));
  news.addEventListener("map", told("map", readInfoSoon));
};
const watch = () => {
  if (!news) return;
  if (news.readyState === 2 || Date.now() - Math.max(heard, tried) > SILENT_MS) { lost(); listen(); }
  else if (!gone && Date.now() - mended > 10000) { mend(); readMissed(); }
};
setInterval(watch, 2000);
document.addEventListener("visibilitychange", watch);  // a phone that was locked
window.addEventListener("online", () => { gone ? listen() : mend(); });
const catchUp = () => quietly("all", async () => {
  const parts = [quietly("photos", readPhotos), quietly("layers", readOverlays), quietly("files", readFiles)];
  await readInfo();
  await Promise.all([...parts, quietly("control", readControl)]);
  document.dispatchEvent(new Event("connected"));
});
// Not before all scripts of the page are there: what one of them waits for must not have happened before it listens.
document.addEventListener("DOMContentLoaded", () => { readInfo().catch(() => say("the server does not answer")).then(listen); });
window.skyquilt = { map, state };
