"""Of photos that were taken near to each other, heights above take-off and headings tell how large
the map is, and where north is.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.near_positions import told_besides, weighed
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.model.poses import Motion
from tests.alignment.test_oblique_start import FRAME, Slanting

HEIGHT = 45.0
ROW = [(0.0, 6.0 * k, HEIGHT, 0.0, 0.0) for k in range(4)]
SQUARE = [(6.0 * i, 6.0 * k, HEIGHT, 180.0 * i, 0.0) for i in range(2) for k in range(2)]
HOVER = [
    (0.5 * np.cos(k), 0.5 * np.sin(2 * k), HEIGHT, (25.0 * k + 180) % 360 - 180, 0.0)
    for k in range(12)
]
WIDE = [(x, y, HEIGHT, 0.0, 0.0) for y in (0, 18, 36) for x in (-40, -20, 0, 20, 40)]
GPS_M, BAROMETER_M = 2.0, 0.5
ALIKE = np.zeros(2)
"""Both kinds of receivers are as likely."""


def flown(places, seed, gps=GPS_M, height_off=0.0):
    """A flight whose heights come from a barometer, begun so many m above the ground of the map."""
    rng = np.random.default_rng(seed + 100)
    survey = Slanting(places, gps=gps, seed=seed, alike_deg=180)
    survey.priors = [
        replace(
            p,
            map_C=np.r_[p.map_C[:2], t.map_C[2] - height_off + rng.normal(0, BAROMETER_M)],
            sigma_C=np.array([0.75 * gps, 0.75 * gps, 3.0]),
        )
        for p, t in zip(survey.priors, survey.truth, strict=True)
    ]
    return survey


def adjusted(survey, **more):
    return Bundle(**more)(survey.photos, FRAME, survey.priors, survey.features, survey.links)


def off(survey, found):
    """Error of the scale of the ground, as a share, and of the direction in degrees."""
    true = np.median([t.map_C[2] for t in survey.truth])
    high = np.median([p.map_C[2] for p in found.poses.values()]) - np.median(found.ties.xyz[:, 2])
    yaws = [
        angle_difference_deg(
            angles_from_cam_R_map(p.cam_R_map)[0],
            angles_from_cam_R_map(survey.truth[i].cam_R_map)[0],
        )
        for i, p in found.poses.items()
    ]
    return abs(high / true - 1), abs(float(np.median(yaws)))


@pytest.mark.slow
@pytest.mark.parametrize("places", [ROW, SQUARE, HOVER], ids=["row", "square", "hover"])
def test_few_photos_are_as_large_as_their_heights_tell(places, monkeypatch):
    surveys = [flown(places, seed) for seed in (1, 3)]
    told = [off(s, adjusted(s)) for s in surveys]
    monkeypatch.setattr("skyquilt.alignment.bundle.told_besides", lambda done, *_: done)
    assert max(scale for scale, _ in told) < 0.08  # by barometer, 5 % are expected
    if places is not HOVER:
        alone = [off(s, adjusted(s)) for s in surveys]
        assert max(scale for scale, _ in alone) > 0.18  # by positions
    assert max(turn for _, turn in told) < 3


def test_their_headings_tell_where_north_is():
    survey = flown(SQUARE, 1, gps=0.1)
    a, middle = np.radians(30), np.array([3.0, 3.0, HEIGHT])
    turn = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    turned = adjusted(survey).carried(turn, 1.0, middle)  # as the positions want it
    priors = [
        replace(p, map_C=turned.poses[i].map_C, sigma_C=np.array([1.5, 1.5, 3.0]))
        for i, p in enumerate(survey.priors)
    ]
    assert off(survey, turned)[1] == pytest.approx(30, abs=1.5)
    # 10 degrees by positions as stated, 1.4 if their errors last, 5 by headings
    loose = np.degrees(np.array([1.5, 0.2]) / np.sqrt(4 * 18))
    left = 30 - weighed(30.0, loose, 5.0, ALIKE).change
    assert left == pytest.approx(30 * 25 / (25 + loose[0] ** 2), abs=0.5)  # they do not, it shows
    found = told_besides(turned, priors, 0.0)
    assert off(survey, found)[1] == pytest.approx(left, abs=1.5)
    assert sum("direction" in note for note in found.notes) == 1
    one = [replace(priors[0], yaw_deg=170.0), *priors[1:]]  # a file that was turned
    assert off(survey, told_besides(turned, one, 0.0))[1] == pytest.approx(left, abs=1.5)
    some = [replace(p, yaw_deg=90.0 * i) for i, p in enumerate(priors)]  # no two alike
    assert off(survey, told_besides(turned, some, 0.0))[1] == pytest.approx(30, abs=1.5)


def test_why_positions_tell_little_is_said_as_it_is():
    """Photos far from each other of which one or two have a position were not taken near to each
    other.
    """
    survey = flown(SQUARE, 1)
    found = replace(adjusted(survey), notes=())
    bare = [replace(p, map_C=np.full(3, np.nan)) for p in survey.priors]
    for count, why in (
        (1, "Only one photo of the map"),
        (2, "The 2 photos that"),
        (4, "The photos "),
    ):
        priors = [*survey.priors[:count], *bare[count:]]
        notes = told_besides(found, priors, 0.0).notes
        assert notes and all(note.startswith(why) for note in notes)


@pytest.mark.slow
def test_positions_that_tell_scale_and_direction_are_not_touched():
    for survey in (flown(WIDE, 0), flown(SQUARE, 0, gps=0.02, height_off=9.0)):
        found = adjusted(survey)
        assert told_besides(found, survey.priors, 0.0) is found


@pytest.mark.parametrize("noise", [0.05, 2.0])
def test_positions_that_lie_as_the_photos_do_tell_the_scale_whatever_they_state(noise):
    """Six photos within 23 m, and heights of a take-off place 9 m above the ground."""
    places = [(9.0 * i, 11.5 * k, HEIGHT, 180.0 * i, 0.0) for i in range(2) for k in range(3)]
    survey = flown(places, 2, gps=noise, height_off=9.0)
    survey.priors = [replace(p, sigma_C=np.array([2.0, 2.0, 3.0])) for p in survey.priors]
    found = adjusted(survey)
    if noise < 0.2:
        assert off(survey, found)[0] < 0.04  # by heights 0.15
        assert not any("so near to each other" in note for note in found.notes)
    else:
        assert any("so near to each other" in note for note in found.notes)


def test_positions_of_photos_that_tell_no_height_count():
    survey = flown(WIDE, 0)
    found = adjusted(survey)
    few = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in survey.priors[1:]]
    assert told_besides(found, [survey.priors[0], *few], 0.0) is found


def test_heights_that_contradict_positions_are_told_and_not_used():
    row = [(0.0, 12.0 * k, HEIGHT, 0.0, 0.0) for k in range(4)]
    survey = flown(row, 0, gps=2.0, height_off=30.0)  # from a hill
    found = adjusted(survey)
    assert any("15 m above take-off" in note for note in found.notes)
    assert off(survey, found)[0] < 0.1
    bare = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in survey.priors]
    found = replace(found, notes=())
    assert told_besides(found, bare, 0.0) is found
    assert told_besides(found, survey.priors, np.nan) is found  # nobody knows the take-off's height


def test_photos_show_the_same_after_a_map_was_turned_and_enlarged():
    survey = flown(ROW, 0)
    found = adjusted(survey)
    motion = Motion(shift_m=np.array([0.3, -0.2, 0.1]), turn_rad=np.zeros(3))
    found = replace(found, poses={i: replace(p, motion=motion) for i, p in found.poses.items()})
    turn = Rotation.from_rotvec([0.1, -0.2, 1.3]).as_matrix()
    middle = np.array([3.0, -20.0, 9.0])
    moved = found.carried(turn, 1.7, middle)
    for i, pose in found.poses.items():
        local, there = (a.poses[i].to_camera(a.ties.xyz) for a in (found, moved))
        np.testing.assert_allclose(there, 1.7 * local, atol=1e-9)
        shift = moved.poses[i].cam_R_map @ moved.poses[i].motion.shift_m
        np.testing.assert_allclose(shift, 1.7 * pose.cam_R_map @ motion.shift_m, atol=1e-12)
    back = moved.carried(turn.T, 1 / 1.7, middle)
    np.testing.assert_allclose(back.ties.xyz, found.ties.xyz, atol=1e-9)
    np.testing.assert_allclose(back.accuracy.xyz, found.accuracy.xyz, atol=1e-9)


@pytest.mark.slow
def test_the_weights_err_less_than_either_scale_and_than_any_fixed_weight():
    """Drawn from what is assumed: ground of any height, receivers of both kinds."""
    rng = np.random.default_rng(1)
    loose, told, n = np.array([0.15, 0.02]), 0.05, 20000
    by_positions = rng.normal(0, np.where(rng.random(n) < 0.5, *loose))
    by_heights = rng.normal(0, told, n)
    apart = by_heights - by_positions
    found = [weighed(a, loose, told, ALIKE) for a in apart]
    error = np.sqrt(
        np.mean(
            [(p + (f.change if f else 0)) ** 2 for p, f in zip(by_positions, found, strict=True)]
        )
    )
    fixed = [np.sqrt(np.mean((by_positions + w * apart) ** 2)) for w in np.linspace(0, 1, 21)]
    assert 0.8 * min(fixed) < error < 0.95 * min(fixed)
    stated = np.sqrt(np.mean([(loose[0] * f.narrowed) ** 2 for f in found if f]))
    assert stated == pytest.approx(error, rel=0.05)  # what is left is what is told


def test_exact_positions_keep_their_scale_and_none_leave_it_to_the_heights():
    told = 0.06
    assert weighed(0.1, np.array([1e-4, 1e-4]), told, ALIKE).change == pytest.approx(0, abs=1e-5)
    assert weighed(0.2, np.array([50.0, 50.0]), told, ALIKE).change == pytest.approx(0.2, rel=1e-4)
    assert weighed(0.0, np.array([0.1, 0.02]), told, ALIKE).change == 0
    assert weighed(3.0, np.array([0.1, 0.02]), told, ALIKE) is None  # a contradiction
