"""The stages of the adjustment of large surveys: what they hold, and how the first one begins."""

import tracemalloc
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skyquilt.alignment import equations, stages
from skyquilt.alignment.deviations import observed_noise, robust_scale
from skyquilt.alignment.robust import observed_cost, robust_cost
from skyquilt.engine.kept import Keep
from tests.alignment.blocks import make_block

WIDE = np.array([40.0, 15.0, 15.0, 0.15, 0.1, 0.01, 1e-3, 1e-3, 3e-3, 1.0, 1e-3])
"""Deviations of a lens of which little is known."""


def stepped(problem, state):
    """The first stage, and the number of steps of all photos."""
    names = []

    def held(part, make):
        names.append(part)
        return make()

    return *stages.rough(problem, state, Keep(held=held)), len(names)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_some_photos_of_a_large_survey_tell_its_lens_first(monkeypatch, seed, cameras):
    """The whole ends where it ends without them, in fewer steps."""
    block = make_block(
        seed, lines=8, per_line=8, points=900, lies=0.02, cameras=cameras, sigma_k=WIDE
    )
    problem, sure, many = stepped(block.problem, block.start)
    monkeypatch.setattr(stages, "ASKED", 24)
    found, state, few = stepped(block.problem, block.start)
    assert few <= 0.7 * many
    assert abs(len(found.px) - len(problem.px)) < 0.002 * len(problem.px)
    one, other = stages.fine(problem, sure)[1], stages.fine(found, state)[1]
    assert np.abs(other.K - one.K)[:, 0].max() < 0.03 * WIDE[0]
    assert np.abs(other.C - one.C).max() < 0.1 * np.abs(block.start.C - block.truth.C).max()


def test_photos_that_stand_for_all_are_of_each_camera(monkeypatch):
    """Neighbours at four places; of several cameras each at one place at least."""
    monkeypatch.setattr(stages, "ASKED", 16)
    for cameras, places in ((1, 4), (2, 4), (3, 3), (5, 5)):
        block = make_block(0, lines=12, per_line=10, points=50, cameras=cameras)
        chosen = stages._places_of(block.problem, block.start)
        assert set(block.problem.camera[chosen]) == set(range(cameras))
        assert 3 * places <= len(chosen) <= 4 * places
        apart = np.linalg.norm(block.start.C[chosen, None, :2] - block.start.C[chosen, :2], axis=2)
        near = np.sort(apart + np.eye(len(apart)) * 1e9, axis=1)[:, 0]
        assert near.max() < 40 and apart.max() > 60


@pytest.mark.parametrize("sigma", [0.05, 2.0, 5.0])
@pytest.mark.parametrize("headed", [False, True])
def test_a_block_is_moved_turned_and_enlarged_as_a_whole(sigma, headed):
    """What observations do not tell is undone, and their residuals stay; a block that lies well
    stays as it is.
    """
    block = make_block(1, lines=4, per_line=6, points=200)
    truth, count = block.truth, len(block.truth.C)
    spread = np.full((count, 3), np.radians([6.0, 6.0, 2.0 if headed else 90.0]))
    noise = np.random.default_rng(0).normal(0, 0.3 * sigma, (count, 3))
    problem = replace(
        block.problem,
        C0=truth.C + noise,
        sigma_C=np.full((count, 3), sigma),
        R0=truth.R,
        sigma_R=spread,
    )
    setup = SimpleNamespace(block_rows=(np.arange(count),))
    turn = Rotation.from_euler("zyx", [0.0 if headed else 25.0, 2.0, -3.0], degrees=True)
    turn = turn.as_matrix()
    away = replace(
        truth,
        R=truth.R @ turn.T,
        C=0.7 * (truth.C - (3, 4, 5)) @ turn.T,
        X=0.7 * (truth.X - (3, 4, 5)) @ turn.T,
    )
    there, found = stages.settled(problem, away, setup)
    apart = found.C - truth.C
    off = np.linalg.norm(apart - apart.mean(0), axis=1).max()
    assert off < 0.3 * sigma + 0.01 and np.abs(apart.mean(0)).max() < 0.3 * sigma
    turned = Rotation.from_matrix(found.R @ np.swapaxes(truth.R, 1, 2)).magnitude()
    assert np.degrees(turned).max() < 0.5 * sigma + 0.1
    assert observed_cost(there, found) == pytest.approx(observed_cost(problem, away), rel=1e-6)
    again = stages.settled(there, found, setup)
    assert again[0] is there and again[1] is found
    known = replace(problem, X0=truth.X)
    assert stages.settled(known, away, setup)[1] is away  # control points hold it


