"""Photos in WebP. Pillow writes and reads them, too."""

import io

import numpy as np
import piexif
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.pixels import read_color, read_gray
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import read_survey
from skyquilt.photos.webp import decode_webp, read_webp
from tests.photos.conftest import dji_exif, dji_xmp, pixels


def written(path, image, **how):
    told = {"exif": piexif.dump(dict(dji_exif())), "xmp": dji_xmp().encode()}
    Image.fromarray(image).save(path, "WEBP", **told, **how)
    return path


@pytest.mark.parametrize("lossless", [False, True])
def test_metadata_are_those_of_a_jpeg_and_pixels_those_that_pillow_reads(
    make_jpeg, tmp_path, lossless
):
    path = written(tmp_path / "a.webp", pixels(), lossless=lossless, quality=90)
    told = read_photo(make_jpeg("b.jpg", exif=dji_exif(), xmp=dji_xmp()))
    found = read_photo(path)
    assert isinstance(found, Photo) and isinstance(told, Photo)
    assert found.position is not None and told.position is not None
    for name in ("latitude_deg", "longitude_deg", "takeoff_m", "sea_level_m"):
        assert getattr(found.position, name) == getattr(told.position, name), name
    assert (found.time, found.camera_key) == (told.time, told.camera_key)
    assert found.focal.px == told.focal.px
    assert (found.width, found.height, found.channels, found.dtype) == (96, 64, 3, "uint8")
    with Image.open(path) as image:
        seen = np.asarray(image.convert("RGB"))
    assert np.array_equal(read_color(found), seen)
    means = seen.reshape(32, 2, 48, 2, 3).mean(axis=(1, 3)) @ [0.299, 0.587, 0.114]
    assert np.abs(read_gray(found, reduction=2) - means).max() < 2


def test_what_is_see_through_is_black(tmp_path):
    image = np.dstack([pixels() | 64, np.full((64, 96), 255, np.uint8)])
    image[:, :48, 3] = 0
    found = read_photo(written(tmp_path / "a.webp", image, lossless=True, exact=True))
    assert isinstance(found, Photo) and found.alpha
    shown = read_color(found)
    assert (shown[:, :48] == 0).all() and np.array_equal(shown[:, 48:], image[:, 48:, :3])


def test_one_that_lies_beside_a_jpeg_of_its_name_is_the_same_photo(make_jpeg, tmp_path):
    for k in range(3):
        make_jpeg(f"IMG_{k}.JPG", exif=dji_exif(), seed=k)
    for name in ("IMG_1.webp", "IMG_7.webp"):
        written(tmp_path / name, pixels(seed=9))
    survey = read_survey(tmp_path)
    names = sorted(p.name for p in survey.photos)
    assert names == ["IMG_0.JPG", "IMG_1.JPG", "IMG_2.JPG", "IMG_7.webp"]
    assert not survey.rejected


def test_a_file_that_is_cut_off_is_truncated(tmp_path):
    data = written(tmp_path / "a.webp", pixels()).read_bytes()
    short = tmp_path / "short.webp"
    for length in range(12, len(data), 61):
        short.write_bytes(data[:length])
        found = read_photo(short)
        assert isinstance(found, RejectedPhoto) and "truncated" in found.reason, length


def test_animations_are_no_photos(tmp_path):
    first, second = Image.fromarray(pixels()), Image.fromarray(pixels(seed=1))
    path = tmp_path / "a.webp"
    first.save(path, save_all=True, append_images=[second], duration=100)
    found = read_photo(path)
    assert isinstance(found, RejectedPhoto) and found.reason == "it is an animation, not a photo"


def test_pictures_are_refused_by_the_size_that_they_declare(tmp_path):
    small = io.BytesIO()
    Image.fromarray(pixels()).save(small, "WEBP")
    data = bytearray(small.getvalue())
    at = data.index(b"\x9d\x01\x2a") + 3
    data[at : at + 4] = (16383).to_bytes(2, "little") * 2
    (tmp_path / "a.webp").write_bytes(data)
    found = read_photo(tmp_path / "a.webp")
    assert isinstance(found, RejectedPhoto) and "160 megapixels are the most" in found.reason
    with pytest.raises(UnreadablePhotoError, match="megapixels"):
        decode_webp(io.BytesIO(data))


def test_another_size_than_was_checked_is_not_decoded(tmp_path):
    path = written(tmp_path / "a.webp", pixels())
    found = read_photo(path)
    written(path, pixels(80, 60))
    assert isinstance(found, Photo)
    with pytest.raises(UnreadablePhotoError, match="80x60 but its header states 96x64"):
        read_color(found)


def seed(**how):
    file = io.BytesIO()
    Image.fromarray(pixels(48, 40)).save(file, "WEBP", **how)
    return file.getvalue()


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([seed(), seed(lossless=True)]), st.data())
def test_damage_ends_in_a_sentence(whole, data):
    spoilt = bytearray(whole)
    for at in data.draw(st.lists(st.integers(12, len(spoilt) - 1), min_size=1, max_size=6)):
        spoilt[at] = data.draw(st.integers(0, 255))
    try:
        header = read_webp(io.BytesIO(spoilt))
    except UnreadablePhotoError:
        return
    try:
        shown = decode_webp(io.BytesIO(spoilt), (header.width, header.height))
    except Exception as error:  # as readers of pixels name it
        assert type(error).__name__ == "WebpError"
        return
    assert shown.shape[:2] == (header.height, header.width)
