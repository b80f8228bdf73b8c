"""Map error: displacement between a mosaic's content and the same content in a true orthophoto."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

from skyquilt.imaging.gradients import NOISE, has_texture
from skyquilt.imaging.registration import RADIUS, Shift, shifts_between
from skyquilt.quality.ground_error import patches

SIZE = 64
"""Side of a patch in px."""
LEAST_KNOWN = 0.7
"""Share of a coarse patch that must be known in both rasters; in the last level, all of it."""
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MapSample:
    """One attempted point."""

    x: float
    """Easting in m in the mosaic."""
    y: float
    """Northing in m in the mosaic."""
    error_x_m: float
    """Mosaic minus truth, east, in m."""
    error_y_m: float
    """Mosaic minus truth, north, in m."""
    ok: bool
    """False: no reliable displacement was found."""
    reason: str
    """Why not; empty where `ok`."""


@dataclass(frozen=True, kw_only=True)
class ErrorFigures:
    """Median and 95th percentile of horizontal errors."""

    median_px: float
    """Median in px of the mosaic."""
    p95_px: float
    """95th percentile in px."""
    median_m: float
    """Median in m."""
    p95_m: float
    """95th percentile in m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapError:
    """Errors of a mosaic; None where nothing was measured."""

    absolute: ErrorFigures | None
    """Errors of the coordinates as they are."""
    relative: ErrorFigures | None
    """Errors after the bias is removed, that is, after a shift of the whole map."""
    bias_x_m: float | None
    """Median error, east, in m."""
    bias_y_m: float | None
    """Median error, north, in m."""
    measured: int
    """Points with a reliable displacement."""
    attempted: int
    """Points where both rasters are known and the truth has texture."""
    samples: tuple[MapSample, ...]
    """All points that were tried."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Level:
    """Points compared at one ground resolution."""

    offset: Array
    """(n, 2) truth minus mosaic in m, east and north; valid where `found`."""
    attempted: NDArray[np.bool_]
    """(n,) both rasters known, and textured."""
    found: NDArray[np.bool_]
    """(n,) the displacement is reliable."""
    reason: list[str]
    """Why it is not."""


def map_error(
    mosaic: Path, truth: Path, *, points: int = 400, search_m: float = 10.0, noise: float = NOISE
) -> MapError:
    """Errors of a GeoTIFF against another in the same CRS, at about `points` places on a regular
    grid.

    The search runs from coarse to fine: first over all displacements up to `search_m`, then around
    the displacement on which neighbouring points agree. `noise`: standard deviation of a value's
    noise, in the rasters' unit.
    """
    with rasterio.open(mosaic) as m, rasterio.open(truth) as t:
        _check(m, t)
        gsd = float(m.transform.a)
        places = _places(m, t, points)
        guess = np.zeros_like(places)
        for factor in (factors := _factors(gsd, search_m)):
            level = _compare(
                m,
                t,
                places,
                guess,
                factor,
                radius=16 if factor == factors[0] else RADIUS,
                noise=noise,
            )
            if factor > 1:
                guess = _agreed(places, level, guess)
    return _report(places, level, gsd)


def _check(m: rasterio.DatasetReader, t: rasterio.DatasetReader) -> None:
    """Refuses rasters that cannot be compared."""
    if m.crs != t.crs:
        raise ValueError(f"the mosaic is in {m.crs}, the truth in {t.crs}: one CRS expected")
    for raster in (m, t):
        a = raster.transform
        if a.b or a.d or a.a <= 0 or abs(a.a + a.e) > 1e-6 * a.a:
            raise ValueError(f"{raster.name}: a north-up raster with square pixels expected")


def _places(m: rasterio.DatasetReader, t: rasterio.DatasetReader, points: int) -> Array:
    """About `points` pixel corners (n, 2) of the mosaic, on a regular grid over the common area, in
    m.
    """
    west, south = max(m.bounds.left, t.bounds.left), max(m.bounds.bottom, t.bounds.bottom)
    east, north = min(m.bounds.right, t.bounds.right), min(m.bounds.top, t.bounds.top)
    if west >= east or south >= north:
        raise ValueError(
            f"the mosaic {tuple(m.bounds)} and the truth {tuple(t.bounds)} do not overlap"
        )
    spacing = np.sqrt((east - west) * (north - south) / points)
    x, y = (
        low + (np.arange(n := max(1, round((high - low) / spacing))) + 0.5) * (high - low) / n
        for low, high in ((west, east), (south, north))
    )
    place = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    corner = np.array([m.bounds.left, m.bounds.top])
    return np.asarray(corner + np.round((place - corner) / m.transform.a) * m.transform.a)


def _factors(gsd: float, search_m: float) -> list[int]:
    """Pixel sizes of the levels in px of the mosaic: `search_m` is at most 16 px of the first, the
    last is 1.
    """
    factors = [max(1, int(np.ceil(search_m / (16 * gsd))))]
    while factors[-1] > 1:
        factors.append(max(1, factors[-1] // 4))
    return factors


def _compare(
    m: rasterio.DatasetReader,
    t: rasterio.DatasetReader,
    places: Array,
    guess: Array,
    factor: int,
    *,
    radius: int,
    noise: float,
) -> _Level:
    """Searches for the mosaic's patches in the truth around places + guess."""
    gsd = m.transform.a * factor
    a, known_a = zip(*patches(m, places, gsd, SIZE), strict=True)
    b, known_b = zip(*patches(t, places + guess, gsd, SIZE), strict=True)
    least = LEAST_KNOWN if factor > 1 else 1.0
    attempted = (np.minimum(known_a, known_b) >= least) & has_texture(np.array(b), noise=noise)
    pick = np.flatnonzero(attempted)
    shifts = shifts_between(np.array(a)[pick], np.array(b)[pick], radius=radius)
    found, offset, reason = np.zeros(len(places), bool), guess.copy(), [""] * len(places)
    for k, shift in zip(pick.tolist(), shifts, strict=True):
        found[k], reason[k] = shift.ok, shift.reason
        offset[k] += _metres(shift, gsd)
    return _Level(offset=offset, attempted=attempted, found=found, reason=reason)


