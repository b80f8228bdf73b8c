"""Small rasters, and rasterio and rio-cogeo to look at what became of them."""

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy

from skyquilt.raster import RasterSpec

PLACE = (0.02, 0.0, 500_000.0, 0.0, -0.02, 4_500_000.0)


def spec_for(array, **options):
    array = array[..., None] if array.ndim == 2 else array
    height, width, bands = array.shape
    known = {"transform": PLACE, "crs": "EPSG:32615"} | options
    return RasterSpec(width=width, height=height, bands=bands, dtype=str(array.dtype), **known)


def picture(height, width, bands=3):
    y, x = np.ogrid[:height, :width]
    waves = [120 + 90 * np.sin(x / (17 + 9 * b)) * np.cos(y / (23 + 5 * b)) for b in range(bands)]
    return np.stack(waves, -1).astype(np.uint8)


def disc(height, width):
    y, x = np.ogrid[:height, :width]
    return ((y - height / 2) / height) ** 2 + ((x - width / 2) / width) ** 2 < 0.2


def assert_valid_cog(path):
    """By rio-cogeo. It takes a level that is exactly one tile wide, and higher than 512 px, for
    untiled, in files of GDAL's own COG driver too: there ours must be judged as GDAL's is.
    """
    cogeo = pytest.importorskip("rio_cogeo")
    with rasterio.open(path) as source:
        tile = source.block_shapes[0][1]
        one_wide = any(
            -(-source.width // k) == tile and -(-source.height // k) > 512
            for k in (1, *source.overviews(1))
        )
    expected = (True, [], [])
    if one_wide:
        copy(path, path.with_suffix(".gdal.tif"), driver="COG", blocksize=tile)
        expected = cogeo.cog_validate(path.with_suffix(".gdal.tif"), strict=True)
        assert all("not tiled" in error for error in expected[1])
    assert cogeo.cog_validate(path, strict=True) == expected


def read(path, level=None):
    options = {} if level is None else {"overview_level": level}
    with rasterio.open(path, **options) as source:
        return np.moveaxis(source.read(), 0, 2), source.dataset_mask() > 0


def psnr(a, b):
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2))
