"""Detects implausible positions: far from the others, all in one place, a whole flight at height
zero.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Datum, Photo
from skyquilt.photos.position_groups import FAR_M, distances_to_median, groups, on_sphere, spread_m
from skyquilt.photos.side_rows import sentence_of

_GROUND_M = 2.0
_STUCK_M = 0.05
_STUCK_PHOTOS = 4
_SITE_PHOTOS = 3


def without_outliers(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, without the positions that a wide gap separates from most others, and a note for
    each, or for each group of them that is a site of its own.

    It takes at least three positions to decide which one is wrong. The photo stays, and its note
    keeps the value: where pictures overlap, they place it.
    """
    if sum(p.position is not None for p in photos) < 3:
        return tuple(photos), _far_pair([p for p in photos if p.position])
    main, *others = groups(photos)
    middle = np.median(on_sphere([photos[i] for i in main]), axis=0)
    kept, notes = list(photos), list[str]()
    for group in others:
        members = [photos[i] for i in group]
        far = np.linalg.norm(on_sphere(members) - middle, axis=1)
        for i, distance in zip(group, far.tolist(), strict=True):
            kept[i] = _unplaced(photos[i], distance)
        notes += _told(members, far, len(main))
    return tuple(kept), tuple(notes)


def _told(members: Sequence[Photo], far: NDArray[np.float64], main: int) -> list[str]:
    """What is said of positions far from `main` others. Three or more that differ are no error of
    a receiver, which repeats an old position.
    """
    if len(members) < _SITE_PHOTOS or spread_m(members) < _STUCK_M:
        return [
            f"{photo.name} reports a position {distance / 1000:.0f} km from the others."
            for photo, distance in zip(members, far.tolist(), strict=True)
        ]
    return [
        f"{len(members)} photos ({sentence_of([p.name for p in members])}) lie"
        f" {np.median(far) / 1000:.0f} km from the {main} others; these positions were not used. If"
        " they show another site, make a map of them by themselves, from a folder of their own."
    ]


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
    if len(placed) < _STUCK_PHOTOS or spread_m(placed) > _STUCK_M:
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
    if apart <= FAR_M:
        return ()
    return (f"{placed[0].name} and {placed[1].name} report positions {apart / 1000:.0f} km apart.",)


def _unplaced(photo: Photo, distance_m: float) -> Photo:
    if photo.position is None:
        return photo
    place = f"{photo.position.latitude_deg:.6f}, {photo.position.longitude_deg:.6f}"
    note = (
        f"Its position ({place}) lies {distance_m / 1000:.0f} km from the other photos and was"
        " not used."
    )
    return replace(photo, position=None, notes=(*photo.notes, note))
