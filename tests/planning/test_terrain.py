"""Heights as other programs write them; each file holds the same ground."""

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from shapely.geometry import box

from skyquilt.errors import SideFileError
from skyquilt.planning.terrain import read_terrain

ZONE = "EPSG:32633"
PLACE = Affine(2, 0, 500_000, 0, -2, 5_000_000)
H, W = 120, 140
Z = (300 + 0.5 * np.arange(W) + 20 * np.sin(np.arange(H) / 20)[:, None]).astype(np.float32)
AREA = box(500_060, 4_999_850, 500_200, 4_999_930)
LOCAL = 'LOCAL_CS["site",UNIT["metre",1],AXIS["E",EAST],AXIS["N",NORTH]]'


def write(path, values, place=PLACE, crs=ZONE, scale=1.0, offset=0.0, unit=None, **more):
    bands = values if values.ndim == 3 else values[None]
    about = {"driver": "GTiff", "dtype": bands.dtype, "crs": crs, "transform": place} | more
    about |= {"width": bands.shape[2], "height": bands.shape[1], "count": len(bands)}
    with rasterio.open(path, "w", **about) as raster:
        raster.write(bands)
        raster.scales, raster.offsets = (scale,) * len(bands), (offset,) * len(bands)
        if unit:
            raster.set_band_unit(1, unit)
    return path


def off(path):
    """Largest error in m over the area and 30 m around it."""
    terrain = read_terrain(path, ZONE, AREA, 30)
    row, column = np.mgrid[25:85, 20:115]
    x, y = PLACE @ (column + 0.5, row + 0.5)
    return float(np.abs(terrain.at(x, y) - Z[row, column]).max())


CASES = {
    "south": (Z[::-1], {"place": PLACE @ Affine(1, 0, 0, 0, -1, H)}),
    "east": (Z[:, ::-1], {"place": PLACE @ Affine(-1, 0, W, 0, 1, 0)}),
    "quarter": (np.rot90(Z), {"place": PLACE @ Affine(0, -1, W, 1, 0, 0)}),
    "decimetres": (np.rint(10 * Z).astype(np.int16), {"scale": 0.1}),
    "offset": (Z - 300, {"offset": 300.0}),
    "feet": (Z / 0.3048, {"unit": "ft"}),
    "survey feet": (Z / (1200 / 3937), {"unit": "US survey foot"}),
    "feet of the system": (Z / 0.3048, {"crs": "EPSG:32633+8228"}),
    "float64": (Z.astype(np.float64), {"nodata": -1.7e308}),
}


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_same_ground_in_every_way(tmp_path, name):
    """Scales, offsets and feet were passed over; mirrored rasters lay "elsewhere on Earth"."""
    values, how = CASES[name]
    bound = 1.3 if name == "quarter" else 0.06  # cells of the turned one are not those of the file
    path = write(tmp_path / "z.tif", np.ascontiguousarray(values), **how)
    assert off(path) < bound


def test_fillings_are_not_mixed_into_what_lies_beside(tmp_path):
    """-9999 that the file does not state, in a file in degrees, whose heights are interpolated."""
    values = np.repeat(np.repeat(Z, 2, 0), 2, 1)
    values[:20] = -9999
    lon, lat = 15.0, 45.153
    place = Affine(1.2e-5, 0, lon, 0, -0.9e-5, lat)
    path = write(tmp_path / "z.tif", values, place, "EPSG:4326")
    from pyproj import Transformer

    x, y = Transformer.from_crs(4326, ZONE, always_xy=True).transform(lon + 0.001, lat - 0.001)
    found = read_terrain(path, ZONE, box(x - 20, y - 20, x + 20, y + 20), 110).heights
    assert found.min() > Z.min() - 1 and found.max() < Z.max() + 1


@pytest.mark.parametrize(
    ("values", "how", "word"),
    [
        (np.full((3, H, W), 90, np.uint8), {}, "picture with colours"),
        (np.full((H, W), 90, np.uint8), {}, "grey levels"),
        (Z.astype(np.complex64), {}, "complex"),
        (Z, {"crs": LOCAL}, "local coordinate system"),
        (Z, {"crs": None}, "does not say its coordinate system"),
        (Z, {"crs": "EPSG:32634"}, "elsewhere on Earth"),
    ],
)
def test_what_holds_no_heights_is_refused(tmp_path, values, how, word):
    """A picture was taken for ground 0 to 255 m high; a local system ended in a traceback."""
    with pytest.raises(SideFileError, match=word):
        read_terrain(write(tmp_path / "z.tif", values, **how), ZONE, AREA, 30)
