"""Parts of a survey whose positions are displaced against those before: another battery, another
day, a correction service that was lost.

A receiver's error hardly changes within a flight and is another in the next. Taken for one, two
flights beside each other stretch or shrink the map by the difference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.poses import Alignment, Prior

Complex = NDArray[np.complex128]
Parts = NDArray[np.int64]
FEWEST = 6
"""Photos of a part that tell how it is displaced."""
CLEARER = 0.35
"""With one more part, squared misfits fall to less than this share of what they were: by chance
they fall to a half at most.
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
"""Receivers err by metres: by more than this, positions are wrong in another way, and positions of
lines in another order can be divided so that they fit.
"""
TRUSTED = 0.8
"""Share of the positions that are compared, those that fit best: others may be gross errors."""

DONE = "They were brought together;"
"""Words of the note by which an alignment tells that it did so."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Displaced:
    """Positions brought together."""

    priors: tuple[Prior, ...]
    """The priors with positions moved by the displacement of their part."""
    note: str
    """What is said of them."""


def brought_together(
    found: Alignment, names: Sequence[str], priors: Sequence[Prior]
) -> Displaced | None:
    """The priors with the positions of displaced parts brought together, the middle of all staying,
    by their deviations; None where no part is displaced. Photos are in order of capture, under
    their `names`.
    """
    own = [i for i in found.held if np.isfinite(priors[i].map_C[:2]).all()]
    if found.frame.crs is None or len(own) < 2 * FEWEST:
        return None
    placed = np.array([complex(*found.poses[i].map_C[:2]) for i in own])
    told = np.array([complex(*priors[i].map_C[:2]) for i in own])
    part = _parts(placed, told)
    shift = _shifts(placed, told, part)
    sigma = np.array([float(priors[i].sigma_C[0]) for i in own])
    apart = float(np.abs(np.diff(shift)).max(initial=0.0))
    usual = float(np.median(sigma))
    left = told - _turn(placed, told, part) * placed - shift[part]
    if not TOLD_APART * usual < apart < MOST_APART_M:
        return None
    if float(np.median(np.abs(left))) > max(EXPLAINED * usual, OF_THESE * apart):
        return None
    shift -= np.average(shift[part], weights=sigma**-2)
    moved = list(priors)
    for i, d in zip(own, shift[part], strict=True):
        there = priors[i].map_C - np.array([d.real, d.imag, 0.0])
        moved[i] = replace(priors[i], map_C=there)
    first = [names[own[k]] for k in np.flatnonzero(np.diff(part)) + 1]
    note = (
        f"Positions from {' and from '.join(first)} on are displaced against those before by up to"
        f" {apart:.1f} m: another flight, or a correction that was lost. {DONE} the map's place is"
        " as uncertain as that."
    )
    return Displaced(priors=tuple(moved), note=note)


def as_taken(found: Alignment, names: Sequence[str], priors: Sequence[Prior]) -> tuple[Prior, ...]:
    """The priors as an alignment took them: brought together where it says so."""
    told = any(DONE in note for note in found.notes)
    together = brought_together(found, names, priors) if told else None
    return tuple(priors) if together is None else together.priors


def _parts(placed: Complex, told: Complex) -> Parts:
    """The part of each photo: a part is divided as long as that makes misfits far smaller."""
    part = np.zeros(len(placed), np.int64)
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
