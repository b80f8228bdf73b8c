"""Reported heights of some photos that those of the others and the pictures contradict: heights in
feet among metres, above take-off among those above sea level, above another take-off point, of
another datum, or made up.

Pictures tell heights against one another, but not from where these count. Taken for right, false
heights lift or lower the whole map by their share of the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.crowded_positions import without_heights
from skyquilt.model.poses import Alignment, Prior
from skyquilt.photos.side_rows import sentence_of

Numbers = NDArray[np.float64]
FEWEST = 4
"""Photos with heights that are needed to judge them."""
AGREE, BETWEEN = 5.0, 0.1
"""Heights agree with most others where they differ by less than this times what these differ by
(median), or state; where more than this share differ by half as much and more, errors of all sizes
occur, as of a barometer that drifts, and nobody is outvoted.
"""
APART_M = 20.0
"""Receivers and barometers err by metres; so far apart, heights are wrong in another way."""
STEP_M = 8.0
"""The same of heights above take-off that all change by one step between two photos, if it is more
than `AGREE` times what they scatter by beside it: errors come and go, or grow.
"""
UNUSED = "These heights are not used."
"""Words of the note by which an alignment tells that."""
MEANT = 2.0
"""The map lies by the others where it misses them by less than this times what their mean errs by.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class FalseHeights:
    """Heights that are not used."""

    priors: tuple[Prior, ...]
    """The priors without these."""
    note: str
    """What is said of them."""


def _differences(found: Alignment, priors: Sequence[Prior]) -> tuple[list[int], Numbers, Numbers]:
    """Photos that report a height, by how many m it lies above where they were found, and the
    deviations in m that they state; none of a map without a place.
    """
    placed = found.held if found.frame.crs is not None else ()
    own = [i for i in placed if np.isfinite(priors[i].map_C[2])]
    off = np.array([priors[i].map_C[2] - found.poses[i].map_C[2] for i in own], np.float64)
    return own, off, np.array([priors[i].sigma_C[2] for i in own], np.float64)


def _majority(off: Numbers, stated: Numbers) -> NDArray[np.bool_] | None:
    """Which differences agree with most others; None where there is no majority."""
    away = np.abs(off - np.median(off))
    limit = AGREE * np.maximum(np.median(away), stated)
    agree = away < limit
    if 2 * agree.sum() <= len(off) or (agree & (2 * away > limit)).mean() > BETWEEN:
        return None
    return np.asarray(agree)


def _flights(off: Numbers, cameras: Sequence[str]) -> NDArray[np.bool_] | None:
    """Which differences are those of the flights from the take-off point with most photos, of
    equally many the first one, where flights of a camera one after the other, or of several drones
    at once, have heights above take-off points of their own. None where they have not.
    """
    order = np.argsort(off)
    gap = np.diff(off[order])
    wide = gap > STEP_M
    group = np.empty(len(off), np.int64)
    group[order] = np.cumsum(np.r_[False, wide])
    drone = np.unique(cameras, return_inverse=True)[1]
    runs = np.column_stack([drone, group])[np.argsort(drone, kind="stable")]
    began = 1 + np.count_nonzero(np.diff(runs, axis=0).any(1))
    if not wide.any() or began != len(np.unique(runs, axis=0)):  # it comes and goes
        return None
    middle = np.array([np.median(off[group == k]) for k in range(wide.sum() + 1)])
    if gap[wide].min() < AGREE * float(np.median(np.abs(off - middle[group]))):
        return None
    count = np.bincount(group)[group]
    return np.asarray(group == group[np.argmax(count)])


def outvoted_heights(
    found: Alignment, names: Sequence[str], priors: Sequence[Prior], cameras: Sequence[str]
) -> FalseHeights | None:
    """The priors without the heights of photos that contradict those of most others; of flights
    from several take-off points without those of all but one. Photos are in order of capture, by
    the cameras of these names. None where no majority agrees, or where the map lies by it already.
    """
    own, off, stated = _differences(found, priors)
    if len(own) < FEWEST:
        return None
    takeoff = found.frame.vertical_datum == "takeoff"
    flights = _flights(off, [cameras[i] for i in own]) if takeoff else None
    agree = _majority(off, stated) if flights is None else flights
    if agree is None or agree.all():
        return None
    middle = float(off[agree].mean())
    apart = float(np.median(np.abs(off[~agree] - middle)))
    errs = np.hypot(off[agree].std(), np.median(stated)) / np.sqrt(agree.sum())
    least = APART_M if flights is None else STEP_M
    if apart < least or abs(middle) < MEANT * errs:
        return None
    out = list(priors)
    false = [i for i, a in zip(own, agree.tolist(), strict=True) if not a]
    for i, bare in zip(false, without_heights([priors[i] for i in false]), strict=True):
        out[i] = bare
    named = sentence_of([names[i] for i in false])
    why = ""
    if flights is not None:
        why = " Perhaps these are flights from another take-off point: heights count from that of"
        why += " the others."
    note = (
        f"The heights of {len(false)} of {len(own)} photos lie {apart:.0f} m (median) from where"
        f" the others and the pictures put them: {named}. {UNUSED}{why}"
        " If these are the right ones, the map lies higher or lower by as much."
    )
    return FalseHeights(priors=tuple(out), note=note)


def outvoted(alignment: Alignment) -> bool:
    """Whether it tells that some heights are not used."""
    return any(UNUSED in note for note in alignment.notes)


def height_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence where reported heights contradict one another, and no majority agrees."""
    own, off, stated = _differences(alignment, priors)
    if len(own) < FEWEST or outvoted(alignment):
        return []
    apart, usual = float(np.median(np.abs(off - np.median(off)))), float(np.median(stated))
    if apart <= max(AGREE * usual, APART_M / 2):
        return []
    return [
        f"The reported heights contradict the pictures: half of the photos lie more than"
        f" {apart:.0f} m higher or lower than they say against the others, {usual:.2g} m are"
        " expected. The height of the map rests on them and is not reliable; correct them with a"
        " geo.txt, or give control points."
    ]
