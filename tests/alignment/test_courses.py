"""Headings by the direction of flight, of photos that report none and are linked with no other,
against those with which flights are simulated.
"""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from skyquilt.alignment import repair as repair_module
from skyquilt.alignment.aligners import by_pose, with_loose_photos
from skyquilt.alignment.motion import headings_by_course
from skyquilt.alignment.repair import Repaired
from skyquilt.geometry.frames import angle_difference_deg, cam_R_map_from_angles
from skyquilt.model.poses import Pose
from tests.alignment.surveys import photo, prior
from tests.alignment.test_oblique import block, hills, seeing_nothing
from tests.alignment.test_oblique import pose as at_place

START = datetime(2024, 5, 1)


def lines(turned_deg=0.0, *, fixed=False, noise_m=1.5, count=4, each=7, apart=30.0, seed=0):
    """Photos, places (n, 2) and headings (n,) of a camera turned against a drone that flies lines
    there and back at 8 m/s along 70 degrees, a photo each 2.5 s.
    """
    rng = np.random.default_rng(seed)
    along = np.array([np.sin(np.radians(70)), np.cos(np.radians(70))])
    xy, yaw, photos = [], [], []
    for k in range(count):
        for n in range(each):
            way = 20.0 * (n if k % 2 == 0 else each - 1 - n)
            xy.append(way * along + apart * k * np.array([along[1], -along[0]]))
            yaw.append(70.0 + turned_deg + (180.0 if k % 2 and not fixed else 0.0))
            time = START + timedelta(seconds=k * 30 + 2.5 * n)
            photos.append(replace(photo(f"{len(xy)}.jpg", key="A"), time=time))
    C = np.array(xy) + rng.normal(0, noise_m, (len(xy), 2))
    return photos, C, np.array(yaw)


def without(yaw, gone):
    told = yaw + np.random.default_rng(1).normal(0, 3, len(yaw))
    told[gone] = np.nan
    return told


@pytest.mark.parametrize("turned", [0.0, 90.0, -140.0])
@pytest.mark.parametrize("fixed", [False, True])
def test_headings_follow_the_lines_or_stay_as_those_of_the_others_do(turned, fixed):
    photos, C, yaw = lines(turned, fixed=fixed)
    gone = np.r_[0:4, 15:20]  # on a line there and on one back
    found = headings_by_course(photos, C, without(yaw, gone))
    assert np.isnan(np.delete(found, gone)).all()
    assert np.abs(angle_difference_deg(found[gone], yaw[gone])).max() < 12
    assert np.abs(np.median(angle_difference_deg(found[gone], yaw[gone]))) < 4


def test_one_line_tells_the_heading_along_it_and_not_that_of_the_way_back():
    photos, C, yaw = lines()
    gone = np.r_[5:28]
    found = headings_by_course(photos, C, without(yaw, gone))
    assert np.abs(found[5:7] - 70).max() < 12
    assert np.isnan(found[7:14]).all() and np.isnan(found[21:]).all()
    assert np.abs(found[14:21] - 70).max() < 12


def test_nothing_is_told_without_times_by_few_or_by_headings_all_over():
    photos, C, yaw = lines()
    gone = np.r_[0:4]
    timeless = [replace(p, time=None) for p in photos]
    assert np.isnan(headings_by_course(timeless, C, without(yaw, gone))).all()
    few = np.setdiff1d(np.arange(28), [8, 16, 17])
    assert np.isnan(headings_by_course(photos, C, without(yaw, few))).all()
    swaying = yaw + np.random.default_rng(2).uniform(-180, 180, len(yaw))
    assert np.isnan(headings_by_course(photos, C, without(swaying, gone))).all()
    other = [replace(p, camera_key="B") if i in gone else p for i, p in enumerate(photos)]
    assert np.isnan(headings_by_course(other, C, without(yaw, gone))).all()


