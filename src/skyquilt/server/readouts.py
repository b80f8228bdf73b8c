"""What a map says at a place: coordinates and values; heights along a line; volumes."""

import math
from typing import Annotated, Any

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Query
from numpy.typing import NDArray

from skyquilt.outside import real
from skyquilt.raster.map_source import MapSource, between, values
from skyquilt.server.access import Context
from skyquilt.server.images import Images
from skyquilt.server.photo_endpoints import Degrees, Latitude

HEIGHTS = ("heights", "finished-heights")
"""Layers from which heights are read, the first that is there."""
MOST_VERTICES = 200
MOST_SAMPLES = 600
"""Points of a profile."""
MOST_CELLS = 2048
"""Cells along the longer side of the area of a volume."""
Place = tuple[float, float]
"""Longitude and latitude in degrees."""


class Readouts:
    """Endpoints that read the map's values; two at a time."""

    def __init__(self, context: Context, images: Images) -> None:
        self.context, self.images = context, images
        self._reading = CapacityLimiter(2)

    async def at(
        self, lon: Degrees, lat: Latitude, crs: Annotated[str | None, Query(max_length=60)] = None
    ) -> dict[str, Any]:
        """A place in the map's projection, or in `crs` (EPSG:...), and the value of every measured
        layer there, with its unit.
        """
        return await to_thread.run_sync(self._at, lon, lat, crs, limiter=self._reading)

    def _at(self, lon: float, lat: float, crs: str | None) -> dict[str, Any]:
        layers = self.context.survey.layers()
        found: dict[str, Any] = {"lon": lon, "lat": lat, "crs": None, "x": None, "y": None}
        told = []
        for name, source in layers.items():
            x, y = between("EPSG:4326", source.crs).transform(lon, lat)
            if found["crs"] is None and math.isfinite(x) and math.isfinite(y):
                found |= {"crs": source.crs, "x": round(x, 3), "y": round(y, 3)}
            style = self.images.style(name)
            if style.measured and (value := value_at(source, x, y)) is not None:
                told.append(
                    {
                        "layer": name,
                        "title": style.title,
                        "value": round(value, 3),
                        "unit": self.images.unit(name),
                    }
                )
        if crs is not None:
            found |= _in_crs(crs, lon, lat)
        return found | {"values": told}

    async def profile(self, line: Annotated[str, Query(max_length=20_000)]) -> dict[str, Any]:
        """Heights along a line (lon,lat;lon,lat;...): distance and height in m, null where there is
        none.
        """
        return await to_thread.run_sync(self._profile, line, limiter=self._reading)

    def _profile(self, line: str) -> dict[str, Any]:
        name, source = self._heights()
        xy = _projected(places_in(line, 2), source)
        reach = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        if reach[-1] <= 0:
            raise HTTPException(400, "the line has no length")
        at = np.linspace(0, reach[-1], MOST_SAMPLES)
        x, y = np.interp(at, reach, xy[:, 0]), np.interp(at, reach, xy[:, 1])
        step = max(float(reach[-1]) / MOST_SAMPLES, 1e-3)
        z = _sampled(source, x, y, step)
        heights = [None if not np.isfinite(v) else round(float(v), 3) for v in z]
        return {
            "distance_m": [round(float(d), 3) for d in at],
            "height_m": heights,
            "unit": self.images.unit(name),
        }

    async def volume(
        self,
        ring: Annotated[str, Query(max_length=20_000)],
        level: Annotated[float | None, Query(ge=-1e4, le=1e4, allow_inf_nan=False)] = None,
    ) -> dict[str, Any]:
        """Volume in m3 above and below a plane through the heights along the ring, or a level in m,
        within a polygon (lon,lat;lon,lat;...).
        """
        return await to_thread.run_sync(self._volume, ring, level, limiter=self._reading)

    def _volume(self, ring: str, level: float | None) -> dict[str, Any]:
        name, source = self._heights()
        xy = _projected(places_in(ring, 3), source)
        low, high = xy.min(0), xy.max(0)
        own = getattr(source, "resolution", lambda: 0.05)()
        step = max(float((high - low).max()) / MOST_CELLS, own)
        columns, rows = (max(2, math.ceil(v / step)) for v in high - low)
        box = (low[0], high[1] - rows * step, low[0] + columns * step, high[1])
        read = values(source, source.crs, box, columns, rows)
        if read is None:
            raise HTTPException(404, "there are no heights within this area")
        z, shown = read[0][..., 0].astype(np.float64), read[1]
        px = np.column_stack([(xy[:, 0] - box[0]) / step, (box[3] - xy[:, 1]) / step]) - 0.5
        inside = np.zeros(z.shape, np.uint8)
        shift = 8  # edges to a 256th of a cell
        cv2.fillPoly(inside, [np.rint(px * 2**shift).astype(np.int32)], 1, shift=shift)
        known = (inside > 0) & shown & np.isfinite(z)
        if not known.any():
            raise HTTPException(404, "there are no heights within this area")
        base = np.full(z.shape, level) if level is not None else _plane(z, inside > 0, known)
        off = (z - base)[known] * step**2
        return {
            "area_m2": round(float(known.sum()) * step**2, 2),
            "above_m3": round(float(off[off > 0].sum()), 2),
            "below_m3": round(float(-off[off < 0].sum()), 2),
            "unknown_m2": round(float((inside > 0).sum() - known.sum()) * step**2, 2),
            "level_m": round(float(base[known].mean()), 3),
            "unit": self.images.unit(name),
        }

    def _heights(self) -> tuple[str, MapSource]:
        layers = self.context.survey.layers()
        for name in HEIGHTS:
            if name in layers:
                return name, layers[name]
        raise HTTPException(404, "this map has no heights; the final map of a flight has")


