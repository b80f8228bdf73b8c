"""Reported heights of some photos that those of the others and the pictures contradict: heights in
feet among metres, above take-off among those above sea level, of another datum, or made up.

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

FEWEST = 4
"""Photos with heights that are needed to judge them."""
AGREE, BETWEEN = 5.0, 0.1
"""Heights agree with most others where they differ by less than this times what these differ by
(median), or state; where more than this share differ by half as much and more, errors of all sizes
occur, as of a barometer that drifts, and nobody is outvoted.
"""
APART_M = 20.0
"""Receivers and barometers err by metres; so far apart, heights are wrong in another way."""
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


def _differences(
    found: Alignment, priors: Sequence[Prior]
) -> tuple[list[int], NDArray[np.float64], NDArray[np.float64]]:
    """Photos that report a height, by how many m it lies above where they were found, and the
    deviations in m that they state; none of a map without a place.
    """
    placed = found.held if found.frame.crs is not None else ()
    own = [i for i in placed if np.isfinite(priors[i].map_C[2])]
    off = np.array([priors[i].map_C[2] - found.poses[i].map_C[2] for i in own], np.float64)
    return own, off, np.array([priors[i].sigma_C[2] for i in own], np.float64)


def outvoted_heights(
    found: Alignment, names: Sequence[str], priors: Sequence[Prior]
) -> FalseHeights | None:
    """The priors without the heights of photos that contradict those of most others. None where no
    majority agrees, or where the map lies by it already.
    """
    own, off, stated = _differences(found, priors)
    if len(own) < FEWEST:
        return None
    away = np.abs(off - np.median(off))
    limit = AGREE * np.maximum(np.median(away), stated)
    agree = away < limit
    if agree.all() or 2 * agree.sum() <= len(own) or (agree & (2 * away > limit)).mean() > BETWEEN:
        return None
    middle = float(off[agree].mean())
    apart = float(np.median(np.abs(off[~agree] - middle)))
    errs = np.hypot(off[agree].std(), np.median(stated)) / np.sqrt(agree.sum())
    if apart < APART_M or abs(middle) < MEANT * errs:
        return None
    out = list(priors)
    false = [i for i, a in zip(own, agree.tolist(), strict=True) if not a]
    for i, bare in zip(false, without_heights([priors[i] for i in false]), strict=True):
        out[i] = bare
    named = sentence_of([names[i] for i in false])
    note = (
        f"The heights of {len(false)} of {len(own)} photos lie {apart:.0f} m (median) from where"
        f" the others and the pictures put them: {named}. They are not used."
        " If these are the right ones, the map lies higher or lower by as much."
    )
    return FalseHeights(priors=tuple(out), note=note)


def height_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence where reported heights contradict one another, and no majority agrees."""
    own, off, stated = _differences(alignment, priors)
    if len(own) < FEWEST:
        return []
    apart, usual = float(np.median(np.abs(off - np.median(off)))), float(np.median(stated))
    if apart <= max(AGREE * usual, APART_M):
        return []
    return [
        f"The reported heights contradict the pictures: half of the photos lie more than"
        f" {apart:.0f} m higher or lower than they say against the others, {usual:.2g} m are"
        " expected. The height of the map rests on them and is not reliable; correct them with a"
        " geo.txt, or give control points."
    ]
