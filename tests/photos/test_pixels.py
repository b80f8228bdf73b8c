from dataclasses import replace

import cv2
import numpy as np
import pytest
import simplejpeg
import tifffile
from PIL import Image

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.pixels import decode_jpeg, read_color, read_gray, reduce_pixels, to_gray
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import read_survey

from .conftest import dji_exif, jpeg_bytes, pixels


def test_full_jpeg_equals_pillows_and_ignores_orientation(make_jpeg):
    path = make_jpeg(exif=dji_exif(**{"0th": {274: 6}}))
    ours = read_color(read_photo(path)).astype(int)
    assert ours.shape == (64, 96, 3)
    assert np.abs(ours - np.asarray(Image.open(path)).astype(int)).max() <= 2


@pytest.mark.parametrize("reduction", [2, 4, 8])
@pytest.mark.parametrize("size", [(96, 64), (101, 75)])
def test_reduced_jpeg_is_the_area_mean(make_jpeg, reduction, size):
    photo = read_photo(make_jpeg(image=pixels(*size)))
    small = read_color(photo, reduction=reduction)
    mean = reduce_pixels(read_color(photo), reduction)
    assert small.shape == mean.shape == (-(-size[1] // reduction), -(-size[0] // reduction), 3)
    assert np.abs(small.astype(int) - mean)[:-1, :-1].mean() < 3
    gray = read_gray(photo, reduction=reduction)
    assert np.abs(gray.astype(int) - to_gray(small))[:-1, :-1].mean() < 3


def test_reduced_pixel_centres_are_where_they_are_said_to_be(make_jpeg):
    """A blob at x of the full image lies at (x - (r - 1) / 2) / r of the reduced one."""
    rows, columns = np.mgrid[0:128, 0:192]
    blob = 250 * np.exp(-((columns - 100.0) ** 2 + (rows - 61.0) ** 2) / (2 * 9.0**2))
    photo = read_photo(make_jpeg(image=np.repeat(blob[..., None], 3, 2).astype(np.uint8)))
    for r in (1, 2, 4):
        small = read_gray(photo, reduction=r).astype(float)
        small[small < 20] = 0
        v, u = np.mgrid[0 : small.shape[0], 0 : small.shape[1]]
        where = np.array([(u * small).sum(), (v * small).sum()]) / small.sum()
        assert where == pytest.approx([(100 - (r - 1) / 2) / r, (61 - (r - 1) / 2) / r], abs=0.03)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95, 0.999])
def test_truncated_jpeg_is_left_out(make_jpeg, share):
    path = make_jpeg(
        exif=dji_exif(), image=np.random.default_rng(1).integers(0, 255, (200, 300, 3), np.uint8)
    )
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    rejected = read_photo(path)
    assert isinstance(rejected, RejectedPhoto)
    assert "truncated" in rejected.reason


def test_zero_padding_does_not_hide_a_truncation(make_jpeg):
    path = make_jpeg(image=np.random.default_rng(1).integers(0, 255, (200, 300, 3), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))
    assert "truncated" in read_photo(path).reason


def test_trailers_behind_the_image_do_no_harm(make_jpeg):
    """Previews, padding, maker's blocks: all stand behind the end of the image proper."""
    path = make_jpeg()
    path.write_bytes(path.read_bytes() + jpeg_bytes(pixels(40, 30)) + bytes(5000))
    assert read_color(read_photo(path)).shape == (64, 96, 3)


def test_damage_inside_raises_instead_of_yielding_grey(make_jpeg):
    path = make_jpeg(image=np.random.default_rng(1).integers(0, 255, (200, 300, 3), np.uint8))
    photo = read_photo(path)
    data = path.read_bytes()
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes(3000) + data[middle + 3000 :])
    with pytest.raises(UnreadablePhotoError, match="damaged"):
        read_color(photo)


