"""Tiles of a raster taken from the file that it replaces."""

import numpy as np
import pytest
import rasterio

from skyquilt.errors import OutputError
from skyquilt.raster import CogWriter, write_array
from skyquilt.raster.former import FormerRaster
from tests.raster.raster_cases import assert_valid_cog, disc, picture, spec_for

KINDS = {
    "jpeg": ({"compress": "jpeg", "mask": True}, np.uint8),
    "zstd": ({"compress": "zstd", "mask": True}, np.uint8),
    "values": ({"compress": "zstd", "nodata": float("nan")}, np.float32),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_raster_that_grows_keeps_its_tiles_bit_for_bit(tmp_path, kind):
    options, dtype = KINDS[kind]
    old = picture(1500, 1300).astype(dtype)
    valid = disc(1500, 1300)
    if dtype == np.float32:
        old[~valid] = np.nan
    write_array(tmp_path / "a.tif", old, spec_for(old, **options), valid)
    new = np.zeros((2560, 2000, 3), dtype)
    spec = spec_for(new, **options)
    with FormerRaster(tmp_path / "a.tif") as former, CogWriter(tmp_path / "b.tif", spec) as writer:
        for block in writer.blocks():
            h, w = block.height, block.width
            pixels, shown = np.full((h, w, 3), 77).astype(dtype), np.ones((h, w), bool)
            tiles = {}
            for row, column, rows, columns in block.tiles():
                inside = 1 <= row < 3 and 1 <= column < 3  # where two by two of the old ones go
                if inside and (found := former.tile(row - 1, column - 1, spec)) is not None:
                    tiles[row, column] = found
                    at = (row * 512 - 512, column * 512 - 512, 512, 512)
                    pixels[rows, columns], shown[rows, columns] = former.pixels(*at)
            writer.write_block(block, pixels, shown, tiles)
    assert_valid_cog(tmp_path / "b.tif")
    with rasterio.open(tmp_path / "a.tif") as a, rasterio.open(tmp_path / "b.tif") as b:
        before = a.read()[:, :1024, :1024]
        now = b.read()
        assert np.array_equal(now[:, 512:1536, 512:1536], before, equal_nan=dtype == np.float32)
        masks = (f.dataset_mask() > 0 for f in (a, b))
        before, now = next(masks)[:1024, :1024], next(masks)[512:1536, 512:1536]
        assert np.array_equal(now, before) and not before.all() and before.any()
        small = b.read(1, out_shape=(640, 500))  # the overviews show them, too
        assert np.isfinite(small[130:380, 130:380]).any()


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_are_those_that_rasterio_reads(tmp_path, kind):
    options, dtype = KINDS[kind]
    array, valid = picture(1500, 1300).astype(dtype), disc(1500, 1300)
    if dtype == np.float32:
        array[~valid] = np.nan
    write_array(tmp_path / "a.tif", array, spec_for(array, **options), valid)
    with FormerRaster(tmp_path / "a.tif") as former, rasterio.open(tmp_path / "a.tif") as file:
        pixels, shown = former.pixels(512, 512, 900, 788)
        theirs = np.moveaxis(file.read(), 0, 2)[512:1412, 512:1300]
        seen = file.dataset_mask()[512:1412, 512:1300] > 0
    assert np.array_equal(shown, seen) and 0.2 < seen.mean() < 1
    off = np.abs(pixels[seen].astype(float) - theirs[seen])
    # two programs decode colours of JPEG at half the size a little differently
    assert np.percentile(off, 99.5) <= (4 if kind == "jpeg" else 0) and off.mean() < 0.5


def test_a_file_that_was_written_otherwise_gives_no_tiles(tmp_path):
    array = picture(600, 600)
    write_array(tmp_path / "a.tif", array, spec_for(array, compress="zstd"))
    with FormerRaster(tmp_path / "a.tif") as former:
        assert former.tile(0, 0, spec_for(array, compress="zstd"))
        assert former.tile(0, 0, spec_for(array, compress="jpeg")) is None
        assert former.tile(0, 0, spec_for(array, compress="zstd", tile=256)) is None
        assert former.tile(0, 0, spec_for(array, compress="zstd", mask=True)) is None
        assert former.tile(9, 9, spec_for(array, compress="zstd")) is None


@pytest.mark.parametrize("content", [None, b"", b"II*\0garbage"])
def test_a_file_that_cannot_be_read(tmp_path, content):
    if content is not None:
        (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(OutputError, match="added to"):
        FormerRaster(tmp_path / "a.tif")


def test_a_file_that_is_damaged_within(tmp_path):
    """The decoder's error ended the run in a traceback."""
    array = picture(1500, 1300)[..., :1]
    write_array(tmp_path / "a.tif", array, spec_for(array, compress="zstd"))
    data = bytearray((tmp_path / "a.tif").read_bytes())
    third = len(data) // 3
    data[third : 2 * third] = bytes(third)
    (tmp_path / "a.tif").write_bytes(data)
    with FormerRaster(tmp_path / "a.tif") as former:
        with pytest.raises(OutputError, match="added to"):
            former.band()
        with pytest.raises(OutputError, match="added to"):
            former.pixels(0, 0, 1500, 1300)
