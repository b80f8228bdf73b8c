"""Bundle adjustment: Levenberg-Marquardt on the Schur complement, with priors on all unknowns for
which one is known.

Robust losses are iteratively reweighted (Cauchy). Why no library is used: see
docs/decisions/adjustment.md. The wheel of pycolmap offers priors on positions only; a flight strip
without loops also needs priors on tilt and on every intrinsic. The tests compare this code with
pycolmap's Ceres on problems that both can express.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.equations import Equations, NearFactor
from skyquilt.alignment.problem import CAMERA, Problem, State
from skyquilt.alignment.robust import attitude_terms, robust_cost
from skyquilt.engine.free_memory import give_back
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.engine.workers import HERE
from skyquilt.geometry.block_cholesky import Factor, Index, Matrix
from skyquilt.geometry.levenberg_marquardt import Tried, levenberg_marquardt

Array = NDArray[np.float64]
ALONE = 60_000
"""Observations up to which one thread computes the equations: sharing them out would cost more.
Threads of one process gain nothing, since half of the work is Python.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """Result of an adjustment."""

    state: State
    """The unknowns at the minimum."""
    cost: float
    """Robust cost there."""
    iterations: int
    """Steps taken."""
    converged: bool
    """False if the limit of iterations was reached first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Covariance:
    """Covariance of photos and cameras at a minimum, points marginalised. Observations count as the
    problem weighs them.
    """

    photos: Array
    """(n, p, p) of each photo with itself: rotation in rad, centre in m, and turn in rad if p is
    9; without `common`, as all fields before that.
    """
    cameras: Array
    """(11m, 11m); zero for what is fixed."""
    inverse: Matrix
    """Of all pairs of photos that share a point, and of photos with cameras."""
    factor: Factor
    """Gives it for other pairs."""
    common: Array
    """(total, k) by how much k errors of one deviation each move all unknowns, that measurements
    have in common and the equations know nothing of.
    """

    @property
    def camera_sigmas(self) -> Array:
        """Standard deviations (m, 11) of the cameras' unknowns."""
        variance = np.abs(np.diagonal(self.cameras)).copy()
        pat = self.inverse.pattern
        lens = self.common[pat.count * pat.size :][: len(variance)]  # none where all are fixed
        variance[: len(lens)] += (lens**2).sum(1)
        return np.asarray(np.sqrt(variance).reshape(-1, CAMERA))

    @property
    def photo_sigmas(self) -> Array:
        """Standard deviations (n, 3) of the centres in m."""
        pat = self.inverse.pattern
        moved = self.common[: pat.count * pat.size].reshape(pat.count, pat.size, -1)[:, 3:6]
        alone = np.abs(np.diagonal(self.photos, axis1=1, axis2=2)[:, 3:6])
        return np.asarray(np.sqrt(alone + (moved**2).sum(2)))

    def of(self, photos: Sequence[int] | Index) -> Array:
        """(p k + b, p k + b) of some photos and the border of the system: all cameras with free
        unknowns, then the common shift of positions, if there is one.
        """
        pat, chosen = self.inverse.pattern, np.asarray(photos, np.int64)
        k, p = len(chosen), pat.size
        a, b = np.minimum.outer(chosen, chosen), np.maximum.outer(chosen, chosen)
        pair = pat.find(a.ravel(), b.ravel()).reshape(k, k)
        border = pat.count * p + np.arange(pat.border)
        rows = np.concatenate([(chosen[:, None] * p + np.arange(p)).ravel(), border])
        alike = self.common[rows] @ self.common[rows].T
        if (pair < 0).any():
            unit = np.zeros((self.factor.total, len(rows)))
            unit[rows, np.arange(len(rows))] = 1.0
            return np.asarray(self.factor.solve(unit)[rows] + alike)
        blocks = self.inverse.blocks[pair]
        turned = chosen[:, None] > chosen
        blocks[turned] = np.swapaxes(blocks[turned], 1, 2)
        beside = self.inverse.beside[chosen].reshape(k * p, pat.border)
        own = np.swapaxes(blocks, 1, 2).reshape(k * p, k * p)
        return np.asarray(np.block([[own, beside], [beside.T, self.inverse.corner]]) + alike)


