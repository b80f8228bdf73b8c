"""Heights of known ground from tie points and from pictures."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.geometry.camera import undistort
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import footprint
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.model.raster import Grid
from skyquilt.model.surface import STRIP, WIDEST, Surface
from skyquilt.ortho.sweep import Sweep
from skyquilt.ortho.tie_surface import FromTiePoints, grid_spacing, level, without_outliers
from tests.texture import texture

BOUNDS = (-50.0, -40.0, 50.0, 40.0)


def points(z, *, seed=0, count=1500, noise=0.0, bounds=BOUNDS):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(bounds[:2], bounds[2:], (count, 2))
    return np.column_stack([xy, z(xy[:, 0], xy[:, 1]) + rng.normal(0, noise, count)])


def at(surface, margin=8.0):
    """Places well inside, and the surface's heights there."""
    x, y = np.meshgrid(
        np.linspace(BOUNDS[0] + margin, BOUNDS[2] - margin, 40),
        np.linspace(BOUNDS[1] + margin, BOUNDS[3] - margin, 40),
    )
    return x, y, surface.at(x, y)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_between_nodes_heights_are_bilinear(seed):
    rng = np.random.default_rng(seed)
    z = rng.normal(0, 10, (6, 9)).astype(np.float32)
    s = Surface(z=z, x0=100.0, y0=-50.0, cell=2.0, source="t")
    column, row = rng.integers(0, 8, 20), rng.integers(0, 5, 20)
    u, v = rng.random((2, 20))
    expected = (
        z[row, column] * (1 - u) * (1 - v)
        + z[row, column + 1] * u * (1 - v)
        + z[row + 1, column] * (1 - u) * v
        + z[row + 1, column + 1] * u * v
    )
    found = s.at(100 + 2 * (column + u), -50 + 2 * (row + v))
    assert found == pytest.approx(expected, abs=40 / 32)  # positions are rounded to 1/32 of a cell
    assert s.at(100 + 2.0 * column, -50 + 2.0 * row) == pytest.approx(z[row, column], abs=1e-5)


def test_beyond_the_rim_heights_go_on_level():
    s = Surface(z=np.array([[1, 2], [3, 4]], np.float32), x0=0.0, y0=0.0, cell=1.0, source="t")
    assert s.at(np.array([-9.0, 9.0, -9.0, 9.0]), np.array([-9.0, -9.0, 9.0, 9.0])).tolist() == [
        1,
        2,
        3,
        4,
    ]
    assert s.at(np.zeros((3, 4, 5)), np.zeros((3, 4, 5))).shape == (3, 4, 5)
    assert s.at(np.full(70000, 1.0), np.full(70000, 1.0))[-1] == 4.0


def test_level_ground():
    s = FromTiePoints()(points(lambda x, y: 0 * x + 37.5), BOUNDS)
    assert s.z == pytest.approx(37.5, abs=1e-4)
    assert level(3.0).at(np.array([1e6]), np.array([-1e6]))[0] == 3.0


def test_a_slope():
    s = FromTiePoints()(points(lambda x, y: 0.2 * x - 0.1 * y + 10), BOUNDS)
    x, y, z = at(s)
    error = z - (0.2 * x - 0.1 * y + 10)
    assert np.abs(error).max() < 0.25 and np.abs(np.median(error)) < 0.01


def test_noise_is_smoothed():
    s = FromTiePoints()(points(lambda x, y: 0 * x, noise=0.5, count=4000), BOUNDS)
    assert 0.02 < at(s)[2].std() < 0.5 / np.sqrt(5)


def test_wrong_points_are_dropped():
    truth = points(lambda x, y: 0.1 * x + 2 * np.sin(y / 15), noise=0.05, seed=1)
    rng = np.random.default_rng(2)
    bad = rng.choice(len(truth), 75, replace=False)
    spoilt = truth.copy()
    spoilt[bad, 2] += rng.choice([-1, 1], 75) * rng.uniform(4, 60, 75)
    kept = {tuple(p) for p in without_outliers(spoilt, 4.0)}
    assert not kept & {tuple(p) for p in spoilt[bad]}
    assert len(kept) > 0.93 * (len(truth) - 75)
    x, y, z = at(FromTiePoints()(spoilt, BOUNDS))
    assert np.abs(z - (0.1 * x + 2 * np.sin(y / 15))).max() < 0.6


def test_far_from_points_the_surface_goes_on_level_at_their_average():
    """A slope known in the middle only: the rim neither climbs on nor follows one point's noise."""
    inner = points(lambda x, y: 0.2 * x, bounds=(-15, -15, 15, 15), noise=0.3, count=600)
    s = FromTiePoints()(inner, BOUNDS)
    east, west = (float(s.at(np.array([x]), np.array([0.0]))[0]) for x in (48.0, -48.0))
    assert 1.0 < east < 3.6 and -3.6 < west < -1.0  # 0.2 * 15 = 3, not 9.6
    ring = s.at(np.full(60, 48.0), np.linspace(-30, 30, 60))
    assert np.abs(np.diff(ring)).max() < 0.3


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_points_are_level(count):
    s = FromTiePoints()(points(lambda x, y: 0 * x + 5, count=count), BOUNDS)
    assert s.source == "plane" and float(s.z[0, 0]) == (5.0 if count else 0.0)