def value_at(source: MapSource, x: float, y: float) -> float | None:
    """The value of a map at a place in its projection; None where it has none."""
    bounds = source.bounds()
    if bounds is None or not (bounds[0] <= x < bounds[2] and bounds[1] < y <= bounds[3]):
        return None
    step = getattr(source, "resolution", lambda: 1e-3)()
    part = source.part((x - step, y - step, x + step, y + step), step)
    if part is None:
        return None
    c, r = int((x - part.west) / part.gsd), int((part.north - y) / part.gsd)
    rows, columns = part.shown.shape
    if not (0 <= r < rows and 0 <= c < columns) or not part.shown[r, c]:
        return None
    return float(part.pixels[r, c, 0])


def _in_crs(crs: str, lon: float, lat: float) -> dict[str, Any]:
    """A place in another coordinate system."""
    from pyproj.exceptions import CRSError

    try:
        x, y = between("EPSG:4326", crs).transform(lon, lat)
    except CRSError as error:
        raise HTTPException(400, "crs is a coordinate system such as EPSG:32633") from error
    if not (math.isfinite(x) and math.isfinite(y)):
        raise HTTPException(400, "the place lies outside this coordinate system")
    return {"crs": crs, "x": round(x, 8), "y": round(y, 8)}


def places_in(text: str, least: int) -> list[Place]:
    """Places from `lon,lat;lon,lat;...`.

    Raises:
        HTTPException: they are too few or too many, or no places.
    """
    parts = text.split(";", MOST_VERTICES)
    if not least <= len(parts) <= MOST_VERTICES:
        raise HTTPException(400, f"from {least} to {MOST_VERTICES} places are needed")
    found = []
    for part in parts:
        words = part.split(",")
        lon = real(words[0], -180, 180) if len(words) == 2 else None
        lat = real(words[1], -90, 90) if len(words) == 2 else None
        if lon is None or lat is None:
            raise HTTPException(400, "a place is lon,lat in degrees")
        found.append((lon, lat))
    return found


def _projected(places: list[Place], source: MapSource) -> NDArray[np.float64]:
    at = np.array(places)
    x, y = between("EPSG:4326", source.crs).transform(at[:, 0], at[:, 1])
    xy = np.column_stack([x, y])
    if not np.isfinite(xy).all():
        raise HTTPException(400, "a place lies outside the map's projection")
    return xy


def _sampled(
    source: MapSource, x: NDArray[np.float64], y: NDArray[np.float64], step: float
) -> NDArray[np.float64]:
    """Heights at places, NaN where there are none."""
    own = getattr(source, "resolution", lambda: 0.05)()
    step = max(step, own)
    box = (x.min() - step, y.min() - step, x.max() + step, y.max() + step)
    size = max(box[2] - box[0], box[3] - box[1])
    part = source.part(box, max(step, size / MOST_CELLS))
    z = np.full(x.shape, np.nan)
    if part is None:
        return z
    c = ((x - part.west) / part.gsd).astype(int)
    r = ((part.north - y) / part.gsd).astype(int)
    rows, columns = part.shown.shape
    good = (c >= 0) & (c < columns) & (r >= 0) & (r < rows)
    good[good] = part.shown[r[good], c[good]]
    z[good] = part.pixels[r[good], c[good], 0]
    return z


def _plane(
    z: NDArray[np.float64], inside: NDArray[np.bool_], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The plane through the heights along the edge of an area, by least squares."""
    core = cv2.erode(inside.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)
    edge = known & (core == 0)
    rows, columns = np.nonzero(edge if edge.sum() >= 3 else known)
    ones = np.ones(len(rows))
    found, *_ = np.linalg.lstsq(
        np.column_stack([columns, rows, ones]), z[rows, columns], rcond=None
    )
    r, c = np.mgrid[: z.shape[0], : z.shape[1]]
    return np.asarray(found[0] * c + found[1] * r + found[2])
