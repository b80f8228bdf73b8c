"""The map's grid covers what the photos show on the heights that were found last."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.blank import whole_picture
from skyquilt.model.poses import Pose, no_ties
from skyquilt.model.raster import Grid
from skyquilt.ortho.ground import ALIGNED, find_ground
from skyquilt.ortho.tie_surface import FromTiePoints, level
from skyquilt.settings import PictureSettings
from skyquilt.workflows.artefacts import REGISTRY
from tests.ortho.scenes import CAMERA, placed

HEIGHT_M = 40.0
XYZ = np.array([[x, y, 0.0] for x in (-20.0, 0.0, 20.0) for y in (-15.0, 15.0)])


@dataclass(frozen=True)
class Found:
    """Pictures by which all ground lies at one height in m."""

    z: float

    def __call__(self, surface, views, grid, grey, keep):
        return level(self.z)


@pytest.fixture
def alignment():
    """Two vertical photos, 20 m apart, whose tie points lie at height 0."""
    poses = {
        k: Pose(cam_R_map=cam_R_map_from_angles(0, 0, 0), map_C=np.array([x, 0.0, HEIGHT_M]))
        for k, x in enumerate((-10.0, 10.0))
    }
    return placed(poses, replace(no_ties(), xyz=XYZ))


@pytest.mark.parametrize("low_m", [-20.0, 0.0, 8.0])
def test_the_grid_covers_all_that_photos_show_on_the_heights_found(alignment, low_m, tmp_path):
    """The size of the ground that a vertical photo shows is its height above it, times the size of
    the picture over the focal length.
    """
    store = Store(folder=tmp_path, registry=REGISTRY)
    steps = find_ground(
        alignment,
        lambda photo, side: np.full((30, 40), 100, np.uint8),
        FromTiePoints(),
        Found(low_m),
        PictureSettings(),
        store,
    )
    ground = result_of(steps)
    west, south, east, north = ground.grid.bounds
    spare = 2 * ALIGNED * ground.grid.gsd
    for length, px, apart in (
        (east - west, CAMERA.width, 20.0),
        (north - south, CAMERA.height, 0.0),
    ):
        least = apart + px * (HEIGHT_M - low_m) / CAMERA.focal
        most = apart + px * (HEIGHT_M - min(low_m, 0.0)) / CAMERA.focal  # as tie points tell
        assert 0.99 * least < length < 1.04 * most + spare  # the lens widens it by up to 4 %
    shown = np.concatenate([v.footprint for v in ground.views])
    margin = ground.grid.gsd
    assert (shown.min(0) > [west - margin, south - margin]).all()
    assert (shown.max(0) < [east + margin, north + margin]).all()


def test_photos_that_yield_to_finer_ones_do_not_tell_the_pixel(alignment, tmp_path):
    """Of two photos at 40 m and four at 80 m that yield to these; without marks, four are more."""
    high = {
        k: replace(alignment.poses[k % 2], map_C=np.array([0.0, 5.0 * k, 2 * HEIGHT_M]))
        for k in range(2, 6)
    }
    alignment = placed({**alignment.poses, **high}, alignment.ties)
    coarse = dict.fromkeys(high, whole_picture((CAMERA.width, CAMERA.height)))
    for marks, height in ((coarse, HEIGHT_M), ({}, 2 * HEIGHT_M)):
        steps = find_ground(
            alignment,
            lambda photo, side: np.full((30, 40), 100, np.uint8),
            FromTiePoints(),
            None,
            PictureSettings(),
            Store(folder=tmp_path, registry=REGISTRY),
            marks=marks,
        )
        assert result_of(steps).native_gsd == pytest.approx(height / CAMERA.focal)


def test_a_grid_reaches_as_far_as_another_one_and_its_cells_stay():
    grid = Grid(west=10.0, north=50.0, gsd=0.5, width=40, height=60)
    wanted = Grid(west=7.0, north=51.0, gsd=0.25, width=100, height=200)
    wider = grid.reaching(wanted, 16)
    assert wider == Grid(west=2.0, north=58.0, gsd=0.5, width=60, height=114)
    assert grid.reaching(grid, 16) == grid
