"""Positions that are wrong or say less than they seem: far from the others, heights of the other
sign or of zero, all in one place, a whole flight at height zero, rounded, or repeated.

Wrong ones are not used. Rounded and repeated ones get deviations as large as they are, so that they
do not shrink or turn a map.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.model.photo import Datum, Photo
from skyquilt.photos.side_rows import sentence_of
from skyquilt.photos.tags import NO_FIX, NO_HEIGHT
from skyquilt.photos.unmeasured import flat, void

Array = NDArray[np.float64]
FAR_M = 5_000.0
FAR_STEPS = 20.0
"""A gap is longer than FAR_M and longer than so many times the way from a photo to the nearest."""
NEAR = 0.01
"""Positions whose signs or coordinates are exchanged must come nearer to the others than this share
of their distance.
"""
_RECEIVER_M = 20.0
"""Errors of heights by which a receiver may put some photos above zero and others below it."""
_EXCHANGED: dict[str, Callable[[float, float], tuple[float, float]]] = {
    "north and south": lambda north, east: (-north, east),
    "east and west": lambda north, east: (north, -east),
    "north and south, east and west": lambda north, east: (-north, -east),
    "latitude and longitude": lambda north, east: (east, north),
}
_EARTH_M = METRES_PER_DEGREE * 180 / np.pi
_Name = Literal["sea_level_m", "ellipsoid_m"]
_ZEROS: tuple[tuple[_Name, str], ...] = (
    ("sea_level_m", "sea level"),
    ("ellipsoid_m", "the ellipsoid"),
)
"""Heights of a position that have a sign, and from where they count."""
_GROUND_M = 2.0
_LOWEST_LAND_M = -430.0
"""Height above sea level of the shore of the Dead Sea, below which no drone flies."""
_STUCK_M = 0.05
_STUCK_PHOTOS = 4
_SITE_PHOTOS = 3
_STEPS_DEG = (0.1, 1 / 60, 1e-2, 1e-3, 1 / 3600, 1e-4)
"""What degrees are rounded to, coarse to fine: finer steps are below a receiver's own error."""
_EXACT_DEG = 1e-8
"""Difference from a multiple of a step, or from another position, that counts as none."""
_ROUNDED_PHOTOS = 4
"""So many photos of a camera must agree before their positions are called rounded."""


