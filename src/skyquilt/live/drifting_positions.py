"""Positions whose errors are alike from photo to photo: those of a receiver that drifts, or that
jumps for some photos. The error of the next photo is foreseen from those of photos taken beside it.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FEWEST = 6
"""Photos that tell how alike errors are."""
CHANCE = 2.0
"""Errors are alike if they are correlated by more than so many deviations of what chance does."""
LAST, SURPRISE = 3, 2.0
"""So many photos tell that positions suddenly err by more, if their errors are, in the root mean
square, so many times as large as usual.
"""
FASTER, LONGER, FEWEST_STEPS, TICK_S = 1.5, 3.0, 2, 0.5
"""A position leaps that lies further from the one before than a drone flies that is so many times
as fast as usual, for so many times as long as usual at most, by so many steps; least time in s
between photos, as clocks tell whole seconds.
"""
RAYLEIGH = 1.18
"""Median length of errors in the plane over their deviation per axis."""


def alike(off: Array) -> float:
    """Share, 0 to 1, of a photo's error that the next one has, too, by errors (n, 2) in m of photos
    in the order in which they were taken; 0 where no more than chance tells of it.
    """
    if len(off) < FEWEST:
        return 0.0
    before, after = off[:-1], off[1:]
    most = max(float((before**2).sum()), float((after**2).sum()), 1e-12)
    share = float((before * after).sum()) / most
    return share if share > CHANCE / np.sqrt(before.size) else 0.0


def foreseen(off: Array, at: int) -> Array:
    """The error (2,) in m of a photo taken before the one at this place of a sequence with errors
    (n, 2) in m, or after all of them: as far as errors are alike, that of the photo before it, or
    of the first.
    """
    share = alike(off)
    return share * off[max(at - 1, 0)] if share else np.zeros(2)


def unforeseen_m(off: Array, usual: float) -> float:
    """Deviation per axis in m of what is not foreseen of errors (n, 2) in m: of all of them, or of
    the last, if that is much more. `usual`: the one to take where errors are not alike.
    """
    share = alike(off)
    left = off.copy()
    left[1:] -= share * off[:-1]
    if share:
        usual = float(np.median(np.linalg.norm(left[1:], axis=1))) / RAYLEIGH
    if len(off) < LAST:
        return usual
    if len(off) < FEWEST:  # they do not tell how alike they are, but which is unlike the others
        left = off - np.median(off, axis=0)
    last = float(np.sqrt((left[-LAST:] ** 2).mean()))
    return last if last > SURPRISE * usual else usual


def leap_m(way: Array, s: Array, at: Array, then: float) -> float:
    """By how many metres a photo's position `at` (2,), told for the moment `then`, lies further
    from the one before it, or from the first, than the drone flies: by the positions (n, 2) in m of
    others and their times in s, ascending. 0 where it does not, or where nothing tells.
    """
    if len(way) < FEWEST_STEPS + 1 or not np.isfinite(then):
        return 0.0
    lasted = np.maximum(np.diff(s), TICK_S)
    usual = float(np.median(np.linalg.norm(np.diff(way, axis=0), axis=1) / lasted))
    before = max(int(np.searchsorted(s, then)) - 1, 0)
    took = np.clip(abs(then - s[before]), TICK_S, LONGER * np.median(lasted))
    away = float(np.linalg.norm(at - way[before]))
    return max(away - FASTER * usual * float(took), 0.0)
