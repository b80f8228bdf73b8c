"""The stages of an adjustment: ever narrower losses, outliers removed in between, observations
believed as far as they show to be right.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import adjust
from skyquilt.alignment.deviations import believed, observed_noise, robust_scale
from skyquilt.alignment.equations import NearFactor
from skyquilt.alignment.problem import (
    READOUT,
    Problem,
    State,
    attitude_error,
    squared_residuals,
    swept,
)
from skyquilt.alignment.robust import position_terms, prior_terms, robust_cost
from skyquilt.alignment.same_place import shares
from skyquilt.alignment.setup import Setup
from skyquilt.alignment.start import UNKNOWN_YAW_DEG
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.geometry.frames import rotation_from_vector

Array = NDArray[np.float64]
ROLLS_PX = 0.3
"""Cameras that move by more than this in px of the photo while a photo is read out turn, too."""
TURN_RAD_S = np.radians(1.5)
"""Deviation of the rates at which they turn, in rad/s; it makes up for errors of velocities too."""
ASKED, PLACES = 160, 4
"""Photos of a large survey that tell its cameras' first intrinsics, and whether these stood still
while they exposed; and the places where they were taken. Each camera has one place at least.
"""
CLEARLY = 9.0
"""By how much the cost of cameras that stood still must be less than that of moving ones, as their
positions and times have them: three deviations.
"""
NO_SPIN = np.zeros(3), np.zeros(1)
"""Rates in rad/s at which cameras turn, and their deviations, where nothing tells them."""
FEWEST_POSITIONS, UNTOLD, SETTLING = 4, 7, 12
"""Positions that tell where a block lies; what they are asked for (place, scale, rotation); and
rounds in which the weights of gross errors settle.
"""
NUDGE, LONGEST_STEP = 1e-6, 0.5
"""Differences by which derivatives are taken, and longest step in rad or of the scale's
logarithm.
"""
LEAST_NOISE = 0.02
"""Share of the variance that positions state, at least, as which their scatter is taken."""


Step = Callable[[Problem, State], tuple[Problem, State]]
"""A step of a stage. Who takes one after the other holds one problem at a time: an earlier one with
all that was removed since would take as much memory again.
"""


def rough(problem: Problem, state: State, keep: Keep = MADE_NOW) -> tuple[Problem, State]:
    """All `rough_steps`."""
    for step in rough_steps(keep):
        problem, state = step(problem, state)
    return problem, state


def rough_steps(keep: Keep = MADE_NOW) -> tuple[Step, ...]:
    """First stage: intrinsics fixed under a wide loss, then all free under a narrower one; outliers
    are removed in between. The whole of a large survey begins with the intrinsics that some of its
    photos show, and takes a third of the steps.
    """
    return _with_lens_of_some, *_roughly(keep)


def _with_lens_of_some(problem: Problem, state: State) -> tuple[Problem, State]:
    if _is_large(problem):
        some, its = problem.among(_places_of(problem, state), state)
        for step in _roughly(MADE_NOW):
            some, its = step(some, its)
        state = replace(state, K=its.K)
    return problem, state


def _roughly(keep: Keep) -> tuple[Step, ...]:
    def fixed(problem: Problem, state: State) -> tuple[Problem, State]:
        still = replace(problem, free=np.zeros_like(problem.free), loss_px=20.0)
        part = keep.within("fixed")
        return problem, adjust(still, state, iterations=10, tolerance=3e-2, keep=part).state

    def free(problem: Problem, state: State) -> tuple[Problem, State]:
        narrow, part = problem.with_loss(6.0), keep.within("free")
        found = adjust(narrow, state, iterations=20, tolerance=3e-3, damping=1e-5, keep=part)
        return problem, found.state

    return fixed, _pruning(40.0), free, _pruning(12.0)


def fine(problem: Problem, state: State, keep: Keep = MADE_NOW) -> tuple[Problem, State]:
    """All `fine_steps`."""
    for step in fine_steps(keep):
        problem, state = step(problem, state)
    return problem, state


def fine_steps(keep: Keep = MADE_NOW, near: NearFactor | None = None) -> tuple[Step, ...]:
    """Second stage: all unknowns free under ever narrower losses; outliers are removed in
    between. `near` serves these and later stages.
    """
    near = near or NearFactor()

    def under(loss_px: float, iterations: int, tolerance: float) -> Step:
        def step(problem: Problem, state: State) -> tuple[Problem, State]:
            part = keep.within(str(loss_px))
            found = adjust(
                problem.with_loss(loss_px),
                state,
                iterations=iterations,
                tolerance=tolerance,
                damping=1e-6,
                keep=part,
                near=near,
            )
            return problem, found.state

        return step

    return _pruning(20.0), under(2.5, 20, 2e-3), _pruning(5.0), under(2.0, 15, 3e-4)


def _pruning(limit: float) -> Step:
    return partial(prune, limit=limit)


def weighed(
    problem: Problem,
    state: State,
    setup: Setup,
    keep: Keep = MADE_NOW,
    near: NearFactor | None = None,
) -> tuple[Problem, State]:
    """The adjustment repeated with observations as sharp as their patches and their residuals show
    them to be, and with the weight that those are worth; where rows were exposed one after the
    other, with turns of the cameras, or with cameras that stood still, whichever explains the
    photos better. Of large surveys, some photos tell, also whether turns are worth estimating.
    """
    if not len(problem.px):  # begun so wrongly that no ray meets another
        return problem, state
    problem = replace(problem, sigma_px=problem.sigma_px * problem.relative, relative=1.0)
    sizes, near = setup.size[setup.members], near or NearFactor()
    rolls, many = _rolls(problem, state), _is_large(problem)
    if rolls:
        readout = np.abs(state.K[problem.camera, READOUT])
        sigma, (rate, off) = TURN_RAD_S * readout, setup.spin or NO_SPIN
        unsure = problem.sigma_K[problem.camera, READOUT] * np.linalg.norm(rate, axis=-1)
        sigma = np.sqrt(sigma**2 + (off * readout) ** 2 + unsure**2)
        state = spinning(problem, state, setup)
        problem = replace(problem, sigma_turn=np.maximum(sigma, 1e-9), turn0=state.turn)
    if rolls and many:
        chosen = _places_of(problem, state)
        some, its = problem.among(chosen, state)
        some, its = _reweighed(some, its, sizes[chosen], MADE_NOW, NearFactor())
        best, there = _standing(some, its, MADE_NOW, NearFactor())
        if best is not some:
            problem, state = _still(problem, state)
        if not _turning(best, there):
            problem = replace(problem, sigma_turn=None)
    problem, state = _reweighed(problem, state, sizes, keep, near)
    if rolls and not many:
        return _standing(problem, state, keep.within("still"), near)
    return problem, state


def spinning(problem: Problem, state: State, setup: Setup) -> State:
    """The state with the turns of cameras while they expose as poses and times tell them."""
    rate, _ = setup.spin or NO_SPIN
    turn = rate * state.K[problem.camera, READOUT, None]
    return replace(state, turn=np.broadcast_to(turn, state.turn.shape).copy())


def _reweighed(
    problem: Problem, state: State, sizes: Array, keep: Keep, near: NearFactor
) -> tuple[Problem, State]:
    """The adjustment with turns, if they are unknown, then twice with the weight that residuals
    show observations to be worth, those of photos of one place as one; `sizes` (n, 2): of the
    photos in px.
    """
    if problem.sigma_turn is not None:
        part = keep.within("turns")
        state = adjust(
            problem, state, iterations=15, tolerance=1e-3, damping=1e-6, keep=part, near=near
        ).state
    shared = shares(problem, state, float(np.median(heights_above(state))))
    problem = replace(problem, shared=shared)
    for again in range(2):
        scale = robust_scale(problem, state)
        problem = replace(problem, sigma_px=problem.sigma_px * scale)
        noise = observed_noise(problem.with_loss(2.0), state, sizes)
        problem = believed(problem.with_loss(2.0), noise)
        part = keep.within(str(again))
        state = adjust(
            problem, state, iterations=15, tolerance=3e-4, damping=1e-6, keep=part, near=near
        ).state
    return problem, state


def plain(problem: Problem, state: State, keep: Keep, near: NearFactor) -> tuple[Problem, State]:
    """In place of `weighed`, in a third of the time: observations keep their weights, and only
    drones that stop are told from those that fly on.
    """
    if not _rolls(problem, state):
        return problem, state
    return _standing(problem, state, keep, near)


def _rolls(problem: Problem, state: State) -> bool:
    """Whether a camera moves visibly while a photo is read out."""
    reach = np.linalg.norm(swept(problem, state), axis=1) / heights_above(state)
    return bool((reach * state.K[problem.camera, 0] > ROLLS_PX).any())


def _standing(
    problem: Problem, state: State, keep: Keep, near: NearFactor
) -> tuple[Problem, State]:
    """The adjustment as if cameras stood still while they expose, where that explains the photos
    clearly better: drones that stop for each photo have positions and times as if they flew on.
    """
    other, begin = _still(problem, state)
    # as far as the other one was, or the two could not be compared
    stood = adjust(other, begin, iterations=25, tolerance=1e-4, damping=1e-6, keep=keep, near=near)
    if stood.cost < robust_cost(problem, state) - CLEARLY:
        return other, stood.state
    return problem, state


def _still(problem: Problem, state: State) -> tuple[Problem, State]:
    """The same with cameras that stand still while they expose."""
    K = state.K.copy()
    K[:, READOUT] = problem.K0[:, READOUT]
    still = replace(problem, velocity=problem.velocity * 0.0, turn0=None)
    return still, replace(state, K=K, turn=np.zeros_like(state.turn))


def _turning(problem: Problem, state: State) -> bool:
    """Whether turns of the cameras explain more than chance would: a unit of the cost for each."""
    turn = np.zeros_like(state.turn) if problem.turn0 is None else problem.turn0
    steady, begin = replace(problem, sigma_turn=None), replace(state, turn=turn)
    without = adjust(steady, begin, iterations=15, tolerance=1e-4, damping=1e-6)
    return without.cost - robust_cost(problem, state) > state.turn.size


def _is_large(problem: Problem) -> bool:
    """Whether some photos are asked first: they are few beside all."""
    return len(problem.camera) > 2 * ASKED * max(1.0, len(problem.K0) / PLACES)


def _places_of(problem: Problem, state: State) -> NDArray[np.int64]:
    """Photos that stand for all: of each camera neighbours at places that were flown over at
    different times.
    """
    chosen, places = [], max(1, PLACES // len(problem.K0))
    for camera in range(len(problem.K0)):
        own = np.flatnonzero(problem.camera == camera)
        middles = own[(np.arange(places) * 2 + 1) * len(own) // (2 * places)]
        apart = np.linalg.norm(state.C[own, None, :2] - state.C[middles, :2], axis=2)
        near = np.argsort(apart, axis=0, kind="stable")[: ASKED // PLACES]
        chosen.append(own[near].ravel())
    return np.unique(np.concatenate(chosen))


def heights_above(state: State) -> Array:
    """Heights (n,) in m of the cameras above the points; NaN where none is left."""
    ground = np.median(state.X[:, 2]) if len(state.X) else np.nan
    return np.maximum(state.C[:, 2] - ground, 1.0)


def prune(problem: Problem, state: State, limit: float) -> tuple[Problem, State]:
    """Removes observations with residuals above `limit` deviations and points left with one
    observation; control points are kept.
    """
    pinned = np.asarray(np.isfinite(problem.X0).any(1))
    good = (squared_residuals(problem, state) < limit**2) | pinned[problem.point]
    enough = np.bincount(problem.point[good], minlength=len(state.X)) >= 2
    good &= enough[problem.point] | pinned[problem.point]
    thinner, points = problem.only(good)
    return thinner, replace(state, X=state.X[points])


def settled(
    problem: Problem, state: State, setup: Setup, clearly: float = CLEARLY
) -> tuple[Problem, State]:
    """The problem and the state with each block moved, turned and enlarged as a whole as its
    positions and attitudes want it, if they want it clearly: if it saves more than `clearly`.

    Observations do not tell these, so steps that follow all unknowns stop long before: of a drone
    that climbs, positions lie within their deviations of one another.
    """
    if problem.offset or np.isfinite(problem.X0).any():
        return problem, state
    block = np.zeros(len(state.C), np.int64)
    for number, rows in enumerate(setup.block_rows):
        block[rows] = number
    point_block = np.zeros(len(state.X), np.int64)
    point_block[problem.point] = block[problem.photo]
    R, C, X, R0 = state.R.copy(), state.C.copy(), state.X.copy(), problem.R0.copy()
    for number, rows in enumerate(setup.block_rows):
        if (found := _wanted(problem, state, rows)) is None:
            continue
        scale, turn, old, new = found
        own = point_block == number
        for places, mine in ((C, rows), (X, own)):
            places[mine] = scale * (places[mine] - old) @ turn.T + new
        R[rows] = state.R[rows] @ turn.T
        unknown = rows[problem.sigma_R[rows, 2] >= np.radians(UNKNOWN_YAW_DEG)]
        R0[unknown] = R0[unknown] @ _about_vertical(turn).T  # those are headings of the start
    there, moved = replace(problem, R0=R0), replace(state, R=R, C=C, X=X)
    gain = prior_terms(problem, state).cost - prior_terms(there, moved).cost
    left = position_terms(there, moved)[2].sum() / max(3 * len(C) - UNTOLD, 1)
    if gain > clearly * max(min(left, 1.0), LEAST_NOISE):
        return there, moved
    return problem, state


def _about_vertical(turn: Array) -> Array:
    """The rotation about the vertical that is nearest to a rotation (3, 3)."""
    angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])


def _wanted(
    problem: Problem, state: State, rows: NDArray[np.int64]
) -> tuple[float, Array, Array, Array] | None:
    """Scale, rotation (3, 3), and a place in m before and after, by which the photos of a block
    (rows) come closest to their positions and attitudes (Gauss-Newton); None where too few are
    known.
    """
    C0, sigma = problem.C0[rows], problem.sigma_C[rows]
    known = np.isfinite(C0).all(1)
    if known.sum() < FEWEST_POSITIONS:
        return None
    spread = np.where(
        problem.sigma_R[rows] >= np.radians(UNKNOWN_YAW_DEG), np.inf, problem.sigma_R[rows]
    )
    C0, sigma, C = C0[known], sigma[known], state.C[rows][known]
    old = C.mean(0)
    reach = max(float(np.abs(C - old).max()), 1e-6)
    scale, turn, new = 1.0, np.eye(3), old.copy()

    def residuals(x: Array, turn: Array, scale: float, new: Array) -> tuple[Array, Array]:
        """Whitened misfits of positions and of attitudes after a step x (7,)."""
        turn, scale = rotation_from_vector(x[None, :3])[0] @ turn, scale * np.exp(x[3])
        e = (scale * (C - old) @ turn.T + new + x[4:] * reach - C0) / sigma
        return e, attitude_error(state.R[rows] @ turn.T, problem.R0[rows]) / spread

    for _ in range(SETTLING):
        e, a = residuals(np.zeros(7), turn, scale, new)
        roots = (  # of the weights of the losses
            (1 + (e**2).sum(1, keepdims=True) / problem.loss_C**2) ** -0.25,
            (1 + (a**2).sum(1, keepdims=True) / problem.loss_R**2) ** -0.25,
        )

        def whole(x: Array, *at: Any, roots: tuple[Array, Array] = roots) -> Array:
            parts = residuals(x, *at)
            return np.concatenate([(r * p).ravel() for r, p in zip(roots, parts, strict=True)])

        at = (turn, scale, new)
        here = whole(np.zeros(7), *at)
        J = np.stack([(whole(NUDGE * unit, *at) - here) / NUDGE for unit in np.eye(7)], 1)
        step = np.linalg.lstsq(J, -here, rcond=1e-9)[0]
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step[:4]).max()), 1e-12))
        turn = rotation_from_vector(np.asarray(step[None, :3], np.float64))[0] @ turn
        scale, new = scale * float(np.exp(step[3])), new + step[4:] * reach
    return scale, turn, old, new
