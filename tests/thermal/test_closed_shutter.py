"""Frames of a closed shutter are told from those of water by other frames of the same ground."""

import numpy as np
import pytest

from skyquilt.ortho.frame_pattern import Samples
from skyquilt.thermal.closed_shutter import closed_frames

FRAMES, SIDE, STEP = 12, 12, 3


def flown(seed, shut=(), contrast=3.0, water=0):
    """A line of frames, each SIDE points wide, over land with a lake under the first points of the
    line; each frame has an offset of its own.
    """
    rng = np.random.default_rng(seed)
    ground = rng.normal(20, contrast, (SIDE, SIDE + STEP * FRAMES))
    ground[:, :water] = 15
    number = np.arange(ground.size).reshape(ground.shape)
    points, rows, values = [], [], []
    for k in range(FRAMES):
        part = np.s_[:, STEP * k : STEP * k + SIDE]
        seen = np.full((SIDE, SIDE), 22.0) if k in shut else ground[part]
        points.append(number[part].ravel())
        values.append((seen + rng.normal(0, 0.5) + rng.normal(0, 0.03, seen.shape)).ravel())
        rows.append(np.full(SIDE * SIDE, k))
    place = np.zeros((FRAMES * SIDE * SIDE, 2))
    point, row, value = (np.concatenate(p) for p in (points, rows, values))
    return Samples(point=point, row=row, value=value, place=place)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("contrast", [0.3, 8.0])
def test_frames_of_a_closed_shutter_are_found(seed, contrast):
    """Also two in turn, which agree with each other."""
    assert closed_frames(flown(seed, (2, 6, 7), contrast)) == {2, 6, 7}


@pytest.mark.parametrize("water", [0, 20, 400])
def test_water_is_no_shutter(water):
    """A lake, its shore, and nothing but water."""
    assert not closed_frames(flown(1, water=water))
