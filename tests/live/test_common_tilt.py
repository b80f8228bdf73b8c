"""What tilts have in common, against drawn ones."""

import numpy as np
import pytest

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.live.common_tilt import common_tilt


def looks(rng, pitch_deg, roll_deg, photos=15, noise_deg=0.5, ahead_deg=0.0):
    """Where photos on lines there and back say that they look, and where they do."""
    told, found = [], []
    for k in range(photos):
        yaw, (pitch, roll) = 180.0 * (k // 5), rng.normal(0, 1, 2) + (ahead_deg, 0)
        noise = rng.normal(0, noise_deg, 2)
        told.append(cam_R_map_from_angles(yaw, pitch + noise[0], roll + noise[1]))
        found.append(cam_R_map_from_angles(yaw, pitch + pitch_deg, roll + roll_deg))
    return np.array(told), np.array(found)


def apart_deg(a, b):
    """Angles between the axes of cameras."""
    return np.degrees(np.arccos(np.clip((a[:, 2] * b[:, 2]).sum(1), -1, 1)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(10, 0), (-4, 0), (0, 6), (3, -5)])
@pytest.mark.parametrize("ahead_deg", [0.0, 45.0])
def test_the_next_photo_looks_where_those_before_it_did(seed, pitch_deg, roll_deg, ahead_deg):
    rng = np.random.default_rng(seed)
    turn = common_tilt(*looks(rng, pitch_deg, roll_deg, ahead_deg=ahead_deg))
    told, found = looks(rng, pitch_deg, roll_deg, ahead_deg=ahead_deg)
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.median(apart_deg(turn @ told, found)) < 1.2 < np.median(apart_deg(told, found))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_small_or_told_by_few_or_differs_is_no_error_in_common(seed):
    rng = np.random.default_rng(seed)
    for case in (
        looks(rng, 1.0, 0.0),
        looks(rng, 10.0, 0.0, photos=5),
        looks(rng, 4.0, 0.0, noise_deg=8.0),
        looks(rng, 0.0, 0.0, photos=0),
    ):
        told, found = (np.reshape(part, (-1, 3, 3)) for part in case)
        assert np.array_equal(common_tilt(told, found), np.eye(3))
