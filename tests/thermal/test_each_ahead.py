"""How far a camera had flown is told by patches, where its rig does not know."""

import numpy as np
import pytest

from skyquilt.coregistration.beside import Beside, Together
from skyquilt.model.camera import Camera
from skyquilt.thermal.each_ahead import ahead_of
from tests.coregistration.rigs import rig, seen
from tests.texture import texture

TAKEN = Camera.ideal(width=500, height=400, focal=430.0)
DEPTH_M, SIZE, FOCAL = 50.0, (320, 256), 380.0
BAND = rig(5, *SIZE, FOCAL, number=1)[0]
THERE = Beside(turn=BAND.turn, place=np.zeros(2), camera=BAND.camera)


def pair(picture, other, ahead_m):
    """Photos of level ground, the second in negative, taken from so many m aside."""
    b = seen(other, TAKEN, BAND, (ahead_m[0] / DEPTH_M, ahead_m[1] / DEPTH_M))
    grey = np.clip(picture, 0, 255).astype(np.uint8)
    negative = np.clip(255 - b, 0, 255).astype(np.uint8)
    near = np.full((2, 2), 1 / DEPTH_M)
    return Together(a=grey, camera_a=TAKEN, b=negative, nearness=near)


@pytest.mark.parametrize("ahead_m", [(0.0, 0.0), (0.2, -0.9), (-0.7, 0.4)])
def test_each_pair_tells_how_far_ahead_the_second_camera_was(ahead_m):
    """0.1 m is 0.8 px of the second camera."""
    picture = texture(TAKEN.height, TAKEN.width, seed=1)
    both = pair(picture, picture, ahead_m)
    found = ahead_of(both, THERE)
    assert found is not None and np.abs(found[:2] - ahead_m).max() < 0.02
    rough = ahead_of(both, THERE, rough=True)
    assert rough is not None and np.abs(rough[:2] - ahead_m).max() < 0.1


def test_other_ground_tells_nothing():
    size = TAKEN.height, TAKEN.width
    assert ahead_of(pair(texture(*size, seed=1), texture(*size, seed=2), (0, 0)), THERE) is None
