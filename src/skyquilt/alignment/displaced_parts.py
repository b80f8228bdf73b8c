"""Positions of a part of a survey that are displaced against the others: another battery, another
day, another drone, a correction service that was lost.

A receiver's error hardly changes within a flight and is another in the next. Taken for one, two
flights beside each other stretch or shrink the map by the difference. Positions of a few photos
that are off by more than receivers err are outvoted by the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.crowded_positions import without_places
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.model.poses import Alignment, Prior
from skyquilt.photos.side_rows import sentence_of

Complex = NDArray[np.complex128]
Parts = NDArray[np.int64]
FEWEST = 6
"""Photos of a part that tell how it is displaced."""
CLEARER = 0.35
"""With one more part, squared misfits fall to less than this share of what they were: by chance
they fall to a half at most.
"""
FEW, CLEAR, CLEAR_APART, CLEAR_M = 3, 0.15, 3.0, 9.0
"""Fewer photos than those, but so many, tell one displacement by more than this times their
deviations and so many m (moments and tilts move lines by less), where misfits fall below the share:
by chance they fall to a fifth at most.
"""
MOST_PARTS = 8
"""Parts into which a survey is divided at most."""
LOOKED_AT = 60
"""So many places of a large survey are tried for where a part begins, then those by the best;"""
MIDDLES = 16
"""and so many for the begin and the end of a part between two others."""
TOLD_APART = 0.5
"""Displacements below this share of the positions' deviations are left alone."""
EXPLAINED, OF_THESE = 2.5, 0.15
"""Displacements explain positions that then misfit (median) by less than this times what they
state, or this share of the displacement: positions in a false order misfit by more.
"""
MOST_APART_M = 40.0
"""Receivers err by metres: by more than this, positions are wrong in another way (another datum, a
false base). Those of fewer photos are then not used at all; and of displacements one alone is
believed, which must explain them as they state, since lines in another order can be divided so that
they fit.
"""
AGREE, BETWEEN = 5.0, 0.1
"""Positions agree with most others where they misfit by less than this times what these misfit by
(median), or state; where more than this share misfit by half as much and more, errors of all sizes
occur, and nobody is outvoted.
"""
OFF = 2.0
"""Nothing is gained where photos lie nearer than this times their misfit to positions that agree.
"""
REACH = 0.5
"""Photos that outvote others reach as far as all photos, or this share of it: those of one line
tell little of scale and direction.
"""
TRUSTED = 0.8
"""Share of the positions that are compared, those that fit best: others may be gross errors."""

