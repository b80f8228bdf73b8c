"""Any CRS in, the same CRS out, as GDAL reads it."""

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.crs import CRS

from skyquilt.raster import write_array

from .raster_cases import PLACE, spec_for

ARRAY = np.zeros((5, 7), np.uint8)
LAEA = "+proj=laea +lat_0=12.5 +lon_0=33.25 +datum=WGS84 +units=m"
LOCAL = pyproj.CRS("+proj=tmerc +lat_0=49 +lon_0=9.5 +k=0.99987 +x_0=1e5 +ellps=bessel").to_wkt()


@pytest.mark.parametrize(
    "code", [32615, 32733, 4326, 3857, 2154, 27700, 2263, 31370, 3413, 25832, 4258, 6668]
)
def test_epsg(tmp_path, code):
    write_array(tmp_path / "a.tif", ARRAY, spec_for(ARRAY, crs=f"EPSG:{code}"))
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.crs == CRS.from_epsg(code)
        assert (
            source.crs.linear_units == CRS.from_epsg(code).linear_units or source.crs.is_geographic
        )


@pytest.mark.parametrize(
    "crs", [LAEA, LOCAL, "EPSG:32615+5773", "EPSG:5555", "ESRI:102003", "EPSG:4979"]
)
def test_others(tmp_path, crs):
    write_array(tmp_path / "a.tif", ARRAY, spec_for(ARRAY, crs=crs))
    with rasterio.open(tmp_path / "a.tif") as source:
        ours = pyproj.CRS.from_wkt(source.crs.to_wkt())
    point = (33.0, 12.0) if crs == LAEA else (9.5, 50.0)
    wanted = pyproj.CRS.from_user_input(crs)
    ahead = pyproj.Transformer.from_crs(4326, wanted.to_2d(), always_xy=True).transform(*point)
    np.testing.assert_allclose(
        pyproj.Transformer.from_crs(4326, ours.to_2d(), always_xy=True).transform(*point),
        ahead,
        atol=1e-3,
    )
    assert ours.is_compound == wanted.is_compound


def test_without_crs(tmp_path):
    write_array(tmp_path / "a.tif", ARRAY, spec_for(ARRAY, crs=None))
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.crs is None
        assert tuple(source.transform)[:6] == PLACE


def test_rotated(tmp_path):
    place = rasterio.Affine(1.7, 1.0, 5.0, 1.0, -1.7, 6.0)
    write_array(tmp_path / "a.tif", ARRAY, spec_for(ARRAY, transform=place))
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.transform.almost_equals(place)
