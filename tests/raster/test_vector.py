"""GeoJSON out, read back by shapely and pyproj."""

import json

import numpy as np
import pyproj
import pytest
from shapely.geometry import shape

from skyquilt.errors import OutputError
from skyquilt.raster import vector

SQUARE = np.array(
    [[500_000, 4_000_000], [500_000, 4_000_100], [500_100, 4_000_100], [500_100, 4_000_000]], float
)


def test_polygons(tmp_path):
    hole = SQUARE * [1, 1] + (SQUARE[::-1] - SQUARE) * 0 + [10, 10] - (SQUARE - SQUARE[0]) * 0.5
    path = tmp_path / "a.geojson"
    vector.polygons(
        path,
        [([SQUARE, hole], {"name": "ü", "n": np.int64(3), "bad": np.nan, "a": np.ones(2)})],
        crs="EPSG:32615",
    )
    (feature,) = json.loads(path.read_text(encoding="utf-8"))["features"]
    assert feature["properties"] == {"name": "ü", "n": 3, "bad": None, "a": [1, 1]}
    polygon = shape(feature["geometry"])
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert not polygon.interiors[0].is_ccw
    back = pyproj.Transformer.from_crs(4326, 32615, always_xy=True).transform
    x, y = back(*np.array(polygon.exterior.coords).T)
    assert {(round(e, 3), round(n, 3)) for e, n in zip(x, y, strict=True)} == {
        tuple(p) for p in SQUARE
    }


def test_points_and_lines_keep_heights(tmp_path):
    place = [500_000.0, 4_000_000.0, 123.4567]
    vector.points(tmp_path / "p.geojson", [(place, {})], crs="EPSG:32615")
    vector.lines(tmp_path / "l.geojson", [([place, place], {})], crs="EPSG:32615")
    point = json.loads((tmp_path / "p.geojson").read_text())["features"][0]["geometry"]
    line = json.loads((tmp_path / "l.geojson").read_text())["features"][0]["geometry"]
    assert point["coordinates"] == [-93, pytest.approx(36.14, abs=0.01), 123.4567]
    assert line == {"type": "LineString", "coordinates": [point["coordinates"]] * 2}


def test_ungeoreferenced_says_so(tmp_path):
    vector.points(tmp_path / "p.geojson", [([3.5, 4], {"k": 1})], crs=None)
    content = json.loads((tmp_path / "p.geojson").read_text())
    assert "not georeferenced" in content["note"]
    assert "not georeferenced" in content["features"][0]["properties"]["note"]
    assert content["features"][0]["geometry"]["coordinates"] == [3.5, 4]


def test_nothing_half_written(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        vector.points(tmp_path / "p.geojson", [([np.nan, 4], {})], crs=None)
    with pytest.raises(OutputError, match="does not exist"):
        vector.points(tmp_path / "none" / "p.geojson", [], crs=None)
    assert list(tmp_path.iterdir()) == []
