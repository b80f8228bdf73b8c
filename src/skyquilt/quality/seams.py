"""Seam disparity: the displacement between two photos where the mosaic changes from one to the
other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.gradients import NOISE, has_texture, noise_in
from skyquilt.imaging.registration import RADIUS, shifts_between
from skyquilt.quality.seam_points import SeamPoint

LEAST_MEASURED = 0.6
"""Share of the attempted points that must be measured for the figures to be reliable."""
SMOOTH = 10.0
"""Percentile of the patches, by their noise, that tells that of measured values: texture of a pixel
looks like noise.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class PatchPairs:
    """The content of two photos around each of n points, orthorectified at the native
    resolution.
    """

    a: NDArray[np.float32]
    """(n, S, S) grey patches of the points' first photos; S about 64."""
    b: NDArray[np.float32]
    """(n, S, S) of their second photos, on the same ground."""
    seen: NDArray[np.bool_]
    """(n,) whether both photos see the whole patch."""


@dataclass(frozen=True, kw_only=True)
class SeamSample:
    """One attempted point."""

    row: float
    """Row in the label raster."""
    column: float
    """Column in the label raster."""
    a: int
    """Label on one side."""
    b: int
    """Label on the other."""
    dx: float
    """Displacement of b's patch against a's in native px, east."""
    dy: float
    """Displacement of b's patch against a's in native px, south."""
    ok: bool
    """False: no reliable displacement was found."""
    reason: str
    """Why not; empty where `ok`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeamReport:
    """Seam disparity of a mosaic; the figures are None where nothing was measured."""

    median_px: float | None
    """Median displacement in px of the native ground resolution."""
    p95_px: float | None
    """95th percentile in px."""
    median_cm: float | None
    """Median in cm on the ground."""
    p95_cm: float | None
    """95th percentile in cm."""
    measured: int
    """Points with a reliable displacement."""
    attempted: int
    """Points with texture whose whole patch lies in both photos."""
    samples: tuple[SeamSample, ...]
    """All points that were tried."""

    @property
    def stands(self) -> bool:
        """Whether enough of the attempted points were measured for the figures to be reliable."""
        return self.measured > 0 and self.measured >= LEAST_MEASURED * self.attempted


def noise_of(pairs: PatchPairs) -> float:
    """Standard deviation of the noise of measured values (degrees, counts, reflectances), from
    patches of them: that of the tenth of the patches that show least, at least what it would be of
    a picture of 0 to 255 to which they are stretched between their 1st and 99th percentile.
    """
    shown = np.concatenate([pairs.a[pairs.seen], pairs.b[pairs.seen]])
    shown = shown[np.isfinite(shown).all((1, 2))]
    if not len(shown):
        return NOISE
    low, high = np.percentile(shown, [1, 99])
    plain = float(np.percentile([noise_in(patch) for patch in shown], SMOOTH))
    return max(plain, NOISE * float(high - low) / 255)


def seam_disparity(
    points: Sequence[SeamPoint],
    pairs: PatchPairs,
    *,
    gsd_m: float,
    radius: int = RADIUS,
    noise: float = NOISE,
) -> SeamReport:
    """Measures the displacement at points of seams, from the pairs of patches centred on them.

    `gsd_m` is the ground size of a patch's pixel in m, `radius` the largest displacement searched
    in px and `noise` the standard deviation of a value in the patches' unit. A weak correlation
    peak is a failed measurement: it counts as attempted.
    """
    if not points:
        return _report([], gsd_m)
    attempt = np.flatnonzero(pairs.seen)
    attempt = attempt[
        has_texture(pairs.a[attempt], noise=noise) & has_texture(pairs.b[attempt], noise=noise)
    ]
    shifts = shifts_between(pairs.a[attempt], pairs.b[attempt], radius=radius)
    samples = [
        SeamSample(
            row=points[k].row,
            column=points[k].column,
            a=points[k].a,
            b=points[k].b,
            dx=shift.dx,
            dy=shift.dy,
            ok=shift.ok,
            reason=shift.reason,
        )
        for k, shift in zip(attempt.tolist(), shifts, strict=True)
    ]
    return _report(samples, gsd_m)


def _report(samples: list[SeamSample], gsd_m: float) -> SeamReport:
    """Figures of the samples."""
    length = np.array([np.hypot(s.dx, s.dy) for s in samples if s.ok])
    median, p95 = np.percentile(length, [50, 95]).tolist() if length.size else (None, None)
    return SeamReport(
        median_px=median,
        p95_px=p95,
        median_cm=None if median is None else median * gsd_m * 100,
        p95_cm=None if p95 is None else p95 * gsd_m * 100,
        measured=len(length),
        attempted=len(samples),
        samples=tuple(samples),
    )
