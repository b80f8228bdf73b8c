"use strict";
// Photos and videos sent from this page, one after the other, in parts (tus 1.0.0). A weak network may lose the connection at
// any moment: what has arrived is not sent again, and nothing is given up but what the server refuses.
const PART = 256 * 1024, PART_MS = 120000, WAITS_MS = [1000, 2000, 4000, 8000, 15000, 30000];
const sending = { queue: [], failed: [], done: 0, total: 0, now: null, sent: 0, size: 0, waits: "" };
const TUS = { "Tus-Resumable": "1.0.0" };
class Refused extends Error {}
const inBase64 = (text) => btoa(String.fromCharCode(...new TextEncoder().encode(text)));
// What the server says against a file; null where the same request may be answered otherwise later.
const objection = async (answer) => {
  const later = answer.status >= 500 && answer.status !== 501 || [404, 408, 409, 423, 425, 429].includes(answer.status);
  const said = await answer.json().catch(() => ({})), why = said.detail || said.reason;
  if (later) { sending.waits = typeof why === "string" ? why : `the server answers ${answer.status}`; return null; }
  return new Refused(typeof why === "string" ? why : `the server answers ${answer.status}`);
};
const tus = async (url, method, headers, body) => {
  const answer = await fetch(url, { method, body, headers: writing({ ...TUS, ...headers }), signal: AbortSignal.timeout(PART_MS) });
  if (answer.ok) return answer;
  const bad = await objection(answer);
  if (bad) throw bad;
  return answer;
};
const begun = async (file) => {
  const about = `filename ${inBase64(file.name)},source ${inBase64("browser")}`;
  const answer = await tus("photos/uploads", "POST", { "Upload-Length": String(file.size), "Upload-Metadata": about });
  // the address below this page, whatever a proxy makes of it
  return answer.ok ? `photos/uploads/${answer.headers.get("Location").split("/").pop()}` : null;
};
const reached = (answer) => Number(answer.headers.get("Upload-Offset"));
// Sends a file; true once the server has it all, false where it has to be tried again. `mine.url` and `sending.sent` tell how far it is.
const attempt = async (mine) => {
  if (!mine.url) {
    mine.url = await begun(mine.file);
    if (!mine.url) return false;
    sending.sent = 0;
  } else {
    const answer = await tus(mine.url, "HEAD", {});
    if (answer.status === 404) { mine.url = null; return attempt(mine); }  // it has expired
    if (!answer.ok) return false;
    sending.sent = reached(answer);
  }
  while (sending.sent < mine.file.size) {
    const part = await mine.file.slice(sending.sent, sending.sent + PART).arrayBuffer().catch(() => { throw new Refused("it cannot be read any more"); });
    const answer = await tus(mine.url, "PATCH", { "Upload-Offset": String(sending.sent), "Content-Type": "application/offset+octet-stream" }, part);
    if (!answer.ok) return false;
    sending.sent = reached(answer);
    sending.waits = "";
    showSending();
  }
  return true;
};
const pause = (ms) => new Promise((go) => {
  const end = () => { clearTimeout(t); window.removeEventListener("online", end); document.removeEventListener("connected", end); go(); };
  const t = setTimeout(end, ms);
  window.addEventListener("online", end);
  document.addEventListener("connected", end);
});
const sendAll = async () => {
  while ((sending.now = sending.queue.shift())) {
    const mine = sending.now;
    sending.sent = 0;
    for (let tries = 0, whole = false; !whole && !mine.stopped; tries++) {
      showSending();
      const before = sending.sent;
      try { whole = await attempt(mine); }
      catch (error) {
        if (error instanceof Refused) { sending.failed.push({ file: mine.file, why: error.message }); break; }
        sending.waits = "the server does not answer";
      }
      if (sending.sent > before) tries = 0;
      if (!whole && !mine.stopped) { showSending(); await pause(WAITS_MS[Math.min(tries, WAITS_MS.length - 1)]); }
    }
    sending.waits = "";
    sending.done++;
  }
  showSending();
};
const send = (files, more = false) => {
  if (!more && !sending.now && !sending.failed.length) { sending.done = 0; sending.total = 0; }
  sending.total += files.length;
  sending.queue.push(...files.map((file) => ({ file, url: null, stopped: false })));
  if (!sending.now) sendAll(); else showSending();
};
const sendAgain = () => {
  const files = sending.failed.map((f) => f.file);
  sending.failed = [];
  sending.total -= files.length;
  sending.done -= files.length;
  send(files, true);
};
const stopSending = () => {
  for (const left of sending.queue) sending.total--;
  sending.queue = [];
  if (sending.now) {
    sending.now.stopped = true;
    sending.total--;
    sending.done--;
    if (sending.now.url) tus(sending.now.url, "DELETE", {}).catch(() => {});
  }
  showSending();
};
const showSending = () => {
  const { now, failed, done, total, waits } = sending, some = now || failed.length || total;
  $("sending").hidden = !some;
  if (!some) return;
  const good = done - failed.length;
  const words = now && !now.stopped ? `Sending ${done + 1} of ${total}: ${now.file.name}` : `${good} of ${total} sent`;
  if ($("sendwords").textContent !== words) $("sendwords").textContent = words;  // read aloud once
  $("sendwaits").textContent = waits && now ? `Waiting: ${waits}. It goes on by itself.` : "";
  $("sent").hidden = !now;
  $("sent").max = Math.max(total, 1);
  $("sent").value = done + (now ? sending.sent / Math.max(now.file.size, 1) : 0);
  $("stopsend").hidden = !now;
  $("resend").hidden = Boolean(now) || !failed.length;
  $("unsent").replaceChildren(...failed.slice(0, 50).map(({ file, why }) => { const li = element("li"), left = element("span", file.name); left.append(element("small", why)); li.append(left); return li; }));
};
$("resend").onclick = sendAgain;
$("stopsend").onclick = stopSending;
window.addEventListener("beforeunload", (e) => { if (sending.now) e.preventDefault(); });
// Files of what was dropped, also those in folders, in the order of their names.
const filesIn = async (dropped) => {
  const entries = [...dropped.items].map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
  if (!entries.some((entry) => entry.isDirectory)) return [...dropped.files];
  const found = [];
  const walk = async (entry) => {
    if (entry.isFile) { found.push(await new Promise((good, bad) => entry.file(good, bad))); return; }
    const reader = entry.createReader();
    for (;;) {  // at most 100 at a time
      const some = await new Promise((good, bad) => reader.readEntries(good, bad));
      if (!some.length) return;
      for (const one of some) if (!one.name.startsWith(".")) await walk(one);
    }
  };
  for (const entry of entries) await walk(entry).catch(() => say(`${entry.name} cannot be read`));
  return found.sort((a, b) => a.name.localeCompare(b.name, "en"));
};
