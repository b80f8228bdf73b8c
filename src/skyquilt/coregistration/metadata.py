"""What two photos' metadata say of how one lies on the other."""

from math import cos, hypot, radians, sin

import numpy as np

from skyquilt.coregistration.candidates import middle, similarity
from skyquilt.model.photo import Photo
from skyquilt.model.registration import Guess

_EARTH_M = 6378137.0
_REACH = 0.3
"""Share of b's longer side by which tilt, lever arms and positions may be wrong."""
_TURN_DEG = 12.0
"""Degrees by which the difference of two yaws may be wrong."""
_SCALE = 1.3
"""Factor by which focal lengths and heights may be wrong together."""


def from_metadata(a: Photo, b: Photo) -> Guess | None:
    """The guess for two photos that look straight down, or None where they do not say enough.

    Scale from focal lengths and heights above take-off, rotation from yaws, shift from positions;
    what both do not state is taken as equal. Focal lengths that are guesses say nothing.
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
    """Heights in m above take-off, where both state them and they are flown at."""
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
