"""Seams go around objects and through places where photos agree; hidden places are known."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.engine.kept import Keep
from skyquilt.engine.workers import Threads
from skyquilt.imaging.blank import around, marked, whole_picture
from skyquilt.imaging.nodes import densify, project_nodes
from skyquilt.imaging.view_limits import ViewLimits
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.bare_ground import bare_ground
from skyquilt.ortho.contours import contour_lines
from skyquilt.ortho.exposure import NEUTRAL
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.occlusion import Shadow
from skyquilt.ortho.seam_lines import SeamLines, _within, flooded
from tests.ortho.scenes import FLAT, block, photograph, view

GRID = Grid(west=-24.0, north=18.0, gsd=0.1, width=480, height=360)


def test_floods_meet_on_the_ridge():
    """From the left and right rim over a landscape: the labels part on its highest line, wherever
    that runs.
    """
    rng = np.random.default_rng(0)
    height = rng.integers(0, 100, (60, 80)).astype(np.uint8)
    ridge = np.rint(40 + 15 * np.sin(np.arange(60) / 9)).astype(int)
    height[np.arange(60), ridge] = 250
    height[np.arange(60), ridge + 1] = 250
    label = np.where(np.arange(80) < 40, 3, 7) * np.ones((60, 1), int)
    sure = np.zeros(label.shape, bool)
    sure[:, :2] = sure[:, -2:] = True
    out = flooded(label.astype(np.int32), sure, height)
    for row in range(60):
        assert (out[row, : ridge[row]] == 3).all() and (out[row, ridge[row] + 2 :] == 7).all()


def test_what_is_outside_stays_outside():
    label = np.full((30, 30), 5, np.int32)
    label[:, 20:] = -1
    sure = np.zeros(label.shape, bool)
    sure[3, 3] = True
    out = flooded(label, sure, np.full(label.shape, 30, np.uint8))
    assert np.array_equal(out, label)


@pytest.fixture(scope="module")
def scene():
    views = block()
    return views, {v.photo: np.clip(photograph(v), 0, 255).astype(np.uint8) for v in views}


def test_alike_photos_are_parted_in_the_middle(scene):
    """On level ground that all photos show alike, seams stay near the most vertical views."""
    views, pictures = scene
    labels = SeamLines()(views, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
    assert not labels.hidden.any() and not labels.tall.any()
    cells = labels.cells
    x, y = np.meshgrid(cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)))
    away = np.stack([np.hypot(x - v.pose.map_C[0], y - v.pose.map_C[1]) for v in views])
    index = {v.photo: k for k, v in enumerate(views)}
    shown = labels.photo >= 0
    mine = np.zeros(x.shape)
    for photo, k in index.items():
        mine = np.where(labels.photo == photo, away[k], mine)
    lost = (mine - away.min(0))[shown]
    assert (lost < 0.5).mean() > 0.6 and np.percentile(lost, 90) < 8.0


def test_marks_are_shown_only_where_no_other_photo_shows_the_ground(scene):
    """A cross in the middle of every photo, 60 px long; of a single photo it stays on the map."""
    views, pictures = scene
    shown = np.zeros((30, 40), bool)
    shown[12:18, 20] = shown[15, 17:24] = True  # cells of 10 px
    mark = marked(shown, 10.0)
    withs = [replace(v, limits=ViewLimits(mark=mark)) for v in views]

    def share(some):
        labels = SeamLines()(some, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
        cells, found = labels.cells, []
        x, y = np.meshgrid(cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)))
        for v in views:
            nodes = project_nodes(v, x, y, np.zeros_like(x))
            u, w = (np.clip(p, 0, 399).astype(int) // 10 for p in (nodes.u, nodes.v))
            on = nodes.seen & shown[np.clip(w, 0, 29), u]
            found.append((labels.photo == v.photo)[on].mean())
        return found

    before, after, one = share(views), share(withs), share(withs[:1])
    assert max(before) > 0.9 and one[0] == 1
    assert max(after) <= 0.02


def test_a_thin_cross_does_not_slip_between_the_middles_of_cells(scene):
    """Lines of 1 px in the middle of every photo, over cells of some 7 px: no cell shows them that
    another photo shows as well.
    """
    views, pictures = scene
    shown = np.zeros((300, 400), bool)
    shown[135:166, 200] = shown[150, 185:216] = True
    mark = around(shown, (400, 300))
    withs = [replace(v, limits=ViewLimits(mark=mark)) for v in views]
    labels = SeamLines()(withs, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
    row, column = np.mgrid[: GRID.height, : GRID.width]
    x, y = GRID.x(column), GRID.y(row)
    side = round(labels.cells.gsd / GRID.gsd)
    for v in views:
        nodes = project_nodes(v, x, y, np.zeros_like(x))
        u, w = (np.rint(np.clip(p, 0, size - 1)).astype(int) for p, size in
                ((nodes.u, 400), (nodes.v, 300)))  # fmt: skip
        on = nodes.seen & shown[w, u]
        assert on.any()
        assert not (labels.photo[row[on] // side, column[on] // side] == v.photo).any()


def test_tiles_continue_their_neighbours(scene, monkeypatch):
    """Tiles of 16 cells: the same photos show nearly everywhere, and always one where there is
    one.
    """
    views, pictures = scene
    whole = SeamLines()(views, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
    again = SeamLines()(views, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
    assert np.array_equal(whole.photo, again.photo)
    monkeypatch.setattr("skyquilt.ortho.seam_lines.TILE", 16)
    tiled = SeamLines()(views, FLAT, GRID, lambda photo, side: pictures[photo], NEUTRAL)
    assert np.array_equal(tiled.photo >= 0, whole.photo >= 0)
    assert (tiled.photo == whole.photo).mean() > 0.6


def test_what_stands_before_hides():
    """A wall of 10 m, photographed from 40 m up and 12 m aside, hides a strip behind it: seen along
    the ray over its top, by the intercept theorem.
    """
    cells = Grid(west=-30.0, north=30.0, gsd=0.25, width=240, height=240)
    z = np.zeros((240, 240), np.float32)
    x, y = np.meshgrid(cells.x(np.arange(240)), cells.y(np.arange(240)))
    wall = (x > 0) & (x < 1)
    z[wall] = 10
    shot = view(0, -12, 0, z=40)
    shadow = Shadow(shot, cells, z, z > 1)
    end = -12 + 13 * 40 / 30  # the wall's far upper edge on the ground
    rows = (np.abs(y) < 5) & (np.abs(x) < 9)
    hidden = shadow.hides(x, y, z)
    assert hidden[rows & (x > 1.5) & (x < end - 0.75)].all()
    assert not hidden[rows & ((x > end + 0.75) | (x < -0.5))].any()
    assert not hidden[rows & wall].any()


@pytest.mark.parametrize("written", [False, True])
def test_a_text_yields_to_what_stands_before_the_place_and_blur_does_not(written):
    """The strip behind a wall, seen by one photo through the wall and by the other, all of which is
    blurred or written over.
    """
    z = np.zeros((241, 241), np.float32)
    z[:, 121:125] = 10
    surface = Surface(z=z, x0=-30.0, y0=-30.0, cell=0.25, source="dense")
    mark = whole_picture((400, 300))
    mark = replace(mark, written=mark if written else None)
    clear, marked_one = view(0, -12, 0, surface=surface), view(1, 12, 0, surface=surface)
    views = [clear, replace(marked_one, limits=ViewLimits(mark=mark))]
    grey = np.full((300, 400), 120, np.uint8)
    labels = SeamLines()(views, surface, GRID, lambda photo, side: grey, NEUTRAL)
    x, y = labels.cells.x(np.arange(labels.cells.width)), labels.cells.y(np.arange(45))
    strip = np.ix_(np.abs(y) < 5, (x > 2) & (x < 4.5))
    assert (labels.photo[strip] == (0 if written else 1)).mean() > 0.9
    assert labels.hidden[strip].mean() == written
    open_ground = np.ix_(np.abs(y) < 5, (x > 7) & (x < 9))  # both see it
    assert (labels.photo[open_ground] == 0).all() and not labels.hidden[open_ground].any()
    alone = SeamLines()(views[1:], surface, GRID, lambda photo, side: grey, NEUTRAL)
    assert (alone.photo[strip] == 1).all() and not alone.hidden[strip].any()


def test_shares_of_all_photos_add_up_to_one():
    cells = Grid(west=0, north=0, gsd=0.8, width=20, height=12)
    rng = np.random.default_rng(2)
    none = np.zeros((12, 20), bool)
    photo = rng.integers(0, 3, (12, 20)).astype(np.int32)
    labels = Labels(cells=cells, factor=8, photo=photo, hidden=none, tall=none)
    for width in (0.0, 6.0, 30.0):
        window = Window(row=16, column=32, height=48, width=64)
        shares = np.stack([labels.share(k, window, width) for k in range(3)])
        assert shares.sum(0) == pytest.approx(1, abs=1e-5)
        near = labels.near(window, width)
        for k in range(3):
            where = shares[k].reshape(3, 16, 4, 16).max((1, 3)) > 0
            assert not (where & ~near[k][1:-1, 1:-1]).any()


def test_bare_ground_has_no_houses_and_keeps_the_slope():
    y, x = np.mgrid[:240, :240].astype(np.float32) * 0.5
    slope = 0.08 * x + 0.03 * y
    z = slope.copy()
    z[60:90, 60:100] += 7  # a house
    z[150:200, 20:110] += 12  # a wood
    rng = np.random.default_rng(1)
    z += rng.normal(0, 0.05, z.shape).astype(np.float32)
    found = bare_ground(z, np.ones(z.shape, bool), 0.5)
    assert (found <= z + 1e-4).all()
    assert np.percentile(np.abs(found - slope), 95) < 0.6
    assert np.abs(found - slope)[60:90, 60:100].max() < 1.0


def test_contours_of_a_cone_are_circles():
    y, x = np.mgrid[:101, :101]
    cone = (10 - 0.2 * np.hypot(x - 50, y - 50)).astype(np.float32)
    lines = list(contour_lines(cone, 2.0))
    assert {h for _, h in lines} >= {2.0, 4.0, 6.0, 8.0}
    for line, height in lines:
        if height >= 2:
            radius = np.hypot(*(line - 50).T)
            assert radius == pytest.approx((10 - height) / 0.2, abs=0.05)
            assert np.array_equal(line[0], line[-1])


def test_nothing_known_gives_no_contours():
    z = np.full((20, 20), np.nan, np.float32)
    z[0, 0] = 1.0
    assert list(contour_lines(z, 0.5)) == []


@pytest.mark.parametrize("tells", [True, False, None])
@pytest.mark.parametrize("number", [1, 3])
def test_seams_go_on_at_their_tile(scene, monkeypatch, tells, number):
    """Also where what is kept is not known beforehand, or is said to be and cannot be read."""
    views, pictures = scene
    monkeypatch.setattr("skyquilt.ortho.seam_lines.TILE", 16)
    kept, made = {}, []

    def keep(part, make):
        if part not in kept:
            made.append(part)
            kept[part] = make()
        return kept[part]

    grey = lambda photo, side: pictures[photo]  # noqa: E731
    has = {True: kept.__contains__, False: lambda part: True, None: None}[tells]
    keep = Keep(held=keep, has=has, workers=Threads(number))
    whole = SeamLines()(views, FLAT, GRID, grey, NEUTRAL)
    first = SeamLines()(views, FLAT, GRID, grey, NEUTRAL, keep)
    assert len(made) > 3
    for part in made[2:]:
        del kept[part]
    before = len(made)
    again = SeamLines()(views, FLAT, GRID, grey, NEUTRAL, keep)
    assert made[before:] == made[2:before]
    for labels in (first, again):
        assert (labels.photo == whole.photo).all() and (labels.hidden == whole.hidden).all()


@pytest.mark.parametrize("size", [(64, 90), (57, 33)])
def test_a_photo_is_compared_within_the_rectangle_that_it_shows(size):
    """Interpolated there alone, nodes give what they give over the whole part; nothing that is seen
    lies outside, nor the four cells beside it that the opening of shadows looks at.
    """
    h, w = size
    rng = np.random.default_rng(3)
    shape = (-(-h // 2) + 2, -(-w // 2) + 2)
    values = rng.normal(size=shape).astype(np.float32)
    whole = densify(values, h, w, 2)
    for _ in range(20):
        r0, c0 = (int(rng.integers(0, n - 3)) for n in shape)
        seen = np.zeros(shape, np.bool_)
        seen[r0 : r0 + int(rng.integers(1, 15)), c0 : c0 + int(rng.integers(1, 15))] = True
        at, near = _within(seen, h, w)
        part = densify(values[near], *whole[at].shape, 2)
        assert np.array_equal(part, whole[at])
        shown = densify(seen.astype(np.float32), h, w, 2) > 0.99
        rows, columns = np.nonzero(shown)
        if len(rows):
            assert at[0].start <= max(rows.min() - 4, 0) and at[0].stop >= min(rows.max() + 5, h)
            assert at[1].start <= max(columns.min() - 4, 0)
            assert at[1].stop >= min(columns.max() + 5, w)
