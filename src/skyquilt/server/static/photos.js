"use strict";
// Photos: their list, tracks and footprints; those that show a place, with a thumbnail and the place marked.
const timeOf = (p) => p.time || p.received || 0;
const until = () => {
  const all = [...state.photos.values()].map(timeOf).filter(Boolean), share = Number($("time").value) / 1000;
  const low = Math.min(...all), high = Math.max(...all);
  $("slider").hidden = !(all.length > 1 && high > low);
  if (share === 1 || !all.length) { $("until").textContent = state.info && state.info.growing ? "now" : "the end"; return Infinity; }
  const t = low + share * (high - low);
  // times without an offset count as UTC, so that they are shown as the camera wrote them
  $("until").textContent = new Date(t * 1000).toLocaleTimeString([], { timeZone: "UTC" });
  return t;
};
const listPhotos = () => {
  const limit = until(), rows = [];
  outlines.clearLayers(); trails.clearLayers();
  const bySource = new Map(), photos = [...state.photos.values()];
  for (const p of photos) {
    if (timeOf(p) > limit || p.state === "superseded") continue;
    if (p.ring && p.ring.length) L.polygon(p.ring.map(([x, y]) => [y, x]), { color: "#000", weight: 1, fill: false, interactive: false }).addTo(outlines);
    if (p.at) { if (!bySource.has(p.source)) bySource.set(p.source, []); bySource.get(p.source).push(p); }
  }
  let k = 0;
  for (const flown of bySource.values()) {
    const color = colours[k++ % colours.length];
    const line = flown.sort((a, b) => timeOf(a) - timeOf(b) || a.id - b.id).map((p) => [p.at[1], p.at[0]]);
    L.polyline(line, { color: "#fff", weight: 7, interactive: false }).addTo(trails);  // dark ground in sunlight would hide the track
    L.polyline(line, { color, weight: 3, interactive: false }).addTo(trails);
    for (const at of line.slice(-400)) L.circleMarker(at, { radius: 4, color, fillColor: "#fff", fillOpacity: 1, interactive: false }).addTo(trails);
  }
  state.tracks = [...bySource.values()].map((flown) => flown.map((p) => p.id));
  for (const p of [...photos].reverse().slice(0, 300)) {
    const li = element("li"), left = element("span", p.name), right = element("span", p.state, `state ${p.state}`);
    if (p.reason && p.state !== "refined") left.append(element("small", p.reason));
    li.append(left, right);
    li.dataset.id = p.id;
    if (p.at) choosable(li, () => map.panTo([p.at[1], p.at[0]]));
    rows.push(li);
  }
  for (const p of (state.refused || []).slice(0, 100)) {
    const li = element("li"), left = element("span", p.name);
    left.append(element("small", p.reason));
    li.append(left, element("span", p.state || "refused", "state refused"));
    rows.unshift(li);
  }
  const held = $("photos").contains(document.activeElement) ? document.activeElement.closest("li").dataset.id : null;
  $("photos").replaceChildren(...rows);
  const again = held && $("photos").querySelector(`li[data-id="${held}"] button`);
  if (again) again.focus({ preventScroll: true });  // the list is made anew while the map grows
  document.dispatchEvent(new Event("photoslisted"));
};
let listing = null;
const listSoon = () => { if (!listing) listing = setTimeout(() => { listing = null; listPhotos(); }, 250); };
const readPhotos = async () => {
  const meanwhile = state.meanwhile = [];  // news that come during a slow answer may not be in it
  const said = await asked("photos");
  state.photos = new Map(said.photos.map((p) => [p.id, p]));
  state.refused = said.refused;
  if (state.meanwhile === meanwhile) state.meanwhile = null;
  meanwhile.forEach(photoNews);
  listPhotos();
};
$("time").oninput = listPhotos;

const ringOf = (p) => p.ring.map(([x, y]) => [y, x]);
const photosHere = async (at) => {
  const said = await asked(`photos?lon=${at.lng}&lat=${at.lat}`);
  $("here").hidden = false;
  fold(false);  // the answer is in the panel
  const mark = (p, li) => {
    for (const other of $("covering").children) { other.classList.remove("chosen"); for (const img of other.querySelectorAll("img")) img.remove(); }
    li.classList.add("chosen");
    const img = element("img", undefined, "thumb");
    img.alt = `photo ${p.name}, reduced`;
    img.src = `photos/${p.id}/thumbnail`;
    img.onerror = () => img.remove();
    img.onclick = (e) => { e.stopPropagation(); showBig(p, at); };
    li.append(img);
    marked.clearLayers();
    L.circleMarker(at, { radius: 8, color: "#ff9d00", weight: 4 }).addTo(marked);
    L.polygon(ringOf(p), { color: "#ff9d00", weight: 4, fill: false }).addTo(marked);
  };
  const rows = said.photos.map((p) => {
    const li = element("li"), open = element("a", "full size", "button");
    open.href = `photos/${p.id}/file`; open.target = "_blank"; open.rel = "noopener";
    open.onclick = (e) => { e.stopPropagation(); if (!e.ctrlKey && !e.metaKey) { e.preventDefault(); showBig(p, at); } };
    li.append(element("span", p.name), open);
    return choosable(li, () => mark(p, li));
  });
  $("covering").replaceChildren(...(rows.length ? rows : [element("li", "no photo covers this point")]));
  if (rows.length) mark(said.photos[0], rows[0]);
  $("here").scrollIntoView({ block: "start" });
  const told = await asked(`at?lon=${at.lng}&lat=${at.lat}`).catch(() => ({ values: [], crs: null }));
  const lines = [degrees(at), ...(told.crs ? [`${told.crs} ${told.x.toFixed(2)} ${told.y.toFixed(2)}`] : []), ...told.values.map(valueText)];
  $("values").replaceChildren(...lines.map((text) => element("p", text)));
};
// A photo in full, with the place marked; it can be scrolled, and Escape closes it.
const showBig = async (p, at) => {
  const box = $("big"), sheet = element("div", undefined, "sheet"), img = element("img");
  img.alt = `photo ${p.name}`;
  img.src = `photos/${p.id}/file`;
  const close = button("Close", () => box.close()), open = element("a", "in a tab of its own", "button");
  open.href = img.src; open.target = "_blank"; open.rel = "noopener";
  const head = element("header");
  head.append(element("strong", p.name), open, close);
  img.onerror = () => say("the photo cannot be loaded");
  sheet.append(img);
  sheet.tabIndex = 0;
  sheet.setAttribute("role", "group");
  sheet.setAttribute("aria-label", "photo: arrow keys move it");
  box.replaceChildren(head, sheet);
  if (!box.open) box.showModal();
  await quietly("place", async () => {
    const place = await asked(`photos/${p.id}/place?lon=${at.lng}&lat=${at.lat}`), ring = element("i", undefined, "spot");
    ring.style.left = `${100 * (place.x + 0.5) / place.width}%`;
    ring.style.top = `${100 * (place.y + 0.5) / place.height}%`;
    sheet.append(ring);
    const centre = () => ring.scrollIntoView({ block: "center", inline: "center" });
    img.complete ? centre() : (img.onload = centre);
  });
};
