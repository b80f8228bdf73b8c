"""Footprints, nodes and grids against rays and projections computed one by one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.geometry.camera import project
from skyquilt.imaging.nodes import (
    STEP,
    cut,
    densify,
    least_scores,
    node_places,
    project_all,
    project_nodes,
)
from skyquilt.imaging.views import footprint, grid_of, native_gsd
from skyquilt.model.camera import Camera
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from tests.ortho.scenes import CAMERA, FLAT, GRID, block, ground_of, view


def test_a_footprint_is_the_rim_on_the_ground():
    shot = view(0, 3, -2, yaw=35, pitch=6, roll=-4)
    corners = ground_of(shot, np.array([[0.0, 0], [399, 0], [399, 299], [0, 299]]))
    assert shot.footprint[::8] == pytest.approx(corners, abs=1e-6)
    assert len(shot.footprint) == 32


def test_a_footprint_climbs_a_slope():
    slope = Surface(
        z=np.tile(np.arange(-40, 41, dtype=np.float32) * 0.3, (81, 1)),
        x0=-40.0,
        y0=-40.0,
        cell=1.0,
        source="t",
    )
    shot = view(0, 0, 0, yaw=90, surface=slope)
    z = 0.3 * shot.footprint[:, 0]
    px = project(CAMERA, shot.pose.to_camera(np.c_[shot.footprint, z]))
    rim = np.min(
        [np.abs(px[:, 0]), np.abs(px[:, 0] - 399), np.abs(px[:, 1]), np.abs(px[:, 1] - 299)], axis=0
    )
    assert rim.max() < 0.6  # six rounds towards the slope


def test_a_photo_above_the_horizon_has_no_footprint():
    assert len(view(0, 0, 0, pitch=100).footprint) == 0


def test_nodes_are_exact_projections_and_in_between_nearly():
    shot = block()[2]
    window = Window(row=160, column=320, height=100, width=130)
    nodes = project_nodes(shot, *node_places(GRID, FLAT, window))
    assert nodes.u.shape == (-(-100 // STEP) + 2, -(-130 // STEP) + 2)
    x, y = np.meshgrid(GRID.x(np.arange(320, 450)), GRID.y(np.arange(160, 260)))
    exact = project(
        CAMERA, shot.pose.to_camera(np.stack([x, y, 0 * x], -1).reshape(-1, 3))
    ).reshape(100, 130, 2)
    dense = np.stack([densify(nodes.u, 100, 130), densify(nodes.v, 100, 130)], -1)
    assert np.abs(dense - exact).max() < 0.03
    # node 1 is the middle of the window's first cell
    middle = np.array([[GRID.x(320 + STEP / 2 - 0.5), GRID.y(160 + STEP / 2 - 0.5), 0.0]])
    assert (nodes.u[1, 1], nodes.v[1, 1]) == pytest.approx(
        project(CAMERA, shot.pose.to_camera(middle))[0], abs=1e-3
    )
    d = middle[0] - shot.pose.map_C
    assert nodes.score[1, 1] == pytest.approx((d[0] ** 2 + d[1] ** 2) / d[2] ** 2, rel=1e-5)
    assert nodes.height == pytest.approx(40.0)


def test_a_cut_is_the_nodes_of_the_sub_window():
    shot = block()[2]
    whole, own = (
        project_nodes(shot, *node_places(GRID, FLAT, window))
        for window in (
            Window(row=0, column=0, height=320, width=400),
            Window(row=96, column=160, height=90, width=100),
        )
    )
    part = cut(whole, 96, 160, 90, 100)
    assert part.u == pytest.approx(own.u, abs=1e-3) and part.seen.tolist() == own.seen.tolist()


@given(st.integers(0, 600), st.integers(0, 600), st.integers(20, 200), st.floats(-5, 30))
def test_no_node_has_a_smaller_score_than_the_least(row, column, size, rise):
    slope = Surface(
        z=np.linspace(0, rise, 41 * 41, dtype=np.float32).reshape(41, 41),
        x0=-80.0,
        y0=-80.0,
        cell=4.0,
        source="t",
    )
    shot = view(0, 3, -2, pitch=10)
    x, y, z = node_places(GRID, slope, Window(row=row, column=column, height=size, width=size))
    score = project_nodes(shot, x, y, z).score.min()
    least = least_scores([shot], x, y, z)[0]
    assert least <= score * (1 + 1e-5)
    if x[0, 0] < shot.pose.map_C[0] < x[0, -1] and y[-1, 0] < shot.pose.map_C[1] < y[0, 0]:
        assert least == 0.0


def test_folded_distortion_and_the_sky_show_nothing():
    """Beyond the fold a polynomial brings far ground back into the image; behind the camera there
    is no ground.
    """
    camera = Camera(width=400, height=300, focal=350.0, cx=199.5, cy=149.5, k1=-0.25)
    shot = view(0, 0, 0, camera=camera)
    x = np.linspace(0, 200, 400)[None]
    nodes = project_nodes(shot, x, 0 * x, 0 * x)
    far = x[0] > 40 * np.sqrt(0.95 / 0.75) + 0.3
    folded = project(camera, shot.pose.to_camera(np.stack([x[0], 0 * x[0], 0 * x[0]], -1)))
    inside = (folded > 2).all(1) & (folded[:, 0] < 397)
    assert (inside & far).any()  # it would
    assert not nodes.seen[0, far].any() and nodes.seen[0, :40].all()
    above = project_nodes(shot, x, 0 * x, 0 * x + 80)
    assert not above.seen.any() and not above.real.any()


def test_the_grid_covers_all_footprints_on_round_coordinates():
    views = block()
    grid = grid_of(views, 0.13)
    low, high = (
        np.min([v.footprint.min(0) for v in views], 0),
        np.max([v.footprint.max(0) for v in views], 0),
    )
    west, south, east, north = grid.bounds
    assert (
        west <= low[0] < west + 0.13
        and south <= low[1]
        and high[0] <= east < high[0] + 0.131
        and high[1] <= north
    )
    assert (grid.west / 0.13) % 1 == pytest.approx(0, abs=1e-9) or (
        grid.west / 0.13
    ) % 1 == pytest.approx(1, abs=1e-9)
    asked = grid_of(views, 0.5, (-3.2, -2.0, 7.7, 4.1))
    assert asked == Grid(west=-3.5, north=4.5, gsd=0.5, width=23, height=13)


def test_the_photos_own_resolution():
    views = block()
    assert native_gsd(views, FLAT) == pytest.approx(40 / 350.0)
    high = [view(k, 0, 0, z=80.0) for k in (2, 3)]
    assert native_gsd([*views[:2], *high], FLAT) == pytest.approx(40 / 350.0)  # of neither: 60


def test_boxes_that_meet():
    shot = view(0, 0, 0)
    low, high = shot.footprint.min(0), shot.footprint.max(0)
    assert shot.overlaps((high[0] - 0.1, -1, high[0] + 9, 1)) and not shot.overlaps(
        (high[0] + 0.1, -1, high[0] + 9, 1)
    )
    assert not shot.overlaps((-1, low[1] - 9, 1, low[1] - 0.1)) and shot.overlaps((-1, -1, 1, 1))
    assert len(footprint(CAMERA, shot.pose, FLAT, per_side=3)) == 12


def test_many_photos_are_projected_as_each_by_itself():
    folded = replace(CAMERA, k1=-0.3, k2=0.0)
    shots = [
        view(k, 9.0 * k - 20, 5 - 3.0 * k, z=30 + 4 * k, yaw=77 * k, pitch=8 * k) for k in range(5)
    ]
    shots = [
        *shots[:3],
        replace(shots[3], camera=folded),
        replace(shots[4], camera=replace(CAMERA, width=320)),
    ]
    hill = Surface(
        z=np.arange(400, dtype=np.float32).reshape(20, 20) / 40,
        x0=-30.0,
        y0=-30.0,
        cell=3.0,
        source="t",
    )
    places = node_places(GRID, hill, Window(row=0, column=0, height=360, width=480))
    for some in (shots, shots[1:2]):
        for shot, found in zip(some, project_all(some, *places), strict=True):
            alone = project_nodes(shot, *places)
            assert found.view is shot and found.height == alone.height
            for name in ("u", "v", "score", "seen", "real"):
                assert np.array_equal(getattr(found, name), getattr(alone, name))
    assert not found.real.all() or project_nodes(shots[3], *places).real.min() == 0
