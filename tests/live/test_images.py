"""Web tiles kept by the server are forgotten where the map has changed, and only there."""

import numpy as np

from skyquilt.raster.map_source import MERCATOR, mercator
from skyquilt.server.images import _meet


def test_tiles_that_touch_a_box_are_found_as_rectangles_say():
    rng = np.random.default_rng(0)
    z = rng.integers(3, 6, 200)
    tiles = np.column_stack([z, rng.integers(0, 2**z), rng.integers(0, 2**z)]).astype(float)
    low = rng.uniform(-MERCATOR, MERCATOR, (4, 2))
    boxes = np.column_stack([low, low + rng.uniform(1e5, 4e6, (4, 2))])
    slow = []
    for tile in tiles.astype(int).tolist():
        west, south, east, north = mercator(*tile)
        slow.append(
            any(west < b[2] and east > b[0] and south < b[3] and north > b[1] for b in boxes)
        )
    found = _meet(tiles, boxes)
    assert found.tolist() == slow
    assert 0.01 < found.mean() < 0.9
