"""Guess of the registration of two photos from their metadata."""

from math import cos, hypot, radians, sin

import numpy as np

from skyquilt.coregistration.candidates import middle, similarity
from skyquilt.model.photo import Photo
from skyquilt.model.registration import Guess

_EARTH_M = 6378137.0
_REACH = 0.3
"""Largest error from tilt, lever arms and positions, as a share of b's longer side."""
_TURN_DEG = 12.0
"""Largest error of the difference of two yaws in degrees."""
_SCALE = 1.3
"""Largest error of the scale from focal lengths and heights, as a factor."""


def from_metadata(a: Photo, b: Photo) -> Guess | None:
    """The guess for two vertical photos, or None if their metadata are not sufficient.

    Scale from focal lengths and heights above take-off, rotation from yaws, shift from positions;
    data that are not given by both are assumed to be equal. Assumed focal lengths are not used.
    """
    if "guess" in (a.focal.source, b.focal.source):
        return None
    said = ["focal lengths"]
    scale = b.focal.px / a.focal.px
    heights = _heights(a, b)
    if heights is not None:
        scale *= heights[0] / heights[1]
        said.append("heights")
    yaws = (a.attitude.yaw_deg, b.attitude.yaw_deg) if a.attitude and b.attitude else None
    if yaws is not None:
        said.append("yaws")
    yaw_a, yaw_b = yaws or (0.0, 0.0)
    to_px = middle((b.height, b.width))
    if yaws is not None and heights is not None and a.position and b.position:
        to_px = to_px + _shift(a, b, yaw_b) * b.focal.px / heights[1]
        said.append("positions")
    half = 0.5 * max(b.height, b.width)
    if hypot(*(to_px - middle((b.height, b.width)))) > 2 * half:
        return None
    transform = similarity(scale, radians(yaw_a - yaw_b), middle((a.height, a.width)), to_px)
    return Guess(
        b_H_a=transform,
        reach=_REACH,
        rotation_deg=_TURN_DEG,
        scale=_SCALE,
        source=f"the photos' metadata ({', '.join(said)})",
    )


def _heights(a: Photo, b: Photo) -> tuple[float, float] | None:
    """Heights in m above take-off, if both photos give them and both were taken in flight."""
    found = [p.position.takeoff_m if p.position else None for p in (a, b)]
    if found[0] is None or found[1] is None or min(found[0], found[1]) < 5:
        return None
    return found[0], found[1]


def _shift(a: Photo, b: Photo, yaw_b_deg: float) -> np.ndarray:
    """(2,) m from b's camera to a's, along b's image: x right, y down."""
    assert a.position is not None and b.position is not None
    north = radians(a.position.latitude_deg - b.position.latitude_deg) * _EARTH_M
    east = radians(a.position.longitude_deg - b.position.longitude_deg) * _EARTH_M
    east *= cos(radians(b.position.latitude_deg))
    yaw = radians(yaw_b_deg)
    right, up = east * cos(yaw) - north * sin(yaw), east * sin(yaw) + north * cos(yaw)
    return np.array([right, -up])
