"""Photos, poses and lenses agree with each other, and with the project's conventions."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.errors import UsageError
from skyquilt.geometry.frames import belly_from_gimbal, cam_R_map_from_angles
from skyquilt.simulate.camera import Lens, camera_rotation, gimbal_angles
from skyquilt.simulate.expose import exposer
from skyquilt.simulate.flight import Shot, Waypoint
from skyquilt.simulate.grid import Grid
from skyquilt.simulate.raycast import first_hits, rays_of, sample
from skyquilt.simulate.scene import Country, Scene, SceneSettings, empty_scene
from skyquilt.simulate.settings import FlightSettings, Pictures
from skyquilt.simulate.weather import Weather

LENS = Lens(width=800, height=600, focal=667.0)
CLEAN = Pictures(exposure_noise=0, vignetting=0, noise=0)


def shot(x=2.0, y=-3.0, z=60.0, yaw=37.0, pitch=3.0, roll=-2.0) -> Shot:
    way = Waypoint(x=x, y=y, heading=yaw, line=0)
    return Shot(name="a", waypoint=way, centre=(x, y, z), yaw=yaw, pitch=pitch, roll=roll)


def opencv_pixels(points, where: Shot, lens: Lens):
    matrix = np.array([[lens.focal, 0, lens.cx], [0, lens.focal, lens.cy], [0, 0, 1]])
    bend = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    turn, _ = cv2.Rodrigues(where.rotation)
    pixels, _ = cv2.projectPoints(points, turn, -where.rotation @ where.place, matrix, bend)
    return pixels[:, 0]


def hills_with_discs():
    grid = Grid(left=-60.0, top=60.0, res=0.08, width=1500, height=1500)
    x, y = np.meshgrid(grid.xs, grid.ys)
    height = (3 * np.sin(x / 17) + 2 * np.cos(y / 13)).astype(np.float32)
    a, b = np.meshgrid(np.arange(-24, 25, 12.0) + 0.031, np.arange(-18, 19, 9.0) + 0.057)
    discs = np.stack([a.ravel(), b.ravel()], axis=1)
    bright = np.full(x.shape, 40.0)
    for dx, dy in discs:
        bright += 180 * np.clip((0.6 - np.hypot(x - dx, y - dy)) / grid.res + 0.5, 0, 1)
    rgb = np.repeat(bright.astype(np.uint8)[..., None], 3, axis=2)
    z = sample(height, grid.pixels(discs).astype(np.float32))
    return Scene(grid=grid, height=height, rgb=rgb, thermal=None), np.column_stack([discs, z])


@pytest.mark.slow
def test_discs_are_where_opencv_projects_them():
    scene, points = hills_with_discs()
    where = shot()
    photo = (
        exposer(scene, LENS)
        .visible(where, CLEAN, 1.0, np.random.default_rng(0))[..., 0]
        .astype(float)
    )
    expected = opencv_pixels(points, where, LENS)
    assert np.abs(LENS.project(points, where.rotation, where.place) - expected).max() < 1e-6
    errors = []
    for u, v in expected:
        c, r = round(u), round(v)
        if 14 < c < LENS.width - 15 and 14 < r < LENS.height - 15:
            weight = photo[r - 12 : r + 13, c - 12 : c + 13] - 40
            rows, cols = np.mgrid[-12:13, -12:13]
            errors.append(
                [
                    c + (weight * cols).sum() / weight.sum() - u,
                    r + (weight * rows).sum() / weight.sum() - v,
                ]
            )
    errors = np.array(errors)
    assert len(errors) >= 15
    assert np.abs(errors).max() < 0.1
    assert np.abs(errors.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("degrees", [84.0, 118.0, 149.0])
def test_a_fisheye_is_opencv_s_and_its_rays_are_the_inverse(degrees):
    lens = replace(LENS, fisheye=True, p1=0.0, p2=0.0).seeing(degrees)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2.5, 2.5, (200, 2)), np.ones(200)])
    matrix = np.array([[lens.focal, 0, lens.cx], [0, lens.focal, lens.cy], [0, 0, 1]])
    bend = np.array([lens.k1, lens.k2, lens.k3, 0.0])
    theirs = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, bend)[0][0]
    assert lens.project(points, np.eye(3), np.zeros(3)) == pytest.approx(theirs, abs=1e-9)
    rays = lens.rays()[::60, ::60].reshape(-1, 2).astype(float)
    back = lens.project(np.column_stack([rays, np.ones(len(rays))]), np.eye(3), np.zeros(3))
    y, x = np.mgrid[0 : lens.height : 60, 0 : lens.width : 60]
    assert back == pytest.approx(np.column_stack([x.ravel(), y.ravel()]), abs=0.01)


@pytest.mark.parametrize("fisheye", [False, True])
def test_the_field_of_view_is_that_of_the_diagonal(fisheye):
    lens = replace(LENS, fisheye=fisheye, k1=0.0, k2=0.0, p1=0.0, p2=0.0).seeing(100.0)
    corner = (np.array([lens.width, lens.height]) / 2) / lens.focal
    x, y = lens.undistort(*(corner[:, None]))
    assert 2 * np.degrees(np.arctan(np.hypot(x, y)))[0] == pytest.approx(100.0)
    wide, _ = lens.undistort(np.array([corner[0]]), np.zeros(1))
    assert lens.extent[0] == pytest.approx(2 * wide[0])
    with pytest.raises(UsageError, match="field of view"):
        lens.seeing(170.0)


def test_first_hits_equal_a_patient_march(tmp_path):
    country = Country(settings=SceneSettings(), bounds=(-45.0, -45.0, 45.0, 45.0), seed=3)
    scene = empty_scene(country.grid(0.1), thermal=False, scratch=tmp_path)
    scene.height[...] = country.paint(scene.grid, Weather()).height
    where = shot(x=0.0, y=0.0, z=50.0)
    lens = LENS.scaled(400, 300)
    corner = np.array([scene.grid.xs[0], scene.grid.ys[0]])
    rays = rays_of(lens.rays(), where.rotation, where.place, corner, scene.grid.res)
    _, heights = first_hits(scene.height, rays)
    picks = np.random.default_rng(1).integers([0, 0], [300, 400], (400, 2))
    levels = np.arange(
        float(scene.height.max()) + 0.1, float(scene.height.min()) - 0.1, -0.01, dtype=np.float32
    )
    wrong = 0
    for row, col in picks:
        line = rays.start[row, col] - levels[:, None] * rays.slope[row, col]
        first = int(np.argmax(sample(scene.height, line) >= levels))
        wrong += abs(levels[first] - heights[row, col]) > 0.05
    assert np.ptp(scene.height) > 8
    assert wrong <= 8


@pytest.mark.parametrize("angles", [(0, 0, 0), (37, 3, -2), (-160, -8, 5), (90, 30, 10)])
def test_rotation_and_gimbal_follow_the_conventions(angles):
    assert np.allclose(camera_rotation(*angles), cam_R_map_from_angles(*angles))
    belly = belly_from_gimbal(*gimbal_angles(*angles))
    assert np.allclose(camera_rotation(*belly), camera_rotation(*angles), atol=1e-9)


def test_signs_of_the_angles():
    def seen(point, yaw=0.0, pitch=0.0, roll=0.0):
        ideal = Lens(offset_x=0, offset_y=0, k1=0, k2=0, p1=0, p2=0)
        rotation = camera_rotation(yaw, pitch, roll)
        return ideal.project(np.array([point]), rotation, np.array([0.0, 0.0, 60.0]))[0] - [
            ideal.cx,
            ideal.cy,
        ]

    assert np.allclose(seen([0, 10.0, 0]), [0, -1333 / 6])  # north is up at yaw 0
    assert np.allclose(seen([10.0, 0, 0], yaw=90), [0, -1333 / 6])  # east is up at yaw 90
    assert seen([0, 0, 0], pitch=5)[1] > 0  # looking ahead, the nadir falls to the bottom
    assert seen([0, 0, 0], roll=5)[0] > 0  # right wing down, it looks left, the nadir moves right


def test_undistortion_and_turning_invert():
    x, y = np.meshgrid(np.linspace(-0.62, 0.62, 9), np.linspace(-0.46, 0.46, 7))
    back = LENS.distort(*LENS.undistort(x, y))
    assert max(np.abs(back[0] - x).max(), np.abs(back[1] - y).max()) < 1e-7
    point, where = np.array([[7.0, 4.0, 1.0]]), shot()
    u, v = LENS.project(point, where.rotation, where.place)[0]
    half = np.diag([-1.0, -1, 1])
    turned = LENS.turned().project(point, half @ where.rotation, where.place)[0]
    assert np.allclose(turned, [LENS.width - 1 - u, LENS.height - 1 - v])


def test_blocks_make_the_same_country():
    country = Country(settings=SceneSettings(), bounds=(-30.0, -30.0, 30.0, 30.0), seed=5)
    grid = country.grid(0.2)
    whole = country.paint(grid, Weather())
    part = country.paint(grid.window(100, 80, 90, 120), Weather())
    inner = grid.window(104, 84, 82, 112)  # smoothing sees a little less at the edge of a block
    a, b = whole.grid.inside(inner), part.grid.inside(inner)
    assert np.abs(whole.height[a] - part.height[b]).max() < 0.001
    assert np.mean(np.abs(whole.look[a] - part.look[b]).max(axis=-1) > 1) < 0.005


@pytest.mark.parametrize(
    ("k1", "folds"), [(-0.08, False), (-0.2, False), (-0.35, True), (-1.0, True), (0.1, False)]
)
def test_a_lens_that_folds_before_its_corners_is_refused(k1, folds):
    """r (1 + k1 r^2) rises up to r = (-3 k1)^-0.5, to two thirds of that; corners lie at 0.71."""
    lens = Lens(width=801, height=801, focal=800.0, k1=k1, k2=0, p1=0, p2=0, offset_x=0, offset_y=0)
    highest = 2 / 3 * (-3 * k1) ** -0.5 if k1 < 0 else np.inf
    assert lens.folds == folds == (highest < np.hypot(0.5, 0.5))
    settings = FlightSettings(lens=lens)
    if folds:
        with pytest.raises(UsageError, match="corners of photos without rays"):
            settings.checked()
    else:
        assert settings.checked() is settings
