"""Ground points of the growing map lie under its photos."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live.refinement import Refinement, on_ground
from skyquilt.model.poses import Pose
from skyquilt.ortho.height_cells import HeightCells

GROUND = 440.0


def poses(high):
    R = np.diag([1.0, -1.0, -1.0])
    return {i: Pose(cam_R_map=R, map_C=np.array([20.0 * i, 0.0, GROUND + high])) for i in range(6)}


@pytest.mark.parametrize("high", [8.0, 60.0, 300.0])
def test_what_photos_may_show_stays(high):
    """Hills half as high as the drone flies, valleys twice as deep, and 70 degrees aside."""
    rng = np.random.default_rng(0)
    xyz = np.column_stack(
        [
            rng.uniform(-2 * high, 100 + 2 * high, 500),
            rng.uniform(-1.5 * high, 1.5 * high, 500),
            GROUND + rng.uniform(-2, 0.5, 500) * high,
        ]
    )
    assert np.array_equal(on_ground(xyz, poses(high), GROUND), xyz)


def test_what_lies_above_or_beyond_the_photos_goes():
    """A text in the pictures matches itself: its rays are parallel."""
    good = np.array([[50.0, 10, GROUND + 5]])
    bad = np.array([[40.0, 10, GROUND + 64], [-1300, -800, GROUND - 2000], [50, 10, GROUND - 900]])
    found = on_ground(np.concatenate([bad, good]), poses(60.0), GROUND)
    assert np.array_equal(found, good)


@pytest.mark.parametrize("wrong", [59.4, -2000.0])
def test_ground_that_was_taken_wrongly_does_not_refuse_the_right_one(wrong):
    """Matches on a text had told ground just below the photos: what lies 60 m below them was
    refused for good, and what links show was measured against ground at 59 m.
    """
    rng = np.random.default_rng(1)
    ground = GROUND + rng.uniform(-5, 5, 300)
    right = np.column_stack([rng.uniform(-30, 130, 300), rng.uniform(-60, 60, 300), ground])
    rays = np.array([[40.0, 10, GROUND + 64], [-1300, -800, GROUND - 2000], [50, 10, GROUND - 900]])
    assert not len(on_ground(right, poses(60.0), GROUND + wrong))
    assert np.array_equal(on_ground(np.concatenate([right, rays]), poses(60.0), None), right)
    assert not len(on_ground(rays[:1], poses(60.0), None))  # all of it above the photos


def test_nothing_is_judged_without_photos():
    bad = np.array([[40.0, 10, GROUND + 64]])
    assert on_ground(bad, {}, GROUND) is bad
    none = np.zeros((0, 3))
    assert on_ground(none, poses(60.0), GROUND) is none


def test_ground_belongs_to_the_photos_that_are_nearest():
    """Two blocks side by side: the ground below one is told anew, but where one of its photos moves
    aside that below it is forgotten.
    """
    before = poses(60.0)
    other = {
        i + 10: Pose(cam_R_map=p.cam_R_map, map_C=p.map_C + [0, 80, 0]) for i, p in before.items()
    }
    shown = [SimpleNamespace(id=i, pose=p) for i, p in (before | other).items()]
    cells = HeightCells(cell=4.0)
    known = np.stack(np.meshgrid(np.arange(-5, 30), np.arange(-10, 30)), -1).reshape(-1, 2)
    cells.put(known, np.full(len(known), GROUND))
    refinement = object.__new__(Refinement)
    refinement.members = SimpleNamespace(on_map=lambda: shown)
    refinement.local_pose = SimpleNamespace(metadata=SimpleNamespace(heights=cells))
    after = before | {5: Pose(cam_R_map=before[5].cam_R_map, map_C=before[5].map_C + [9, 0, 0])}
    own, gone = refinement._ground_of(after, GROUND)
    middle = (own + 0.5) * 4
    assert len(own) == (((known + 0.5) * 4)[:, 1] < 40).sum()
    assert (middle[:, 1] < 40).all()
    between = middle[:, 0] == 90
    assert np.array_equal(gone[~between], middle[~between, 0] > 90)
    assert len(refinement._ground_of({}, GROUND)[0]) == 0
