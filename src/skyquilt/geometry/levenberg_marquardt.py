"""The method of Levenberg and Marquardt: which steps are tried, which are taken, and when to end.

What is adjusted, and how its equations are solved, is the caller's: dense for one transformation,
by Schur complement for a block of photos.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

State = TypeVar("State")
"""What is adjusted."""
Linearise = Callable[[State], tuple[float, Callable[[float], State]]]
"""The cost of a state, and where a step goes from there, for a damping relative to the diagonal of
the normal equations; LinAlgError where it goes nowhere.
"""

Tried = tuple[float, float, bool, State, float]
"""One iteration: the cost before and after, whether a step was accepted, the state after it, and
the next damping.
"""
Keep = Callable[[str, Callable[[], Tried[State]]], Tried[State]]
"""Gives an iteration by its name: the one kept of an interrupted run, or made now."""

_SMALLEST, _LARGEST = 1e-9, 1e8


@dataclass(frozen=True, kw_only=True, eq=False)
class Descent(Generic[State]):
    """Where it ended."""

    state: State
    """The best one found."""
    cost: float
    """Its cost."""
    iterations: int
    """Steps taken."""
    converged: bool
    """False when the number of steps ended it."""


def levenberg_marquardt(
    state: State,
    linearise: Linearise[State],
    cost: Callable[[State], float],
    *,
    iterations: int,
    tolerance: float,
    damping: float = 1e-4,
    keep: Keep[State] | None = None,
) -> Descent[State]:
    """The state of a locally least cost.

    Args:
        state: where to start.
        linearise: see `Linearise`.
        cost: of a state.
        iterations: most steps to take.
        tolerance: relative decrease of the cost at which it counts as converged.
        damping: the first one.
        keep: for descents that resume at an iteration.
    """
    least = np.inf
    for iteration in range(iterations):

        def iterated(state: State = state, damping: float = damping) -> Tried[State]:
            return _iterated(state, linearise, cost, damping)

        tried = iterated() if keep is None else keep(str(iteration), iterated)
        least, new, accepted, candidate, damping = tried
        if not accepted:
            return Descent(state=state, cost=least, iterations=iteration, converged=True)
        state = candidate
        if least - new <= tolerance * least:
            return Descent(state=state, cost=new, iterations=iteration + 1, converged=True)
    return Descent(state=state, cost=least, iterations=iterations, converged=False)


def _iterated(
    state: State, linearise: Linearise[State], cost: Callable[[State], float], damping: float
) -> Tried[State]:
    """Steps with ever more damping until one does not raise the cost."""
    least, step = linearise(state)
    new, accepted, candidate = np.inf, False, state
    while not accepted and damping < _LARGEST:
        try:
            candidate = step(damping)
            new = cost(candidate)
        except np.linalg.LinAlgError:
            new = np.inf
        accepted = bool(new <= least * (1 + 1e-12))
        damping = max(damping / 4, _SMALLEST) if accepted else damping * 8
    return least, new, accepted, candidate, damping
