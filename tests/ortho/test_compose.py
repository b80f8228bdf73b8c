"""Composition of exact photos of known ground against the ground, and its rules against brute
force.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.geometry.camera import project, undistort
from skyquilt.imaging.nodes import STEP, cut, inside, node_places, project_nodes
from skyquilt.imaging.registration import shifts_between
from skyquilt.live.tile_drawing import Newest
from skyquilt.model.poses import Motion
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Average, Feather, First, Multiband
from skyquilt.ortho.compose import _remapped
from skyquilt.ortho.plan import STILL
from skyquilt.ortho.stepped import Closer, Part, lifted, stepped_heights
from tests.ortho.scenes import CAMERA, FLAT, GRID, block, composer, photograph, truth, view

WHOLE = Window(row=0, column=0, height=GRID.height, width=GRID.width)


@pytest.fixture(scope="module")
def scene():
    views = block()
    pictures = {
        v.photo: np.clip(np.rint(photograph(v)), 0, 255).astype(np.uint8)[..., None] for v in views
    }
    return views, pictures


def exact_pixels(views, grid=GRID):
    """u, v (photos, h, w) of every map pixel in every photo, each projected by itself, and what
    decides between photos.
    """
    x, y = np.meshgrid(grid.x(np.arange(grid.width)), grid.y(np.arange(grid.height)))
    xyz = np.stack([x, y, 0 * x], -1)
    px = np.stack(
        [
            project(v.camera, v.pose.to_camera(xyz.reshape(-1, 3))).reshape(*x.shape, 2)
            for v in views
        ]
    )
    C = np.array([v.pose.map_C for v in views])
    tangent2 = ((x - C[:, 0, None, None]) ** 2 + (y - C[:, 1, None, None]) ** 2) / C[
        :, 2, None, None
    ] ** 2
    seen = np.stack(
        [inside(v.camera, p[..., 0], p[..., 1]) for v, p in zip(views, px, strict=True)]
    )
    return px, np.where(seen, tangent2, np.inf), seen


@pytest.mark.parametrize("blend", [Feather(), First()], ids=lambda b: type(b).__name__)
def test_where_a_frame_has_no_value_another_is_shown(scene, blend):
    """Pixels and parts without a value in single frames were holes of the map, though other frames
    show the ground there.
    """
    (views, pictures), rng = scene, np.random.default_rng(8)
    frames = {k: picture.astype(np.float32) for k, picture in pictures.items()}
    for frame in frames.values():
        frame[rng.random(frame.shape) < 0.01] = np.nan
        y, x = rng.integers(20, 60, 2)
        frame[y : y + 20, x : x + 30] = np.nan
    made = composer(views, frames, GRID, blend, dtype=np.float32)(WHOLE)
    px, _, seen = exact_pixels(views)
    known = np.zeros(made.photo.shape, bool)
    for (u, v), frame, here in zip(px.transpose(0, 3, 1, 2), frames.values(), seen, strict=True):
        u, v = u.astype(np.float32), v.astype(np.float32)
        known |= here & np.isfinite(cv2.remap(frame, u, v, cv2.INTER_LINEAR))
    finite = np.isfinite(made.pixels[..., 0])
    assert (finite != known).mean() < 2e-3  # what lies on the rim of a frame or a hole
    error = made.pixels[..., 0] - truth(GRID)
    assert np.sqrt((error[finite] ** 2).mean()) < 4.0
    for k, shot in enumerate(views):  # the frame that is named has the value
        own = finite & (made.photo == shot.photo)
        u, v = px[k].transpose(2, 0, 1).astype(np.float32)
        off = abs(made.pixels[..., 0] - cv2.remap(frames[shot.photo], u, v, cv2.INTER_LINEAR))[own]
        assert np.isfinite(off).mean() > 0.99 and np.nanmedian(off) < 0.2


@pytest.mark.parametrize(
    "blend", [Feather(), First(), Average(), Multiband(levels=3)], ids=lambda b: type(b).__name__
)
def test_the_map_is_the_ground(scene, blend):
    views, pictures = scene
    made = composer(views, pictures, GRID, blend)(WHOLE)
    expected = truth(GRID)
    valid = made.photo >= 0
    error = made.pixels[..., 0].astype(float) - expected
    assert abs(error[valid].mean()) < 0.3 and np.sqrt((error[valid] ** 2).mean()) < 4.0
    a, b = [], []
    for row in range(0, 360 - 64, 48):
        for column in range(0, 480 - 64, 48):
            cut = np.s_[row : row + 64, column : column + 64]
            if valid[cut].all():
                a.append(expected[cut])
                b.append(made.pixels[cut][..., 0].astype(np.float32))
    shifts = [(s.dx, s.dy) for s in shifts_between(np.array(a), np.array(b)) if s.ok]
    assert len(shifts) > 0.9 * len(a) > 15
    assert np.hypot(*np.array(shifts).T).max() < 0.1
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.03


def test_a_shifted_camera_would_be_noticed(scene):
    """The tolerance above is worth something: half a photo pixel of principal point shows."""
    views, pictures = scene
    bent = [replace(v, camera=replace(v.camera, cx=v.camera.cx + 0.5)) for v in views]
    made = composer(bent, pictures, GRID, First())(WHOLE)
    cut = np.s_[150:214, 200:264]
    (shift,) = shifts_between(
        truth(GRID)[cut][None], made.pixels[cut][None, ..., 0].astype(np.float32)
    )
    assert np.hypot(shift.dx, shift.dy) > 0.3


def test_the_most_vertical_view_wins(scene):
    views, pictures = scene
    made = composer(views, pictures, GRID, Feather(width_px=0))(WHOLE)
    px, score, seen = exact_pixels(views)
    numbers = np.array([v.photo for v in views])
    expected = np.where(seen.any(0), numbers[score.argmin(0)], -1)
    differs = made.photo != expected
    # at seams nodes interpolate a parabola linearly: pixels that differ lie within a pixel of equal
    # scores or of a rim
    two = np.sort(score, axis=0)[:2]
    with np.errstate(invalid="ignore"):
        near_seam = two[1] - two[0] < 4e-3
    rims = [
        np.stack(
            [
                p[..., 0] - 2,
                p[..., 1] - 2,
                CAMERA.width - 3 - p[..., 0],
                CAMERA.height - 3 - p[..., 1],
            ]
        )
        for p in px
    ]
    edge = np.min([np.abs(rim).min(0) for rim in rims], axis=0) < 1.0
    assert differs.mean() < 0.01
    assert not (differs & ~near_seam & ~edge).any()


def test_the_first_photo_stays(scene):
    views, pictures = scene
    made = composer(views, pictures, GRID, First())(WHOLE)
    _, _, seen = exact_pixels(views)
    numbers = np.array([v.photo for v in views])
    expected = np.where(seen.any(0), numbers[seen.argmax(0)], -1)
    assert (made.photo != expected).mean() < 0.003


def test_the_average_is_the_mean_of_all_that_see(scene):
    views, _ = scene
    levels = {
        v.photo: np.full((CAMERA.height, CAMERA.width, 1), 20 + 31 * k, np.uint8)
        for k, v in enumerate(views)
    }
    made = composer(views, levels, GRID, Average())(WHOLE)
    _, _, seen = exact_pixels(views)
    mean = (seen * (20 + 31 * np.arange(6))[:, None, None]).sum(0) / np.maximum(seen.sum(0), 1)
    off = np.abs(made.pixels[..., 0] - mean) > 0.501
    assert off.mean() < 0.012  # rims move by a fraction of a pixel
    assert (made.photo >= 0).sum() == pytest.approx(seen.any(0).sum(), rel=2e-3)


def test_views_are_counted_at_the_cells_middles(scene):
    views, pictures = scene
    made = composer(views, pictures, GRID)(WHOLE)
    coarse = Grid(
        west=GRID.west,
        north=GRID.north,
        gsd=GRID.gsd * STEP,
        width=GRID.width // STEP,
        height=-(-GRID.height // STEP),
    )
    _, _, seen = exact_pixels(views, coarse)
    assert made.views.shape == (coarse.height, coarse.width)
    assert (made.views == seen.sum(0)).mean() > 0.995 and made.views.max() >= 4


@pytest.mark.parametrize(
    "blend", [Feather(), First(), Average(), Multiband(levels=3)], ids=lambda b: type(b).__name__
)
def test_pieces_fit_together(scene, blend):
    """Windows at multiples of the step, composed by themselves, equal the whole."""
    views, pictures = scene
    compose = composer(views, pictures, GRID, blend)
    whole = compose(WHOLE)
    for row in range(0, GRID.height, 128):
        for column in range(0, GRID.width, 160):
            h, w = min(128, GRID.height - row), min(160, GRID.width - column)
            part = compose(Window(row=row, column=column, height=h, width=w))
            cut = np.s_[row : row + h, column : column + w]
            # nodes in float32 differ in the last digit; multiband sees a finite margin
            assert np.abs(part.pixels.astype(int) - whole.pixels[cut].astype(int)).max() <= 1
            assert (part.photo != whole.photo[cut]).mean() < 1e-3
            k = np.s_[
                row // STEP : -(-(row + h) // STEP), column // STEP : -(-(column + w) // STEP)
            ]
            assert (part.views == whole.views[k]).all()


@pytest.mark.parametrize("blend", [Feather(), First(), Newest()], ids=lambda b: type(b).__name__)
def test_photos_that_others_hide_need_not_be_looked_at(scene, blend):
    """Each part of the map planned by itself, with as few photos as can show, is the part of the
    whole.
    """
    views, pictures = scene
    compose = composer(views, pictures, GRID, blend)
    planned = 0
    for row in range(0, GRID.height, 96):
        for column in range(0, GRID.width, 96):
            window = Window(row=row, column=column, height=96, width=96)
            plan, whole = compose.plan(window), compose.plan(window, counted=True)
            assert plan.shown == whole.shown
            assert len(plan.nodes) <= len(whole.nodes)
            planned += len(whole.nodes) - len(plan.nodes)
            made, expected = compose.drawn(plan), compose.drawn(whole)
            assert np.array_equal(made.pixels, expected.pixels) and np.array_equal(
                made.photo, expected.photo
            )
            assert set(np.unique(expected.photo)) - {-1} <= set(plan.shown)
    assert planned > 0  # some were spared


@pytest.mark.parametrize(
    "blend", [Feather(width_px=2.0), First(), Newest()], ids=lambda b: type(b).__name__
)
def test_what_changed_is_drawn_into_what_was_there(scene, blend):
    """Photos come, move and go, and the ground rises: only some cells are drawn, and nobody can
    tell.
    """
    views, pictures = scene
    away, moved = (
        views[2],
        replace(views[1], pose=replace(views[1].pose, map_C=views[1].pose.map_C + 0.7)),
    )
    shots = [
        [v for v in views if v is not away],
        views,
        [moved if v is views[1] else v for v in views],
        views[:-1],
    ]
    hill = replace(FLAT, z=np.array([[0, 0], [0, 3]], np.float32), cell=9.0)
    steps = [*((some, FLAT) for some in shots[:3]), *((some, hill) for some in (*shots[2:], []))]
    touched = [np.zeros(())] * len(steps)
    for column in (0, 256):
        window = Window(row=32, column=column, height=256, width=200)
        plan = made = None
        for step, (some, surface) in enumerate(steps):
            compose = composer(some, pictures, GRID, blend, surface=surface)
            new = compose.plan(window, earlier=plan)
            if plan is None or made is None:
                plan, made = new, compose.drawn(new)
                continue
            before, made = made, compose.redrawn(new, plan, made)
            expected = compose.drawn(new)
            assert np.array_equal(made.photo, expected.photo)
            if surface is FLAT:
                fresh = compose.drawn(compose.plan(window))
                assert np.array_equal(made.pixels, expected.pixels) and np.array_equal(
                    made.pixels, fresh.pixels
                )
            off = np.abs(made.pixels.astype(int) - expected.pixels)
            assert (
                off.max() <= 1 and (off > 0).mean() < 1e-3
            )  # ramps follow the height of the whole window
            plan = new
            touched[step] = touched[step] + (before.pixels != made.pixels).sum()
    assert all(t > 0 for t in touched[1:3]) and touched[4] > 0 and touched[5] > 0


def test_heights_that_shift_nothing_visibly_stay(scene):
    views, pictures = scene
    window = Window(row=32, column=0, height=256, width=256)
    flat = composer(views, pictures, GRID)
    plan = flat.plan(window)
    steepest = np.sqrt(
        max(n.score[m].max() for n, m in zip(plan.nodes, plan.near, strict=True) if m.any())
    )
    for rise, stays in (
        (0.9 * STILL * GRID.gsd / steepest, True),
        (4 * STILL * GRID.gsd / steepest, False),
    ):
        lifted = composer(
            views, pictures, GRID, surface=replace(FLAT, z=np.full((2, 2), rise, np.float32))
        )
        again = lifted.plan(window, earlier=plan)
        assert (again.z == plan.z).all() == stays
        kept = [
            again.projected[v.photo] is plan.projected[v.photo]
            for v in views
            if v.photo in plan.projected
        ]
        assert all(kept) if stays else not any(kept)
        if stays:
            assert np.array_equal(lifted.drawn(again).pixels, flat.drawn(plan).pixels)


def test_measured_values_are_resampled_and_nothing_else():
    """Float bands: a photo that shows a linear field of its own pixels gives exactly that field;
    gaps are NaN.
    """
    shot = view(5, 0, 0, yaw=30)
    u, v = np.meshgrid(np.arange(400, dtype=np.float32), np.arange(300, dtype=np.float32))
    picture = (0.25 * u - 0.5 * v - 273.0)[..., None]
    compose = composer([shot], {5: picture}, GRID, Feather(), dtype=np.float32)
    made = compose(WHOLE)
    px, _, seen = exact_pixels([shot])
    expected = 0.25 * px[0, ..., 0] - 0.5 * px[0, ..., 1] - 273.0
    valid = made.photo >= 0
    assert valid.sum() == pytest.approx(seen.sum(), rel=3e-3)
    assert np.isnan(made.pixels[~valid]).all() and np.isfinite(made.pixels[valid]).all()
    # remap rounds positions to 1/32 px, nodes interpolate the projection
    assert np.abs(made.pixels[valid][:, 0] - expected[valid]).max() < 0.06
    assert abs((made.pixels[valid][:, 0] - expected[valid]).mean()) < 2e-3


def test_values_far_beyond_bytes_survive_blending():
    shots = [view(0, -5, 0), view(1, 5, 0)]
    pictures = {
        0: np.full((300, 400, 1), 1e6, np.float32),
        1: np.full((300, 400, 1), -40.0, np.float32),
    }
    made = composer(shots, pictures, GRID, Feather(width_px=0), dtype=np.float32)(WHOLE)
    assert set(np.unique(made.pixels[np.isfinite(made.pixels)])) == {-40.0, 1e6}


def test_relief_is_taken_out():
    """A slope of 20 %: photos of it, projected point by point, meet the true places of its
    texture.
    """
    x = np.arange(0, 400.0, 1.0)
    slope = Surface(
        z=np.tile((0.2 * (x - 200)).astype(np.float32), (400, 1)),
        x0=-200.0,
        y0=-200.0,
        cell=1.0,
        source="t",
    )
    shot = view(0, 2, 1, z=45, yaw=75, pitch=3, surface=slope)
    u, v = np.meshgrid(np.arange(400, dtype=np.float32), np.arange(300, dtype=np.float32))
    pictures = {0: np.dstack([u, v])}
    made = composer([shot], pictures, GRID, Feather(), surface=slope, dtype=np.float32, bands=2)(
        WHOLE
    )
    rows, columns = np.nonzero(made.photo >= 0)
    pick = np.random.default_rng(0).choice(len(rows), 500, replace=False)
    x, y = GRID.x(columns[pick]), GRID.y(rows[pick])
    px = project(shot.camera, shot.pose.to_camera(np.c_[x, y, 0.2 * x]))
    assert np.abs(made.pixels[rows[pick], columns[pick]] - px).max() < 0.08


ROOF = (-4.4, -3.6, 5.2, 6.0)
"""West, south, east, north in m of a house of 6 m, its walls half-way between cells of 0.8 m."""
WALL = 250


def house():
    """Heights of the house's cells."""
    at = np.arange(-40, 40.1, 0.8)
    x, y = np.meshgrid(at, at)
    on = (x > ROOF[0]) & (x < ROOF[2]) & (y > ROOF[1]) & (y < ROOF[3])
    return Surface(z=on * np.float32(6), x0=-40.0, y0=-40.0, cell=0.8, source="t")