DONE = "They were brought together;"
"""Words of the note by which an alignment tells that it did so."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Displaced:
    """Positions brought together."""

    priors: tuple[Prior, ...]
    """The priors with positions moved by the displacement of their part, or without those of some.
    """
    note: str
    """What is said of them."""
    apart_m: float
    """How far these positions lie from the others."""


class _Compared(NamedTuple):
    """Photos whose positions are told, in order of capture."""

    own: list[int]
    """Their numbers."""
    placed: Complex
    """(n,) where they were found, x + iy in m."""
    told: Complex
    """(n,) where they tell that they are."""
    sigma: NDArray[np.float64]
    """(n,) deviations of that in m."""


def _compared(found: Alignment, priors: Sequence[Prior]) -> _Compared | None:
    """The photos that tell of displaced positions; None where they are too few."""
    own = [i for i in found.held if np.isfinite(priors[i].map_C[:2]).all()]
    if found.frame.crs is None or len(own) < 2 * FEW:
        return None
    return _Compared(
        own=own,
        placed=np.array([complex(*found.poses[i].map_C[:2]) for i in own]),
        told=np.array([complex(*priors[i].map_C[:2]) for i in own]),
        sigma=np.array([float(priors[i].sigma_C[0]) for i in own]),
    )


def brought_together(
    found: Alignment,
    names: Sequence[str],
    priors: Sequence[Prior],
    cameras: Sequence[str],
    *,
    few: bool = True,
) -> Displaced | None:
    """The priors with the positions of displaced parts brought together, the middle of all staying,
    by their deviations; None where no part is displaced. Photos are in order of capture, under
    their `names` and those of their `cameras`, which may be those of drones that fly together.
    `few`: parts may also be of few photos.
    """
    positions = _compared(found, priors)
    if positions is None:
        return None
    own, placed, told, sigma = positions
    part, drones = _parts(placed, told), _drones([cameras[i] for i in own])
    if few and not part.any():
        part = _few(positions)
    together = np.zeros(len(own), np.int64)
    several = _misfit(placed, told, drones) < CLEARER * _misfit(placed, told, together)
    several &= _misfit(placed, told, drones) < _misfit(placed, told, part)
    part = drones if several else part
    shift = _shifts(placed, told, part)
    apart = float(np.abs(np.diff(shift)).max(initial=0.0))
    usual = float(np.median(sigma))
    left = told - _turn(placed, told, part) * placed - shift[part]
    if not TOLD_APART * usual < apart:
        return None
    near = apart < MOST_APART_M
    if float(np.median(np.abs(left))) > max(EXPLAINED * usual, OF_THESE * apart if near else 0.0):
        return None
    if not near and len(shift) > 2 and not several:
        return None
    shift -= np.average(shift[part], weights=sigma**-2)
    moved = list(priors)
    for i, d in zip(own, shift[part], strict=True):
        there = priors[i].map_C - np.array([d.real, d.imag, 0.0])
        moved[i] = replace(priors[i], map_C=there)
    first = [int(np.flatnonzero(part == k)[0]) for k in range(1, len(shift))]
    if several:
        which = f"of {' and of '.join(cameras[own[k]] for k in first)}"
        other = f"those of {cameras[own[int(np.flatnonzero(part == 0)[0])]]}"
    else:
        which = f"from {' and from '.join(names[own[k]] for k in first)} on"
        other = "those before"
    why = "drones with receivers of their own" if several else "another flight"
    note = (
        f"Positions {which} are displaced against {other} by up to {apart:.1f} m: {why}, or a"
        f" correction that was lost. {DONE} the map's place is as uncertain as that."
    )
    return Displaced(priors=tuple(moved), note=note, apart_m=apart)


def outvoted(
    found: Alignment, names: Sequence[str], priors: Sequence[Prior], cameras: Sequence[str]
) -> Displaced | None:
    """The priors without the positions of photos that contradict those of most others, whichever
    photos these are: a second drone with a false base, files whose positions somebody shifted.
    Heights stay. None where no majority agrees, or where the map lies by it already; and where
    parts err as receivers do, which are brought together.
    """
    positions = _compared(found, priors)
    if positions is None:
        return None
    own, placed, told, sigma = positions
    g, c, _ = fit_similarity(placed, told, sigma)
    off = np.abs(told - g * placed - c)
    limit = AGREE * max(float(np.median(off)), float(np.median(sigma)))
    agree = off < limit
    fit = float(np.median(off[agree])) if agree.any() else np.inf
    if len(own) < 2 * FEWEST or agree.all() or 2 * agree.sum() <= len(own) or agree.sum() < FEWEST:
        return None
    if (agree & (off > limit / 2)).mean() > BETWEEN:
        return None
    if np.median(np.abs(told - placed)[agree]) < OFF * max(fit, float(np.median(sigma))):
        return None
    if np.std(placed[agree]) < REACH * np.std(placed):
        return None
    apart = float(np.median(off[~agree]))
    if apart < MOST_APART_M and brought_together(found, names, priors, cameras, few=False):
        return None
    out, away = list(priors), [i for i, a in zip(own, agree.tolist(), strict=True) if not a]
    for i, bare in zip(away, without_places([priors[i] for i in away]), strict=True):
        out[i] = bare
    note = (
        f"The positions of {len(away)} of {len(own)} photos lie {apart:.0f} m (median) from where"
        f" the others and the pictures put them: {sentence_of([names[i] for i in away])}. They are"
        " not used. If these are the right ones, the map lies elsewhere by as much."
    )
    return Displaced(priors=tuple(out), note=note, apart_m=apart)


def placed_between(found: Alignment, apart_m: float) -> Alignment:
    """The alignment, its place in the middle of parts so far apart, any of which may be right."""
    told = found.accuracy
    if told is None or not any(told.shared_m):  # held by control points
        return found
    flat, up = told.shared_m
    return replace(found, accuracy=replace(told, shared_m=(max(flat, apart_m / 2), up)))


def as_taken(
    found: Alignment, names: Sequence[str], priors: Sequence[Prior], cameras: Sequence[str]
) -> tuple[Prior, ...]:
    """The priors as an alignment took them: brought together where it says so."""
    told = any(DONE in note for note in found.notes)
    together = brought_together(found, names, priors, cameras) if told else None
    return tuple(priors) if together is None else together.priors


def _drones(cameras: Sequence[str]) -> Parts:
    """The part of each photo, those of a camera (name) with enough photos being one, and all others
    the first.
    """
    enough = [c for c in dict.fromkeys(cameras) if cameras.count(c) >= FEWEST]
    return np.array([enough.index(c) if c in enough else 0 for c in cameras], np.int64)


def _parts(placed: Complex, told: Complex) -> Parts:
    """The part of each photo: a part is divided as long as that makes misfits far smaller."""
    part = np.zeros(len(placed), np.int64)
    if len(part) < 2 * FEWEST:
        return part
    misfit = _misfit(placed, told, part)
    for _ in range(MOST_PARTS - 1):
        rough = np.linspace(FEWEST, len(part) - FEWEST, LOOKED_AT).astype(int)
        best, least = _best_division(placed, told, part, sorted(set(rough.tolist())))
        around = range(best - len(part) // LOOKED_AT, best + len(part) // LOOKED_AT + 1)
        best, least = _best_division(placed, told, part, [best, *around])
        if least < CLEARER * misfit:
            part, misfit = _divided(part, best), least
            continue
        if len(middle := _middle_part(placed, told, part, CLEARER**2 * misfit)) != len(part):
            break
        part, misfit = middle, _misfit(placed, told, middle)
    return part


def _few(positions: _Compared) -> Parts:
    """The part of each photo, one of the two being of few; all the same where nothing is clear."""
    _, placed, told, sigma = positions
    together = np.zeros(len(placed), np.int64)
    ends = range(FEW, len(placed) - FEW + 1)
    misfit = {k: _misfit(placed, told, _divided(together, k)) for k in ends}
    best = min(misfit, key=lambda k: misfit[k])
    part = _divided(together, best)
    first, second = _shifts(placed, told, part)
    far = abs(second - first) > max(CLEAR_APART * float(np.median(sigma)), CLEAR_M)
    return part if far and misfit[best] < CLEAR * _misfit(placed, told, together) else together


def _middle_part(placed: Complex, told: Complex, part: Parts, below: float) -> Parts:
    """The parts with a further one between two others, as long as a battery lasts, which a single
    division does not show; empty where misfits do not fall below.
    """
    rough = sorted(set(np.linspace(0, len(part), MIDDLES).astype(int).tolist()))
    tried = {c: _misfit_of(placed, told, part, c) for c in combinations(rough, 2)}
    a, b = min(tried, key=lambda c: tried[c])
    step = len(part) // MIDDLES + 1
    a = _least(a - step, a + step, lambda k: _misfit_of(placed, told, part, (k, b)))
    b = _least(b - step, b + step, lambda k: _misfit_of(placed, told, part, (a, k)))
    if not _misfit_of(placed, told, part, (a, b)) < below:
        return np.zeros(0, np.int64)
    return _divided(_divided(part, a), b)


def _least(low: int, high: int, misfit: Callable[[int], float]) -> int:
    """The place from low to high where a misfit is least, of a wide range by ever closer ones."""
    while (step := max(1, (high - low) // LOOKED_AT)) > 1:
        best = min(range(low, high + 1, step), key=misfit)
        low, high = best - step, best + step
    return min(range(low, high + 1), key=misfit)


def _misfit_of(placed: Complex, told: Complex, part: Parts, ends: tuple[int, int]) -> float:
    """The misfit with a further part between these photos; infinite where a part is too small."""
    a, b = ends
    if min(a, b - a, len(part) - b) < FEWEST:
        return np.inf
    tried = _divided(_divided(part, a), b)
    return _misfit(placed, told, tried) if np.bincount(tried).min() >= FEWEST else np.inf


def _best_division(
    placed: Complex, told: Complex, part: Parts, places: Sequence[int]
) -> tuple[int, float]:
    """Where a new part fits best, and the misfit then; infinite where all would be too small."""
    best, least = places[0], np.inf
    for k in places:
        if not FEWEST <= k <= len(part) - FEWEST:
            continue
        tried = _divided(part, k)
        if np.bincount(tried).min() >= FEWEST and (miss := _misfit(placed, told, tried)) < least:
            best, least = k, miss
    return best, least


def _divided(part: Parts, k: int) -> Parts:
    """The parts with one more beginning at the photo k."""
    if part[k] != part[k - 1]:
        return part
    return part + (np.arange(len(part)) >= k)


def _misfit(placed: Complex, told: Complex, part: Parts) -> float:
    """Mean square in m^2 of the smaller distances between the positions told and the photos as
    placed, brought to them by one similarity with a shift for each part.
    """
    turn = _turn(placed, told, part)
    off = _apart(told - turn * placed, part)
    squares = np.sort(np.abs(off) ** 2)[: int(np.ceil(TRUSTED * len(off)))]
    return float(squares.mean())


def _turn(placed: Complex, told: Complex, part: Parts) -> complex:
    """Scale and rotation that all parts share, by weights that gross errors lose."""
    x, weight, turn = _apart(placed, part), np.ones(len(placed)), 1 + 0j
    for _ in range(10):
        y = _apart(told, part, weight)
        x = _apart(placed, part, weight)
        turn = complex((weight * np.conj(x) * y).sum() / (weight * np.abs(x) ** 2).sum())
        off = np.abs(y - turn * x)
        usual = max(float(np.median(off)), 1e-6)
        weight = 1 / (1 + (off / (3 * usual)) ** 2)
    return turn


def _apart(z: Complex, part: Parts, weight: NDArray[np.float64] | None = None) -> Complex:
    """Values minus the (weighted) mean of their part."""
    w = np.ones(len(z)) if weight is None else weight
    total = np.bincount(part, w)
    mean = (np.bincount(part, w * z.real) + 1j * np.bincount(part, w * z.imag)) / total
    return np.asarray(z - mean[part])


def _shifts(placed: Complex, told: Complex, part: Parts) -> Complex:
    """Displacement of each part."""
    off = told - _turn(placed, told, part) * placed
    return np.array(
        [
            complex(np.median(off[part == k].real), np.median(off[part == k].imag))
            for k in range(int(part.max()) + 1)
        ]
    )
