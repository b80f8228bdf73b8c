"""Positions and heights of which files say that the receiver did not measure them."""

from collections.abc import Sequence
from dataclasses import replace

from skyquilt.model.photo import Photo
from skyquilt.photos.tags import NO_FIX, NO_HEIGHT

UNMEASURED = 20.0
"""Factor of the deviations of what was not measured: a hundred metres for a camera's receiver."""


def void(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Photos of a camera, with larger deviations where it had no fix; a note on these. Where half
    of them or more say so, it is a camera that always writes it, which tells nothing.
    """
    found = [_widened(p, NO_FIX, UNMEASURED, UNMEASURED) for p in photos]
    return _unless_usual(photos, found), (
        "say that the receiver measured no position then, and wrote an earlier one (GPSStatus V);"
        " their positions count for little."
    )


def flat(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """The same of heights, where it had a fix of two dimensions."""
    found = [_widened(p, NO_HEIGHT, 1.0, UNMEASURED) for p in photos]
    return _unless_usual(photos, found), (
        "say that the receiver measured no height then (GPSMeasureMode 2); their heights count for"
        " little."
    )


def _unless_usual(photos: Sequence[Photo], found: list[Photo]) -> list[Photo]:
    changed = sum(a is not b for a, b in zip(photos, found, strict=True))
    return list(photos) if 2 * changed >= len(photos) else found


def _widened(photo: Photo, told: str, xy: float, z: float) -> Photo:
    """The photo, whose deviations are so many times as large where a note has `told` so; positions
    of a side file are others.
    """
    place = photo.position
    if place is None or place.source != "exif" or told not in photo.notes:
        return photo
    wider = replace(place, sigma_xy_m=xy * place.sigma_xy_m, sigma_z_m=z * place.sigma_z_m)
    return replace(photo, position=wider)
