"""Finds photos of two cameras that were taken together, by their times or their names."""

import re
from collections.abc import Sequence
from datetime import UTC
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import east_north_m
from skyquilt.model.photo import Photo

SECONDS = 0.75
"""Longest time between two photos of one trigger."""
CONTRADICTION_S = 5.0
"""Time difference above which equal numbers in names are chance. Below it, time stamps may be
rounded to seconds, or a camera may write late.
"""
APART_M = 5.0
"""Distance between reported positions above which two photos are not from the same drone."""


def taken_together(a: Sequence[Photo], b: Sequence[Photo]) -> list[tuple[int, int]]:
    """Pairs (index of a, index of b), each photo in at most one, by ascending index of b.

    Photos are paired by equal numbers in the names, where neither times nor positions contradict;
    photos without a partner by name are paired by time, the nearest first: of a camera that
    exposes several times a second, the photo nearest to the other camera's counts. Of photos of
    several cameras taken at once (wide and zoom), the one with the widest view counts.
    """
    named: dict[tuple[str, ...], list[int]] = {}
    for i, photo in enumerate(a):
        named.setdefault(_numbers(photo), []).append(i)
    found: dict[int, int] = {}
    for j, photo in enumerate(b):
        same = _widest(a, named.get(_numbers(photo), [])) if _numbers(photo) else []
        if len(same) == 1 and same[0] not in found.values() and _possible(a[same[0]], photo):
            found[j] = same[0]
    taken, rest = set(found.values()), [j for j in range(len(b)) if j not in found]
    near = sorted(
        (gap, _narrow(a[i]), i, j)
        for i in range(len(a))
        for j in rest
        if i not in taken and (gap := _gap_s(a[i], b[j])) is not None and gap <= SECONDS
    )
    for _, _, i, j in near:
        if i not in taken and j not in found and _possible(a[i], b[j]):
            found[j] = i
            taken.add(i)
    return [(found[j], j) for j in sorted(found)]


def nearest_in_time(a: Sequence[Photo], b: Sequence[Photo], most_s: float) -> list[tuple[int, int]]:
    """Pairs (index of a, index of b) of photos of one clock, each of which is nearest in time to
    the other, less than `most_s` seconds apart, and at one place. By ascending index of b.
    """
    of_a, of_b = (clocks(photos) for photos in (a, b))
    order = np.argsort(of_a, kind="stable")[: int(np.isfinite(of_a).sum())]
    sorted_a = of_a[order]
    nearest: dict[int, tuple[float, int]] = {}
    for j, time in enumerate(of_b):
        if not np.isfinite(time):
            continue
        low, high = np.searchsorted(sorted_a, [time - most_s, time + most_s])
        gaps = [(abs(float(of_a[i] - time)), int(i)) for i in order[low:high]]
        found = [(gap, i) for gap, i in gaps if gap < most_s and _possible(a[i], b[j])]
        if found and min(found)[0] < nearest.get(min(found)[1], (np.inf, 0))[0]:
            nearest[min(found)[1]] = min(found)[0], j
    return sorted(((i, j) for i, (_, j) in nearest.items()), key=lambda pair: pair[1])


def late_by(a: Sequence[Photo], b: Sequence[Photo]) -> NDArray[np.float64]:
    """(n,) how much later than its partner of `a` each photo of `b` says that it was taken, s,
    beside the median of all; 0 where the times of either camera are whole seconds, or tell nothing.
    """
    gaps = clocks(b) - clocks(a)
    zoned = [p.time is not None and p.time.tzinfo is not None for p in (*a, *b)]
    if not np.isfinite(gaps).any() or whole_seconds(a) or whole_seconds(b) or len(set(zoned)) > 1:
        return np.zeros(len(gaps))
    return np.nan_to_num(gaps - np.nanmedian(gaps))


def whole_seconds(photos: Sequence[Photo]) -> bool:
    """Whether no photo tells a part of a second."""
    return all(p.time is None or p.time.microsecond == 0 for p in photos)


def clocks(photos: Sequence[Photo]) -> NDArray[np.float64]:
    """(n,) times in s by the photos' own clocks, whatever their zones; NaN where there is none."""
    return np.array(
        [np.nan if p.time is None else p.time.replace(tzinfo=UTC).timestamp() for p in photos],
        np.float64,
    )


def _narrow(photo: Photo) -> float:
    """Focal length over the longer side: more for a narrower view."""
    return photo.focal.px / max(photo.width, photo.height)


def _widest(a: Sequence[Photo], same: Sequence[int]) -> list[int]:
    """Of photos (indices) with one number, that with the widest view, where each is of another
    camera; all of them otherwise.
    """
    if len({a[i].camera_key for i in same}) < len(same):
        return list(same)
    return [min(same, key=lambda i: (_narrow(a[i]), i))] if same else []


def _numbers(photo: Photo) -> tuple[str, ...]:
    return tuple(re.findall(r"\d+", PurePosixPath(photo.name).stem))


def _gap_s(a: Photo, b: Photo) -> float | None:
    if a.time is None or b.time is None or (a.time.tzinfo is None) != (b.time.tzinfo is None):
        return None
    return abs((a.time - b.time).total_seconds())


def _possible(a: Photo, b: Photo) -> bool:
    """Whether time and position allow that both photos were taken at the same moment and place."""
    gap = _gap_s(a, b)
    if gap is not None and gap > CONTRADICTION_S:
        return False
    if a.position is None or b.position is None:
        return True
    return bool(np.hypot(*east_north_m(a.position, b.position)) < APART_M)
