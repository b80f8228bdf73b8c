"""Positions of flights with different errors are brought together, and others are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.displaced_parts import as_taken, brought_together, outvoted, placed_between
from skyquilt.model.poses import Accuracy
from tests.alignment.surveys import alignment, prior


def lines(count, per_line=6):
    column, row = np.divmod(np.arange(count), per_line)
    row = np.where(column % 2, per_line - 1 - row, row)
    return np.column_stack([25.0 * column, 18.0 * row, np.full(count, 60.0)])


def survey(true, told, sigma):
    """An alignment turned and shrunk a little against what the photos report, and their priors."""
    c, s = 0.97 * np.cos(0.05), 0.97 * np.sin(0.05)
    placed = true @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    found = alignment(len(true))
    poses = {i: replace(found.poses[i % 8], map_C=C) for i, C in enumerate(placed)}
    sigmas = np.broadcast_to(sigma, len(true))
    priors = [prior(C, sigma=float(e)) for C, e in zip(told, sigmas, strict=True)]
    found = replace(found, poses=poses, blocks=(tuple(range(len(true))),))
    return found, [f"{i:03d}.jpg" for i in range(len(true))], priors, ["cam"] * len(true)


@pytest.mark.parametrize("count", [16, 24, 90])
@pytest.mark.parametrize("seed", range(2))
def test_a_second_flight_is_brought_to_the_first(count, seed):
    rng = np.random.default_rng(seed)
    true, begins = lines(count), count // 2 + int(rng.integers(-count // 12, count // 12 + 1))
    told = true + rng.normal(0, 0.4, true.shape)
    told[begins:, :2] += jump if np.hypot(*(jump := rng.normal(0, 5, 2))) > 4 else (4.0, 3.0)
    moved = brought_together(*survey(true, told, 1.5))
    assert f"{begins:03d}.jpg" in moved.note
    found, names, priors, cameras = survey(true, told, 1.5)
    assert as_taken(found, names, priors, cameras) == tuple(priors)  # not what that was made with
    taken = as_taken(replace(found, notes=(moved.note,)), names, priors, cameras)
    assert all(np.array_equal(a.map_C, b.map_C) for a, b in zip(taken, moved.priors, strict=True))
    off = np.array([p.map_C[:2] for p in moved.priors]) - true[:, :2]
    assert np.abs(off[begins:].mean(0) - off[:begins].mean(0)).max() < 0.8
    middle = off.mean(0) - (told - true)[:, :2].mean(0)
    assert np.abs(middle).max() < 1e-9  # of all, it stays
    assert all(np.array_equal(p.map_C[2:], t[2:]) for p, t in zip(moved.priors, told, strict=True))


def test_three_flights_one_of_which_knows_better():
    true = lines(36)
    told = true + np.random.default_rng(3).normal(0, 0.3, true.shape)
    told[12:24, :2] += (5, -3)
    told[24:, :2] += (-4, -4)
    sigma = np.where(np.arange(36) // 12 == 1, 0.02, 2.0)
    moved = brought_together(*survey(true, told, sigma))
    assert "012.jpg and from 024.jpg" in moved.note
    shift = np.array([p.map_C[:2] for p in moved.priors]) - told[:, :2]
    assert np.abs(shift[12:24]).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 12, 24, 150])
@pytest.mark.parametrize("seed", range(5))
def test_noise_and_gross_errors_are_no_parts(count, seed):
    rng = np.random.default_rng(seed)
    true = lines(count)
    told = true + rng.normal(0, 1.5, true.shape)
    told[rng.choice(count, count // 10, replace=False), :2] += rng.normal(0, 50, 2)
    assert brought_together(*survey(true, told, 1.5)) is None


@pytest.mark.parametrize("count", range(6, 12))
def test_few_photos_tell_one_clear_displacement(count):
    """Those of a receiver that jumped soon after it began."""
    for seed in range(3):
        rng = np.random.default_rng([count, seed])
        true, begins = lines(count), int(rng.integers(3, count - 2))
        told = true + rng.normal(0, 1.5, true.shape)
        told[:begins, :2] += rng.permutation([24.0, 18.0]) * rng.choice([-1, 1], 2)
        found, names, priors, cameras = survey(true, told, 3.0)
        moved = brought_together(found, names, priors, cameras)
        assert f"from {begins:03d}.jpg on" in moved.note
        assert abs(moved.apart_m - 30) < 9
        off = np.array([p.map_C[:2] for p in moved.priors]) - true[:, :2]
        assert np.abs(off[begins:].mean(0) - off[:begins].mean(0)).max() < 8
        assert brought_together(found, names, priors, cameras, few=False) is None


@pytest.mark.parametrize("count", range(6, 12))
def test_noise_and_drifts_of_few_photos_are_no_displacement(count):
    """Errors of a receiver, which are alike from photo to photo or not, and of moments."""
    for seed in range(4):
        rng = np.random.default_rng([count, seed])
        true = lines(count)
        steps = rng.normal(0, 3.0, (count + 40, 2))
        drift = np.array([0.9 ** np.arange(k, -1, -1) @ steps[: k + 1] for k in range(count + 40)])
        back_and_forth = 2.0 * np.where(np.arange(count) // 6 % 2, -1, 1)[:, None] * (0.0, 1.0)
        for off in (steps[40:], drift[40:] * np.sqrt(1 - 0.81), back_and_forth):
            told = true.copy()
            told[:, :2] += off
            assert brought_together(*survey(true, told, 3.0)) is None


def test_what_is_small_beside_the_deviations_is_left_alone():
    true = lines(24)
    told = true + np.random.default_rng(1).normal(0, 0.01, true.shape)
    told[12:, :2] += 0.3
    assert brought_together(*survey(true, told, 1.5)) is None
    assert brought_together(*survey(true, told, 0.02)) is not None


def test_photos_in_one_place_tell_nothing():
    true = np.zeros((14, 3)) + (3.0, 4.0, 60.0)
    assert brought_together(*survey(true, true.copy(), 1.5)) is None


@pytest.mark.parametrize("count", [24, 36, 150])
@pytest.mark.parametrize("seed", range(3))
def test_a_flight_between_two_others_is_brought_to_them(count, seed):
    """One division alone hardly makes positions fit better."""
    rng = np.random.default_rng(seed)
    true = lines(count)
    told = true + rng.normal(0, 0.3, true.shape)
    begins, ends = count // 3 + 1, 2 * count // 3
    told[begins:ends, :2] += (4.0, 3.0)
    moved = brought_together(*survey(true, told, 1.5))
    assert f"from {begins:03d}.jpg and from " in moved.note
    off = np.array([p.map_C[:2] for p in moved.priors]) - true[:, :2]
    assert np.abs(off[begins:ends].mean(0) - off[:begins].mean(0)).max() < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_positions_in_a_false_order_are_no_displaced_parts(seed):
    """Lines that are displaced each by itself would explain them."""
    true = lines(40, per_line=10)
    told = true + np.random.default_rng(seed).normal(0, 1.5, true.shape)
    for false in (told[::-1], np.roll(told, 10, axis=0), np.roll(told, -8, axis=0)):
        assert brought_together(*survey(true, false, 5.0)) is None


def shifted(count, away, by, seed=0):
    """Lines of photos with positions of 1.5 m, and those of some shifted, which bends the map."""
    true = lines(count)
    told = true + np.random.default_rng(seed).normal(0, 1.5, true.shape)
    told[away, :2] += by
    return survey(true, told, 1.5)


@pytest.mark.parametrize("by", [(70.0, 70.0), (-12.0, 25.0)])
@pytest.mark.parametrize("away", [slice(1, None, 3), slice(1, None, 5), [0, 2, 3, 9, 10, 16, 17]])
def test_positions_of_fewer_photos_are_not_used(away, by):
    """A second drone whose photos lie among the others, with a false base."""
    found, names, priors, cameras = shifted(20, away, by)
    few = np.isin(np.arange(20), np.arange(20)[away])
    done = outvoted(found, names, priors, cameras)
    told = np.isfinite([p.map_C[:2] for p in done.priors]).all(1)
    assert np.array_equal(told, ~few)
    assert all(a.map_C[2] == b.map_C[2] for a, b in zip(done.priors, priors, strict=True))
    assert f"positions of {few.sum()} of 20 photos lie {done.apart_m:.0f} m" in done.note
    assert abs(done.apart_m - np.hypot(*by)) < 3


def test_nobody_is_outvoted_without_a_majority_or_where_nothing_is_wrong():
    for away in (slice(0, 0), slice(0, None, 2)):
        assert outvoted(*shifted(20, away, (70.0, 70.0))) is None
    true = lines(24)
    told = true + np.random.default_rng(4).standard_t(1.2, true.shape)  # errors of all sizes
    assert outvoted(*survey(true, told, 1.5)) is None
    found, names, priors, cameras = shifted(24, slice(1, None, 3), (70.0, 70.0))
    right = {i: replace(found.poses[i], map_C=true[i]) for i in found.poses}
    as_most = replace(found, poses=right)
    assert outvoted(as_most, names, priors, cameras) is None


def test_flights_with_errors_of_receivers_are_brought_together_and_not_outvoted():
    case = shifted(24, slice(16, None), (12.0, 9.0))
    assert outvoted(*case) is None
    assert brought_together(*case) is not None


@pytest.mark.parametrize("seed", range(3))
def test_two_halves_in_different_datums_are_brought_together(seed):
    case = shifted(20, slice(10, None), (70.0, -70.0), seed)
    assert outvoted(*case) is None
    moved = brought_together(*case)
    off = np.array([p.map_C[:2] for p in moved.priors]) - lines(20)[:, :2]
    assert np.abs(off[10:].mean(0) - off[:10].mean(0)).max() < 3.0  # 99 m before
    assert abs(moved.apart_m - 99) < 3


def test_a_place_between_two_parts_is_as_uncertain_as_half_of_what_they_are_apart():
    def told(shared):
        some = np.zeros((1, 3))
        return replace(
            alignment(),
            accuracy=Accuracy(
                xyz=some, sigma_m=some, shared_m=shared, focal_shares={}, design_effect=1.0
            ),
        )

    assert placed_between(told((1.5, 3.0)), 99.0).accuracy.shared_m == (49.5, 3.0)
    assert placed_between(told((1.5, 3.0)), 2.0).accuracy.shared_m == (1.5, 3.0)
    assert placed_between(told((0.0, 0.0)), 99.0).accuracy.shared_m == (0.0, 0.0)
    assert placed_between(alignment(), 99.0).accuracy is None


@pytest.mark.parametrize("by", [(4.0, 3.0), (9.0, -8.0), (70.0, 70.0)])
@pytest.mark.parametrize("each", [[0, 1], [0, 1, 1, 0, 2]])
def test_drones_that_fly_together_are_brought_together(by, each):
    """Their photos lie among one another, and each one's receiver errs in its own way."""
    drone = np.resize(each, 30)
    true = lines(30)
    told = true + np.random.default_rng(5).normal(0, 0.5, true.shape)
    told[:, :2] += drone[:, None] * by
    found, names, priors, _ = survey(true, told, 1.5)
    assert brought_together(found, names, priors, ["cam"] * 30) is None
    moved = brought_together(found, names, priors, [f"cam {k}" for k in drone])
    off = np.array([p.map_C[:2] for p in moved.priors]) - true[:, :2]
    means = np.array([off[drone == k].mean(0) for k in set(each)])
    assert np.abs(means - means[0]).max() < 1.0
    assert "Positions of cam 1" in moved.note and "against those of cam 0 by" in moved.note


def test_cameras_of_one_drone_are_no_drones():
    true = lines(30)
    told = true + np.random.default_rng(6).normal(0, 1.5, true.shape)
    found, names, priors, _ = survey(true, told, 1.5)
    assert brought_together(found, names, priors, [f"cam {k % 2}" for k in range(30)]) is None
    told[12:, :2] += (5.0, 5.0)  # another flight of the same two
    found, names, priors, _ = survey(true, told, 1.5)
    moved = brought_together(found, names, priors, [f"cam {k % 2}" for k in range(30)])
    assert "from 012.jpg on" in moved.note
