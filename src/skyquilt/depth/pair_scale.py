"""The scale of two photos alone, from the distance of their positions and the height above take-off
together.

Two photos from 60 m are some 15 m apart, so positions that err by 2 m, each by itself, leave the
scale of a pair open by a fifth. Barometers tell the height above take-off to decimetres, and with
it the height above ground, where this lies about as high as the take-off point. Receivers whose
errors last longer than the time between two photos tell the distance far better than each position.
Which kind a receiver is, two photos show only by how well both scales agree: both kinds are weighed
by how likely they make the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Prior

GROUND = 0.06
"""Standard deviation of the ground's height above the take-off point, as a share of the flying
height: treetops of gardens seen from 40 m, relief of some metres from 60 m.
"""
LOW = 0.25
"""Share of the tie points that lie below the ground's height: the others may lie on what stands
there.
"""
LASTING_M = 0.3
"""Standard deviation in m of the distance of two positions whose errors last."""


@dataclass(frozen=True, kw_only=True)
class PairScale:
    """How the scale of a pair was found."""

    factor: float
    """By which lengths are multiplied that positions alone give."""
    share: float
    """Weight of the height above take-off, 0 to 1."""


def pair_scale(
    alignment: Alignment, photos: Sequence[Photo], priors: Sequence[Prior]
) -> PairScale | None:
    """The scale of two photos placed by their positions; None where there are not two, or the
    heights above take-off are unknown, or control points tell the scale.
    """
    placed, z = sorted(alignment.poses), alignment.ties.xyz[:, 2]
    if len(placed) != 2 or not len(z) or alignment.control:
        return None
    a, b = (alignment.poses[i].map_C for i in placed)
    reported = [p.takeoff_m for i in placed if (p := photos[i].position)]
    known = [h for h in reported if h is not None and h > 0]
    above = float((a + b)[2]) / 2 - float(np.quantile(z, LOW))
    baseline = float(np.linalg.norm(a - b))
    sigma = float(np.hypot(*(priors[i].sigma_C[0] for i in placed)))
    if len(known) < 2 or above <= 0 or baseline <= 0 or not np.isfinite(sigma):
        return None
    return weighed(float(np.log(np.mean(known) / above)), sigma / baseline, LASTING_M / baseline)


def weighed(difference: float, sigma: float, lasting: float) -> PairScale:
    """The scale between those of positions and of heights, which differ by so much in their
    logarithm; `sigma`: relative deviation of the distance of both positions as stated, `lasting`:
    that of a receiver whose errors last.
    """
    error = np.array([sigma, min(sigma, lasting)]) ** 2
    whole = error + GROUND**2
    likely = np.exp(-(difference**2) / (2 * whole)) / np.sqrt(whole)
    share = float((error / whole) @ likely / max(likely.sum(), 1e-300))
    return PairScale(factor=float(np.exp(share * difference)), share=share)


def scaled(alignment: Alignment, factor: float) -> Alignment:
    """The alignment with all lengths multiplied, about the middle of its cameras."""
    middle = np.mean([p.map_C for p in alignment.poses.values()], axis=0)
    return alignment.carried(np.eye(3), factor, middle)
