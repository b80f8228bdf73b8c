"""Placing by metadata: `position` (Y 4.2: one scale, no rotation of one's own) and `pose` (Y 4.3,
4.4).
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.pose import ByPose, ByPosition
from skyquilt.errors import AlignmentError
from skyquilt.geometry.camera import project
from skyquilt.geometry.frames import angles_from_cam_R_map
from skyquilt.model.photo import GeoPosition
from skyquilt.model.poses import MapFrame
from tests.alignment.surveys import FOCAL, HEIGHT, WIDTH, photo, prior

FRAME = MapFrame(crs="EPSG:32630", origin=(0.0, 0.0), vertical_datum="takeoff")
PHOTOS = [photo(f"{i}.jpg") for i in range(5)]
TOLD = [
    prior((3.0 * i, 10.0 * i, 50.0 + 4 * i), yaw=30.0 * i, pitch=2.0, roll=-3.0) for i in range(5)
]


def ground_of(alignment, i, px):
    """Map coordinates on z = 0 of a pixel of a camera without distortion, by hand."""
    pose, camera = alignment.poses[i], alignment.camera(i)
    ray = (
        np.array([(px[0] - camera.cx) / camera.focal, (px[1] - camera.cy) / camera.focal, 1.0])
        @ pose.cam_R_map
    )
    return (pose.map_C - ray * pose.map_C[2] / ray[2])[:2]


def test_position_is_a_translation_at_one_scale():
    """Every photo is the same square of ground, north up, moved to its position."""
    found = ByPosition()(PHOTOS, FRAME, TOLD)
    metres_per_px = 58.0 / FOCAL  # the median height
    middle = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    for i in range(5):
        for px in ((0, 0), (WIDTH - 1, 0), (100, 500)):
            east, south = (np.array(px) - middle) * metres_per_px
            assert ground_of(found, i, px) - TOLD[i].map_C[:2] == pytest.approx(
                [east, -south], abs=1e-9
            )
    assert found.method == "position" and found.blocks == ((0,), (1,), (2,), (3,), (4,))


def test_position_takes_one_heading_for_all():
    found = ByPosition(heading_deg=90.0)(PHOTOS, FRAME, TOLD)
    for i in range(5):  # the image's top shows the east
        top = ground_of(found, i, ((WIDTH - 1) / 2, 0)) - TOLD[i].map_C[:2]
        assert top == pytest.approx([58.0 / FOCAL * (HEIGHT - 1) / 2, 0], abs=1e-9)


def test_pose_believes_angles_and_heights():
    found = ByPose()(PHOTOS, FRAME, TOLD)
    for i, pose in found.poses.items():
        assert angles_from_cam_R_map(pose.cam_R_map) == pytest.approx(
            (TOLD[i].yaw_deg, 2.0, -3.0), abs=1e-9
        )
        assert pose.map_C == pytest.approx(TOLD[i].map_C)
        # projecting the ground of a pixel gives the pixel
        xy = ground_of(found, i, (123.0, 456.0))
        assert project(found.camera(i), pose.to_camera(np.array([*xy, 0.0]))[None])[
            0
        ] == pytest.approx([123, 456])


def test_what_cannot_be_placed_says_why():
    told = [
        *TOLD[:2],
        prior((np.nan, np.nan, 50)),
        prior((1, 2, 60), yaw=np.nan),
        prior((1, 2, -5), yaw=3),
    ]
    found = ByPose()(PHOTOS, FRAME, told)
    assert sorted(found.poses) == [0, 1]
    assert {i: r.split(" would")[0] for i, r in found.rejected.items()} == {
        2: "it has no position",
        3: "it has a position but no heading",
        4: "its height above ground",
    }
    assert sorted(ByPosition()(PHOTOS, FRAME, told).poses) == [0, 1, 3, 4]  # needs no heading


def test_heights_that_do_not_tell_the_ground():
    sea = MapFrame(crs="EPSG:32630", origin=(0.0, 0.0), vertical_datum="sea_level")
    with pytest.raises(AlignmentError, match="--height"):
        ByPose()(PHOTOS, sea, TOLD)
    found = ByPose(height_m=40.0)(PHOTOS, sea, TOLD)
    assert [p.map_C[2] for p in found.poses.values()] == [50.0, 54.0, 58.0, 62.0, 66.0]
    assert found.ground_m == 18.0 and found.frame.vertical_datum == "sea_level"


def test_heights_above_take_off_tell_where_the_ground_lies_in_another_datum():
    """A receiver states ellipsoidal heights, the barometer beside it heights above take-off."""
    place = {"latitude_deg": 50.8, "longitude_deg": -0.1}
    above = [50.0, 54.5, 58.0, 61.5, 66.0]
    photos = [
        photo(
            f"{i}.jpg",
            position=GeoPosition(
                **place, altitude_m=t.map_C[2] + 430, datum="ellipsoid", takeoff_m=h
            ),
        )
        for i, (t, h) in enumerate(zip(TOLD, above, strict=True))
    ]
    told = [replace(t, map_C=t.map_C + [0, 0, 430]) for t in TOLD]
    frame = replace(FRAME, vertical_datum="ellipsoid")
    found = ByPose()(photos, frame, told)
    assert found.ground_m == pytest.approx(430) and found.frame.vertical_datum == "ellipsoid"
    assert [p.map_C[2] - 430 for p in found.poses.values()] == pytest.approx(above)
    # heights by the scale of pictures, where nothing else is told: what they count from is not
    found = ByPose()(
        PHOTOS, frame, [prior((3.0 * i, 0, np.nan)) for i in range(5)], np.array(above)
    )
    assert found.ground_m == 0 and found.frame.vertical_datum == "unknown"


def test_no_position_at_all():
    with pytest.raises(AlignmentError, match="none of 5 can be placed .it has no position"):
        ByPose()(PHOTOS, FRAME, [prior((np.nan,) * 3)] * 5)
    alone = ByPose()(
        PHOTOS[:1],
        MapFrame(crs=None, origin=(0, 0), vertical_datum="unknown"),
        [prior((np.nan,) * 3)],
    )
    assert list(alone.poses) == [0] and not alone.frame.metric
