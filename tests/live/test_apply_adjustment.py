"""Photos that came while others were adjusted go along with them, as a rigid block does."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.live.apply_adjustment import ApplyAdjustment, carried
from skyquilt.model.poses import Pose

LINE = [
    Pose(
        cam_R_map=cam_R_map_from_angles(15.0 + k, 0.4 * k, -0.3), map_C=np.array([8.0, 20 * k, 60])
    )
    for k in range(8)
]
TURN = cam_R_map_from_angles(1.4, 0.2, -0.3).T @ cam_R_map_from_angles(0.0, 0.0, 0.0)
"""A turn (3, 3) in the map frame."""


def turned(pose):
    """A pose of the block after it was turned about the origin and moved."""
    place = TURN @ pose.map_C + [3.0, -2.0, 0.5]
    return Pose(cam_R_map=pose.cam_R_map @ TURN.T, map_C=place)


def same(a, b):
    return np.allclose(a.map_C, b.map_C, atol=1e-9) and np.allclose(a.cam_R_map, b.cam_R_map)


def test_a_pose_is_carried_as_a_rigid_block_is():
    near = [(p, turned(p)) for p in LINE[:3]]
    assert np.degrees(np.arccos((np.trace(TURN) - 1) / 2)) > 1.4
    assert same(carried(LINE[4], near), turned(LINE[4]))
    assert same(carried(LINE[4], near[:1]), turned(LINE[4]))


@pytest.mark.parametrize("reach", [1, 2])
def test_photos_are_carried_that_are_linked_with_others_of_these_alone(reach):
    """Of a line, each is linked with so many before it: only the first of those that came since
    are linked with adjusted ones.
    """

    def member(k, pose, links):
        return SimpleNamespace(
            id=k, pose=pose, camera="c", tried=k, again=0, learned=None, links=links
        )

    near = [{j for j in range(8) if 0 < abs(j - k) <= reach} for k in range(8)]
    members = [member(k, pose, near[k]) for k, pose in enumerate(LINE)]
    members += [member(8, None, {7}), member(9, LINE[0], set())]
    moved, untried = {}, []
    refinement = SimpleNamespace(
        members=SimpleNamespace(save=lambda member, about: None),
        ledger=None,
        schedule=None,
        redraw=None,
        queues=SimpleNamespace(untried=untried),
        move=lambda poses, cameras: moved.update(poses),
    )
    done = {k: (LINE[k], turned(LINE[k])) for k in range(4)}
    ApplyAdjustment(refinement)._follow(members[4:], done)
    assert sorted(moved) == [4, 5, 6, 7] and [m.id for m in untried] == [4, 5, 6, 7]
    assert all(same(moved[k], turned(LINE[k])) for k in moved)