def adjust(
    problem: Problem,
    state: State,
    *,
    iterations: int = 30,
    tolerance: float = 1e-5,
    damping: float = 1e-4,
    keep: Keep = MADE_NOW,
    near: NearFactor | None = None,
) -> Adjusted:
    """Minimises the robust cost.

    After each step the points are refined under the moved photos before the step is accepted or
    rejected. A strip that straightens moves along a curve; without this refinement all its long
    steps would be rejected.

    Args:
        problem: observations and priors.
        state: where to start.
        iterations: largest number of steps.
        tolerance: relative decrease of the cost below which the adjustment has converged.
        damping: first damping, relative to the diagonal of the normal equations.
        keep: keeps each iteration, from where an interrupted run goes on.
        near: of earlier adjustments of nearly the same problem; it saves time if that is large.
    """
    shared = keep.workers.apart and len(problem.px) > ALONE
    workers = keep.workers if shared else HERE
    near = near or NearFactor()
    system = Equations(problem, state, workers, near=near)
    last: list[tuple[State, float]] = []

    def cost(state: State) -> float:
        if not last or last[0][0] is not state:
            last[:] = [(state, robust_cost(problem, state))]
        return last[0][1]

    def equations(state: State) -> tuple[float, Callable[[float], State]]:
        def step(damping: float) -> State:
            last[:] = [system.moved(state, damping)]
            return last[0][0]

        return cost(state), step

    place = state

    def kept(part: str, make: Callable[[], Tried[State]]) -> Tried[State]:
        nonlocal place
        tried, renewed = keep(part, lambda: (make(), near.renewed()))
        if renewed is not None:
            near.know(problem, place, renewed, workers)
        place = tried[3]
        return tried

    found = levenberg_marquardt(
        state,
        equations,
        cost,
        iterations=iterations,
        tolerance=tolerance,
        damping=damping,
        keep=kept,
    )
    return Adjusted(
        state=found.state, cost=found.cost, iterations=found.iterations, converged=found.converged
    )


def covariance(problem: Problem, state: State) -> Covariance | None:
    """Covariance of photos and cameras at a minimum; None if some unknowns are not determined."""
    system = Equations(problem, state)
    give_back()
    try:
        factor = Factor(system.reduced(state, 0.0)[0])
    except np.linalg.LinAlgError:
        return None
    inverse = factor.selected_inverse()
    own = np.arange(system.n)
    cameras = np.zeros((CAMERA * system.m,) * 2)
    free = system.q * system.m
    cameras[:free, :free] = inverse.corner[:free, :free]
    photos = inverse.blocks[system.pattern.find(own, own)]
    if not (np.isfinite(photos).all() and np.isfinite(cameras).all()):
        return None
    none = np.zeros((factor.total, 0))
    return Covariance(photos=photos, cameras=cameras, inverse=inverse, factor=factor, common=none)


def with_common_tilts(
    found: Covariance, problem: Problem, state: State, alike: Array
) -> Covariance:
    """The covariance where tilts that were measured err not only each by itself but also all of a
    camera alike, as seen from it, as a gimbal does, by these deviations (n,) in rad. No number of
    photos averages that out.
    """
    first = problem.photo_unknowns * np.arange(len(state.C))
    known = attitude_terms(problem, state)[1] * alike[:, None]
    pull = np.zeros((found.factor.total, 2 * len(state.K)))
    for axis in range(2):  # an error about x, and one about y of a camera
        turned = np.einsum("nij,nj->ni", problem.R0, known * problem.R0[:, axis])
        pull[first[:, None] + np.arange(3), 2 * problem.camera[:, None] + axis] = turned
    return replace(found, common=found.factor.solve(pull))
