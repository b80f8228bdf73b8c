"""Positions and tilts that files tell, believed as far as the photos confirm them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import adjust
from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.deviations import lone_errors, position_noise
from skyquilt.alignment.equations import NearFactor
from skyquilt.alignment.problem import Problem, State, attitude_error
from skyquilt.alignment.setup import Setup
from skyquilt.alignment.stages import settled
from skyquilt.engine.kept import MADE_NOW, Keep

Array = NDArray[np.float64]
DOUBTED = 2.5
"""Positions that a block misses by more than this many deviations are not what they claim."""
CONFIRMED = 1.4
"""A scatter of positions or tilts up to so many times what they state confirms it: the scatter of
some twenty photos is itself known to a fifth.
"""


def believe_told(
    problem: Problem,
    state: State,
    setup: Setup,
    keep: Keep = MADE_NOW,
    near: NearFactor | None = None,
) -> tuple[Problem, State]:
    """Positions and tilts believed as far as the photos confirm them.

    The start gave them deviations as wide as their scatter about it, which is coarse. Here they get
    those that they state, or their scatter between neighbours where that is clearly larger; single
    ones that are grossly wrong get their error, since together they would shrink the block. Only
    differences from photo to photo count: a smooth misfit may be a deformation of the block, and
    positions with less weight would permit it. Where a block then still misses its positions by
    more than these deviations allow, they are not what they claim (a drifting barometer, a plain
    GPS that states centimetres), and what the start gave stays. Tilts get what they state, or their
    scatter between neighbours likewise.
    """
    started = problem.sigma_C
    doubted, near = np.zeros(started.shape, bool), near or NearFactor()
    for again in range(3):
        error = state.C - problem.C0
        sigma, single = started.copy(), False
        for block in setup.block_rows:
            for axes in (slice(0, 2), slice(2, 3)):
                stated = setup.stated_sigma_C[block][:, axes]
                own = error[block][:, axes]
                lone = np.zeros(len(own), bool)
                measured = np.isfinite(own).all(1)  # of others nothing is stated
                least = stated[measured] if measured.any() else stated
                if not setup.in_space:  # there a photo may be alone in a false minimum
                    lone = lone_errors(own, float(np.median(least)))
                noise = position_noise(own[~lone])
                wanted = np.maximum(stated, noise if (noise > CONFIRMED * least).any() else 0.0)
                trusted = ~doubted[block][:, axes]
                given = np.where(trusted, wanted, sigma[block, axes])
                single |= bool(lone.any())
                off = np.linalg.norm(own, axis=1, keepdims=True)
                sigma[block, axes] = np.where(lone[:, None], off, given)
        scattered = _scattered_tilts(problem, state, setup)
        alike = all(
            np.allclose(new, old, rtol=0.15, equal_nan=True)
            for new, old in ((sigma, problem.sigma_C), (scattered, problem.sigma_R))
        )
        problem = replace(problem, sigma_C=sigma, sigma_R=scattered)
        if alike:
            break
        if single:  # gone is what drew the block aside
            problem, state = settled(problem, state, setup, clearly=0.0)
        narrow, part = problem.with_loss(2.0), keep.within(str(again))
        state = adjust(narrow, state, iterations=10, tolerance=1e-4, keep=part, near=near).state
        misfit = np.abs(state.C - problem.C0) / problem.sigma_C
        for block in setup.block_rows:
            for axes in (slice(0, 2), slice(2, 3)):
                known = misfit[block][:, axes][np.isfinite(misfit[block][:, axes])]
                if len(known) and 1.48 * np.median(known) > DOUBTED:
                    doubted[block, axes] = True
    return problem, state


def _scattered_tilts(problem: Problem, state: State, setup: Setup) -> Array:
    """Deviations (n, 3) in rad of attitudes, those of tilts that are told as large as these scatter
    between neighbours, where that is clearly more than they state.
    """
    sigma = problem.sigma_R.copy()
    off = attitude_error(state.R, problem.R0)[:, :2]
    off[sigma[:, 0] > np.radians(STATED_DEG)] = np.nan
    for block in setup.block_rows:
        told = block[np.isfinite(off[block, 0])]
        noise = position_noise(off[told])
        if noise > CONFIRMED * sigma[told, :2].max(initial=0.0):
            sigma[told, :2] = np.maximum(sigma[told, :2], noise)
    return sigma
