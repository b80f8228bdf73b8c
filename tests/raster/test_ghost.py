"""GDAL's structural metadata promise an order and frames around each tile: the file keeps them."""

import numpy as np
import tifffile

from skyquilt.raster import write_array

from .raster_cases import disc, picture, spec_for


def test_tiles_lie_as_promised(tmp_path):
    array, valid = picture(1500, 1100), disc(1500, 1100)
    valid[:520, :520] = False
    write_array(
        tmp_path / "a.tif", array, spec_for(array, compress="jpeg", mask=True, tile=256), valid
    )
    data = (tmp_path / "a.tif").read_bytes()
    assert b"MASK_INTERLEAVED_WITH_IMAGERY=YES" in data[:300]
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        pages = list(file.pages)
    images, masks = pages[::2], pages[1::2]
    assert [page.subfiletype for page in pages] == [0, 4, 1, 5, 1, 5, 1, 5]
    assert [page.offset for page in pages] == sorted(page.offset for page in pages)
    following = max(page.offset for page in pages)
    for image, mask in zip(reversed(images), reversed(masks), strict=True):
        for parts in zip(
            image.dataoffsets,
            image.databytecounts,
            mask.dataoffsets,
            mask.databytecounts,
            strict=True,
        ):
            assert parts[0] > following
            check_frame(data, *parts[:2])
            check_frame(data, *parts[2:])
            assert parts[2] == parts[0] + parts[1] + 8
            following = parts[2] + parts[3]
    assert following + 4 == len(data)


def check_frame(data, offset, count):
    assert int.from_bytes(data[offset - 4 : offset], "little") == count
    assert data[offset + count : offset + count + 4] == data[offset + count - 4 : offset + count]


def test_another_reader_sees_the_same(tmp_path):
    """tifffile with its own decoders; it reads neither GDAL's metadata nor through libtiff."""
    array = np.random.default_rng(2).normal(size=(300, 500, 2)).astype(np.float32)
    write_array(tmp_path / "a.tif", array, spec_for(array, tile=128, compress="zstd"))
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), array)
    picture_in = picture(300, 500)
    write_array(tmp_path / "b.tif", picture_in, spec_for(picture_in, tile=128, compress="jpeg"))
    assert np.abs(tifffile.imread(tmp_path / "b.tif").astype(int) - picture_in).max() < 40
