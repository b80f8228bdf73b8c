"""Normal equations of an adjustment, with the points eliminated (Schur complement).

Observations are taken in parts of whole points: what a part says of photos and cameras is added to
one sparse matrix, and then forgotten. So memory holds the matrix, not the equations.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.eliminated_points import Reduced, moved_points, reduced_part
from skyquilt.alignment.problem import CAMERA, Linearised, Problem, State, linearise
from skyquilt.alignment.robust import add_diagonal, position_terms, prior_terms
from skyquilt.engine.free_memory import give_back
from skyquilt.engine.workers import HERE, Workers
from skyquilt.geometry.block_cholesky import LEAF, Factor, Index, Matrix, distinct, pattern
from skyquilt.geometry.conjugate_gradients import conjugate_gradients

Array = NDArray[np.float64]
FACTORED = 600
"""Photos up to which the equations of each step are factored. Beyond, factors take longer than
equations: there one serves many steps, which are solved by conjugate gradients.
"""
STEP_ERROR = 0.01
"""Error of a step found so, relative to its length in the norm of the equations: less than what the
weights of a robust cost, which change with each step, make of it.
"""
STEPS = 12
"""Steps of conjugate gradients that take less time than a factor."""


def _together(problem: Problem) -> tuple[Index, Index]:
    """Pairs of photos (a < b) that share a point."""
    n = len(problem.camera)
    if n <= LEAF:  # eliminated at once: all count as coupled
        return np.triu_indices(n, 1)
    keys = np.zeros(0, np.int64)
    step, alive = 1, np.arange(len(problem.point) - 1)
    while True:
        alive = alive[alive + step < len(problem.point)]
        alive = alive[problem.point[alive] == problem.point[alive + step]]
        if not len(alive):
            return np.divmod(keys, n)
        ends = np.sort([problem.photo[alive], problem.photo[alive + step]], axis=0)
        keys = distinct(np.concatenate([keys, ends[0].astype(np.int64) * n + ends[1]]))
        step += 1


class NearFactor:
    """The factor of one step's equations, for later steps, also of other adjustments.

    An interrupted run makes it again from what is known of that step, so it gets the same figures.
    """

    def __init__(self) -> None:
        self._made: Factor | None = None
        self._of: tuple[Problem, State, float, Workers] | None = None
        self._taken: State | None = None
        self._renewed: float | None = None

    def take(self, factor: Factor, state: State, damping: float) -> None:
        """Takes the factor of the present step."""
        self._made, self._of = factor, None
        self._taken, self._renewed = state, damping

    def renewed(self) -> float | None:
        """Damping of the step whose factor was taken since this was asked, if one was."""
        self._renewed, renewed = None, self._renewed
        return renewed

    def know(self, problem: Problem, state: State, damping: float, workers: Workers) -> None:
        """Says that a step renewed it, which an interrupted run may have taken."""
        if state is not self._taken:
            self._made, self._of = None, (problem, state, damping, workers)

    def get(self) -> Factor | None:
        """The factor; None if no step was made yet."""
        if self._made is None and self._of is not None:
            problem, state, damping, workers = self._of
            equations = Equations(problem, state, workers)
            self._made = Factor(equations.reduced(state, damping)[0])
        return self._made


T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class _Parts:
    """Computes something of each part of a problem. Workers are told the problem once; then only
    unknowns go there.
    """

    problem: Problem

    def __call__(
        self, given: tuple[tuple[int, int], State, Callable[[Problem, State], Any]]
    ) -> Any:
        piece, own, asked = given
        return asked(self.problem.part(piece), own)

    def each(
        self, workers: Workers, state: State, asked: Callable[[Problem, State], T]
    ) -> Iterator[tuple[slice, T]]:
        """What is `asked` of each part and its state, and which points it has."""
        pieces = self.problem.pieces()
        points = [self.problem.points_of(piece) for piece in pieces]
        given = [
            (piece, replace(state, X=state.X[own]), asked)
            for piece, own in zip(pieces, points, strict=True)
        ]
        return zip(points, workers.each(self, given), strict=True)


class Equations:
    """The equations of one problem, at any state: which photos are coupled is found once."""

    def __init__(
        self,
        problem: Problem,
        state: State,
        workers: Workers = HERE,
        *,
        near: NearFactor | None = None,
    ) -> None:
        """`workers` compute the equations of the parts; `near`: a factor of nearly these
        equations.
        """
        self.problem, self.workers, self.near = problem, workers, near
        self.parts = _Parts(problem)
        pieces = problem.pieces()
        self._alone = pieces[0] if len(pieces) == 1 else None
        self._linear: tuple[State, Linearised] | None = None
        self.n, self.m = len(state.C), len(state.K)
        self.p = problem.photo_unknowns
        self.q = CAMERA if problem.free.any() else 0
        border = self.q * self.m + (3 if problem.offset else 0)
        self.pattern = pattern(state.C[:, :2], self.p, border, *_together(problem))

    def _linearised(self, state: State) -> Linearised | None:
        """The observations at a state, where one part holds all: each step asks for them twice.
        More than that are not held.
        """
        if self._alone is None:
            return None
        if self._linear is None or self._linear[0] is not state:
            own = replace(state, X=state.X[self.problem.points_of(self._alone)])
            self._linear = state, linearise(self.problem.part(self._alone), own)
        return self._linear[1]

    def step(self, state: State, damping: float) -> tuple[Array, Array]:
        """The Gauss-Newton step of photos (n, p) and cameras (m, 11).

        Raises:
            LinAlgError: it goes nowhere.
        """
        du = -self._solved(state, damping)
        photos = self.p * self.n
        cameras = np.zeros((self.m, CAMERA))
        if self.q:
            cameras = du[photos : photos + CAMERA * self.m].reshape(-1, CAMERA)
        return du[:photos].reshape(-1, self.p), cameras

    def moved(self, state: State, damping: float) -> tuple[State, float]:
        """The state after a step, the points refined under the moved photos, and its robust cost.

        Raises:
            LinAlgError: it goes nowhere.
        """
        photos, cameras = self.step(state, damping)
        there = state.moved(photos, cameras, np.zeros(3))
        asked = partial(
            moved_points,
            damping=damping,
            photos=photos,
            cameras=cameras,
            there=replace(there, X=there.X[:0]),
            linear=self._linearised(state),
        )
        X, cost = there.X, prior_terms(self.problem, there).cost
        for points, (own, observed) in self.parts.each(self.workers, state, asked):
            X[points] = own
            cost += observed
        return there, cost

    def _solved(self, state: State, damping: float) -> Array:
        """The inverse of the equations times the gradient."""
        near = self.near if self.n > FACTORED else None
        made = near and near.get()
        matrix, gradient = self.reduced(state, damping)
        if made and made.total == len(gradient):
            found = conjugate_gradients(
                matrix.times(), made.solve, gradient, tolerance=STEP_ERROR, most=STEPS
            )
            if found is not None:
                return found
        if near:
            give_back()  # a factor takes more memory than all before it
        factor = Factor(matrix)
        if near:
            near.take(factor, state, damping)
        return factor.solve(gradient)

    def reduced(self, state: State, damping: float) -> tuple[Matrix, Array]:
        """The Schur complement on photos and cameras, damped, and the gradient (photos, then
        cameras, then the common shift of measured positions, if there is one).
        """
        n, m, p, q, pat = self.n, self.m, self.p, self.q, self.pattern
        priors = prior_terms(self.problem, state)
        U, Uc = np.zeros((n, p, p)), np.zeros((m, q, q))
        out = Matrix(
            pattern=pat,
            blocks=np.zeros((len(pat.first), p, p)),
            beside=np.zeros((n, p, pat.border)),
            corner=np.zeros((pat.border, pat.border)),
        )
        g, gc = priors.photo_gradient[:, :p].copy(), np.zeros(pat.border)
        gc[: q * m] = priors.camera_gradient[:, :q].ravel()
        asked = partial(reduced_part, damping=damping, linear=self._linearised(state))
        for _, found in self.parts.each(self.workers, state, asked):
            U[found.seen] += found.U
            Uc += found.Uc
            self._add(out, found)
            s = p * len(found.seen)
            g[found.seen] += found.gradient[:s].reshape(-1, p)
            gc[: q * m] += found.gradient[s:]
        U += priors.photo[:, :p, :p]
        add_diagonal(Uc, np.where(self.problem.free, priors.camera, 1.0)[:, :q])
        add_diagonal(U, np.diagonal(U, axis1=1, axis2=2) * damping + 1e-9)
        add_diagonal(Uc, np.diagonal(Uc, axis1=1, axis2=2) * damping)
        own = np.arange(n)
        out.blocks[pat.find(own, own)] += U
        for j in range(m if q else 0):
            out.corner[q * j : q * j + q, q * j : q * j + q] += Uc[j]
        if q and priors.common is not None:
            out.corner[: q * m, : q * m] += priors.common[:, :q, :, :q].reshape(q * m, q * m)
        if self.problem.offset:
            self._share_shift(out, state)
        return out, np.concatenate([g.ravel(), gc])

    def _add(self, out: Matrix, found: Reduced) -> None:
        """Adds what a part ties together."""
        pair = out.pattern.find(*found.seen[found.pair])
        tied = pair >= 0  # photos that share no point have nothing in common here, either
        out.blocks[pair[tied]] += found.tied[tied]
        cameras = self.q * self.m
        out.beside[found.seen, :, :cameras] += found.beside
        out.corner[:cameras, :cameras] += found.corner

    def _share_shift(self, out: Matrix, state: State) -> None:
        """Couples the measured centres with their common shift, which is at its minimum already."""
        _, precision, _ = position_terms(self.problem, state)
        for axis in range(3):
            at = self.q * self.m + axis
            out.beside[:, 3 + axis, at] = -precision[:, axis]
            total = float(precision[:, axis].sum())
            out.corner[at, at] = total if total > 0 else 1.0
