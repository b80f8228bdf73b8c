() => {
  const out = [], seen = new Set();
  for (const e of document.querySelectorAll("[id]")) { if (seen.has(e.id)) out.push(`two elements have the id ${e.id}`); seen.add(e.id); }
  for (const e of document.querySelectorAll("[tabindex]")) if (e.tabIndex > 0) out.push(`tabindex ${e.tabIndex} of ${e.id || e.tagName}`);
  for (const e of document.querySelectorAll("img:not([alt])")) out.push(`no alt: ${e.src}`);
  for (const e of document.querySelectorAll("[aria-labelledby],[aria-describedby],[aria-controls]")) for (const a of ["aria-labelledby", "aria-describedby", "aria-controls"]) for (const id of (e.getAttribute(a) || "").split(/\s+/).filter(Boolean)) if (!document.getElementById(id)) out.push(`${a} of ${e.id || e.tagName} names ${id}, which is not there`);
  for (const e of document.querySelectorAll("th")) if (!e.closest("table").querySelector("td")) out.push("a table without cells");
  if (!document.documentElement.lang) out.push("the page has no language");
  if (!document.title) out.push("the page has no title");
  let level = 0;
  for (const h of document.querySelectorAll("h1,h2,h3,h4")) { if (!h.offsetParent) continue; const n = Number(h.tagName[1]); if (n > level + 1) out.push(`heading level ${n} after ${level}: ${h.textContent.slice(0, 40)}`); level = n; }
  return out;
}
// ---
() => {
  const parse = (c) => { const m = c.match(/[\d.]+/g).map(Number); return [m[0], m[1], m[2], m.length > 3 ? m[3] : 1]; };
  const light = ([r, g, b]) => { const f = (v) => { v /= 255; return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }; return 0.2126 * f(r) + 0.7152 * f(g) + 0.0722 * f(b); };
  const ratio = (a, b) => { const [x, y] = [light(a), light(b)].sort((p, q) => q - p); return (x + 0.05) / (y + 0.05); };
  const ground = (e) => { const stack = []; for (let n = e; n; n = n.parentElement) { const s = getComputedStyle(n); if (s.backgroundImage !== "none") return null; const c = parse(s.backgroundColor); stack.push(c); if (c[3] === 1) break; } let base = stack.pop(); if (base[3] < 1) base = matchMedia("(prefers-color-scheme: dark)").matches ? [18, 18, 18, 1] : [255, 255, 255, 1]; for (const c of stack.reverse()) base = [0, 1, 2].map((k) => c[k] * c[3] + base[k] * (1 - c[3])).concat(1); return base; };
  const out = [];
  for (const e of document.querySelectorAll("body *")) {
    if (e.closest("svg") || e.closest("#map") || !e.offsetParent || e.disabled) continue;
    const text = [...e.childNodes].filter((n) => n.nodeType === 3).map((n) => n.textContent.trim()).join("");
    if (!text) continue;
    const s = getComputedStyle(e), box = e.getBoundingClientRect();
    if (s.visibility === "hidden" || Number(s.opacity) < 0.9 || box.width < 2 || box.height < 2) continue;
    const back = ground(e);
    if (!back) continue;
    const found = ratio(parse(s.color), back), size = parseFloat(s.fontSize), large = size >= 24 || (size >= 18.6 && Number(s.fontWeight) >= 700);
    if (found < (large ? 3 : 4.5)) out.push(`contrast ${found.toFixed(2)}: ${text.slice(0, 40)} (${s.color} on ${back.slice(0, 3).map(Math.round)})`);
  }
  return [...new Set(out)];
}
// ---
() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const box = e.getBoundingClientRect(), s = getComputedStyle(e);
  const all = [...document.querySelectorAll("*")];
  return { what: e.id || `${e.tagName} ${(e.textContent || "").trim().slice(0, 30)}`, at: all.indexOf(e), seen: box.width > 0 && box.height > 0, outline: s.outlineStyle !== "none" || s.boxShadow !== "none" };
}