def test_a_wrong_bit_that_moves_all_pixels_after_it_is_damage(make_jpeg):
    """The decoder then has bytes left over, as it has of what some cameras fill up with; where it
    has none, nobody can tell.
    """
    path = make_jpeg(image=np.random.default_rng(1).integers(90, 110, (64, 96, 3), np.uint8))
    good, original = read_photo(path), path.read_bytes()
    rng, told = np.random.default_rng(1), 0
    for place in rng.integers(len(original) // 2, len(original) * 9 // 10, 60):
        wrong = bytearray(original)
        wrong[place] ^= 1 << int(rng.integers(8))
        try:
            decoded = simplejpeg.decode_jpeg(bytes(wrong), strict=True) is not None
        except ValueError as error:
            decoded = "extraneous" not in str(error)
        path.write_bytes(wrong)
        if not decoded:
            told += 1
            with pytest.raises(UnreadablePhotoError, match="damaged"):
                read_color(good)
    assert told > 3
    for filling in (b"\0" * 50, b"\x20" * 7, b"\1\2\3"):
        path.write_bytes(original[:-2] + filling + original[-2:])
        assert np.array_equal(read_color(good), decode_jpeg(original))


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_small_first_page_of_a_tiff_is_a_preview_although_it_does_not_say_so(
    tmp_path, below, dtype
):
    large = pixels(384, 256).astype(dtype)
    small = np.ascontiguousarray(large[::4, ::4])
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(small, photometric="rgb", subifds=1 if below else None)
        tiff.write(large, photometric="rgb")
    photo = read_photo(path)
    assert (photo.width, photo.height) == large.shape[1::-1]
    assert any("preview" in n for n in photo.notes)
    assert np.array_equal(read_color(photo), large)


@pytest.mark.parametrize("other", [(128, 128, 3), (128, 192)])
def test_another_picture_behind_the_first_page_of_a_tiff_is_not_the_photo(tmp_path, other):
    """Of another shape, or of one band: what a thermal camera saves beside its picture."""
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(pixels(96, 64), photometric="rgb")
        kind = "rgb" if len(other) == 3 else "minisblack"
        tiff.write(np.zeros(other, np.uint8), photometric=kind)
    photo = read_photo(path)
    assert np.array_equal(read_color(photo), pixels(96, 64))


def test_a_file_that_changed_its_size_is_no_longer_that_photo(make_jpeg):
    photo = read_photo(make_jpeg())
    make_jpeg(image=pixels(60, 60))
    with pytest.raises(UnreadablePhotoError, match="60x60"):
        read_color(photo)


def test_gone_file_is_a_reason(make_jpeg):
    photo = read_photo(make_jpeg())
    photo.path.unlink()
    with pytest.raises(UnreadablePhotoError):
        read_gray(photo)


def test_gray_jpeg(tmp_path):
    Image.fromarray(pixels()[..., 0]).save(tmp_path / "g.jpg")
    photo = read_photo(tmp_path / "g.jpg")
    assert (photo.channels, read_color(photo).shape) == (1, (64, 96))


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_multiband_tiff(tmp_path, planar, dtype):
    bands = np.random.default_rng(0).integers(0, 255, (64, 96, 5)).astype(dtype)
    stored = bands if planar == "contig" else np.moveaxis(bands, -1, 0)
    tifffile.imwrite(tmp_path / "m.tif", stored, photometric="minisblack", planarconfig=planar)
    photo = read_photo(tmp_path / "m.tif")
    assert (photo.width, photo.height, photo.channels, photo.dtype) == (
        96,
        64,
        5,
        np.dtype(dtype).name,
    )
    assert np.array_equal(read_color(photo), bands)
    assert read_color(photo, reduction=2).shape == (32, 48, 5)
    assert read_gray(photo).shape == (64, 96)


@pytest.mark.parametrize("compression", ["raw", "packbits", "tiff_lzw"])
@pytest.mark.parametrize("white", [0, 1])
def test_black_and_white_tiff_is_read_as_the_same_png_is(tmp_path, compression, white):
    """Pillow wrote both; `white`: the bit that stands for it."""
    picture = Image.fromarray(pixels(99, 61)[..., 0]).convert("1")
    picture.save(tmp_path / "b.png")
    picture.save(tmp_path / "b.tif", compression=compression, tiffinfo={262: white})
    with tifffile.TiffFile(tmp_path / "b.tif") as file:
        assert (file.asarray() == white).mean() == np.asarray(picture).mean()
    photo, other = (read_photo(tmp_path / name) for name in ("b.tif", "b.png"))
    assert (photo.width, photo.height, photo.channels, photo.dtype) == (99, 61, 1, "uint8")
    assert set(np.unique(read_color(photo))) == {0, 255}
    assert np.array_equal(read_color(photo), read_color(other))
    assert np.array_equal(read_gray(photo, reduction=2), read_gray(other, reduction=2))


@pytest.mark.parametrize("mode", ["P", "CMYK", "RGBA", "LA"])
def test_tiff_of_palettes_inks_and_alpha_is_read_as_pillow_reads_it(tmp_path, mode):
    """Numbers of a palette's colours had been taken for brightness, inks for four bands."""
    picture = Image.fromarray(pixels()).convert(mode)
    picture.save(tmp_path / "p.tif")
    photo = read_photo(tmp_path / "p.tif")
    want = np.asarray(Image.open(tmp_path / "p.tif").convert("L" if mode == "LA" else "RGB"))
    bands = 1 if want.ndim == 2 else 3
    assert (photo.channels, photo.dtype, photo.alpha) == (bands, "uint8", mode[-1] == "A")
    assert np.abs(read_color(photo).astype(int) - want).max() <= 1


def test_grey_tiff_in_which_zero_is_white(tmp_path):
    grey = pixels()[..., 0]
    tifffile.imwrite(tmp_path / "w.tif", 255 - grey, photometric="miniswhite")
    assert np.array_equal(read_color(read_photo(tmp_path / "w.tif")), grey)


def test_tiff_in_colours_that_are_not_read_is_left_out_with_a_reason(tmp_path):
    tifffile.imwrite(tmp_path / "l.tif", pixels(), photometric="cielab")
    assert "save it as RGB" in read_photo(tmp_path / "l.tif").reason


@pytest.mark.parametrize("kind", ["png", "tif"])
@pytest.mark.parametrize(("bands", "dtype"), [(3, np.uint8), (3, np.uint16), (1, np.uint8)])
def test_pixels_that_may_be_seen_through_hold_nothing(tmp_path, kind, bands, dtype):
    """Whatever a program left in them was drawn as ground."""
    rng = np.random.default_rng(4)
    most = np.iinfo(dtype).max
    values = rng.integers(1, most, (40, 60, bands)).astype(dtype)
    alpha = np.where(np.arange(60) < 13, 0, most).astype(dtype) * np.ones((40, 1), dtype)
    stored = np.concatenate([values, alpha[..., None]], 2)
    path = tmp_path / f"a.{kind}"
    if kind == "tif":
        tifffile.imwrite(
            path,
            stored,
            photometric="rgb" if bands == 3 else "minisblack",
            extrasamples=["unassalpha"],
            planarconfig="contig",
        )
    elif bands == 3:
        cv2.imwrite(str(path), stored[..., [2, 1, 0, 3]])
    else:
        Image.fromarray(stored, "LA").save(path)
    photo = read_photo(path)
    assert (photo.channels, photo.dtype, photo.alpha) == (bands, np.dtype(dtype).name, True)
    found = read_color(photo).reshape(40, 60, bands)
    assert not found[:, :13].any()
    assert np.array_equal(found[:, 13:], values[:, 13:])


@pytest.mark.parametrize("name", ["g.jpg", "g.png", "g.tif"])
def test_grey_among_colours_is_read_as_colours(tmp_path, name):
    Image.fromarray(pixels()).save(tmp_path / f"c{name[1:]}")
    Image.fromarray(pixels()[..., 0]).save(tmp_path / name)
    survey = read_survey(tmp_path)
    grey = next(p for p in survey.photos if p.name == name)
    assert [p.channels for p in survey.photos] == [3, 3]
    assert any("1 photos are grey" in note and name in note for note in survey.notes)
    values = read_color(grey)
    assert values.shape == (64, 96, 3) and (values == values[..., :1]).all()
    assert np.array_equal(values[..., 0], read_color(replace(grey, channels=1)))


def test_png_of_sixteen_bits_keeps_them(tmp_path):
    """Of 12 bits in 16, eight upper ones are 16 levels of grey."""
    values = (pixels().astype(np.uint16) * 16)[..., ::-1]
    cv2.imwrite(str(tmp_path / "d.png"), values)
    photo = read_photo(tmp_path / "d.png")
    assert (photo.channels, photo.dtype, photo.alpha) == (3, "uint16", False)
    assert np.array_equal(read_color(photo), values[..., ::-1])
    assert not any("without a balance" in n for n in read_survey(tmp_path).notes)


def test_floating_point_colours_are_told_to_be_mapped_as_recorded(tmp_path):
    tifffile.imwrite(tmp_path / "f.tif", pixels().astype(np.float32), photometric="rgb")
    assert any("1 photos in colour have floating-point" in n for n in read_survey(tmp_path).notes)


@pytest.mark.parametrize("fill", [-9999.0, -32768.0, -3.4028235e38, 1e20, np.inf])
@pytest.mark.parametrize("scale", [0.004, 12.0], ids=["reflectance", "counts"])
def test_what_programs_fill_gaps_with_is_no_value_although_the_file_does_not_say_so(
    tmp_path, scale, fill
):
    """Shares of light became degrees Celsius, and a picture of counts was grey all over."""
    values = pixels().astype(np.float32)[..., 0] * np.float32(scale)
    filled = values.copy()
    filled[:20, :30] = fill
    tifffile.imwrite(tmp_path / "f.tif", filled)
    photo = read_photo(tmp_path / "f.tif")
    assert (photo.unit, photo.band) == ("", "visible")
    found = read_color(photo)
    assert np.isnan(found[:20, :30]).all()
    assert np.array_equal(found[20:], values[20:]) and np.array_equal(found[:, 30:], values[:, 30:])
    assert read_gray(photo)[20:].std() > 40  # of pictures without gaps: 70


def test_a_low_value_among_lower_ones_is_a_value(tmp_path):
    values = np.linspace(-30_000, 60_000, 96 * 64).astype(np.float32).reshape(64, 96)
    values[5, 5] = -9999
    tifffile.imwrite(tmp_path / "f.tif", values)
    assert np.array_equal(read_color(read_photo(tmp_path / "f.tif")), values)


def test_truncated_tiff(tmp_path):
    tifffile.imwrite(tmp_path / "m.tif", pixels(), photometric="rgb")
    data = (tmp_path / "m.tif").read_bytes()
    (tmp_path / "m.tif").write_bytes(data[:-4000])
    assert "truncated" in read_photo(tmp_path / "m.tif").reason


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "I;16"])
def test_png(tmp_path, mode):
    image = Image.fromarray(pixels())
    if mode == "I;16":
        cv2.imwrite(str(tmp_path / "p.png"), pixels()[..., 0].astype(np.uint16) * 200)
    else:
        image.convert(mode).save(tmp_path / "p.png")
    photo = read_photo(tmp_path / "p.png")
    values = read_color(photo)
    assert values.dtype == photo.dtype
    assert values.shape == ((64, 96) if mode in ("L", "I;16") else (64, 96, 3))
    if mode.startswith("RGB"):
        assert np.array_equal(values, pixels())


def test_sixteen_bit_gray_is_stretched(tmp_path):
    ramp = np.tile(np.linspace(1000, 3000, 96).astype(np.uint16), (64, 1))
    tifffile.imwrite(tmp_path / "r.tif", ramp)
    gray = read_gray(read_photo(tmp_path / "r.tif"))
    assert (gray.min(), gray.max()) == (0, 255)


def test_decode_jpeg_of_bytes():
    assert decode_jpeg(jpeg_bytes(pixels()), gray=True, reduction=2).shape == (32, 48)
