"""Which visual photo each thermal one was taken together with, if one drone took both."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.motion import velocities
from skyquilt.geometry.frames import east_north_m
from skyquilt.model.photo import Photo, RejectedPhoto, evenly
from skyquilt.photos.together import APART_M, SECONDS, clocks, taken_together, whole_seconds

Array = NDArray[np.float64]
LONGEST_S = 3.0
"""Longest delay in s between two cameras of one trigger."""
SCATTER_S = 0.25
"""Standard deviation in s of the delays of one trigger, at most; a drone that flies the same lines
again is at the same places by other times.
"""
_MORE = 1.1
"""Times as many pairs as by names and nearest times tell that both cameras have a delay."""
_LEAST = 0.5
"""Share of the photos of that camera which took fewer that must have a partner."""
_LESS = 2
"""By how many pairs less than the best another difference of clocks has, where only times tell."""
_ASKED = 200
"""Most thermal photos whose times are compared with those of all visual ones."""
_TRIED = 40
"""Most differences of clocks that are tried."""
_BIAS_M, _SCATTER_M = 2.0, 2.0
"""Standard deviations in m of the distance that two receivers are apart, and of its changes."""
_FEW = 0.2
"""Share of the thermal photos up to which those of another camera or format are exceptions."""
_ANOTHER = "it is of another camera or format than most of the thermal photos"
"""Why they are not drawn."""


@dataclass(frozen=True, kw_only=True)
class Partners:
    """Photos of two cameras that one trigger released."""

    beside: dict[int, int]
    """Index of a thermal photo -> that of the visual one taken together with it."""
    doubled: frozenset[str] = frozenset()
    """Names of thermal photos whose visual one is beside one of another camera, of which there are
    more.
    """
    by_pattern: bool = False
    """Whether only the pattern of their times tells the pairs."""
    delay_s: float = 0.0
    """How much later the thermal photos were taken, by positions; 0 where these tell nothing."""
    apart_s: float = 0.0
    """How much later they say that they were taken, where only the pattern tells."""


def partners(visual: Sequence[Photo], thermal: Sequence[Photo]) -> Partners:
    """Photos taken together, by names and times, or with a constant delay where that pairs clearly
    more of them.
    """
    of_camera: dict[str, list[int]] = {}
    for j, photo in enumerate(thermal):
        of_camera.setdefault(photo.camera_key, []).append(j)
    found = []
    for own in of_camera.values():
        frames = [thermal[j] for j in own]
        pairs, delayed = taken_together(visual, frames), released_later(visual, frames)
        if delayed is None or len(delayed.beside) <= _MORE * len(pairs):
            delayed = Partners(beside={k: i for i, k in pairs})
        named = {own[k]: i for k, i in delayed.beside.items()}
        found.append(replace(delayed, beside=named))
    found.sort(key=lambda one: len(one.beside), reverse=True)
    beside, doubled = dict[int, int](), set[str]()
    for one in found:
        taken = set(beside.values())
        beside |= {j: i for j, i in one.beside.items() if i not in taken}
        doubled |= {thermal[j].name for j, i in one.beside.items() if i in taken}
    most = found[0] if found else Partners(beside={})
    return replace(most, beside=beside, doubled=frozenset(doubled))


def released_later(a: Sequence[Photo], b: Sequence[Photo]) -> Partners | None:
    """Photos of two cameras of one drone whose times differ by one amount: one camera is released
    later, or its clock is off, or both; None where nothing, or more than one amount, tells pairs.

    Photos in regular intervals have the same pattern of times one photo further on. Positions tell
    which is right: the second camera is ahead of the first one by what the drone flew meanwhile.
    """
    times_a, times_b = clocks(a), clocks(b)
    of_a, of_b = (np.flatnonzero(np.isfinite(t)) for t in (times_a, times_b))
    fewest = max(3, _LEAST * min(len(a), len(b)))
    if min(len(of_a), len(of_b)) < fewest:
        return None
    of_a, of_b = of_a[np.argsort(times_a[of_a])], of_b[np.argsort(times_b[of_b])]
    times_a, times_b = times_a[of_a], times_b[of_b]
    within = min(SECONDS, 0.4 * float(np.median(np.diff(times_a))))
    coarse = whole_seconds(a) or whole_seconds(b)
    places = _places([a[i] for i in of_a.tolist()], [b[j] for j in of_b.tolist()])
    found: list[tuple[int, float, NDArray[np.intp]]] = []
    for apart_s in _differences(times_a, times_b, within, fewest):
        pairs = _nearest(times_a, times_b - apart_s, within)
        late = times_b[pairs[:, 1]] - times_a[pairs[:, 0]]
        if len(pairs) < fewest or late.std() > (0.5 if coarse else SCATTER_S):
            continue
        if places is None:
            found.append((len(pairs), float(np.median(late)), pairs))
        elif (delay := _delay_s(*(own[pairs[:, k]] for k, own in places))) is not None:
            found.append((len(pairs), delay, pairs))
    if places is None:  # one photo further on, each line has a pair less
        found.sort(key=lambda one: -one[0])
        if not found or (len(found) > 1 and found[0][0] - found[1][0] < _LESS):
            return None
    else:
        found = [one for one in found if abs(one[1]) <= LONGEST_S]
        found.sort(key=lambda one: (-one[0], abs(one[1])))
        if not found:
            return None
    _, delay_s, pairs = found[0]
    return Partners(
        beside={int(of_b[j]): int(of_a[i]) for i, j in pairs},
        by_pattern=True,
        delay_s=0.0 if places is None else delay_s,
        apart_s=float(np.median(times_b[pairs[:, 1]] - times_a[pairs[:, 0]])),
    )


def _differences(times_a: Array, times_b: Array, within: float, fewest: float) -> list[float]:
    """Differences of clocks in s, by which most photos of b are within so many s of one of a."""
    asked = times_b[evenly(len(times_b), _ASKED)]
    apart = np.sort((asked[:, None] - times_a).ravel())
    last = np.searchsorted(apart, apart + 2 * within, side="right")
    count, found = last - np.arange(len(apart)), list[float]()
    least = fewest * len(asked) / len(times_b)
    while len(found) < _TRIED and count.max() >= least:
        k = int(count.argmax())
        found.append(float(np.median(apart[k : last[k]])))
        count[np.abs(apart - apart[k]) < 2 * within] = 0
    return found


def _nearest(times_a: Array, times_b: Array, within: float) -> NDArray[np.intp]:
    """(n, 2) indices of a and of b (in order of time) of photos nearest to each other."""
    at = np.searchsorted(times_a, times_b).clip(1, len(times_a) - 1)
    at -= times_b - times_a[at - 1] < times_a[at] - times_b
    gap = np.abs(times_b - times_a[at])
    order = np.lexsort([gap, at])
    first = order[np.r_[True, np.diff(at[order]) > 0]]
    kept = np.sort(first[gap[first] <= within])
    return np.column_stack([at[kept], kept])


def _places(
    a: Sequence[Photo], b: Sequence[Photo]
) -> tuple[tuple[int, Array], tuple[int, Array], tuple[int, Array]] | None:
    """Which of a pair, and its (n, 2) places in m, of both; and velocities (n, 2) in m/s of the
    first. NaN where a file tells none; None where hardly any of either camera does.
    """
    known = [p.position for p in (*a, *b) if p.position is not None]
    told = [np.mean([p.position is not None for p in own]) for own in (a, b)]
    if min(told) < _LEAST:
        return None
    of_a, of_b = (
        np.array(
            [
                (np.nan, np.nan) if p.position is None else east_north_m(known[0], p.position)
                for p in own
            ]
        )
        for own in (a, b)
    )
    placed = np.isfinite(of_a[:, 0])
    velocity = np.full(of_a.shape, np.nan)
    C = np.column_stack([of_a[placed], np.zeros(placed.sum())])
    velocity[placed] = velocities([p for p in a if p.position is not None], C)[:, :2]
    return (0, of_a), (1, of_b), (0, velocity)


def _delay_s(place_a: Array, place_b: Array, velocity: Array) -> float | None:
    """The time in s after which the first camera is where the second is, (n, 2) m and m/s each;
    None where they are not on one drone.
    """
    known = np.isfinite(place_a + place_b + velocity).all(1)
    if known.sum() < 3:
        return None
    ahead, v = (place_b - place_a)[known], velocity[known]
    terms = np.zeros((ahead.size, 3))
    terms[0::2, 0], terms[1::2, 1], terms[:, 2] = 1, 1, v.ravel()
    weight = np.ones(ahead.size)
    prior = np.diag([_SCATTER_M / _BIAS_M, _SCATTER_M / _BIAS_M, 1e-6])
    for _ in range(8):  # single positions may be far off
        design = np.vstack([terms * weight[:, None], prior])
        found = np.linalg.lstsq(design, np.r_[ahead.ravel() * weight, np.zeros(3)])[0]
        off = np.linalg.norm((ahead.ravel() - terms @ found).reshape(-1, 2), axis=1)
        weight = np.repeat(1 / (1 + (off / (2 * _SCATTER_M)) ** 2), 2)
    if np.hypot(*found[:2]) > APART_M or np.median(off) > APART_M:
        return None
    return float(found[2])


def of_one_camera(
    thermal: Sequence[Photo], pairs: Sequence[tuple[int, int]]
) -> tuple[list[tuple[int, int]], list[RejectedPhoto]]:
    """The pairs (index of the visual photo, of the thermal one) without the few whose thermal photo
    is of another camera or format than most, such as a reduced copy; all of them where these are
    not few.
    """
    kinds = [kind_of(thermal[j]) for _, j in pairs]
    usual, n = Counter(kinds).most_common(1)[0] if kinds else (None, 0)
    if len(kinds) - n > _FEW * len(kinds):
        return list(pairs), []
    kept = [pair for pair, kind in zip(pairs, kinds, strict=True) if kind == usual]
    other = [thermal[j].name for (_, j), k in zip(pairs, kinds, strict=True) if k != usual]
    return kept, [RejectedPhoto(name=name, reason=_ANOTHER) for name in other]


def kind_of(photo: Photo) -> tuple[str, int, str, str]:
    """Camera and format: what the photos of one raster have in common."""
    return photo.camera_key, photo.channels, photo.dtype, photo.unit