def test_unlinked_photos_of_water_lie_along_the_line_of_flight():
    photos, C, yaw = lines(180.0, noise_m=0.0, count=2, each=10, apart=70.0)
    linked = [i for i in range(20) if i % 10 < 7]
    poses = [
        replace(at_place(x, y), cam_R_map=cam_R_map_from_angles(h))
        for (x, y), h in zip(C, yaw, strict=True)
    ]
    done = block([poses[i] for i in linked], hills(6000, wide=250.0))
    done = replace(
        done,
        frame=replace(done.frame, crs="EPSG:32630"),
        poses=dict(zip(linked, done.poses.values(), strict=True)),
        blocks=(tuple(linked),),
        cameras={"A": done.camera(0)},
        camera_of=dict.fromkeys(linked, "A"),
        ties=replace(done.ties, photo=np.array(linked)[done.ties.photo]),
    )
    # what is reported lies 3 m east of where the photos are
    priors = [prior((*(c + [3.0, 0.0]), 60.0), yaw=np.nan) for c in C]
    found = with_loose_photos(done, replace(seeing_nothing(photos, done, 90), priors=priors))
    assert sorted(found.poses) == list(range(20)) and not found.rejected
    for i in set(range(20)) - set(linked):
        pose: Pose = found.poses[i]
        np.testing.assert_allclose(pose.map_C, [*C[i], 60.0], atol=0.01)
        np.testing.assert_allclose(pose.cam_R_map, poses[i].cam_R_map, atol=0.05)
    (note,) = [n for n in found.notes if "placed by its position and the direction of fl" in n]
    assert note.startswith("6 photos (")  # not a note for each


@pytest.mark.parametrize("height_m", [60.0, None])
def test_photos_that_share_next_to_nothing_are_placed_along_the_line_of_flight(height_m):
    photos, C, yaw = lines(noise_m=0.0)
    done = block([at_place(x, y) for x, y in C], hills(300, wide=150.0))
    frame = replace(done.frame, crs="EPSG:32630", vertical_datum="sea_level")
    one = replace(
        done, frame=frame, poses={3: done.poses[3]}, blocks=((3,),), rejected={4: "no link"}
    )
    inputs = seeing_nothing(photos, one)
    inputs = replace(inputs, priors=[prior((x, y, 500.0), yaw=np.nan) for x, y in C])
    found = by_pose(height_m, repair=True).instead_of(one, inputs)
    if height_m is None:
        assert found.poses.keys() == {3} and "--height" in found.notes[-1]
        return
    assert found.method == "pose" and len(found.poses) == len(photos) and not found.rejected
    for i, pose in found.poses.items():
        np.testing.assert_allclose(pose.cam_R_map, cam_R_map_from_angles(yaw[i]), atol=0.05)
    assert "where it goes" in found.notes[-1]
    held = replace(one, poses=dict(list(done.poses.items())[:4]), blocks=((0, 1, 2, 3),))
    nothing = replace(one, poses={}, blocks=())  # they were taken from one place
    for other in (held, nothing):
        assert by_pose(height_m, repair=True).instead_of(other, inputs) is other


def test_headings_of_a_few_links_turn_no_other_photos():
    photos, C, yaw = lines(noise_m=0.0)
    bare = [prior((x, y, 60.0), yaw=np.nan) for x, y in C]
    wrong = replace(bare[0], yaw_deg=5.0, yaw_source="pixels")
    linked = Repaired(
        priors=(wrong, wrong, wrong, *bare[3:]), heights_m=np.full(len(C), 9.0), notes=()
    )
    few = repair_module._without_few(linked, bare)
    assert np.isnan([p.yaw_deg for p in few.priors]).all() and np.isnan(few.heights_m).all()
    found = repair_module._headed(few, photos)
    off = angle_difference_deg(np.array([p.yaw_deg for p in found.priors]), yaw)
    assert np.abs(off).max() < 1
    told = [replace(bare[0], yaw_deg=5.0), *bare[1:]]  # a reported heading is another thing
    assert repair_module._without_few(linked, told) is linked
