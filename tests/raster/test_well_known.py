"""Well-known binary and text against shapely's own writer, and what would crash GEOS."""

import struct

import pytest
from shapely import (
    GeometryCollection,
    LineString,
    MultiLineString,
    MultiPoint,
    MultiPolygon,
    Point,
    Polygon,
    force_2d,
    force_3d,
    set_srid,
    to_wkb,
    to_wkt,
)

from skyquilt.raster.well_known import of_wkb, of_wkt

HOLED = Polygon([(0, 0), (9, 0), (9, 9)], [[(4, 1), (5, 1), (5, 2)], [(6, 1), (7, 1), (7, 2)]])
SHAPES = (
    Point(1, 2),
    LineString([(0, 0), (1, 1), (2, 0)]),
    HOLED,
    MultiPoint([(0, 0), (1, 1)]),
    MultiLineString([[(0, 0), (1, 1)], [(2, 2), (3, 3), (4, 5)]]),
    MultiPolygon([HOLED, HOLED]),
    GeometryCollection([Point(1, 2), HOLED, GeometryCollection([MultiPolygon([HOLED])])]),
    Polygon(),
    GeometryCollection(),
)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.geom_type)
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("flavor", ["extended", "iso"])
def test_every_shape_comes_back_and_torn_ones_do_not(shape, order, flavor):
    for form in (shape, force_3d(shape, 7)):
        data = to_wkb(set_srid(form, 4326), byte_order=order, flavor=flavor,
                      include_srid=flavor == "extended")  # fmt: skip
        assert of_wkb(data).equals_exact(force_2d(shape), 0)
        with pytest.raises(ValueError, match="torn"):
            of_wkb(data[:-1])
        assert of_wkt(to_wkt(form)).equals_exact(force_2d(shape), 0)


def header(kind, count, order="<"):
    return struct.pack(f"{order}BII", order == "<", kind, count)


@pytest.mark.parametrize("kind", [4, 5, 6, 7, 1007, 3004, 0x80000007, 0xE0000006])
def test_shapes_nested_too_deeply_never_reach_geos(kind):
    one = header(kind, 1) if not kind & 0x20000000 else struct.pack("<BIII", 1, kind, 4326, 1)
    with pytest.raises(ValueError, match="nested"):
        of_wkb(one * 50_000)
    with pytest.raises(ValueError, match="nested"):
        of_wkb(header(7, 2) + to_wkb(Point(1, 2)) + one * 50_000)


def test_text_nested_too_deeply_never_reaches_geos():
    with pytest.raises(ValueError, match="nested"):
        of_wkt("GEOMETRYCOLLECTION(" * 50_000 + "POINT(1 1)" + ")" * 50_000)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (header(3, 0xFFFFFFFF), "more than"),
        (header(7, 0xFFFFFFFF), "more than"),
        (header(2, 0xFFFFFFFF), "torn"),
        (header(10, 1), "none of"),
        (header(4007, 1), "none of"),
        (b"", "torn"),
        (b"\1", "torn"),
    ],
)
def test_counts_and_kinds_that_are_not_meant(data, words):
    with pytest.raises(ValueError, match=words):
        of_wkb(data)
