"""Random areas and hills, and a judge of coverage by rays that shares no code with the planner."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import rasterio
from shapely import LineString, MultiPoint, Point, Polygon, box, union_all
from shapely.affinity import rotate, translate

from skyquilt.model.camera import Camera

EAST, NORTH = 400_000.0, 5_800_000.0
CAMERAS = {
    "20 MP": Camera(width=5472, height=3648, focal=3648, cx=2735.5, cy=1823.5),
    "12 MP, distorted": Camera(
        width=4000, height=3000, focal=2310, cx=2010, cy=1480, k1=-0.12, k2=0.06, p1=0.0008,
        p2=-0.0005,
    ),
    "thermal": Camera(width=640, height=512, focal=772, cx=321, cy=256, k1=-0.2, k2=0.05),
}  # fmt: skip
KINDS = ("rectangle", "concave", "hole", "several", "sliver", "corridor")


@dataclass(frozen=True)
class Hills:
    """Ground as a sum of waves; `relief` m from bottom to top."""

    relief: float
    seed: int

    def at(self, x, y):
        """Heights in m."""
        rng = np.random.default_rng(self.seed)
        z = np.zeros(np.broadcast(x, y).shape)
        for length in (350.0, 520.0, 900.0):
            a, p = rng.uniform(0, 2 * np.pi, 2)
            k = 2 * np.pi / length
            z = z + np.sin(k * (np.cos(a) * (x - EAST) + np.sin(a) * (y - NORTH)) + p)
        return 200.0 + self.relief / 6 * z

    def write(self, path, area):
        """A GeoTIFF of 2 m cells around an area."""
        west, south, east, north = area.buffer(150).bounds
        cols, rows = int((east - west) / 2), int((north - south) / 2)
        x = west + 2 * (np.arange(cols) + 0.5)
        y = north - 2 * (np.arange(rows) + 0.5)
        z = self.at(*np.meshgrid(x, y)).astype(np.float32)
        with rasterio.open(
            path, "w", driver="GTiff", width=cols, height=rows, count=1, dtype="float32",
            crs="EPSG:32633", transform=rasterio.transform.from_origin(west, north, 2, 2),
        ) as raster:  # fmt: skip
            raster.write(z, 1)


def area_of(kind, rng):
    """A random area around the place."""
    w, h = rng.uniform(60, 350, 2)
    if kind == "rectangle":
        shape = box(0, 0, w, h)
    elif kind == "concave":
        r = rng.uniform(0.35, 1, 11) * rng.uniform(80, 220)
        t = np.sort(rng.uniform(0, 2 * np.pi, 11))
        shape = Polygon(np.column_stack([r * np.cos(t), r * np.sin(t)])).buffer(0)
        shape = max(getattr(shape, "geoms", [shape]), key=lambda s: s.area)
    elif kind == "hole":
        shape = box(0, 0, w + 100, h + 100)
        hole = Point(rng.uniform(60, w + 40), rng.uniform(60, h + 40)).buffer(
            rng.uniform(20, 50), 6
        )
        shape = shape.difference(hole)
    elif kind == "several":
        blobs = [
            MultiPoint(rng.uniform(0, 120, (7, 2))).convex_hull for _ in range(rng.integers(2, 4))
        ]
        shape = union_all([translate(b, *rng.uniform(-250, 250, 2)) for b in blobs])
    elif kind == "sliver":
        shape = box(0, 0, rng.uniform(150, 600), rng.uniform(0.5, 8))
    else:
        steps = np.array([80, 30]) + rng.normal(0, 90, (5, 2))
        shape = LineString(np.cumsum(steps, axis=0)).buffer(
            rng.uniform(5, 30), cap_style="flat", join_style="mitre", mitre_limit=2
        )
    return translate(rotate(shape, rng.uniform(0, 180)), EAST, NORTH)


def views_by_rays(camera, points, ground, places):
    """Number of photos that see each place (n, 2): projected with OpenCV, with the line of sight
    followed over the ground in steps.
    """
    z = ground.at(places[:, 0], places[:, 1])
    spots = np.column_stack([places, z])
    seen = np.zeros(len(spots), int)
    K = np.array([[camera.focal, 0, camera.cx], [0, camera.focal, camera.cy], [0, 0, 1]])
    k = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    for p in points:
        near = np.hypot(spots[:, 0] - p.x, spots[:, 1] - p.y) < 1.3 * (p.z - z)
        if not near.any():
            continue
        yaw = math.radians(p.yaw)
        ahead = np.array([math.sin(yaw), math.cos(yaw), 0])
        right = np.array([math.cos(yaw), -math.sin(yaw), 0])
        R = np.stack([right, -ahead, [0, 0, -1.0]])
        here = (spots[near] - [p.x, p.y, p.z]) @ R.T
        px = cv2.projectPoints(here, np.zeros(3), np.zeros(3), K, k)[0][:, 0]
        ok = (
            (px[:, 0] >= -0.5) & (px[:, 0] <= camera.width - 0.5)
            & (px[:, 1] >= -0.5) & (px[:, 1] <= camera.height - 0.5)
        )  # fmt: skip
        share = np.linspace(0.02, 0.98, 60)[None, :]
        s = spots[near]
        x, y, h = (c + (s[:, i, None] - c) * share for i, c in enumerate((p.x, p.y, p.z)))
        ok &= (ground.at(x, y) <= h + 0.05).all(axis=1)
        seen[np.flatnonzero(near)[ok]] += 1
    return seen


def places_in(area, rng, number=700):
    """Random places of an area, many of them on its rim."""
    west, south, east, north = area.bounds
    xy = rng.uniform([west, south], [east, north], (number * 12, 2))
    inner = [p for p in xy if area.covers(Point(p))][:number]
    parts = getattr(area, "geoms", [area])
    rim = [np.array(r.interpolate(t, normalized=True).coords[0])
           for p in parts for r in (p.exterior, *p.interiors)
           for t in rng.uniform(0, 1, 120)]  # fmt: skip
    return np.array([*inner, *rim])


def perfect(width, height, settings, along, across):
    """Points of the perfect grid over the rectangle grown by the margins, the better way round."""
    f, s = 1 - settings.overlap / 100, 1 - settings.sidelap / 100
    n, m = math.floor(1 / f + 1e-6), math.floor(1 / s + 1e-6)
    d, e = min(f * along, along / n), min(s * across, across / m)
    margin_d, margin_e = along / 2 - d, across / 2 - e
    ways = [(width, height), (height, width)]
    return min(
        (math.ceil((a + 2 * margin_d) / d - 1e-9) + 1)
        * (math.ceil((b + 2 * margin_e) / e - 1e-9) + 1)
        for a, b in ways
    )
