"""How far the results of an adjustment may be wrong, from what its residuals show.

Two figures describe the observations. The *variance factor*: how much larger their errors are than
was assumed. The *design effect* (Kish 1965): how many observations with correlated errors tell as
much as one independent one. Errors of neighbouring observations in a photo are correlated, since
the model is incomplete in the same way for them (lens, air, leaves, relief within a patch).
Residuals of neighbours show a part of that, which is measured in small cells. The other part is
hidden: pose and lens take it up. On simulated flights, where errors are known, it amounts to some
thousandths of a pixel and hardly falls with distance up to a third of a photo; it is what limits a
focal length. Both are taken to reach over a quarter of a photo.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import Covariance
from skyquilt.alignment.eliminated_points import observation_equations
from skyquilt.alignment.least_squares_matching import LeastSquaresMatching
from skyquilt.alignment.problem import CAMERA, PART, Problem, State, residuals_px

Array = NDArray[np.float64]
CELLS = 8
"""Cells of a photo along each side in which residuals of neighbours are compared."""
FEWEST_ERRORS, LONE, MOST_LONE = 6, 5.0, 0.2
"""Of so many known positions and more, those are wrong by themselves whose errors are so many times
as large as most; where they are more than this share, nothing tells which ones are wrong.
"""
REACH = 2
"""Parts of a photo along each side over which a correlation is taken to reach."""

HIDDEN = 0.003
"""Deviation of the error that all observations of a part of a photo have in common and that its
pose takes up, in px of an image of `MATCHED` px, or of the photo if that is smaller.
"""
MATCHED = LeastSquaresMatching.longest
"""Longest side in px of the images in which observations are refined."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """What residuals show of the observations."""

    variance: float
    """Variance of the observations over the assumed one."""
    design_effect: float
    """Observations that tell as much as an independent one."""


def robust_scale(problem: Problem, state: State) -> float:
    """Deviation of the bulk of the observations over the assumed one, from the median residual.

    Residuals of a few observations per point are smaller than the errors; the share of the
    equations that is left after the unknowns accounts for that.
    """
    e = residuals_px(problem, state)
    e /= problem.sigma_px[:, None]
    left = max(1 - _unknowns(problem, state) / (2 * len(e)), 0.05)
    if not np.isfinite(e).any():  # photos of one place: no ray has a point on it
        return float("nan")
    return float(1.48 * np.nanmedian(np.abs(e, out=e)) / np.sqrt(left))


def observed_noise(problem: Problem, state: State, size: Array) -> Noise:
    """The noise of the observations at a minimum; `size` (n, 2): each photo's in px."""
    psi, w = _weighted(problem, state)
    spare = max(2 * len(psi) - _unknowns(problem, state), 1)
    # the weights enter the normal equations; their variance and slope tell what these are worth
    variance = float((psi**2).sum()) / spare * float(w.mean()) / float((w**2).mean()) ** 2
    del w
    near = max(alike_within(_part(problem, size, CELLS), psi), 0.0)
    del psi
    hidden = (HIDDEN * np.maximum(size.max(1) / MATCHED, 1))[problem.photo]
    hidden /= problem.sigma_px
    near += float((hidden**2).mean()) / variance
    part = _part(problem, size, REACH)
    crowd = np.bincount(part).astype(float)
    together = float((crowd**2).sum() / crowd.sum())  # in the part of an observation, on average
    return Noise(variance=variance, design_effect=1 + min(near, 1.0) * (together - 1))


def likeness(problem: Problem, state: State, size: Array) -> Array:
    """Correlation (m,) of residuals of different points of an eighth of a photo, for the photos of
    each camera: 0 = they are independent, 1 = they err as one, as they do where no lens of the
    model fits. `size` (n, 2): each photo's in px.
    """
    psi, _ = _weighted(problem, state)
    part, camera = _part(problem, size, CELLS), problem.camera[problem.photo]
    each = [camera == row for row in range(len(state.K))]
    return np.array([alike_within(part[own], psi[own]) for own in each])


def _weighted(problem: Problem, state: State) -> tuple[Array, Array]:
    """Residuals (N, 2) in deviations times their robust weights, and these (N,)."""
    psi = np.nan_to_num(residuals_px(problem, state), copy=False)  # of millions of observations
    psi /= problem.sigma_px[:, None]
    w = 1 / (1 + (psi**2).sum(1) / problem.loss_px**2)
    psi *= w[:, None]
    return psi, w


def _unknowns(problem: Problem, state: State) -> int:
    """Unknowns of an adjustment, turns left out."""
    return 6 * len(state.C) + int(problem.free.sum()) + 3 * len(state.X)


