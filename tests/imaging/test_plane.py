"""Photos on a plane, and the overview they build up."""

import numpy as np
import pytest

from skyquilt.imaging.plane import Overview, Patch, to_grid, view_patch
from skyquilt.imaging.views import make_views
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.ortho.tie_surface import level
from skyquilt.papers.pieces import map_H_cam_of
from tests.alignment.flights import CAMERA, CELL, fly, line
from tests.alignment.surveys import alignment

GSD = 0.4


@pytest.fixture(scope="module")
def flight():
    return fly(line(1, heading=0.0), yaw=35.0, tilt=2.0)


def grid_truth(flight, patch):
    """The ground's grey values at the patch's pixels, averaged over one."""
    h, w = patch.shown.shape
    column = ((patch.column + np.arange(w)) * GSD - flight.west) / CELL - 0.5
    row = (flight.north + (patch.row + np.arange(h)) * GSD) / CELL - 0.5
    smooth = flight.ground
    c, r = np.meshgrid(column.round().astype(int), row.round().astype(int))
    total = sum(
        smooth[np.clip(r + dr, 0, None), np.clip(c + dc, 0, None)]
        for dr in (-1, 0, 1)
        for dc in (-1, 0, 1)
    )
    return total / 9


def pose_of(flight):
    return Pose(cam_R_map=flight.R[0], map_C=flight.C[0])


def both(flight):
    cam_H_grid = np.linalg.inv(map_H_cam_of(pose_of(flight))) @ np.diag([GSD, -GSD, 1.0])
    told = alignment(1)
    told.poses[0], told.cameras["cam"] = pose_of(flight), CAMERA
    (view,) = make_views(told, level(0.0))
    picture = flight.grey(0, 400)
    return to_grid(picture, CAMERA, cam_H_grid), view_patch(picture, view, level(0.0), GSD)


def test_a_photo_lies_on_the_grid_where_its_ground_is(flight):
    for patch in both(flight):
        truth = grid_truth(flight, patch)
        inside = patch.shown
        assert np.corrcoef(patch.pixels[inside], truth[inside])[0, 1] > 0.97
        shifted = np.roll(truth, 2, axis=1)
        assert np.corrcoef(patch.pixels[inside], shifted[inside])[0, 1] < 0.96


def test_both_ways_to_the_grid_agree(flight):
    a, b = both(flight)
    r0, c0 = max(a.row, b.row), max(a.column, b.column)
    h = min(a.row + a.shown.shape[0], b.row + b.shown.shape[0]) - r0
    w = min(a.column + a.shown.shape[1], b.column + b.shown.shape[1]) - c0
    cut = [p.shown[r0 - p.row :, c0 - p.column :][:h, :w] for p in (a, b)]
    pix = [p.pixels[r0 - p.row :, c0 - p.column :][:h, :w] for p in (a, b)]
    assert (cut[0] == cut[1]).mean() > 0.99
    assert np.abs(pix[0] - pix[1])[cut[0] & cut[1]].mean() < 1.0


def test_the_centre_is_half_as_wide_as_the_photo(flight):
    a, _ = both(flight)
    assert (a.central & ~a.shown).sum() == 0
    assert a.central.sum() / a.shown.sum() == pytest.approx(0.25, abs=0.02)


def test_a_photo_of_the_horizon_is_no_patch():
    up = np.array([[1.0, 0, 0], [0, 0.2, 1], [0, 1, -0.2]])
    assert (
        to_grid(np.zeros((60, 80), np.uint8), Camera.ideal(width=80, height=60, focal=70), up)
        is None
    )


def patch(value, row=0, column=0, size=8, centre=(3, 5)):
    central = np.zeros((size, size), bool)
    central[centre[0] : centre[1], centre[0] : centre[1]] = True
    return Patch(
        row=row,
        column=column,
        pixels=np.full((size, size), value, np.float32),
        shown=np.ones((size, size), bool),
        central=central,
    )


def test_the_centre_is_laid_over_the_rest_only_where_nothing_is():
    overview = Overview()
    overview.merge(patch(1.0))
    overview.merge(patch(2.0, row=2, column=2))
    pixels, shown = overview.window(0, 0, 10, 10)
    assert shown[:8, :8].all() and shown[2:, 2:].all() and not shown[0, 8] and not shown[9, 0]
    assert (pixels[5:7, 5:7] == 2.0).all()  # the second one's centre
    assert (pixels[2:5, 2:5] == 1.0).all() and (
        pixels[8:, 2:] == 2.0
    ).all()  # its rim: only beyond the first one


def test_it_grows_in_every_direction_and_forgets_nothing():
    overview, rng = Overview(), np.random.default_rng(0)
    places = rng.integers(-300, 300, (30, 2))
    for k, (row, column) in enumerate(places):
        overview.merge(patch(float(k + 1), int(row), int(column)))
    for k, (row, column) in enumerate(places):
        pixels, shown = overview.window(int(row) + 3, int(column) + 3, 2, 2)
        later = [j for j in range(k + 1, 30) if np.abs(places[j] - places[k]).max() < 2]
        assert shown.all() and (later or (pixels == k + 1).all())


def test_beyond_what_is_there_windows_are_empty():
    overview = Overview()
    assert not overview.window(0, 0, 4, 4)[1].any()
    overview.merge(patch(1.0))
    assert not overview.window(100, 100, 4, 4)[1].any()
