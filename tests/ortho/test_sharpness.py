"""Blurred photos and spots are found among photos of one ground, and drawn only where nothing else
shows it.
"""

import json
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.grey import DETAIL_CELLS, detail
from skyquilt.model.poses import Pose, TiePoints, no_ties
from skyquilt.ortho.sharpness import _places, find_blurred
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import preset, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Pictures, Route
from skyquilt.workflows.mosaic import mosaic
from tests.ortho.scenes import photograph, placed, view

ROWS, COLUMNS = DETAIL_CELLS


def flight(count, apart=9.0, across=12.0, *, ties=True, seed=0):
    """Photos of level ground from 40 m, in lines of ten, and a tie point every 1.5 m."""
    rng = np.random.default_rng(seed)
    places = [(apart * (k % 10), across * (k // 10)) for k in range(count)]
    poses = {
        k: Pose(
            cam_R_map=cam_R_map_from_angles(float(rng.normal(0, 5)), *rng.normal(0, 1, 2)),
            map_C=np.array([x, y, 40.0]),
        )
        for k, (x, y) in enumerate(places)
    }
    points = no_ties()
    if ties:
        x, y = np.meshgrid(np.arange(-30, 10 * apart + 30, 1.5),
                           np.arange(-30, across * (count // 10) + 30, 1.5))  # fmt: skip
        xyz = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
        points = TiePoints(xyz=xyz, point=points.point, photo=points.photo, px=points.px,
                           residual_px=points.residual_px)  # fmt: skip
    return placed(poses, points)


def seen(alignment, seed=1):
    """Detail of each photo: the ground's, which changes by 2 over 40 m, and noise of 0.4."""
    rng = np.random.default_rng(seed)
    out = []
    for pose in alignment.poses.values():
        v, u = np.mgrid[:ROWS, :COLUMNS]
        x = pose.map_C[0] + 45.7 * (u / COLUMNS - 0.5)
        y = pose.map_C[1] - 34.3 * (v / ROWS - 0.5)
        ground = np.sin(x / 12.0) + np.cos(y / 15.0)
        out.append(ground[..., None] + rng.normal(0, 0.4, (ROWS, COLUMNS, 3)))
    return out


def found(alignment, details, apart=None):
    names = [f"{k}.jpg" for k in range(len(details))]
    apart = set(alignment.poses) if apart is None else apart
    return find_blurred(alignment, lambda k: details[k].astype(np.float32), names, apart)


def test_sharp_photos_of_changing_ground_are_all_kept():
    for seed in range(5):
        alignment = flight(40, seed=seed)
        assert found(alignment, seen(alignment, seed + 10)) == ({}, ())


def test_blurred_photos_are_named_also_in_a_row():
    alignment = flight(40)
    details = seen(alignment)
    blurred = [3, 14, 15, 16, 31]
    for k in blurred:
        details[k] -= [1.4, 0.1, 1.0]  # along x only, as motion does
    marks, notes = found(alignment, details)
    assert sorted(marks) == blurred
    assert all((m.at(np.array([0.0, 200, 399]), np.array([0.0, 150, 299])) < 0).all()
               for m in marks.values())  # fmt: skip
    assert len(notes) == 1
    assert "5 photos are blurred" in notes[0]
    assert "3.jpg, 14.jpg, 15.jpg, 16.jpg, 31.jpg" in notes[0]


def test_photos_of_water_are_not_called_blurred():
    """Waves and glitter differ from photo to photo; there are no tie points on them."""
    alignment = flight(40, ties=False)
    details = seen(alignment)
    details[7] -= 2.0
    assert found(alignment, details) == ({}, ())


def test_level_ground_far_above_zero_is_looked_at_where_it_lies():
    """Photos that were laid on level ground by their metadata have no tie points."""
    alignment = flight(40, ties=False)
    up = {k: replace(p, map_C=p.map_C + [0, 0, 400.0]) for k, p in alignment.poses.items()}
    lifted = replace(alignment, poses=up, frame=replace(alignment.frame, takeoff_m=400.0))
    for low, high in zip(
        *(_places(a, range(40), (4, 5)) for a in (alignment, lifted)), strict=True
    ):
        np.testing.assert_allclose(high, low, atol=1e-6)


def test_a_spot_on_the_lens_is_found_and_only_there():
    alignment = flight(40)
    details = seen(alignment)
    for k in range(12, 40):  # the drop falls on the lens during the flight
        details[k][4:6, 7:9, 2] -= 2.0
    marks, notes = found(alignment, details)
    assert len(marks) == 40
    assert "at the same place of every picture, on 4 % of it" in notes[0]
    u, v = (np.arange(COLUMNS) + 0.5) / COLUMNS * 400, (np.arange(ROWS) + 0.5) / ROWS * 300
    spot = marks[20].at(*np.meshgrid(u, v)) < 0
    expected = np.zeros((ROWS, COLUMNS), bool)
    expected[4:6, 7:9] = True
    assert np.array_equal(spot, expected)


def test_photos_of_one_place_tell_of_the_lens_once():
    """Brackets: three exposures at each of eight places; what six of these lack is chance."""
    once = flight(8)
    poses = {k: once.poses[k // 3] for k in range(24)}
    thrice = replace(once, poses=poses, camera_of=dict.fromkeys(poses, once.camera_of[0]))
    details = seen(thrice)
    for k in range(18):
        details[k][4:6, 7:9, 2] -= 2.0
    marks, _ = found(thrice, details)
    assert len(marks) == 24
    assert found(thrice, details, apart=range(0, 24, 3)) == ({}, ())


@pytest.mark.slow
def test_two_thousand_photos_take_seconds():
    alignment = flight(2000)
    details = seen(alignment)
    details[777] -= 1.5
    begun = time.process_time()
    marks, _ = found(alignment, details)
    assert time.process_time() - begun < 12
    assert list(marks) == [777]


def test_detail_falls_with_blur_and_not_with_light():
    shot = view(0, 0.0, 0.0)
    sharp = np.clip(photograph(shot), 0, 255).astype(np.uint8)
    large = cv2.resize(sharp, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    usual = np.median(detail(large).reshape(-1, 3), 0)
    motion = cv2.blur(large, (9, 1))
    along = np.median(detail(motion).reshape(-1, 3), 0) - usual
    assert along[0] < -1.0
    assert along[0] < along[1] - 0.6
    dark = (large * 0.6).astype(np.uint8)
    assert np.abs(np.median(detail(dark).reshape(-1, 3), 0) - usual).max() < 0.15
    assert np.isnan(detail(large.astype(np.uint16))).all()


@pytest.mark.slow
def test_blurred_photos_of_a_flight_are_shown_only_where_no_other_is(tmp_path):
    base = preset("default")
    settings = replace(
        base,
        seed=77,
        lens=Lens().scaled(800, 600),
        route=Route(photos=24),
        pictures=Pictures(blurred=5, blurred_px=9.0),
        thermal=None,
    )
    list(simulate(settings, tmp_path / "flight"))
    truth = json.loads((tmp_path / "flight" / "truth" / "truth.json").read_text())
    blurred = [k for k, p in enumerate(truth["photos"]) if p["blurred"]]
    assert len(blurred) == 5
    mosaic(tmp_path / "flight" / "photos", tmp_path / "map", MosaicSettings(jobs=1))
    notes = json.loads((tmp_path / "map" / "metrics.json").read_text())["notes"]
    said = next(n for n in notes if "blurred against others" in n)
    assert "5 photos are blurred" in said
    assert all(truth["photos"][k]["name"] in said for k in blurred)
    with rasterio.open(tmp_path / "map" / "provenance.tif") as source:
        shown = source.read(1)
    with rasterio.open(tmp_path / "map" / "views.tif") as source:
        views = cv2.resize(source.read(1), shown.shape[::-1], interpolation=cv2.INTER_NEAREST)
    from_blurred = np.isin(shown, np.array(blurred) + 1)
    assert from_blurred[views >= 4].mean() < 0.01  # 0.21 of the photos
