"""Photos on a line that tell no angles: nothing but a level horizon tells how all are turned about
it.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.oblique_guess import guessed_priors
from skyquilt.alignment.oblique_start import levelled_about_line, told_directions, turned_aside
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from tests.alignment.surveys import alignment, prior
from tests.alignment.test_oblique_start import Slanting, untold_tilts

COURSE_DEG = 30.0
AHEAD = np.array([np.sin(np.radians(COURSE_DEG)), np.cos(np.radians(COURSE_DEG)), 0.0])


def centres(count=9):
    return np.linspace(-50, 50, count)[:, None] * AHEAD + [0, 0, 45.0]


@pytest.mark.parametrize("turn_deg", [-30.0, -4.0, 0.0, 12.0])
@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(30, 15), (30, 0), (210, -10), (60, 40)])
def test_a_turn_about_the_line_is_taken_back(turn_deg, yaw_deg, pitch_deg):
    level = np.array([cam_R_map_from_angles(yaw_deg, pitch_deg, 0.0)] * 9)
    turn = rotation_from_vector(np.radians(turn_deg) * AHEAD)
    back = levelled_about_line(centres(), level @ turn.T)
    assert np.allclose(back @ turn, np.eye(3), atol=1e-9)


def test_rows_along_the_line_do_not_tell_it():
    aside = np.array([cam_R_map_from_angles(COURSE_DEG + 90, 25.0, 0.0)] * 9)
    assert np.array_equal(levelled_about_line(centres(), aside), np.eye(3))


def test_what_positions_tell_by_where_they_lie():
    over = [prior((x, y, 50.0)) for x in (0, 20, 40) for y in (0, 20, 40)]
    assert told_directions(over) == 2
    assert told_directions(over[:3]) == 0  # too few
    assert told_directions([prior(tuple(c)) for c in centres()]) == 1
    assert told_directions([prior((0.1 * k, 0.0, 50.0)) for k in range(9)]) == 0


@pytest.mark.parametrize("turn_deg", [0.0, 8.0])
def test_the_guess_for_photos_on_a_line_has_level_horizons(turn_deg):
    flown = Slanting([(*c, COURSE_DEG, 20.0) for c in centres().tolist()])
    turn = rotation_from_vector(np.radians(turn_deg) * AHEAD)
    poses = {
        i: replace(p, map_C=turn @ p.map_C, cam_R_map=p.cam_R_map @ turn.T)
        for i, p in enumerate(flown.truth)
    }
    found = replace(alignment(len(poses)), poses=poses)
    level = untold_tilts(flown)
    assert np.abs(turned_aside(found, level) @ turn - np.eye(3)).max() < 0.02
    guess = guessed_priors(flown.photos, level, flown.features, flown.links, found)
    for p, true in zip(guess, flown.truth, strict=True):
        R = cam_R_map_from_angles(p.yaw_deg, p.pitch_deg, p.roll_deg)
        off = np.degrees(np.arccos(np.clip((R @ true.cam_R_map.T)[2, 2], -1, 1)))
        assert off < 8.0  # positions err
        assert abs(R[0, 2]) < 0.02
