"""Mosaics one strip from photo to photo with one choice of lens model, features and
transformation.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import RefusedError
from skyquilt.geometry.camera import undistort
from skyquilt.geometry.transforms import Model, transfer
from skyquilt.matching.levelled import Level
from skyquilt.matching.ransac import Ransac
from skyquilt.model.camera import Camera, order_named
from skyquilt.model.estimate import NoEstimate
from skyquilt.quality.registration_quality import eta, four_lengths
from skyquilt.simulate import Strip, StripSettings

Doubles = NDArray[np.float64]


def board_camera(
    board: Doubles, views: Sequence[Doubles], size: tuple[int, int], order: str
) -> tuple[Camera, float]:
    """The camera with distortion of an order, and the RMS error in px, from views (N, 2) px of a
    board (N, 3).

    `size` is (width, height) in px. Pixels are square. Each order is a separate fit, not a
    truncated higher order.
    """
    kept, flags = order_named(order), cv2.CALIB_FIX_ASPECT_RATIO
    flags |= 0 if kept.tangential else cv2.CALIB_ZERO_TANGENT_DIST
    for fixed in (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3)[kept.radial :]:
        flags |= fixed
    points = [board.astype(np.float32)] * len(views)
    seen = [v.astype(np.float32) for v in views]
    rms, K, d, _, _ = cv2.calibrateCamera(points, seen, size, np.eye(3), np.zeros(5), flags=flags)
    k1, k2, p1, p2, k3 = (float(v) for v in np.ravel(d)[:5])
    camera = Camera(
        width=size[0],
        height=size[1],
        focal=float(K[0, 0]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        k1=k1,
        k2=k2,
        k3=k3,
        p1=p1,
        p2=p2,
    )
    return camera, float(rms)


LOOSE_PX = 10.0
"""Threshold of RANSAC in px. It is large enough to keep points on raised objects, which the
levelling then removes.
"""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Parameters of a curve of Y Fig. 6.5."""

    name: str
    """Name in the legend."""
    distortion: str
    """`none`, `2`, `4`, `6`, `6t`."""
    levelled: bool
    """Whether only features of the dominant plane are used."""
    model: Model
    """Transformation from photo to photo."""
    every: int = 1
    """1 uses every photo, 2 every other one (Y Fig. 4.5)."""


VARIANTS = (
    Variant(name="no distortion correction", distortion="none", levelled=True, model="homography"),
    Variant(name="order 2", distortion="2", levelled=True, model="homography"),
    Variant(name="order 4", distortion="4", levelled=True, model="homography"),
    Variant(name="order 6", distortion="6", levelled=True, model="homography"),
    Variant(name="order 6 + tangential", distortion="6t", levelled=True, model="homography"),
    Variant(
        name="order 6 + tangential, not levelled",
        distortion="6t",
        levelled=False,
        model="homography",
    ),
    Variant(
        name="order 6 + tangential, similarity", distortion="6t", levelled=True, model="similarity"
    ),
    Variant(
        name="every other photo, homography",
        distortion="6t",
        levelled=True,
        model="homography",
        every=2,
    ),
    Variant(
        name="every other photo, similarity",
        distortion="6t",
        levelled=True,
        model="similarity",
        every=2,
    ),
)
"""The seven of Y Fig. 6.5, of which the first five are levelled, with homographies, and the two of
Y Fig. 4.5 with half of the photos.
"""


def calibrated(strip: Strip, settings: StripSettings) -> dict[str, tuple[Camera, float]]:
    """Camera and RMS error in px of each order of distortion, from the board's views."""
    size = (settings.lens.width, settings.lens.height)
    orders = dict.fromkeys(v.distortion for v in VARIANTS)
    return {order: board_camera(strip.board, strip.views, size, order) for order in orders}


def chained(strip: Strip, settings: StripSettings, camera: Camera, variant: Variant) -> Doubles:
    """eta (4.7) of the board below each photo (photos,), as mapped into the first photo, against
    the first one; NaN for photos that the variant leaves out.

    Raises:
        RefusedError: two photos cannot be registered.
    """
    estimate = Ransac(model=variant.model, threshold_px=LOOSE_PX, seed=settings.seed)
    level = Level(relief_m=settings.relief, height_m=settings.height, width=settings.lens.width)
    px = [_straight(camera, p) for p in strip.px]
    targets = [_straight(camera, p) for p in strip.targets]
    first, H, found = four_lengths(targets[0]), np.eye(3), np.full(len(px), np.nan)
    found[0] = 1.0
    for k in range(variant.every, len(px), variant.every):
        onto = k - variant.every
        _, i, j = np.intersect1d(strip.ids[k], strip.ids[onto], return_indices=True)
        a, b = px[k][i], px[onto][j]
        step = estimate(a, b)
        if isinstance(step, NoEstimate):
            raise RefusedError(
                f"photos {onto + 1} and {k + 1} of the strip do not match ({step.reason}); choose"
                " more overlap or less noise"
            )
        if variant.levelled:
            step = level(a, b, step).estimate
        H = H @ step.b_H_a
        found[k] = eta(four_lengths(transfer(H, targets[k])), first)
    return found


def _straight(camera: Camera, px: Doubles) -> Doubles:
    """Undistorted pixels (N, 2)."""
    return np.asarray(undistort(camera, px) * camera.focal + (camera.cx, camera.cy))
