"""Photos of one place count as one: their errors repeat, so more of them do not sharpen a lens."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.alignment.adjust import covariance
from skyquilt.alignment.outcome import accuracy
from skyquilt.alignment.problem import State
from skyquilt.alignment.same_place import places, shares
from skyquilt.alignment.stages import weighed
from tests.alignment.blocks import FLYING, HEIGHT, WIDTH, make_block


def repeated(block, photos, copies):
    """The problem and its true state with copies of some photos, which show the same pixels."""
    problem, truth, n = block.problem, block.truth, len(block.truth.C)
    rows = np.r_[np.arange(n), np.tile(photos, copies)]
    extra = [np.flatnonzero(problem.photo == i) for i in rows[n:].tolist()]
    some = np.r_[np.arange(len(problem.px)), *extra].astype(int)
    photo = np.r_[problem.photo, *(np.full(len(e), n + k) for k, e in enumerate(extra))]
    order = np.lexsort((photo, problem.point[some]))
    some, photo = some[order], photo[order].astype(np.int64)
    many = replace(
        problem,
        point=problem.point[some],
        photo=photo,
        px=problem.px[some],
        sigma_px=problem.sigma_px[some],
        camera=problem.camera[rows],
        C0=problem.C0[rows],
        # what repeats tells nothing new
        sigma_C=np.where(np.arange(len(rows))[:, None] < n, problem.sigma_C[rows], 1e3),
        R0=problem.R0[rows],
        sigma_R=np.where(np.arange(len(rows))[:, None] < n, problem.sigma_R[rows], 1e2),
        last_row=problem.last_row[rows],
        velocity=problem.velocity[rows],
    )
    C = truth.C[rows] + np.where(np.arange(len(rows))[:, None] < n, 0.0, 0.05)
    return many, State(R=truth.R[rows], C=C, K=truth.K, X=truth.X, turn=truth.turn[rows])


def focal(problem, state):
    setup = SimpleNamespace(
        size=np.tile([WIDTH, HEIGHT], (len(state.C), 1)), members=np.arange(len(state.C))
    )
    problem, state = weighed(problem, state, setup)
    return state.K[0, 0], covariance(problem, state).camera_sigmas[0, 0]


def test_photos_of_different_places_share_nothing():
    block = make_block(0)
    assert shares(block.problem, block.truth, FLYING) == 1.0


def test_places_are_those_of_one_camera_and_one_direction():
    block = make_block(0, cameras=2)
    problem, state = repeated(block, [3, 4], 2)
    place = places(problem, state, FLYING)
    assert place[:18].tolist() == list(range(18))
    assert place[18:].tolist() == [3, 4, 3, 4]
    other = replace(problem, camera=np.r_[problem.camera[:18], 1 - problem.camera[18:]])
    assert places(other, state, FLYING)[18:].tolist() == [18, 19, 18, 19]
    turned = replace(state, R=np.r_[state.R[:18], np.diag([-1.0, -1, 1]) @ state.R[18:]])
    assert places(problem, turned, FLYING)[18:].tolist() == [18, 19, 18, 19]


def test_photos_of_one_place_count_as_one_for_every_point():
    problem, state = repeated(make_block(1), [7], 4)
    share = shares(problem, state, FLYING)
    here = np.isin(problem.photo, [7, 18, 19, 20, 21])
    assert (share[~here] == 1).all()
    assert share[here] == pytest.approx(0.2)
    total = np.bincount(problem.point, share, len(state.X))
    one = make_block(1).problem
    assert total == pytest.approx(np.bincount(one.point, minlength=len(state.X)).astype(float))


@pytest.mark.slow
@pytest.mark.parametrize("photos", [range(18), [8]], ids=["brackets", "hover"])
def test_copies_do_not_make_a_focal_length_sharper(photos):
    copies = 2 if len(photos) > 1 else 12
    told, single = [], []
    for seed in range(2):
        block = make_block(seed, points=250)
        single.append(focal(block.problem, block.truth))
        told.append(focal(*repeated(block, list(photos), copies)))
    (f, sigma), (f1, sigma1) = np.array(told).T, np.array(single).T
    assert (sigma / sigma1 > 0.9).all()
    assert (np.abs(f - f1) < 0.5 * sigma1).all()


def test_points_that_only_copies_show_are_not_the_worst_place():
    """Nothing tells how far away what a photo and its copies alone show is."""
    block = make_block(1)
    problem, state = repeated(block, [7], 2)
    mine = np.isin(problem.photo, [7, 18, 19])
    lonely = np.unique(problem.point[mine])[::6]
    kept, points = problem.only(mine | ~np.isin(problem.point, lonely))
    state = replace(state, X=state.X[points])
    kept = replace(kept, shared=shares(kept, state, FLYING))
    stated = np.tile([1.0, 1.0, 2.0], (len(state.C), 1))
    setup = SimpleNamespace(stated_sigma_C=stated, camera_keys=("a",))
    told = accuracy(setup, kept, state, covariance(kept, state)).sigma_m.max()
    single, truth = block.problem, block.truth
    stated = stated[: len(truth.C)]
    setup = SimpleNamespace(stated_sigma_C=stated, camera_keys=("a",))
    assert told < 1.5 * accuracy(setup, single, truth, covariance(single, truth)).sigma_m.max()
