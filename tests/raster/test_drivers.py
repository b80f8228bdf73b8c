"""Rasters that name other files or addresses are not read, whatever they are called."""

import os

import numpy as np
import pytest
import rasterio

from skyquilt.errors import SideFileError, UsageError
from skyquilt.raster.map_source import FileSource
from skyquilt.raster.read_map import open_map
from skyquilt.server.shown import base_map

PLACE = rasterio.Affine(1.0, 0.0, 500_000.0, 0.0, -1.0, 5_000_000.0)
VRT = """<VRTDataset rasterXSize="8" rasterYSize="8"><SRS>EPSG:32632</SRS>
<GeoTransform>500000, 1, 0, 5000000, 0, -1</GeoTransform><VRTRasterBand dataType="Byte" band="1">
<SimpleSource><SourceFilename relativeToVRT="0">{}</SourceFilename><SourceBand>1</SourceBand>
</SimpleSource></VRTRasterBand></VRTDataset>"""


def written(path, driver="GTiff"):
    about = {"width": 8, "height": 8, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", driver=driver, crs="EPSG:32632", transform=PLACE, **about) as to:
        to.write(np.full((1, 8, 8), 7, np.uint8))
    return path


@pytest.fixture
def lure(tmp_path):
    secret = written(tmp_path / "secret.tif")
    named = tmp_path / "map.tif"
    named.write_text(VRT.format(secret))
    with rasterio.open(named) as opened:  # GDAL itself would follow it
        assert opened.read(1)[0, 0] == 7
    return named


def test_a_map_is_read(tmp_path):
    path = written(tmp_path / "old.tif")
    assert open_map(path).crs and list(base_map(path)) == ["base"]
    assert FileSource(path=path).about().bands == 1


def test_a_file_that_names_others_is_not(lure):
    assert open_map(lure) is None
    with pytest.raises(SideFileError, match="cannot be read as a map"):
        FileSource(path=lure).about()
    with pytest.raises(UsageError, match="not a georeferenced map"):
        base_map(lure)


def test_a_name_that_is_no_text_gets_a_sentence(tmp_path):
    """GDAL takes names as UTF-8 only; `register` ended in a traceback."""
    try:
        path = written(tmp_path / "map.tif").rename(tmp_path / os.fsdecode(b"map \xff.tif"))
    except OSError:
        pytest.skip("this file system wants names to be text")
    assert open_map(path) is None
    with pytest.raises(SideFileError, match="no UTF-8 text; rename it"):
        FileSource(path=path).about()


@pytest.mark.parametrize("name", ["a.png", "a.img", "a.jp2"])
def test_other_formats_of_maps_stay(tmp_path, name):
    driver = {"a.png": "PNG", "a.img": "HFA", "a.jp2": "JP2OpenJPEG"}[name]
    try:
        path = written(tmp_path / name, driver)
    except rasterio.errors.RasterioIOError:
        pytest.skip(f"this GDAL does not write {driver}")
    assert open_map(path) is not None
