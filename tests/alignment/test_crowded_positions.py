"""Positions that crowd where the pictures show photos far apart are not used; others are."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.aligners import Auto, ByLinks, by_pose
from skyquilt.alignment.crowded_positions import (
    ONE_PLACE,
    believed,
    one_place_notes,
    without_crowded,
)
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.model.photo import ControlPoint
from tests.alignment.surveys import alignment
from tests.alignment.test_oblique_start import FRAME, Slanting

LINES = [(x, y, 45.0, 20.0, 0.0) for y in (-40, -20, 0, 20) for x in (-36, -18, 0, 18, 36)]
"""Four lines of five photos, 45 m high."""


def flown(places=LINES, seed=0):
    return Slanting(places, seed=seed)


def inputs(survey, priors, **more):
    return AlignmentInputs(
        photos=survey.photos,
        features=survey.features,
        frame=FRAME,
        priors=priors,
        links=survey.links,
        control=more.get("control", ()),
        order=range(len(survey.photos)),
        grey=None,
    )


def at_one_place(survey, noise_m, seed=0):
    rng = np.random.default_rng(seed)
    error = np.column_stack([rng.normal(0, noise_m, (len(survey.priors), 2)) + (30, -12)])
    return [
        replace(p, map_C=np.r_[e, p.map_C[2]]) for p, e in zip(survey.priors, error, strict=True)
    ]


@pytest.mark.parametrize("noise_m", [0.3, 1.5, 3.0])
@pytest.mark.parametrize("seed", range(2))
def test_positions_that_crowd_are_told(noise_m, seed):
    survey = flown(seed=seed)
    left, (note,) = without_crowded(inputs(survey, at_one_place(survey, noise_m, seed)))
    assert left.frame.crs is None and "remote control" in note
    for own, told in zip(left.priors, survey.priors, strict=True):
        assert np.isnan(own.map_C[:2]).all() and own.map_C[2] == told.map_C[2]


@pytest.mark.slow
def test_a_map_without_them_has_its_scale_from_the_heights():
    survey = flown()
    priors = at_one_place(survey, 1.5)
    found = Auto(bundle=ByLinks(), pose=by_pose(None, repair=True))(inputs(survey, priors))
    assert found.frame.crs is None and found.frame.metric
    assert any("remote control" in note for note in found.notes)
    assert "not georeferenced" in found.why
    true = np.array([p.map_C for p in survey.truth])
    placed = np.array([found.poses[i].map_C for i in range(len(true))])
    scale = np.ptp(placed[:, :2]) / np.ptp(true[:, :2])
    assert scale == pytest.approx(1, abs=0.08)  # by the heights, over ground a metre high
    assert all(np.isnan(p.map_C[:2]).all() for p in believed(found, FRAME, priors))


def test_without_heights_they_crowd_where_photos_would_be_taken_from_below_2_m():
    survey = flown()
    bare = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in at_one_place(survey, 0.5)]
    left, _ = without_crowded(inputs(survey, bare))
    assert left.frame.crs is None


@pytest.mark.parametrize("sigma", [0.02, 1.5, 8.0])
@pytest.mark.parametrize("seed", range(3))
def test_positions_that_are_right_stay(sigma, seed):
    survey = Slanting(LINES, gps=sigma, seed=seed)
    told = [replace(p, sigma_C=np.array([sigma, sigma, 2 * sigma])) for p in survey.priors]
    given = inputs(survey, told)
    assert without_crowded(given) == (given, ())


def test_a_drone_that_hovers_stays_where_it_is():
    survey = flown([(0.2 * i, 0.1 * i, 45.0, 20.0, 0.0) for i in range(8)])
    given = inputs(survey, survey.priors)
    assert without_crowded(given) == (given, ())


def test_control_points_keep_the_frame():
    survey = flown()
    points = [
        ControlPoint(name=str(k), x=0.0, y=0.0, z=0.0, crs="EPSG:32630", observations=())
        for k in range(3)
    ]
    found, _ = without_crowded(inputs(survey, at_one_place(survey, 1.0), control=points))
    assert found.frame.crs == FRAME.crs
    assert all(np.isnan(p.map_C[:2]).all() for p in found.priors)


def panorama(tilt, drift_m):
    """Photos all around from one place, where a drone drifts."""
    off = np.random.default_rng(5).normal(0, drift_m, (20, 3)) + (0.0, 0.0, 50.0)
    return [(*off[k].tolist(), 360.0 * k / 20 - 180, tilt) for k in range(20)]


@pytest.mark.slow
@pytest.mark.parametrize(("tilt", "drift_m"), [(45.0, 0.0), (45.0, 0.1), (52.0, 0.4)])
def test_a_panorama_keeps_its_positions_and_is_placed_by_its_angles(tilt, drift_m):
    """Its photos show places far apart and were taken from one: what only turns has no parallax."""
    survey = Slanting(panorama(tilt, drift_m))
    given = inputs(survey, survey.priors)
    assert without_crowded(given) == (given, ())
    found = Auto(bundle=ByLinks(), pose=by_pose(None, repair=True))(given)
    assert len(found.poses) == len(survey.photos)
    apart, turned = survey.errors(found)
    assert apart.max() < 1.0  # positions err by 1.5, and do not tear it
    assert turned.max() < 3.0  # as angles err
    assert found.notes.count(ONE_PLACE) == 1
    assert (found.method == "bundle") == (drift_m > 0.2)


@pytest.mark.slow
def test_oblique_photos_whose_positions_are_those_of_the_remote_control():
    survey = Slanting(
        [(x, y, 45.0, 0.0, 50.0) for y in (-60, -42, -24) for x in range(-54, 60, 18)]
    )
    _, (note,) = without_crowded(inputs(survey, at_one_place(survey, 1.5)))
    assert "remote control" in note


def test_a_hover_before_a_flight_is_no_panorama():
    """Most photos were taken where the flight began, and so were most of the pairs that show the
    same: the flight tells the heights of the ground all the same.
    """
    hover, flight = [(0.0, 0.0, 60.0, 20.0, 0.0)] * 8, [(x, 0.0, 60.0, 20.0, 0.0) for x in (20, 40)]
    survey = Slanting([*hover, *flight])
    given = inputs(survey, survey.priors)
    poses, n = dict(enumerate(survey.truth)), len(survey.truth)
    found = replace(alignment(n), poses=poses, blocks=(tuple(range(n)),))
    assert one_place_notes(given, found) == ()
    still = dict.fromkeys(range(n), survey.truth[0])
    assert one_place_notes(given, replace(found, poses=still)) == (ONE_PLACE,)
