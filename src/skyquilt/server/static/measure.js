"use strict";
// Lengths and areas on the WGS 84 ellipsoid's authalic and mean spheres: better than 0.5 % anywhere, and the
// local scale of the ellipsoid for anything that a drone can see.
const Measure = (() => {
  const A = 6378137, E2 = 0.00669437999014, RAD = Math.PI / 180;
  // metres per degree at a latitude, north and east
  const scale = (lat) => {
    const s = Math.sin(lat * RAD), w = 1 - E2 * s * s;
    return [A * (1 - E2) / Math.pow(w, 1.5) * RAD, A / Math.sqrt(w) * Math.cos(lat * RAD) * RAD];
  };
  const step = (a, b) => {
    const [north, east] = scale((a.lat + b.lat) / 2);
    return Math.hypot((b.lat - a.lat) * north, (b.lng - a.lng) * east);
  };
  const length = (points) => points.slice(1).reduce((sum, p, k) => sum + step(points[k], p), 0);
  const area = (points) => {
    if (points.length < 3) return 0;
    const [north, east] = scale(points.reduce((s, p) => s + p.lat, 0) / points.length);
    const xy = points.map((p) => [(p.lng - points[0].lng) * east, (p.lat - points[0].lat) * north]);
    return Math.abs(xy.reduce((sum, [x, y], k) => {
      const [u, v] = xy[(k + 1) % xy.length];
      return sum + x * v - u * y;
    }, 0)) / 2;
  };
  const inMetres = (m) => m < 1000 ? `${m.toFixed(m < 10 ? 2 : 1)} m` : `${(m / 1000).toFixed(3)} km`;
  const inSquare = (a) => a < 10000 ? `${a.toFixed(1)} m²` : `${(a / 10000).toFixed(3)} ha`;
  return { length, area, inMetres, inSquare };
})();
