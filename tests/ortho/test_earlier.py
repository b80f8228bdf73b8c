"""A map that photos are added to: areas, grids, and what is laid into what."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.model.raster import Grid, Window, meet
from skyquilt.model.surface import Surface
from skyquilt.ortho import companions, earlier
from skyquilt.ortho.earlier import ALIGNED, EarlierMap, Growth, with_new
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.orthomosaic import Drawing
from skyquilt.raster import Block

GRID = Grid(west=-40.0, north=60.0, gsd=0.05, width=4000, height=3000)
AREA = (100.0, -60.0, 190.0, 30.0)
"""In part beyond the earlier map, which ends at 160 and -90."""
boxes = st.tuples(
    st.floats(-100, 100), st.floats(-100, 100), st.floats(0.1, 40), st.floats(0.1, 40)
).map(lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3]))


def plane(x, y):
    return (0.1 * x - 0.2 * y + 3).astype(np.float32)


def surface(z=plane, west=-50.0, south=-100.0, rows=180, columns=230, cell=1.0):
    x, y = np.meshgrid(west + cell * np.arange(columns), south + cell * np.arange(rows))
    return Surface(z=z(x, y), x0=west, y0=south, cell=cell, source="multi-view matching")


def labels(grid, photo, factor=8):
    cells = grid.coarser(factor)
    shape = (cells.height, cells.width)
    number = np.full(shape, photo, np.int32) if np.ndim(photo) == 0 else photo
    no = np.zeros(shape, np.bool_)
    return Labels(cells=cells, factor=factor, photo=number, hidden=no, tall=no)


def growth(areas=(AREA,), **more):
    known = {"labels": labels(GRID, 7), "surface": surface(), "files": True} | more
    map_ = EarlierMap(
        alignment=None, grid=GRID, exposure=Exposure(gains={}, fields={}), shown=(), key="", **known
    )
    return Growth(earlier=map_, areas=areas, margin=10.0)


def wanted(west, south, east, north, gsd=0.05):
    size = (round((east - west) / gsd), round((north - south) / gsd))
    return Grid(west=west, north=north, gsd=gsd, width=size[0], height=size[1])


@given(st.lists(boxes, max_size=12))
@settings(max_examples=80, deadline=None)
def test_areas_are_apart_and_hold_all_boxes(given):
    found = earlier._joined(given)
    for k, a in enumerate(found):
        assert not any(meet(a, b) for b in found[:k])
    for box in given:
        assert any(
            a[0] <= box[0] and a[1] <= box[1] and a[2] >= box[2] and a[3] >= box[3] for a in found
        )


@given(boxes)
@settings(max_examples=80, deadline=None)
def test_a_map_grows_by_whole_tiles_and_holds_both(box):
    grid = growth().grown(wanted(*box))
    for mine, theirs in ((GRID.bounds, grid.bounds), (box, grid.bounds)):
        assert theirs[0] <= mine[0] + 1e-6 and theirs[1] <= mine[1] + 0.05
        assert theirs[2] >= mine[2] - 0.05 and theirs[3] >= mine[3] - 1e-6
    right, down = growth().shift(grid)
    assert right % ALIGNED == 0 and down % ALIGNED == 0 and right >= 0 and down >= 0
    assert grid.west + right * 0.05 == pytest.approx(GRID.west)
    assert grid.north - down * 0.05 == pytest.approx(GRID.north)


def test_a_map_that_holds_all_stays_as_it_is():
    assert growth().grown(wanted(0.0, 0.0, 50.0, 50.0)) == GRID


def test_heights_made_anew_are_laid_into_those_that_stay():
    grows = growth()
    grid = grows.grown(wanted(0.0, -80.0, 185.0, 50.0))

    def made(area, part):
        assert area == AREA and part.bounds[2] <= grid.bounds[2]
        return surface(lambda x, y: plane(x, y) + 5)

    found = grows.surface(grid, made)
    x, y = np.meshgrid(np.arange(-45, 178, 1.0), np.arange(-88, 58, 1.0))
    z = found.at(x, y) - plane(x, y)
    inner = (x > 105) & (x < 184) & (y > -55) & (y < 25)
    assert np.allclose(z[inner], 5, atol=1e-3)
    outside = (x < 99) | (y < -61) | (y > 31)
    assert np.allclose(z[outside], 0, atol=1e-3)
    assert (z > -1e-3).all() and (z < 5.001).all()
    west, south, east, north = grid.bounds
    last = found.x0 + (found.z.shape[1] - 1) * found.cell
    assert found.x0 <= west and last >= east - found.cell


def test_heights_that_are_found_again_change_nothing():
    grows = growth()
    again = grows.surface(GRID, lambda area, part: surface())
    assert np.abs(again.at(*np.meshgrid(np.arange(99.0), np.arange(9.0))) - 0).max() > 0
    assert np.allclose(again.z[: len(surface().z), : surface().z.shape[1]], surface().z, atol=1e-4)


def test_labels_made_anew_are_laid_into_those_that_stay():
    grows = growth()
    grid = grows.grown(wanted(-70.0, -80.0, 185.0, 50.0))
    found = grows.labels(grid, lambda area, part: labels(part, 3))
    x, y = found.cells.x(np.arange(found.cells.width)), found.cells.y(np.arange(found.cells.height))
    x, y = np.meshgrid(x, y)
    inside = (x > 105) & (x < 185) & (y > -55) & (y < 25)
    old = (x > -40) & (x < 160) & (y < 60) & (y > -90)
    assert (found.photo[inside] == 3).all()
    assert (found.photo[~inside & old] == 7).all()
    assert (found.photo[~inside & ~old] == -1).all()


def test_coarser_labels_are_laid_in_too():
    found = growth().labels(GRID, lambda area, part: labels(part, 3, 16))
    assert set(np.unique(found.photo)) == {3, 7}


def test_windows_away_from_what_changed_stay():
    grows = growth()
    grid = grows.grown(wanted(-70.0, -80.0, 185.0, 90.0))
    right, down = grows.shift(grid)
    assert (right, down) == (1024, 1024)
    there = Window(row=down + 512, column=right + 512, height=2048, width=1024)
    assert grows.stays(there, grid) == Window(row=512, column=512, height=2048, width=1024)
    # beyond the earlier map, and in the area
    assert grows.stays(Window(row=0, column=0, height=2048, width=2048), grid) is None
    at = right + int((120 + 40) / 0.05)
    changed = Window(row=down + 1024, column=at, height=512, width=512)
    assert grows.stays(changed, grid) is None
    gone = growth(files=False)
    assert gone.stays(there, grid) is None


def test_new_photos_get_the_level_of_those_that_stay():
    """Both found the same differences between photos, about another mean."""
    old = Exposure(
        gains={0: np.array([0.1, 0.0, 0.2], np.float32), 1: np.array([0.3, 0.1, 0.1], np.float32)},
        fields={0: np.zeros(6, np.float32), 1: np.zeros(6, np.float32)},
    )
    fresh = Exposure(
        gains={i: g - 0.25 for i, g in old.gains.items()}
        | {2: np.array([-0.15, 0.05, 0.05], np.float32)},
        fields={i: np.full(6, 0.1, np.float32) for i in range(3)},
    )
    found = with_new(old, fresh)
    assert found.gains[2] == pytest.approx([0.1, 0.3, 0.3])
    assert not found.fields[2].any()  # no photo of this map has one
    assert all(np.array_equal(found.gains[i], old.gains[i]) for i in (0, 1))
    frames = with_new(
        Exposure(gains={}, fields={}, offsets={0: 1.0, 1: -1.0}),
        Exposure(gains={}, fields={}, offsets={0: 1.5, 1: -0.5, 2: 0.75}),
    )
    assert frames.offsets == {0: 1.0, 1: -1.0, 2: 0.25}


def test_a_map_too_large_for_its_provenance_is_drawn_anew(monkeypatch):
    grows = growth()
    grid = grows.grown(wanted(-70.0, -80.0, 185.0, 90.0))
    drawing = SimpleNamespace(growth=grows, compose=SimpleNamespace(grid=grid))
    block = Block(row0=1536, col0=1536, height=2048, width=1024, tile=512)
    assert list(Drawing._staying(drawing, [block])) == [block]
    monkeypatch.setattr(companions, "MOST_NUMBERS", GRID.width * GRID.height / 16)
    assert Drawing._staying(drawing, [block]) == {}