def test_the_grid_covers_its_bounds_within_reason():
    s = FromTiePoints()(points(lambda x, y: 0 * x, count=300), BOUNDS)
    assert s.x0 == BOUNDS[0] and s.y0 == BOUNDS[1]
    assert (
        s.x0 + (s.z.shape[1] - 1) * s.cell >= BOUNDS[2]
        and s.y0 + (s.z.shape[0] - 1) * s.cell >= BOUNDS[3]
    )
    clumped = np.column_stack([np.random.default_rng(0).normal(0, 1e-3, (50, 2)), np.zeros(50)])
    assert 10000**2 / grid_spacing(clumped, (-5000, -5000, 5000, 5000)) ** 2 < 4.01e6


# plane sweep

SIZE, FOCAL, FLYING, BOX = (500, 400), 450.0, 50.0, 1.8
FINE = 0.04


def relief(x, y):
    """Level ground with a flat box of 12 m x 10 m in the middle."""
    return np.where((np.abs(x) < 6) & (np.abs(y) < 5), BOX, 0.0)


def render(view, ground):
    """The picture of the scene: every ray marched to where it meets ground or box (its walls are
    the ground's).
    """
    w, h = SIZE
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    d = (
        np.c_[undistort(view.camera, np.c_[u.ravel(), v.ravel()]), np.ones(w * h)]
        @ view.pose.cam_R_map
    )
    C = view.pose.map_C

    def meet(z):
        return C[:2] + d[:, :2] * ((z - C[2]) / d[:, 2])[:, None]

    top, bottom = meet(BOX), meet(0.0)
    xy = np.where((relief(*top.T) > 0)[:, None], top, bottom)
    n = ground.shape[0]
    column, row = (
        (xy[:, 0] / FINE + n / 2).astype(np.float32),
        (n / 2 - xy[:, 1] / FINE).astype(np.float32),
    )
    image = cv2.remap(
        ground,
        column.reshape(h, w),
        row.reshape(h, w),
        cv2.INTER_AREA,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.6), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
    camera = Camera.ideal(width=SIZE[0], height=SIZE[1], focal=FOCAL)
    ground = texture(2400, 2400, seed=21, roughness=1.1)
    views = []
    for k, (x, y) in enumerate([(-10.0, -2.0), (1.0, 3.0), (11.0, -1.0)]):
        pose = Pose(
            cam_R_map=cam_R_map_from_angles(40.0 * k, 1.0, -1.0), map_C=np.array([x, y, FLYING])
        )
        views.append(
            View(photo=k, camera=camera, pose=pose, footprint=footprint(camera, pose, level(0.0)))
        )
    return views, [render(v, ground) for v in views]


GRID = Grid(west=-24.0, north=20.0, gsd=0.1, width=480, height=400)


def shrunk(pictures):
    return lambda photo, longest: pictures[photo]


def test_a_sweep_finds_the_box(scene):
    views, pictures = scene
    found = Sweep()(level(0.0), views, GRID, shrunk(pictures))
    assert found.source == "tie points and sweep"
    x, y = np.meshgrid(np.linspace(-4, 4, 30), np.linspace(-3, 3, 30))
    roof = found.at(x, y)
    assert np.abs(np.median(roof) - BOX) < 0.15 and np.abs(roof - BOX).max() < 0.6
    x, y = np.meshgrid(np.linspace(-18, 18, 60), np.linspace(-14, 14, 60))
    open_ground = (np.abs(x) > 9) | (np.abs(y) > 8)
    error = found.at(x, y)[open_ground]
    assert abs(np.median(error)) < 0.1 and np.percentile(np.abs(error), 95) < 0.4


def test_where_pictures_do_not_agree_the_surface_stays(scene):
    views, _ = scene
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, SIZE[::-1]).astype(np.uint8) for _ in views]
    known = Surface(
        z=np.full((50, 50), 1.25, np.float32), x0=-25.0, y0=-25.0, cell=1.0, source="tie points"
    )
    found = Sweep()(known, views, GRID, shrunk(noise))
    assert found.z == pytest.approx(1.25, abs=0.02)
    blank = [np.full(SIZE[::-1], 90, np.uint8)] * 3
    assert Sweep()(known, views, GRID, shrunk(blank)).z == pytest.approx(1.25, abs=1e-4)


def test_what_is_higher_than_the_search_is_left_alone(scene):
    """At the end of the search no height is believed: the roof stays on the ground instead of
    halfway up.
    """
    views, pictures = scene
    found = Sweep(above=0.02)(level(0.0), views, GRID, shrunk(pictures))
    x, y = np.meshgrid(np.linspace(-4, 4, 30), np.linspace(-3, 3, 30))
    assert np.median(found.at(x, y)) < 0.35 * 0.02 * FLYING