def of_the_house(x, y):
    return (x > ROOF[0]) & (x < ROOF[2]) & (y > ROOF[1]) & (y < ROOF[3])


def painted(x, y, roof):
    """Grey values of ground and roof."""
    return np.where(roof, 150 + 20 * np.sin(2 * x), 70 + 30 * np.sin(1.5 * x) * np.cos(1.3 * y))


def photographed(shot):
    """A picture of the house, from the rays of its pixels: walls are white."""
    h, w = shot.camera.height, shot.camera.width
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    d = np.c_[undistort(shot.camera, np.c_[u.ravel(), v.ravel()]), np.ones(h * w)]
    d = d @ shot.pose.cam_R_map
    C = shot.pose.map_C

    def at(z):
        return (C[:2] + d[:, :2] * ((z - C[2]) / d[:, 2])[:, None]).T

    value = painted(*at(0.0), np.zeros(h * w, bool))
    for z in np.arange(0, 6, 0.02):
        value[of_the_house(*at(z))] = WALL
    over = at(6.0)
    value = np.where(of_the_house(*over), painted(*over, np.ones(h * w, bool)), value)
    return value.reshape(h, w, 1).astype(np.float32)


@pytest.mark.slow
def test_a_house_has_no_walls_in_the_map():
    """A photo that sees two walls: the map shows the roof up to its edges, the ground from there
    on, and no strip of wall between.
    """
    surface = house()
    shot = view(0, 9, 8, z=45, yaw=0, pitch=2, roll=-1, surface=surface)
    pictures = {0: photographed(shot)}
    compose = replace(
        composer([shot], pictures, GRID, Feather(), surface=surface, dtype=np.float32),
        detailed=True,
    )
    made = compose(WHOLE)
    x, y = np.meshgrid(GRID.x(np.arange(GRID.width)), GRID.y(np.arange(GRID.height)))
    roof = of_the_house(x, y)
    hidden = np.zeros(x.shape, np.bool_)
    for z in np.arange(0.02, 6, 0.02):
        up = z / shot.pose.map_C[2]
        hidden |= of_the_house(
            *((1 - up) * p + up * c for p, c in zip((x, y), shot.pose.map_C[:2], strict=True))
        )
    aside = [
        np.minimum(np.abs(p - low), np.abs(p - high))
        for p, low, high in ((x, ROOF[0], ROOF[2]), (y, ROOF[1], ROOF[3]))
    ]
    # a photo's pixels, 0.13 m wide, mix both sides of an edge; the house's corners are cut off
    edge = (np.minimum(*aside) < 0.2) | (np.hypot(*aside) < 0.5)
    hidden = cv2.dilate(hidden.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    sees = (made.photo >= 0) & (roof | ~hidden) & ~edge
    error = np.abs(made.pixels[..., 0] - painted(x, y, roof))[sees]
    assert (sees & roof).sum() > 8000 and error.max() < 8
    sloping = replace(compose, detailed=False)(WHOLE)
    assert (made.pixels[..., 0] > 200)[sees].sum() == 0
    assert (sloping.pixels[..., 0] > 200)[sees].sum() > 50


@pytest.mark.parametrize("moving", [False, True])
def test_pixels_at_stepping_heights_lie_where_they_are_projected(moving):
    rng = np.random.default_rng(5)
    shot = view(0, 14, 9, z=45, yaw=30, pitch=12)
    if moving:
        motion = Motion(shift_m=np.array([0.3, -0.1, 0.0]), turn_rad=np.array([2e-3, 1e-3, 0]))
        shot = replace(shot, pose=replace(shot.pose, motion=motion))
    place = Window(row=32, column=64, height=256, width=200)
    rough = Surface(
        z=rng.uniform(-2, 12, (90, 90)).astype(np.float32), x0=-24.0, y0=-24.0, cell=0.5, source="t"
    )
    stepped = stepped_heights(GRID, rough, place, [shot])
    assert stepped is not None
    flat = project_nodes(shot, *node_places(GRID, rough, place))
    (nodes,) = lifted([(Part(nodes=flat, row=0, column=0, height=256, width=200), stepped)])
    found = nodes.pixels(256, 200, slice(0, 9), slice(0, 9))
    x, y = GRID.x(place.column + np.arange(200)), GRID.y(place.row + np.arange(256))
    exact = project_nodes(shot, *np.meshgrid(x, y), rough.on(x, y))
    off = np.hypot(found[0] - exact.u, found[1] - exact.v)[exact.seen]
    assert len(off) > 5000 and off.max() < 0.1


def test_parts_of_several_photos_are_each_projected_on_their_own_heights():
    rough = Surface(
        z=np.random.default_rng(6).uniform(-2, 12, (90, 90)).astype(np.float32),
        x0=-24.0,
        y0=-24.0,
        cell=0.5,
        source="t",
    )
    parts = []
    for k, shot in enumerate([view(0, 14, 9, yaw=30), view(4, -3, 2, pitch=12)] * 2):
        place = Window(row=32 * k, column=64, height=128, width=96)
        stepped = stepped_heights(GRID, rough, place, [shot])
        assert stepped is not None
        closer = Closer(**dict(zip("xyz", node_places(GRID, rough, place, 4), strict=True)), step=4)
        flat = project_nodes(shot, *node_places(GRID, rough, place))
        inner = cut(flat, 16, 32, 100, 60)
        own = Part(nodes=inner, row=16, column=32, height=100, width=60)
        parts += [(own, finer) for finer in (stepped, closer, None)]
    for (part, finer), n in zip(parts, lifted(parts), strict=True):
        if finer is None:
            assert n is part.nodes
            continue
        exact = project_nodes(part.nodes.view, *finer.places(part))
        u, v = (n.u, n.v) if n.levels is None else n.levels
        assert np.abs(u - exact.u).max() < 1e-3 and np.abs(v - exact.v).max() < 1e-3
        seen = exact.seen if n.levels is None else exact.seen.all(0) & part.nodes.seen
        assert np.array_equal(n.seen, seen)
        if n.levels is not None:
            assert np.array_equal(n.rise, finer.rise[:, 16:116, 32:92])


def test_nothing_to_see():
    far = view(0, 500, 500)
    made = composer([far], {0: np.zeros((300, 400, 1), np.uint8)}, GRID)(WHOLE)
    assert (made.photo == -1).all() and not made.pixels.any() and not made.views.any()


@pytest.mark.parametrize("bands", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("cut", [40, 400])
def test_a_fourth_band_on_the_way_changes_nothing(bands, dtype, cut):
    rng = np.random.default_rng(bands)
    image = rng.uniform(0, 255, (cut, cut, bands)).astype(dtype)
    u, v = rng.uniform(-3, cut + 3, (2, 48, 64)).astype(np.float32)
    plain = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(
        48, 64, bands
    )
    found = _remapped(image, u, v)
    assert found.dtype == dtype and (found == plain).all()
