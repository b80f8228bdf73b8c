"""Detects implausible positions: one far from all others, all in one place, a whole flight at
height zero.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Datum, Photo

_FAR_M = 5_000.0
_FAR_SPREADS = 20.0
_METRES_PER_DEGREE = 111_320.0
_GROUND_M = 2.0
_STUCK_M = 0.05
_STUCK_PHOTOS = 4


def without_outliers(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, without the positions that are implausibly far from the others, and a note for
    each.

    Implausible is more than 5 km from the median and more than 20 times the median distance to it;
    it takes at least three positions to decide which one is wrong. The photo stays, and its note
    keeps the value.
    """
    placed = [p for p in photos if p.position]
    if len(placed) < 3:
        return tuple(photos), _far_pair(placed)
    distance = dict(zip((p.name for p in placed), distances_to_median(placed), strict=True))
    limit = max(_FAR_M, _FAR_SPREADS * float(np.median(list(distance.values()))))
    far = {name: d for name, d in distance.items() if d > limit}
    notes = tuple(
        f"{name} reports a position {d / 1000:.0f} km from the others." for name, d in far.items()
    )
    return tuple(_unplaced(p, far[p.name]) if p.name in far else p for p in photos), notes


def without_ground_heights(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Replaces heights above take-off that stay at zero during a whole flight by heights above sea
    level.

    Some firmware always writes `RelativeAltitude` 0; nobody maps from below 2 m.
    """
    heights = [
        p.position.takeoff_m for p in photos if p.position and p.position.takeoff_m is not None
    ]
    if not heights or max(map(abs, heights)) > _GROUND_M:
        return tuple(photos), ()
    note = f"The heights above take-off stay within {_GROUND_M:.0f} m of zero and were not used."
    return tuple(_unraised(p) for p in photos), (note,)


def without_stuck(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, without positions where all are identical in four or more photos: the receiver
    was stuck.

    Such positions would shrink the map to a point.
    """
    placed = [p for p in photos if p.position]
    if len(placed) < _STUCK_PHOTOS or distances_to_median(placed).max() > _STUCK_M:
        return tuple(photos), ()
    place = placed[0].position
    note = (
        f"All {len(placed)} positions are identical"
        f" ({place.latitude_deg:.6f}, {place.longitude_deg:.6f}): the receiver was stuck, and"
        " they were not used. Provide positions in a geo.txt, or control points."
        if place
        else ""
    )
    return tuple(replace(p, position=None) for p in photos), (note,)


def _unraised(photo: Photo) -> Photo:
    old = photo.position
    if old is None or old.takeoff_m is None:
        return photo
    old = replace(old, takeoff_m=None)
    if old.datum == "takeoff":
        datum: Datum = "sea_level" if old.sea_level_m is not None else "unknown"
        old = replace(old, altitude_m=old.sea_level_m, datum=datum)
    return replace(photo, position=old)


def _far_pair(placed: Sequence[Photo]) -> tuple[str, ...]:
    """With two positions far apart, one of them is wrong, but it cannot be decided which."""
    apart = 2 * float(distances_to_median(placed)[0]) if len(placed) == 2 else 0.0
    if apart <= _FAR_M:
        return ()
    return (f"{placed[0].name} and {placed[1].name} report positions {apart / 1000:.0f} km apart.",)


def distances_to_median(photos: Sequence[Photo]) -> NDArray[np.float64]:
    """Horizontal distances (n,) in m of placed photos to the median of their positions."""
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    degrees = np.array(places, dtype=np.float64)
    middle = np.median(degrees, axis=0)
    away = degrees - middle
    away[:, 1] = (away[:, 1] + 180) % 360 - 180
    away[:, 1] *= np.cos(np.radians(middle[0]))
    return np.asarray(np.hypot(*away.T) * _METRES_PER_DEGREE)


def _unplaced(photo: Photo, distance_m: float) -> Photo:
    if photo.position is None:
        return photo
    place = f"{photo.position.latitude_deg:.6f}, {photo.position.longitude_deg:.6f}"
    note = (
        f"Its position ({place}) lies {distance_m / 1000:.0f} km from the other photos and was"
        " not used."
    )
    return replace(photo, position=None, notes=(*photo.notes, note))