def _part(problem: Problem, size: Array, parts: int) -> NDArray[np.int64]:
    """Number (N,) of the cell of its photo in which each observation lies."""
    out = np.empty(len(problem.px), np.int64)
    for lo in range(0, len(out), PART):
        some = slice(lo, lo + PART)
        photo = problem.photo[some].astype(np.int64)
        cell = (problem.px[some] + 0.5) / size[photo] * parts
        column, row = np.clip(cell, 0, parts - 1).astype(int).T
        out[some] = (photo * parts + row) * parts + column
    return out


def alike_within(part: NDArray[np.int64], psi: Array) -> float:
    """Correlation of residuals (N, 2) of different points in the same one of the parts (N,)."""
    count = np.bincount(part).astype(float)
    pairs = float((count * (count - 1)).sum())
    sums = np.stack([np.bincount(part, psi[:, k]) for k in range(2)], 1)
    own = float((psi**2).sum())
    if pairs == 0 or own == 0:
        return 0.0
    return (float((sums**2).sum()) - own) / pairs / (own / len(psi))


def point_deviations(
    problem: Problem, state: State, covariance: Covariance, points: NDArray[np.int64]
) -> Array:
    """Standard deviations (k, 3) in m of points of a problem.

    Args:
        problem: their observations; each point's own are taken to be independent of one another,
            but for those of photos of the same place.
        state: the minimum.
        covariance: of photos and cameras, as from `adjust.covariance`.
        points: (k,) which points.
    """
    own, _ = replace(problem, trust=problem.shared).only(np.isin(problem.point, points))
    normal = observation_equations(own, replace(state, X=state.X[np.sort(points)]))
    p, q = normal.Wp.shape[1], normal.Wc.shape[1]
    first = np.searchsorted(own.point, np.arange(len(points) + 1))
    out = np.full((len(points), 3), np.nan)
    alike: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for k, point in enumerate(np.argsort(np.argsort(points)).tolist()):
        shown = own.photo[first[point] : first[point + 1]].tolist()
        alike.setdefault(tuple(shown), []).append((k, point))
    # points that the same photos show need the same part of the covariance
    for shown, some in alike.items():
        photo = np.array(shown, np.int64)
        local = np.arange(p * len(photo))
        camera = len(local) + CAMERA * own.camera[photo][:, None] + np.arange(q)
        at = np.concatenate([local, camera.ravel()])
        among = covariance.of(photo)[np.ix_(at, at)]
        for k, point in some:
            seen = slice(first[point], first[point + 1])
            W = np.concatenate([normal.Wp[seen].reshape(-1, 3), normal.Wc[seen].reshape(-1, 3)])
            V = normal.V[point] + 1e-9 * np.eye(3)
            moved = np.linalg.solve(V, W.T)
            total = np.linalg.inv(V) + moved @ among @ moved.T
            out[k] = np.sqrt(np.maximum(np.diag(total), 0.0))
    return out


def believed(problem: Problem, noise: Noise) -> Problem:
    """The problem whose observations weigh what the noise says that they tell."""
    effect = noise.design_effect
    return replace(problem, design_effect=effect, trust=problem.shared / (effect * noise.variance))


def lone_errors(error: Array, stated: float) -> NDArray[np.bool_]:
    """Which errors (n, k) of positions, in order of capture, NaN where unknown, are gross ones of
    single photos: far larger than most, and than those before and after. Errors that grow from
    photo to photo are none: they may tell of a bent strip. `stated`: the usual deviation.
    """
    lone = np.zeros(len(error), np.bool_)
    known = np.flatnonzero(np.isfinite(error).all(1))
    if len(known) < FEWEST_ERRORS:
        return lone
    own = error[known]
    size = np.linalg.norm(own, axis=1)
    limit = LONE * max(float(np.median(size)), stated)
    beside = [np.r_[own[1:2], own[:-1]], np.r_[own[1:], own[-2:-1]]]
    apart = [np.linalg.norm(own - other, axis=1) for other in beside]
    far = (size > limit) & (np.minimum(*apart) > limit)
    if far.sum() <= MOST_LONE * len(own):
        lone[known[far]] = True
    return lone


def position_noise(error: Array) -> float:
    """Robust deviation in m of each axis of position errors (n, 2), in order of capture, from
    their neighbours' mean.
    """
    known = error[np.isfinite(error).all(1)]
    if len(known) < 6:
        return 0.0
    local = known[1:-1] - (known[:-2] + known[2:]) / 2
    return float(1.48 * np.median(np.abs(local)) / np.sqrt(1.5))


def drift(error: Array) -> float:
    """Robust deviation in m of what position errors (n, 2), in order of capture, have in common
    with those before and after: all of it less `position_noise`. Zero for errors of which each is
    its own, and of fewer than six, which do not tell.
    """
    noise = position_noise(error)
    known = error[np.isfinite(error).all(1)]
    spread = 1.48 * np.median(np.abs(known)) if noise > 0 else 0.0
    return float(np.sqrt(max(spread**2 - noise**2, 0.0)))