def _metres(shift: Shift, gsd: float) -> Array:
    """East and north in m."""
    return np.array([shift.dx, -shift.dy]) * gsd


def _agreed(places: Array, level: _Level, guess: Array) -> Array:
    """(n, 2) median displacement of the five nearest points that were found; the guess if none
    was.
    """
    if not level.found.any():
        return guess
    at, offset = places[level.found], level.offset[level.found]
    distance = ((places[:, None] - at[None]) ** 2).sum(-1)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :5]
    return np.asarray(np.median(offset[nearest], axis=1))


def _report(places: Array, level: _Level, gsd: float) -> MapError:
    """Figures of the last level."""
    samples = tuple(
        MapSample(
            x=float(places[k, 0]),
            y=float(places[k, 1]),
            error_x_m=float(-level.offset[k, 0]),
            error_y_m=float(-level.offset[k, 1]),
            ok=bool(level.found[k]),
            reason=level.reason[k],
        )
        for k in np.flatnonzero(level.attempted)
    )
    error = -level.offset[level.found]
    bias = np.median(error, axis=0) if len(error) else None
    return MapError(
        absolute=None if bias is None else _figures(error, gsd),
        relative=None if bias is None else _figures(error - bias, gsd),
        bias_x_m=None if bias is None else float(bias[0]),
        bias_y_m=None if bias is None else float(bias[1]),
        measured=len(error),
        attempted=len(samples),
        samples=samples,
    )


def _figures(error: Array, gsd: float) -> ErrorFigures:
    """Figures of errors (n, 2) in m."""
    median, p95 = np.percentile(np.hypot(error[:, 0], error[:, 1]), [50, 95]).tolist()
    return ErrorFigures(median_px=median / gsd, p95_px=p95 / gsd, median_m=median, p95_m=p95)
