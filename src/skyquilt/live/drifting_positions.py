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
    if len(off) < FEWEST:
        return usual
    last = float(np.sqrt((left[-LAST:] ** 2).mean()))
    return last if last > SURPRISE * usual else usual
