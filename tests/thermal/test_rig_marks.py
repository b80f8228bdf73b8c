"""A cross in every thermal frame is drawn only where no other frame shows the ground."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from skyquilt.imaging.view_limits import USUAL
from skyquilt.imaging.views import make_views
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Alignment, MapFrame, Pose, no_ties
from skyquilt.model.raster import Grid, Window
from skyquilt.ortho.blend import Feather
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.tie_surface import level
from skyquilt.thermal.rig_marks import drawn, marks_in

W, H, HIGH, FRAMES = 128, 96, 40.0, 12
CAMERA = Camera.ideal(width=W, height=H, focal=128.0)
PX = HIGH / CAMERA.focal
GRID = Grid(west=0.0, north=60.0, gsd=PX, width=320, height=190)
CROSS = 255


@pytest.fixture(scope="module")
def flown():
    """Ground (h, w), a pixel of which is one of the frames, and frames over it in three lines."""
    rng = np.random.default_rng(1)
    ground = gaussian_filter(rng.normal(0, 1, (190, 320)), 3)
    ground = np.clip(120 + 60 * ground / ground.std(), 1, 230).astype(np.uint8)
    poses, frames = {}, {}
    for k in range(FRAMES):
        row, column = 20 * (k // 4) + 20, 48 * (k % 4) + 5 + 7 * (k // 4)
        at = [(column + W / 2) * PX, 60.0 - (row + H / 2) * PX, HIGH]
        poses[k] = Pose(cam_R_map=np.diag([1.0, -1.0, -1.0]), map_C=np.array(at))
        frames[k] = ground[row : row + H, column : column + W].copy()
        frames[k][H // 2 - 1 : H // 2 + 1, W // 2 - 9 : W // 2 + 9] = CROSS
        frames[k][H // 2 - 9 : H // 2 + 9, W // 2 - 1 : W // 2 + 1] = CROSS
    alignment = Alignment(
        method="rig",
        why="",
        frame=MapFrame(crs="EPSG:32633", origin=(0.0, 0.0), vertical_datum="takeoff"),
        poses=poses,
        cameras={"thermal": CAMERA},
        camera_of=dict.fromkeys(poses, "thermal"),
        blocks=(tuple(poses),),
        ties=no_ties(),
    )
    return ground, alignment, frames


def test_crosses_are_found_and_drawn_from_other_frames(flown):
    truth, alignment, frames = flown
    photos = [SimpleNamespace(camera_key="thermal")] * FRAMES
    ground = SimpleNamespace(surface=level(0.0), grid=GRID)
    views = make_views(alignment, level(0.0), USUAL)
    marks, notes = marks_in(photos, views, frames, ground)
    assert set(marks) == set(range(FRAMES)) and len(notes) == 1
    compose = [
        Composer(
            grid=GRID,
            views=make_views(alignment, level(0.0), limits),
            surface=level(0.0),
            blend=Feather(width_px=0.0),
            pixels=lambda i: np.repeat(frames[i][..., None], 3, 2),
            bands=3,
            dtype=np.dtype(np.uint8),
        )
        for limits in (USUAL, replace(USUAL, blanks=marks))
    ]
    window = Window(row=0, column=0, height=GRID.height, width=GRID.width)
    before, seen = drawn(window, compose[0], None)
    after, shown = drawn(window, compose[1], compose[0])
    assert np.array_equal(seen, shown)
    crosses = [((p[..., 0] > 240) & seen).sum() for p in (before, after)]
    assert crosses[0] > 300 and crosses[1] == 0
    off = np.abs(after[..., 0].astype(int) - truth)[shown]
    assert np.percentile(off, 99) < 12


def test_frames_without_marks_have_none(flown):
    truth, alignment, frames = flown
    rows = [(20 * (k // 4) + 20, 48 * (k % 4) + 5 + 7 * (k // 4)) for k in range(FRAMES)]
    clean = {k: truth[r : r + H, c : c + W] for k, (r, c) in enumerate(rows)}
    views = make_views(alignment, level(0.0), USUAL)
    ground = SimpleNamespace(surface=level(0.0), grid=GRID)
    photos = [SimpleNamespace(camera_key="thermal")] * FRAMES
    assert marks_in(photos, views, clean, ground) == ({}, ())
    heat = {k: f.astype(np.float32) for k, f in frames.items()}
    assert marks_in(photos, views, heat, ground) == ({}, ())