def test_one_photo_sweeps_nothing(scene):
    views, pictures = scene
    known = level(0.0)
    assert Sweep()(known, views[:1], GRID, shrunk(pictures)) is known


def test_heights_on_a_raster_are_those_at_its_places():
    rng = np.random.default_rng(3)
    surface = Surface(
        z=rng.uniform(0, 1.39, (40, 50)).astype(np.float32), x0=3.0, y0=-7.0, cell=0.7, source="p"
    )
    x, y = np.arange(0, 45, 0.31), np.arange(-12, 30, 0.05)[::-1]
    assert len(y) > 3 * STRIP
    assert (surface.on(x, y) == surface.at(*np.meshgrid(x, y))).all()
    assert surface.stepped(x, y) is None
    assert surface.on(x, y[:0]).shape == (0, len(x))


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_at_steps_heights_are_those_of_one_side(seed):
    """Rough ground: the ends of every cell's diagonal may be a step. A place lies between the
    corners on its own side, and at a corner it has its height; no part depends on what is asked
    beside it.
    """
    rng = np.random.default_rng(seed)
    z = rng.choice(np.array([0, 0, 0, 12, 30], np.float32), (14, 17)) + rng.random(
        (14, 17), np.float32
    )
    s = Surface(z=z, x0=-4.0, y0=9.0, cell=1.5, source="t")
    x, y = -4 + 1.5 * np.arange(0.05, 16, 0.1), 9 + 1.5 * np.arange(0.05, 13, 0.1)[::-1]
    found = s.on(x, y)
    i, j = (np.floor((at - start) / 1.5).astype(int) for at, start in ((y, 9), (x, -4)))
    corners = np.stack([z[i + a][:, j + b] for a in (0, 1) for b in (0, 1)])
    low, high = corners.min(0), corners.max(0)
    step = high - low > 5 * 1.5
    side = (corners > (low + high) / 2) == (found > (low + high) / 2)
    least, most = np.where(side, corners, 99).min(0), np.where(side, corners, -99).max(0)
    assert ((found >= least - 1e-4) & (found <= most + 1e-4))[step].all()
    assert (found == s.at(*np.meshgrid(x, y)))[~step].all()
    assert np.abs(s.on(-4 + 1.5 * np.arange(17), 9 + 1.5 * np.arange(14)) - z).max() < 1e-5
    some = (slice(int(rng.integers(0, 60)), 100), slice(int(rng.integers(0, 80)), 120))
    assert s.on(x[some[1]], y[some[0]]) == pytest.approx(found[some], abs=1e-4)


@pytest.mark.parametrize("turn_deg", [0, 7, 18, 30, 45, 77])
def test_edges_run_straight_through_the_staircase_of_cells(turn_deg):
    """A wall of 10 m in any direction: the map's edge stays within half a cell's side of it, where
    the cells' own edges lie up to 0.7 away, and there is nothing between top and bottom.
    """
    a = np.radians(turn_deg)
    c = np.arange(60) - 29.7
    across = c * np.cos(a) + c[:, None] * np.sin(a)
    s = Surface(z=np.float32(10) * (across > 0), x0=-29.7, y0=-29.7, cell=1.0, source="t")
    x = y = np.linspace(-20, 20, 401)
    found = s.on(x, y)
    assert (np.minimum(np.abs(found), np.abs(found - 10)) < 1e-5).all()
    away = x * np.cos(a) + y[:, None] * np.sin(a)
    wrong = (found > 5) != (away > 0)
    nearest = s.z[np.rint(y + 29.7).astype(int)][:, np.rint(x + 29.7).astype(int)] > 5
    assert np.abs(away[wrong]).max() < 0.5 + 1e-6
    if 0 < turn_deg < 45:
        stairs = nearest != (away > 0)
        off = [np.abs(away[w]).max() for w in (wrong, stairs)]
        assert off[0] < 0.75 * off[1] and wrong.mean() < 0.7 * stairs.mean()


@pytest.mark.slow
@pytest.mark.parametrize("along", [0, 1])
def test_the_heights_of_a_long_corridor_stay_within_what_opencv_takes(along):
    """30 km of railway, points every half metre."""
    rng = np.random.default_rng(4)
    xyz = rng.uniform(0, 1, (60_000, 3)) * (30_000, 4, 0)
    xyz[:, 2] = xyz[:, 0] / 1000
    box = (0.0, 0.0, 30_000.0, 4.0)
    if along:
        xyz[:, :2], box = xyz[:, 1::-1], (0.0, 0.0, 4.0, 30_000.0)
    found = FromTiePoints()(xyz, box)
    assert max(found.z.shape) <= WIDEST + 1
    at = np.linspace(100, 29_900, 50)
    places = (at, np.full(50, 2.0))[:: 1 - 2 * along]
    assert found.at(*places) == pytest.approx(at / 1000, abs=0.05)
