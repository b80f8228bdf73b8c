"""Mosaics one strip from photo to photo with one choice of lens model, features and
transformation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import RefusedError
from skyquilt.geometry.camera import undistort
from skyquilt.geometry.transforms import Model, transfer
from skyquilt.matching.levelled import Level
from skyquilt.matching.ransac import Ransac
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import NoEstimate
from skyquilt.papers.board_camera import board_camera
from skyquilt.quality.registration_quality import eta, four_lengths
from skyquilt.simulate import Strip, StripSettings

Doubles = NDArray[np.float64]

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
)
"""The seven of Y 6.2; the first five are levelled, with homographies."""


def calibrated(strip: Strip, settings: StripSettings) -> dict[str, tuple[Camera, float]]:
    """Camera and RMS error in px of each order of distortion, from the board's views."""
    size = (settings.lens.width, settings.lens.height)
    orders = dict.fromkeys(v.distortion for v in VARIANTS)
    return {order: board_camera(strip.board, strip.views, size, order) for order in orders}


def chained(strip: Strip, settings: StripSettings, camera: Camera, variant: Variant) -> Doubles:
    """eta (4.7) of the board below each photo (photos,), as mapped into the first photo, against
    the first one.

    Raises:
        RefusedError: two photos cannot be registered.
    """
    estimate = Ransac(model=variant.model, threshold_px=LOOSE_PX, seed=settings.seed)
    level = Level(relief_m=settings.relief, height_m=settings.height, width=settings.lens.width)
    px = [_straight(camera, p) for p in strip.px]
    targets = [_straight(camera, p) for p in strip.targets]
    first, H, found = four_lengths(targets[0]), np.eye(3), [1.0]
    for k in range(1, len(px)):
        _, i, j = np.intersect1d(strip.ids[k], strip.ids[k - 1], return_indices=True)
        a, b = px[k][i], px[k - 1][j]
        step = estimate(a, b)
        if isinstance(step, NoEstimate):
            raise RefusedError(
                f"photos {k} and {k + 1} of the strip do not match ({step.reason}); choose more"
                " overlap or less noise"
            )
        if variant.levelled:
            step = level(a, b, step).estimate
        H = H @ step.b_H_a
        found.append(eta(four_lengths(transfer(H, targets[k])), first))
    return np.array(found)


def _straight(camera: Camera, px: Doubles) -> Doubles:
    """Undistorted pixels (N, 2)."""
    return np.asarray(undistort(camera, px) * camera.focal + (camera.cx, camera.cy))