def test_short_numbers_change_nothing():
    """Points and photos in 32 bits, as large surveys hold them, and in 64."""
    block = make_block(3, lies=0.02)
    one = stages.fine(*stages.rough(block.problem, block.start))
    short = {k: getattr(block.problem, k).astype(np.int32) for k in ("point", "photo")}
    other = stages.fine(*stages.rough(replace(block.problem, **short), block.start))
    for name in ("R", "C", "K", "X"):
        assert np.array_equal(getattr(one[1], name), getattr(other[1], name))
    assert np.array_equal(one[0].point, other[0].point)
    assert other[0].point.dtype == other[0].photo.dtype == np.int32


def test_photos_of_large_surveys_are_paired_by_long_numbers():
    """The number of a pair of photos, one's number times how many there are, exceeds 32 bits."""
    block = make_block(0, lines=2, per_line=3, points=60)
    photos = 70_000
    far = replace(
        block.problem,
        point=block.problem.point.astype(np.int32),
        photo=(photos - 6 + block.problem.photo).astype(np.int32),
        camera=np.zeros(photos, np.int64),
    )
    a, b = equations._together(far)
    seen = block.problem.point[:, None] == np.arange(block.problem.point[-1] + 1)
    shown = np.array([seen[block.problem.photo == k].any(0) for k in range(6)])
    wanted = {(i, j) for i in range(6) for j in range(i + 1, 6) if (shown[i] & shown[j]).any()}
    assert {(int(i) - photos + 6, int(j) - photos + 6) for i, j in zip(a, b, strict=True)} == wanted


def test_what_was_removed_is_not_held(monkeypatch):
    """Who takes the steps of a stage holds one problem at a time."""
    block = make_block(1, lies=0.05)
    problem, state = replace(block.problem, px=block.problem.px.copy()), block.start
    first, alive = weakref.ref(problem.px), list[bool]()
    given, adjust = len(problem.px), stages.adjust

    def watched(*words, **named):
        alive.append(first() is not None)
        return adjust(*words, **named)

    monkeypatch.setattr(stages, "adjust", watched)
    for step in stages.rough_steps():
        problem, state = step(problem, state)
    assert len(problem.px) < given
    assert alive == [True, False]


@pytest.mark.slow
def test_what_millions_of_observations_tell_takes_little_memory():
    """Bytes for each observation of a problem of 0.4 million, beside the problem itself."""
    block = make_block(2, lines=4, per_line=8, points=1500)
    own, times = block.problem, 400_000 // len(block.problem.px)
    P, again = len(own.X0), np.repeat(np.arange(times), len(own.px))
    many = replace(
        own,
        point=(np.tile(own.point, times) + P * again).astype(np.int32),
        photo=np.tile(own.photo, times).astype(np.int32),
        px=np.tile(own.px, (times, 1)),
        sigma_px=np.tile(own.sigma_px, times),
        X0=np.broadcast_to(np.nan, (P * times, 3)),
        sigma_X=np.broadcast_to(1.0, (P * times, 3)),
    )
    state = replace(block.truth, X=np.tile(block.truth.X, (times, 1)))
    size = np.full((len(own.camera), 2), [800.0, 600.0])
    cases = {
        "cost": (lambda: robust_cost(many, state), 20),
        "scale": (lambda: robust_scale(many, state), 60),
        "noise": (lambda: observed_noise(many, state, size), 70),
        "prune": (lambda: stages.prune(many, state, 1e9), 90),
    }
    for name, (work, most) in cases.items():
        tracemalloc.start()
        work()
        taken = tracemalloc.get_traced_memory()[1] / len(many.px)
        tracemalloc.stop()
        assert taken < most, (name, taken)
