"""Pictures without metadata that repeat the view of a photo are left out, and no others are."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.copied_views import without_copied_views
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.photo import Focal
from skyquilt.model.poses import Pose, TiePoints
from tests.alignment.surveys import FOCAL, HEIGHT, WIDTH, alignment, photo

SHOTS = [photo(f"DJI_{k}.JPG") for k in range(5)]
"""Photos 15 m apart at 60 m."""


def bare(name="Screenshot.png"):
    return replace(
        photo(name, position=None), time=None, focal=Focal(px=680, sigma_px=170, source="guess")
    )


def without(found, photos):
    told = {i for i, p in enumerate(photos) if p.position is not None}
    bare = {i for i, p in enumerate(photos) if p.focal.source == "guess"}
    return without_copied_views(found, [p.name for p in photos], told, bare)


def survey(place, *, shown=(0.0, 1.0), seed=0):
    """Five photos and a sixth picture at a place, which shows points between two shares of its
    height only.
    """
    rng = np.random.default_rng(seed)
    found = alignment(6)
    poses = {i: found.poses[i] for i in range(5)}
    poses[5] = Pose(cam_R_map=cam_R_map_from_angles(10.0), map_C=np.array(place))
    xyz = np.column_stack([rng.uniform(-50, 50, (1500, 1)), rng.uniform(-40, 100, (1500, 1))])
    xyz = np.column_stack([xyz, rng.uniform(0, 2, 1500)])
    rows = []
    for i, pose in poses.items():
        local = pose.to_camera(xyz)
        px = FOCAL * local[:, :2] / local[:, 2:] + np.array([WIDTH - 1, HEIGHT - 1]) / 2
        low, high = shown if i == 5 else (0.0, 1.0)
        seen = ((px > 0) & (px < [WIDTH - 1, HEIGHT - 1])).all(1) & (rng.random(len(px)) < 0.6)
        seen &= (px[:, 1] >= low * HEIGHT) & (px[:, 1] <= high * HEIGHT)
        rows += [(k, i, *px[k]) for k in np.flatnonzero(seen)]
    point, which, x, y = np.array(rows).T
    ties = TiePoints(
        xyz=xyz,
        point=point.astype(int),
        photo=which.astype(int),
        px=np.column_stack([x, y]),
        residual_px=np.zeros((len(rows), 2)),
    )
    return replace(found, poses=poses, ties=ties)


@pytest.mark.parametrize("seed", range(3))
def test_a_copy_and_a_screenshot_are_left_out(seed):
    for place, shown, words in (
        ((0.5, 15.5, 60.0), (0.0, 1.0), "DJI_1.JPG"),
        ((8.0, 25.0, 60.0), (0.2, 0.6), "screenshot"),
    ):
        left = without(survey(place, shown=shown, seed=seed), [*SHOTS, bare()])
        assert set(left.poses) == set(range(5)) and 5 not in left.ties.photo
        assert words in left.rejected[5]


@pytest.mark.parametrize("seed", range(3))
def test_a_photo_that_was_sent_without_its_metadata_stays(seed):
    found = survey((8.0, 25.0, 60.0), seed=seed)
    assert set(without(found, [*SHOTS, bare()]).poses) == set(range(6))


def test_photos_with_metadata_stay_wherever_they_were_taken():
    found = survey((0.0, 15.0, 60.0), shown=(0.2, 0.6))
    assert without(found, [*SHOTS, photo("hover.jpg")]) is found
    nowhere = [bare(f"{k}.jpg") for k in range(6)]
    assert without(found, nowhere) is found
