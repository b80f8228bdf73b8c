"""Heights that contradict those of most photos are not used, and others are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.false_heights import height_warnings, outvoted_heights
from tests.alignment.test_displaced_parts import lines, survey

SIGMA_M = 3.0


def told_at(heights, sigma=SIGMA_M, lifted_m=0.0):
    """An alignment of photos 60 m high, lifted by what false heights do, the photos' names,
    priors with these heights, and cameras.
    """
    true = lines(len(heights))
    told = np.column_stack([true[:, :2], heights])
    found, names, priors, cameras = survey(true + (0, 0, lifted_m), told, SIGMA_M)
    stated = np.broadcast_to(sigma, len(true))
    priors = [replace(p, sigma_C=np.full(3, s)) for p, s in zip(priors, stated, strict=True)]
    return found, names, priors, cameras


def noisy(count, sigma=SIGMA_M, seed=0):
    return 60 + np.random.default_rng(seed).normal(0, sigma, count)


@pytest.mark.parametrize("false", [1, 5, 7])
@pytest.mark.parametrize("by_m", [-440.0, 35.0, 1000.0])
@pytest.mark.parametrize("seed", range(3))
def test_heights_that_most_others_contradict_are_not_used(false, by_m, seed):
    heights = noisy(20, seed=seed)
    wrong = np.random.default_rng(seed).permutation(20)[:false]
    heights[wrong] += by_m
    found, names, priors, cameras = told_at(heights, lifted_m=by_m * false / 20 + 5)
    told = outvoted_heights(found, names, priors, cameras)
    assert {i for i, p in enumerate(told.priors) if np.isnan(p.map_C[2])} == set(wrong)
    assert all(
        np.array_equal(a.map_C[:2], b.map_C[:2]) for a, b in zip(told.priors, priors, strict=True)
    )
    assert told.note.startswith(f"The heights of {false} of 20 photos lie")
    assert f"{wrong.min():03d}.jpg" in told.note


@pytest.mark.parametrize("sigma", [0.03, 3.0, 15.0])
def test_heights_with_errors_of_receivers_and_barometers_are_used(sigma):
    noise = noisy(20, sigma)
    drift = np.linspace(0, 40, 20) - 20
    flights = np.repeat([0.0, 7.0], 10)
    for heights in (noise, noise + drift, noise + flights):
        case = told_at(heights, sigma, 20.0)
        assert outvoted_heights(*case) is None
        assert height_warnings(case[2], case[0]) == [] or sigma < 3


def test_heights_by_which_the_map_lies_already_are_left_alone():
    heights = noisy(20)
    heights[3] += 500
    assert outvoted_heights(*told_at(heights)) is None


def test_those_that_know_less_may_differ_more():
    """Photos that lost their correction."""
    sigma = np.where(np.arange(20) % 5, 0.03, 15.0)
    heights = 60 + np.where(np.arange(20) % 5, 0.02, 30.0)
    assert outvoted_heights(*told_at(heights, sigma, 6.0)) is None


@pytest.mark.parametrize(("second", "third"), [(10, 20), (4, 20), (15, 20), (8, 14)])
@pytest.mark.parametrize(("by_m", "sigma"), [(-40.0, 3.0), (100.0, 3.0), (12.0, 1.0)])
def test_heights_above_several_take_off_points_count_from_that_of_most_photos(
    second, third, by_m, sigma
):
    """Of equally many, from the first one."""
    heights = noisy(20, sigma)
    heights[second:] += by_m
    heights[third:] += by_m
    parts = [range(second), range(second, third), range(third, 20)]
    found, names, priors, cameras = told_at(heights, lifted_m=float(heights.mean()) - 60)
    found = replace(found, frame=replace(found.frame, vertical_datum="takeoff"))
    told = outvoted_heights(found, names, priors, cameras)
    kept = [i for i, p in enumerate(told.priors) if np.isfinite(p.map_C[2])]
    assert kept == list(max(parts, key=len))
    assert "take-off point" in told.note
    assert height_warnings(priors, replace(found, notes=(told.note,))) == []


@pytest.mark.parametrize("of_second", [6, 10, 13])
@pytest.mark.parametrize("by_m", [-14.0, 12.0])
def test_drones_that_fly_at_once_have_take_off_points_of_their_own(of_second, by_m):
    heights = noisy(20, 0.7)
    second = np.isin(np.arange(20), np.random.default_rng(1).permutation(20)[:of_second])
    heights[second] += by_m
    found, names, priors, _ = told_at(heights, lifted_m=float(heights.mean()) - 60)
    found = replace(found, frame=replace(found.frame, vertical_datum="takeoff"))
    drones = ["b" if b else "a" for b in second]
    told = outvoted_heights(found, names, priors, drones)
    kept = np.array([np.isfinite(p.map_C[2]) for p in told.priors])
    most = second if of_second > 10 or (of_second == 10 and second[0]) else ~second
    assert np.array_equal(kept, most)
    assert "take-off point" in told.note
    mixed = ["b" if k % 3 else "a" for k in range(20)]  # the step comes and goes
    assert outvoted_heights(found, names, priors, mixed) is None


@pytest.mark.parametrize("kind", ["drift", "back", "small", "scattered"])
def test_heights_above_one_take_off_point_are_used(kind):
    """Also where a barometer drifts and is set to zero again, or errs by metres."""
    heights = noisy(20, 3.0 if kind == "scattered" else 0.5)
    if kind == "drift":
        heights += np.linspace(0, 25, 20)
    if kind == "back":
        heights[:12] += np.linspace(0, 15, 12)
    if kind == "small":
        heights[10:] += 6
    if kind == "scattered":
        heights[10:] += 12
    found, names, priors, cameras = told_at(heights, lifted_m=float(heights.mean()) - 60)
    found = replace(found, frame=replace(found.frame, vertical_datum="takeoff"))
    assert outvoted_heights(found, names, priors, cameras) is None


@pytest.mark.parametrize("by_m", [-440.0, 60.0])
def test_half_of_the_heights_against_the_other_half_are_told(by_m):
    heights = noisy(20) + np.where(np.arange(20) % 2, by_m, 0)
    found, names, priors, cameras = told_at(heights, lifted_m=by_m / 2)
    assert outvoted_heights(found, names, priors, cameras) is None
    (note,) = height_warnings(priors, found)
    assert note.startswith("The reported heights contradict the pictures")
