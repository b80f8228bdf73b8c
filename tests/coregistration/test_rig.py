"""The rig from exact directions, with noise, wrong pairs and a wrong focal length."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.coregistration.rig import FindRig, RigPair
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import angle_deg, cam_R_map_from_angles, median_rotation
from skyquilt.model.camera import Camera

A = Camera(width=4000, height=3000, focal=3000.0, cx=2010.0, cy=1490.0, k1=-0.05)
B = Camera(width=640, height=512, focal=760.0, cx=321.0, cy=257.0, k1=-0.2, k2=0.05)


def turned(yaw, pitch, roll):
    """A camera turned against one that looks straight down."""
    return cam_R_map_from_angles(yaw, pitch, roll) @ cam_R_map_from_angles(0, 0, 0).T


TRUE = turned(3.0, 1.5, -2.0)


def pairs(rng, number, wrong=0):
    found = []
    for k in range(number):
        px_b = rng.uniform([20, 20], [620, 490], (30, 2))
        b_R_a = turned(20, 9, 5) if k < wrong else TRUE
        px_a = project(A, rays(B, px_b) @ b_R_a)
        found.append(RigPair(px_a=px_a + rng.normal(0, 4, px_a.shape), px_b=px_b, camera_a=A))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_the_rotation_is_found_though_pairs_are_wrong(seed):
    rig = FindRig(free=0)(pairs(np.random.default_rng(seed), 9, wrong=3), B)
    assert angle_deg(rig.b_R_a, TRUE) < 0.03 and (rig.pairs, rig.agreeing) == (9, 6)
    assert rig.camera_b == B


def test_a_free_focal_length_is_found():
    rig = FindRig(free=0.2)(pairs(np.random.default_rng(4), 8), replace(B, focal=690.0))
    assert rig.camera_b.focal == pytest.approx(760, rel=0.005)
    assert angle_deg(rig.b_R_a, TRUE) < 0.03


def test_too_few_and_quarrelling_pairs_are_refused():
    rng = np.random.default_rng(5)
    assert not FindRig()(pairs(rng, 2), B) and "3 are needed" in FindRig()(pairs(rng, 2), B).reason
    apart = [
        replace(p, px_a=project(A, rays(B, p.px_b) @ turned(0, 3 * k, -2 * k)))
        for k, p in enumerate(pairs(rng, 6), 1)
    ]
    assert "agree on one rotation" in FindRig(free=0)(apart, B).reason


def late_pairs(rng, delay_s, headings, flown=(0.0, -6.0, 0.0), height=60.0):
    """Pairs over level ground of a second camera that is exposed later (one delay, or one of each
    pair), on lines flown so that the first camera sees the drone go at these headings.
    """
    found = []
    for heading, late_s in zip(headings, np.broadcast_to(delay_s, len(headings)), strict=True):
        velocity = cam_R_map_from_angles(heading) @ cam_R_map_from_angles(0).T @ np.array(flown)
        px_a = rng.uniform([800, 600], [3200, 2400], (30, 2))
        ray = rays(A, px_a)
        ground = ray * height / ray[:, 2:]
        px_b = project(B, (ground - late_s * velocity) @ TRUE.T)
        pace = velocity / np.linalg.norm(ground, axis=1, keepdims=True)
        pair = RigPair(px_a=px_a + rng.normal(0, 4, (1, 2)), px_b=px_b, camera_a=A, pace=pace)
        found.append(pair)
    return found


@pytest.mark.parametrize(
    ("delay_s", "headings"),
    [(0.2, [0] * 6 + [180] * 6), (-0.12, [0] * 9 + [180] * 3), (0.8, [0, 90, 180, 270])],
)
def test_a_late_shutter_is_told_from_a_turned_camera(delay_s, headings):
    """On lines flown there and back by a camera that keeps its heading, the delay turns the views
    to either side: half of the pairs would agree on a rotation that is wrong for the others.
    """
    late = late_pairs(np.random.default_rng(7), delay_s, headings)
    rig = FindRig(free=0)(late, B)
    assert rig.delay_s == pytest.approx(delay_s, abs=0.02)
    assert rig.agreeing == len(headings) and angle_deg(rig.b_R_a, TRUE) < 0.1


@pytest.mark.parametrize(("delay_s", "headings"), [(0.0, [0, 180] * 5), (0.3, [0] * 10)])
def test_no_delay_is_made_up(delay_s, headings):
    """Nor where a rotation explains it: cameras that turn with the lines see one way of flight."""
    rig = FindRig(free=0)(late_pairs(np.random.default_rng(8), delay_s, headings), B)
    assert rig.delay_s == 0 and rig.agreeing == 10


def test_the_delay_that_files_tell_is_taken_where_pictures_do_not_tell_it():
    """A camera that turns with the lines: a rotation explains the delay over level ground, and lies
    beside it over hills.
    """
    late = late_pairs(np.random.default_rng(8), 1.0, [0] * 10)
    rig = FindRig(free=0, told_s=1.0)(late, B)
    assert rig.delay_s == 1.0 and angle_deg(rig.b_R_a, TRUE) < 0.1
    wrong = late_pairs(np.random.default_rng(7), 0.2, [0] * 6 + [180] * 6)
    assert FindRig(free=0, told_s=1.0)(wrong, B).delay_s == pytest.approx(0.2, abs=0.02)


@pytest.mark.slow
def test_recorded_times_of_a_camera_with_a_clock_of_its_own_are_used_where_they_are_true():
    """Each pair is late by another time; the camera turns with the lines. Times that were drawn
    apart from the pictures change nothing.
    """
    rng = np.random.default_rng(9)
    true, drawn = rng.uniform(-0.2, 0.2, (2, 10))
    pairs = late_pairs(rng, 0.1 + true, [0] * 10)
    plain, timed, astray = (
        FindRig(free=0)(
            [replace(p, late_s=float(s)) for p, s in zip(pairs, late_s, strict=True)], B
        )
        for late_s in (0 * true, true, drawn)
    )
    assert timed.timed and timed.spread_deg < 0.15 < 0.3 < plain.spread_deg
    assert not plain.timed and not astray.timed
    assert astray.spread_deg == plain.spread_deg


def test_the_median_of_rotations_bears_outliers():
    rng = np.random.default_rng(6)
    near = [
        cam_R_map_from_angles(*(np.array([10, 2, -1]) + rng.normal(0, 0.1, 3))) for _ in range(8)
    ]
    far = [cam_R_map_from_angles(*rng.uniform(-90, 90, 3)) for _ in range(5)]
    assert angle_deg(median_rotation(near + far), cam_R_map_from_angles(10, 2, -1)) < 0.15
