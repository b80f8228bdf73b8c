"""Matches of places that look alike (rows of trees) do not move the growing map."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live.local_pose import MISLED, Change, LocalPose
from skyquilt.model.poses import Pose
from tests.alignment.surveys import prior

HIGH, NEW = 60.0, 9
ALONG = np.array([12.0, 0.0, 0.0])


def pose(C):
    return Pose(cam_R_map=np.diag([1.0, -1.0, -1.0]), map_C=np.asarray(C, float))


def judged(moved_by, *, off=(0.0, 0.0), observations=20, before=None, number=5, sigma=1.5):
    """What is said of a photo that moves the others by so much (function of their number), and lies
    `off` its position itself.
    """
    rng = np.random.default_rng(0)
    by_id, moved = {}, {}
    for i in range(number):
        true = ALONG * i + [0, 0, HIGH]
        told = prior(true + np.r_[rng.normal(0, 1, 2), 0], sigma=sigma)
        was = pose(true + (before(i) if before else 0))
        by_id[i] = SimpleNamespace(id=i, prior=told, pose=was)
        moved[i] = pose(true + moved_by(i))
    true = ALONG * number + [0, 0, HIGH]
    member = SimpleNamespace(id=NEW, prior=prior(true, sigma=sigma), pose=None)
    moved[NEW] = pose(true + np.r_[off, 0])
    local = object.__new__(LocalPose)
    local.members = SimpleNamespace(by_id=by_id | {NEW: member})
    local.metadata = SimpleNamespace(ground_at=lambda C: 0.0)
    change = Change(
        moved=moved,
        cameras={},
        camera_of={},
        links={},
        xyz=np.zeros((0, 3)),
        observations=observations,
    )
    return local._misled(member, change)


def still(i):
    return np.zeros(3)


def squeezed(i):
    """The photos end up in half as long a line."""
    return np.array([-6.0 * i, 0, 0])


def test_a_photo_that_squeezes_the_map_is_not_believed():
    assert judged(squeezed) == MISLED
    assert judged(squeezed, observations=200) == MISLED  # however many they are


def test_a_photo_that_closes_a_loop_may_move_all():
    """Photos that had drifted away from their positions come back."""
    assert not judged(still, before=squeezed)
    assert not judged(lambda i: 0.4 * squeezed(i), before=squeezed)


@pytest.mark.parametrize(
    ("off", "observations", "sigma", "believed"),
    [
        ((24.0, 18.0), 20, 1.5, False),
        ((24.0, 18.0), 60, 1.5, True),  # a position that lies elsewhere
        ((24.0, 18.0), 20, 8.0, True),  # as positions of this receiver may
        ((5.0, 4.0), 20, 1.5, True),
    ],
)
def test_few_matches_place_no_photo_far_from_its_position(off, observations, sigma, believed):
    why = judged(still, off=off, observations=observations, sigma=sigma)
    assert (not why) == believed
    assert believed or "20 tie points, by which it would lie 30 m" in why


def test_two_photos_do_not_tell():
    assert not judged(squeezed, number=2)
