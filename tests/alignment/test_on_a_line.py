"""Photos on a line that tell no angles: nothing but a level horizon tells how all are turned about
it.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.dominant_plane import TAKEN_DOWN, UNTOLD, dominant_normal, level_untold
from skyquilt.alignment.oblique import tilt_deg
from skyquilt.alignment.oblique_guess import guessed_priors
from skyquilt.alignment.oblique_start import levelled_about_line, told_directions, turned_aside
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from skyquilt.model.poses import Pose
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


GRID = np.stack(np.meshgrid(*2 * [np.linspace(-90, 90, 40)]), -1).reshape(-1, 2)


def flown(ahead_deg, *, climb=0.0, slope=0.0, untold=2, lines=(0.0,)):
    """Photos along a line (or lines side by side, all headed alike), and level ground: poses, tie
    points, and priors whose first axes tell the place alone; as true, and as if cameras looked
    straight down.
    """
    true, rng = [], np.random.default_rng(7)
    for aside in lines:
        for c in centres():
            place = c + aside * np.array([AHEAD[1], -AHEAD[0], 0.0])
            place += (*rng.normal(0, 0.5, 2), climb * (c @ AHEAD) + rng.normal(0, 0.3))
            R = cam_R_map_from_angles(COURSE_DEG, ahead_deg, 0.0)
            true.append(Pose(cam_R_map=R, map_C=place))
    xyz = np.column_stack([GRID, slope * (GRID @ AHEAD[:2]) + rng.normal(0, 0.5, len(GRID))])
    priors = [
        replace(prior(tuple(p.map_C)), map_C=np.r_[p.map_C[:untold], [np.nan] * (3 - untold)])
        for p in true
    ]
    priors = [replace(p, sigma_tilt_deg=6.0) for p in priors]
    done = alignment(len(true))
    done = replace(
        done,
        poses=dict(enumerate(true)),
        ties=replace(done.ties, xyz=xyz),
        blocks=(tuple(range(len(true))),),
    )
    down = rotation_from_vector(np.radians(ahead_deg) * np.cross(AHEAD, [0, 0, 1.0]))
    ways = [replace_turned(done, turn) for turn in (down, down.T)]
    return (
        done,
        min(ways, key=lambda d: max(tilt_deg(p.cam_R_map) for p in d.poses.values())),
        priors,
    )


def replace_turned(done, turn):
    return done.carried(turn, 1 / np.cos(np.arccos(np.clip(turn[2, 2], -1, 1))), np.zeros(3))


@pytest.mark.parametrize("lines", [(0.0,), (-30.0, 0.0, 30.0)])
@pytest.mark.parametrize("ahead_deg", [15.0, -12.0, 25.0])
def test_a_flight_that_looks_ahead_and_tells_no_heights_is_level(ahead_deg, lines):
    true, found, priors = flown(ahead_deg, lines=lines)
    assert max(tilt_deg(p.cam_R_map) for p in found.poses.values()) < 0.1
    done = level_untold(found, priors)
    assert done.notes[-1].startswith(UNTOLD) and "taken to be level" in done.notes[-1]
    for i, p in done.poses.items():
        assert tilt_deg(p.cam_R_map) == pytest.approx(abs(ahead_deg), abs=0.5)
        assert np.linalg.norm(p.map_C - true.poses[i].map_C) < 1.0
    assert dominant_normal(done.ties.xyz, 1.5)[2] > np.cos(np.radians(0.5))


@pytest.mark.parametrize(
    ("ahead_deg", "climb", "slope", "untold", "says"),
    [
        (0.0, 0.0, 0.0, 2, False),  # down upon level ground
        (0.0, 0.0, 0.3, 2, False),  # a hillside: the drone keeps its height
        (0.0, 0.07, 0.07, 2, True),  # as much as ground slopes
        (0.0, 0.3, 0.0, 2, True),  # a climb
        (15.0, 0.0, 0.0, 3, False),  # heights are told
    ],
)
def test_others_stay_as_they_are_and_say_so_where_nothing_tells(
    ahead_deg, climb, slope, untold, says
):
    _, found, priors = flown(ahead_deg, climb=climb, slope=slope, untold=untold)
    done = level_untold(found, priors)
    assert done.poses == found.poses and done.notes[len(found.notes) :] == (TAKEN_DOWN,) * says


def test_photos_of_several_headings_and_told_angles_say_nothing():
    _, found, priors = flown(0.0, lines=(0.0, 30.0))
    half = cam_R_map_from_angles(180.0, 0.0, 0.0)
    turned = {
        i: replace(p, cam_R_map=half @ p.cam_R_map) if i % 2 else p for i, p in found.poses.items()
    }
    both = replace(found, poses=turned)
    assert level_untold(both, priors) is both
    stated = [replace(p, sigma_tilt_deg=1.0) for p in priors]
    assert level_untold(found, stated) is found


def test_a_receiver_that_is_stuck_tells_no_scale():
    _, found, priors = flown(15.0)
    stuck = [replace(p, map_C=np.array([3.0, 4.0, np.nan])) for p in priors]
    done = level_untold(found, stuck)
    apart = [np.linalg.norm(d.poses[8].map_C - d.poses[0].map_C) for d in (done, found)]
    assert apart[0] == pytest.approx(apart[1])
    assert dominant_normal(done.ties.xyz, 1.5)[2] > np.cos(np.radians(0.5))
