"""Disparities of linked photos after their homography, signed along the baseline: heights above the
dominant plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, hstack
from scipy.sparse.linalg import lsmr

from skyquilt.geometry.camera import rays
from skyquilt.geometry.transforms import transfer
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import on_ground
from skyquilt.matching.levelled import WORKING_WIDTH, Level, disparities, threshold_px
from skyquilt.matching.ransac import Ransac
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features, Link
from skyquilt.ortho.tie_surface import level

Array = NDArray[np.float64]


def heights_above_plane(
    d: Array, w: Array, b_T: Array, depth: Array, height_a: float
) -> tuple[Array, Array, Array]:
    """Heights (n,) above the plane, disparities (n,) along the baseline and (n,) across it.

    `d` (n, 2): disparities in photo b, units of the focal length; `w` (n, 2): positions of the
    points predicted by the plane's homography, same unit, undistorted; `b_T` (3,): centre of photo
    a in camera coordinates of b; `depth` (n,): depth of the plane in b at w, `height_a`: height of
    a above the plane, all in the same unit, which is also that of the heights. NaN where the
    baseline points at the point itself. Disparities are positive for points above the plane.
    """
    g = b_T[:2] - w * b_T[2]
    long = np.linalg.norm(g, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (d * g).sum(1) / long
        across = (d[:, 0] * g[:, 1] - d[:, 1] * g[:, 0]) / long
        s = along / long
        share = s * depth / (1 + s * (depth - b_T[2]))
    return np.asarray(share * height_a), np.asarray(along), np.asarray(across)


@dataclass(frozen=True, kw_only=True)
class OnePlane:
    """Least squares for the height of each cell of the ground and a plane for each pair, outliers
    down-weighted.
    """

    cells: int = 60
    """Cells along the longer side."""
    damping: float = 1e-3
    """Weight of a prior of zero for planes and heights, which holds undetermined ones."""
    rounds: int = 4
    """Rounds of reweighting (Cauchy's function)."""
    version: ClassVar[int] = 1

    def __call__(self, fields: Sequence[Array]) -> Array:
        """All points (n, 3): x, y, height in m, from those of the pairs (n_k, 3), without a general
        slope.
        """
        xyz = np.concatenate(fields)
        owner = np.repeat(np.arange(len(fields)), [len(f) for f in fields])
        middle, extent = xyz[:, :2].mean(0), max(float(np.ptp(xyz[:, :2], axis=0).max()), 1e-9)
        terms = np.c_[np.ones(len(xyz)), (xyz[:, :2] - middle) / extent]
        z = xyz[:, 2].copy()
        if len(fields) > 1:
            place = np.floor((xyz[:, :2] - xyz[:, :2].min(0)) / extent * self.cells).astype(
                np.int64
            )
            _, cell = np.unique(place @ [self.cells + 1, 1], return_inverse=True)
            z += self._planes(z, terms, owner, cell)
        z -= terms @ np.linalg.lstsq(terms, z, rcond=None)[0]
        return np.asarray(np.c_[xyz[:, :2], z])

    def _planes(
        self, z: Array, terms: Array, owner: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> Array:
        """Height of each pair's plane at its points (n,)."""
        row = np.arange(len(z))
        column = 3 * owner[:, None] + np.arange(3)
        planes = csr_matrix((terms.ravel(), (np.repeat(row, 3), column.ravel())))
        both = hstack([planes, -csr_matrix((np.ones(len(z)), (row, cell)))]).tocsr()
        weight, change = np.ones(len(z)), np.zeros(len(z))
        for _ in range(self.rounds):
            root = np.sqrt(weight)
            solved = lsmr(diags(root) @ both, -z * root, damp=self.damping, maxiter=2000)[0]
            change = planes @ solved[: planes.shape[1]]
            lacking = z + both @ solved
            weight = 1 / (1 + (lacking / (1.48 * np.median(np.abs(lacking)) + 1e-9)) ** 2)
        return np.asarray(change)


LEAST_BASE = 0.05
"""Least ratio of baseline to height for disparities to be used."""
ACROSS_PX = 2.0
"""Matches with a larger disparity across the baseline are outliers; in px at the working width."""
LEAST_POINTS = 12
"""Fewest points for a pair to be used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PairField:
    """Heights from the disparities of two photos."""

    a: int
    """Index of the first photo."""
    b: int
    """Index of the second."""
    px: NDArray[np.float64]
    """(n, 2) px of b."""
    d_px: NDArray[np.float64]
    """(n, 2) disparity vectors (Y 4.8) in px of an image WORKING_WIDTH wide."""
    xyz: NDArray[np.float64]
    """(n, 3) map coordinates x, y and height above the pair's dominant plane, m."""
    baseline_m: float
    """Distance of both centres, m."""
    height_m: float
    """Height of a above the plane, m."""
    level: int
    """Number of points on the dominant plane."""


@dataclass(frozen=True, kw_only=True)
class NoField:
    """A pair that determines no heights. Its truth value is False."""

    a: int
    """Index of the first photo."""
    b: int
    """Index of the second."""
    reason: str
    """The reason as a phrase."""

    def __bool__(self) -> bool:
        return False


def pair_field(
    link: Link,
    features: tuple[Features, Features],
    views: tuple[View, View],
    z: float,
    relief_m: float | None,
) -> PairField | NoField:
    """Heights from the disparities of one linked pair; `z`: level in m of the ground in the map
    frame.

    Uses all matches of the link, which fulfil one epipolar geometry, not only those on the plane.
    """
    a, b = views
    px = features[0].px[link.index_a], features[1].px[link.index_b]
    baseline = float(np.linalg.norm(a.pose.map_C - b.pose.map_C))
    height = float(a.pose.map_C[2] - z)
    if baseline < LEAST_BASE * height:
        return NoField(a=link.a, b=link.b, reason=f"its baseline of {baseline:.2f} m is too short")
    unit = b.camera.focal * WORKING_WIDTH / b.camera.width
    u = [
        r[:, :2] / r[:, 2:] * unit
        for r in (rays(v.camera, p) for v, p in zip(views, px, strict=True))
    ]
    found = Ransac(
        model="homography", threshold_px=threshold_px(relief_m, height), minimum=LEAST_POINTS
    )(u[0], u[1])
    if isinstance(found, NoEstimate):
        return NoField(a=link.a, b=link.b, reason=f"no dominant plane: {found.reason}")
    everything = replace(found, inliers=np.ones(len(u[0]), bool))
    flat = Level(relief_m=relief_m, height_m=height)(u[0], u[1], everything)
    H = flat.estimate.b_H_a
    d, w = disparities(H, u[0], u[1]), transfer(H, u[0]) / unit
    depth = (z - b.pose.map_C[2]) / (np.c_[w, np.ones(len(w))] @ b.pose.cam_R_map)[:, 2]
    b_T = b.pose.cam_R_map @ (a.pose.map_C - b.pose.map_C)
    h, _, across = heights_above_plane(d / unit, w, b_T, depth, height)
    keep = np.isfinite(h) & (np.abs(across) * unit < ACROSS_PX) & (np.abs(h) < 0.5 * height)
    if keep.sum() < LEAST_POINTS:
        return NoField(a=link.a, b=link.b, reason="its disparities do not lie along the baseline")
    return PairField(
        a=link.a,
        b=link.b,
        px=px[1][keep],
        d_px=d[keep],
        xyz=np.c_[_placed(b, px[1][keep], z, h[keep]), h[keep]],
        baseline_m=baseline,
        height_m=height,
        level=int((keep & flat.level).sum()),
    )


def _placed(view: View, px: NDArray[Any], z: float, h: NDArray[Any]) -> NDArray[np.float64]:
    """(n, 2) positions in m of pixels of a photo at heights h above the level z; along a ray they
    are linear in h.
    """
    low, high = (on_ground(view, px, level(at))[:, :2] for at in (z, z + 1))
    return np.asarray(low + h[:, None] * (high - low))