def without_outliers(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, without the positions that a wide gap separates from most others, and a note for
    each, or for each group of them that is a site of its own.

    It takes at least three positions to decide which one is wrong. The photo stays, and its note
    keeps the value: where pictures overlap, they place it.
    """
    if sum(p.position is not None for p in photos) < 3:
        return _far_pair(photos)
    main, *others = groups(photos)
    middle = np.median(on_sphere([photos[i] for i in main]), axis=0)
    kept, notes = list(photos), list[str]()
    for group in others:
        members = [photos[i] for i in group]
        far = np.linalg.norm(on_sphere(members) - middle, axis=1)
        changed, said = _with_other_signs(members, middle, far, len(main))
        if said:
            notes.append(said)
            for i, photo in zip(group, changed, strict=True):
                kept[i] = photo
            continue
        for i, distance in zip(group, far.tolist(), strict=True):
            kept[i] = _unplaced(photos[i], distance)
        notes += _told(members, far, len(main))
    return tuple(kept), tuple(notes)


def _with_other_signs(
    members: Sequence[Photo], middle: Array, far: NDArray[np.float64], main: int
) -> tuple[list[Photo], str]:
    """Photos far from `main` others at `middle`, where they lie near these once north and south,
    east and west, or both coordinates are exchanged: a program lost the letter or the sign of some.
    Empty text where they do not.
    """
    for words, change in _EXCHANGED.items():
        moved = list[Photo]()
        for photo in members:
            if photo.position is None:
                continue
            latitude, longitude = change(photo.position.latitude_deg, photo.position.longitude_deg)
            if abs(latitude) <= 90:
                place = replace(photo.position, latitude_deg=latitude, longitude_deg=longitude)
                moved.append(replace(photo, position=place))
        if len(moved) == len(members) and (
            np.linalg.norm(on_sphere(moved) - middle, axis=1).max() < NEAR * far.min()
        ):
            return moved, (
                f"{len(members)} photos ({sentence_of([p.name for p in members])}) lie"
                f" {np.median(far) / 1000:.0f} km from the {main} others, but among them once"
                f" {words} are exchanged: so they are. If it is the others that are wrong, give"
                " positions in a geo.txt."
            )
    return [], ""


def without_zero_heights(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, without heights of exactly zero where others lie far from it, and a note on
    these: receivers write zero until they know a height.
    """
    kept, notes = list(photos), list[str]()
    for name, zero in _ZEROS:
        told = {i: getattr(p.position, name) for i, p in enumerate(photos) if p.position}
        unknown = [i for i, height in told.items() if height == 0]
        known = [abs(height) for height in told.values() if height]
        if not unknown or not known or min(known) < _RECEIVER_M:
            continue
        for i in unknown:
            kept[i] = _with_height(kept[i], name, None)
        names = sentence_of([photos[i].name for i in unknown])
        notes.append(
            f"In {len(unknown)} of {len(photos)} photos ({names}) the height above {zero} is"
            " exactly 0, as receivers write it until they know one; it was not used."
        )
    return tuple(kept), tuple(notes)


def with_one_sign(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, with the sign of the others where some heights lie as far below zero as the
    others lie above it, and a note on these: a program lost or made up EXIF's `GPSAltitudeRef`.

    Of both signs the one of most photos is right, of equally many the positive one, which is also
    that of heights at which there is no land.
    """
    kept, notes = list(photos), list[str]()
    for name, zero in _ZEROS:
        found = {i: getattr(p.position, name) for i, p in enumerate(photos) if p.position}
        heights = {i: float(h) for i, h in found.items() if h}
        above, below = ([i for i, h in heights.items() if (h > 0) == up] for up in (True, False))
        if not above or not below or not _same_but_for_sign([*heights.values()]):
            continue
        deep = min(heights.values()) < _LOWEST_LAND_M
        wrong = below if deep or len(below) <= len(above) else above
        for i in wrong:
            kept[i] = _with_height(kept[i], name, -heights[i])
        right = above if wrong is below else below
        names = sentence_of([photos[i].name for i in wrong])
        notes.append(
            f"In {len(wrong)} of {len(heights)} photos ({names}) the height above {zero} is"
            f" {np.median([heights[i] for i in wrong]):.0f} m, in the others"
            f" {np.median([heights[i] for i in right]):.0f} m: the sign of the"
            f" {len(wrong)} was taken for wrong and changed. If it is that of the others, give"
            " heights in a geo.txt."
        )
    return tuple(kept), tuple(notes)


def _same_but_for_sign(heights: Sequence[float]) -> bool:
    """Whether heights of both signs in m are alike once all are positive: these differ by less
    than those of both signs lie apart, and no receiver's error explains that gap.
    """
    size = np.abs(heights)
    return bool(2 * size.min() > max(np.ptp(size), _RECEIVER_M))


def _with_height(photo: Photo, name: _Name, height_m: float | None) -> Photo:
    """The photo with another height above sea level or the ellipsoid (a field of its position)."""
    old = photo.position
    if old is None:
        return photo
    used = old.altitude_m == getattr(old, name) and old.datum == name.removesuffix("_m")
    position = (
        replace(old, sea_level_m=height_m)
        if name == "sea_level_m"
        else replace(old, ellipsoid_m=height_m)
    )
    if used:
        datum: Datum = "unknown" if height_m is None else old.datum
        position = replace(position, altitude_m=height_m, datum=datum)
    return replace(photo, position=position)


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


def raised(photo: Photo) -> bool:
    """Whether a photo tells a height above take-off from which maps are made."""
    height = photo.above_takeoff_m
    return height is not None and abs(height) > _GROUND_M


def without_ground_heights(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Replaces heights above take-off that stay at zero in all photos of a camera by heights above
    sea level.

    Some firmware always writes `RelativeAltitude` 0; nobody maps from below 2 m.
    """
    told = {p.camera_key for p in photos if p.above_takeoff_m is not None}
    grounded = told - {p.camera_key for p in photos if raised(p)}
    return tuple(unraised(p) if p.camera_key in grounded else p for p in photos), ground_notes(
        {p.camera_key for p in photos}, grounded
    )


def ground_notes(cameras: Collection[str], grounded: Collection[str]) -> tuple[str, ...]:
    """What is told of the cameras, of all `cameras`, whose heights above take-off stay at zero."""
    if not grounded:
        return ()
    whose = "" if set(grounded) >= set(cameras) else f" of {sentence_of(sorted(grounded))}"
    return (
        f"The heights above take-off{whose} stay within {_GROUND_M:.0f} m of zero and were not"
        " used.",
    )


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
    return tuple(replace(p, position=None, height_m=p.above_takeoff_m) for p in photos), (note,)


def unraised(photo: Photo) -> Photo:
    """The photo without its height above take-off."""
    old = photo.position
    photo = replace(photo, height_m=None)
    if old is None or old.takeoff_m is None:
        return photo
    old = replace(old, takeoff_m=None)
    if old.datum == "takeoff":
        datum: Datum = "sea_level" if old.sea_level_m is not None else "unknown"
        old = replace(old, altitude_m=old.sea_level_m, datum=datum)
    return replace(photo, position=old)


def _far_pair(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """With two positions far apart, one of them is wrong, but it cannot be decided which: among
    other photos, neither is used. The map would lie between them.
    """
    placed = [p for p in photos if p.position]
    apart = 2 * float(distances_to_median(placed)[0]) if len(placed) == 2 else 0.0
    if apart <= FAR_M:
        return tuple(photos), ()
    told = f"{placed[0].name} and {placed[1].name} report positions {apart / 1000:.0f} km apart"
    if len(photos) == 2:
        return tuple(photos), (f"{told}.",)
    note = f"{told}, and no third one tells which is right: neither is used."
    return tuple(_unplaced(p, apart) for p in photos), (note,)


def _unplaced(photo: Photo, distance_m: float) -> Photo:
    if photo.position is None:
        return photo
    place = f"{photo.position.latitude_deg:.6f}, {photo.position.longitude_deg:.6f}"
    note = (
        f"Its position ({place}) lies {distance_m / 1000:.0f} km from the other photos and was"
        " not used."
    )
    return replace(photo, position=None, notes=(*photo.notes, note))


def with_coarse_deviations(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos (in order of capture) with larger deviations where their positions are rounded,
    repeat the one before or were not measured, and notes on these.
    """
    unmeasured = (void, flat) if any({NO_FIX, NO_HEIGHT} & {*p.notes} for p in photos) else ()
    kept, notes = list(photos), list[str]()
    for key in dict.fromkeys(p.camera_key for p in photos if p.position):
        own = [i for i, p in enumerate(photos) if p.position and p.camera_key == key]
        for coarse in (_rounded, _repeated, *unmeasured):
            given = [kept[i] for i in own]
            found, note = coarse(given)
            for i, photo in zip(own, found, strict=True):
                kept[i] = photo
            changed = [new.name for old, new in zip(given, found, strict=True) if new is not old]
            if changed:
                counted = "One photo" if len(changed) == 1 else f"{len(changed)} photos"
                notes.append(f"{counted} ({sentence_of(changed)}) {note}")
    return tuple(kept), tuple(notes)


def _rounded(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Photos of a camera whose positions all are multiples of a step of degrees."""
    degrees = _degrees(photos)
    for step in _STEPS_DEG if len(photos) >= _ROUNDED_PHOTOS else ():
        if (np.abs(degrees - step * np.round(degrees / step)) < _EXACT_DEG).all():
            metres = step * METRES_PER_DEGREE
            sigma = metres / np.sqrt(12)  # of a uniform distribution
            note = (
                f"have positions that are rounded to {metres:.0f} m; they count as uncertain by"
                f" {sigma:.1f} m."
            )
            return [_widened(p, float(sigma)) for p in photos], note
    return list(photos), ""


def _repeated(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Photos of a camera that repeat the position of the photo before: the camera is somewhere on
    the way to the next position that differs, or, after the last one, as far as it flew meanwhile.
    """
    degrees, xyz = _degrees(photos), on_sphere(photos)
    new = np.ones(len(photos), bool)
    new[1:] = (np.abs(np.diff(degrees, axis=0)) > _EXACT_DEG).any(1)
    starts = np.flatnonzero(new)
    if len(starts) < 2 or new.all():
        return list(photos), ""
    run = np.cumsum(new) - 1
    to_next = np.linalg.norm(np.diff(xyz[starts], axis=0), axis=1)
    count = np.bincount(run)
    since = (count[-1] - 1) * float(np.median(to_next / count[:-1]))
    away = np.append(to_next, max(to_next[-1], since))[run]
    found = [
        p if first else _widened(p, float(m)) for p, first, m in zip(photos, new, away, strict=True)
    ]
    repeat, they_were, counts = "repeats", "it was", "it counts"
    if (~new).sum() > 1:
        repeat, they_were, counts = "repeat", "they were", "they count"
    note = (
        f"{repeat} the position of the photo before: {they_were} taken at the same place, or the"
        f" receiver was slow or stuck; {counts} as uncertain by up to"
        f" {away[~new].max():.0f} m."
    )
    return found, note


def _degrees(photos: Sequence[Photo]) -> Array:
    """Latitudes and longitudes (n, 2) of those photos that have a position."""
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    return np.array(places, np.float64).reshape(-1, 2)


def _widened(photo: Photo, sigma_xy_m: float) -> Photo:
    """The photo whose position has at least that deviation."""
    if photo.position is None or sigma_xy_m <= photo.position.sigma_xy_m:
        return photo
    return replace(photo, position=replace(photo.position, sigma_xy_m=sigma_xy_m))


def groups(photos: Sequence[Photo]) -> list[list[int]]:
    """Indices of the photos with positions, in groups with a gap around each; the largest first,
    of equal ones the one that began first.
    """
    placed = [i for i, p in enumerate(photos) if p.position]
    if not placed:
        return []
    xyz = on_sphere(photos)
    limit = max(FAR_M, FAR_STEPS * _usual_step(xyz))
    rest, found = np.arange(len(placed)), list[list[int]]()
    while len(rest):
        reached, rest, done = [int(rest[0])], rest[1:], 0
        while done < len(reached) and len(rest):
            near = np.linalg.norm(xyz[rest] - xyz[reached[done]], axis=1) <= limit
            reached += rest[near].tolist()
            rest, done = rest[~near], done + 1
        found.append(sorted(placed[k] for k in reached))
    return sorted(found, key=lambda g: (-len(g), g[0]))


def on_sphere(photos: Sequence[Photo]) -> Array:
    """Positions (n, 3) in m on a sphere, of those photos that have one: distances between them
    do not depend on the pole or on the meridian of 180 degrees.
    """
    return sphere(_degrees(photos))


def sphere(degrees: Array) -> Array:
    """Latitudes and longitudes (n, 2) in degrees as places (n, 3) in m on a sphere."""
    north, east = np.radians(degrees).T
    flat = np.cos(north)
    return _EARTH_M * np.stack([flat * np.cos(east), flat * np.sin(east), np.sin(north)], 1)


def _usual_step(xyz: Array) -> float:
    """Median distance in m from a position to the nearest of some neighbours in capture order."""
    reach = range(1, min(len(xyz), 4))
    steps = np.full((len(xyz), 2 * len(reach)), np.inf)
    for k in reach:
        apart = np.linalg.norm(xyz[k:] - xyz[:-k], axis=1)
        steps[k:, 2 * k - 2], steps[:-k, 2 * k - 1] = apart, apart
    return float(np.median(steps.min(1))) if len(xyz) > 1 else 0.0


def spread_m(photos: Sequence[Photo]) -> float:
    """Largest distance in m of positions to their middle."""
    return float(distances_to_median(photos).max())


def distances_to_median(photos: Sequence[Photo]) -> Array:
    """Distances (n,) in m of placed photos to the median of their positions."""
    xyz = on_sphere(photos)
    return np.asarray(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1))
