"""What a map shows of each photo is known before it is drawn, so that a photo is decoded once."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.engine.pixel_cache import PhotoParts, PixelCache
from skyquilt.model.raster import Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.shown_parts import shown_parts
from tests.ortho.scenes import FLAT, GRID, block, composer, photograph

BLOCK = 128
"""Side in px of the blocks that are drawn."""
HILLS = Surface(
    z=(3 * np.sin(np.arange(50) / 6)[:, None] * np.cos(np.arange(50) / 5)).astype(np.float32),
    x0=-25.0,
    y0=-25.0,
    cell=1.0,
    source="tie points",
)


@pytest.fixture(scope="module")
def scene():
    views = block()
    pictures = {v.photo: np.clip(photograph(v), 0, 255).astype(np.uint8)[..., None] for v in views}
    return views, pictures


def nearest(views):
    """Every cell shows the photo whose camera is nearest."""
    cells = GRID.coarser(8)
    x, y = np.meshgrid(cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)))
    away = [np.hypot(x - v.pose.map_C[0], y - v.pose.map_C[1]) for v in views]
    photo = np.array([v.photo for v in views], np.int32)[np.argmin(away, 0)]
    none = np.zeros(photo.shape, bool)
    return Labels(cells=cells, factor=8, photo=photo, hidden=none, tall=none)


def corners():
    return [(r, c) for r in range(0, GRID.height, BLOCK) for c in range(0, GRID.width, BLOCK)]


def window(row, column):
    size = min(BLOCK, GRID.height - row), min(BLOCK, GRID.width - column)
    return Window(row=row, column=column, height=size[0], width=size[1])


@pytest.mark.parametrize("surface", [FLAT, HILLS])
def test_a_photo_is_decoded_once_and_the_map_is_that_of_whole_photos(scene, surface, monkeypatch):
    for module in ("compose", "shown_parts"):
        monkeypatch.setattr(f"skyquilt.ortho.{module}.PIECE", 64)
    monkeypatch.setattr("skyquilt.ortho.shown_parts.SHOWN_SAMPLE_PX", 8)
    views, pictures = scene
    labels = nearest(views)
    shown = shown_parts(labels, views, surface, BLOCK)
    whole = composer(views, pictures, GRID, surface=surface)
    whole = replace(whole, labels=labels, detailed=True)
    asked, decoded = [], []

    def read(photo):
        decoded.append(photo)
        return pictures[photo]

    parts = PhotoParts(read, shown, PixelCache(read=read, budget_bytes=10**9))

    def part(photo, rows, columns):
        asked.append((photo, rows, columns))
        return parts(photo, rows, columns)

    drawing = replace(whole, parts=part, pixels=None)
    for at in corners():
        asked.clear()
        one, other = drawing(window(*at)), whole(window(*at))
        assert np.array_equal(one.pixels, other.pixels) and np.array_equal(one.photo, other.photo)
        for photo, rows, columns in asked:
            own = shown[photo][at]
            for inner, outer in ((rows, own[0]), (columns, own[1])):
                assert outer.start <= inner.start and inner.stop <= outer.stop
        parts.done(at)
    assert sorted(decoded) == sorted(shown) and len(shown) > 3
    assert not parts._kept._kept
    area = [r.stop - r.start for v in shown.values() for r, _ in v.values()]
    assert np.median(area) < 0.7 * views[0].camera.height
