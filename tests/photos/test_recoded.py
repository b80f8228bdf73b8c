"""Files that another program wrote, told by their coding."""

import io

import numpy as np
import pytest
from PIL import Image

from skyquilt.photos.headers import read_jpeg_header
from skyquilt.photos.recoded import UNNAMED, with_editors
from skyquilt.photos.survey import read_survey
from tests.alignment.surveys import photo

PIXELS = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def jpeg(**options):
    out = io.BytesIO()
    Image.fromarray(options.pop("pixels", PIXELS)).save(out, "JPEG", **options)
    return out.getvalue()


def without_jfif(data):
    assert data[2:4] == b"\xff\xe0"
    return data[:2] + data[4 + int.from_bytes(data[4:6], "big") :]


@pytest.mark.parametrize(
    ("data", "coding"),
    [
        (jpeg(subsampling=0), "1x1 1x1 1x1 JFIF"),
        (jpeg(subsampling=1), "2x1 1x1 1x1 JFIF"),
        (jpeg(subsampling=2, quality=30), "2x2 1x1 1x1 JFIF"),
        (jpeg(subsampling=2, progressive=True), "2x2 1x1 1x1 JFIF"),
        (without_jfif(jpeg(subsampling=1)), "2x1 1x1 1x1"),
        (jpeg(pixels=PIXELS[..., 0]), "1x1 JFIF"),
    ],
)
def test_coding(data, coding):
    """As Pillow was told to write them."""
    assert read_jpeg_header(io.BytesIO(data)).coding == coding


def coded(*codings, **more):
    return [photo(f"{i}.jpg", coding=c, **more) for i, c in enumerate(codings)]


def editors(photos):
    return [p.editor for p in with_editors(photos)]


def test_the_few_that_are_coded_otherwise_were_rewritten():
    assert editors(coded("a", "a", "b", "a")) == [None, None, UNNAMED, None]


def test_nothing_is_told_by_few_photos_or_halves():
    assert editors(coded("a", "b", "a")) == [None] * 3
    assert editors(coded("a", "b") * 3) == [None] * 6


def test_each_camera_codes_its_own_way():
    assert editors(coded("a", "a", "a", key="x") + coded("b", key="y")) == [None] * 4


def test_a_program_that_is_named_stays():
    photos = coded("a", "a", "a", "b", editor="Some Viewer")
    assert editors(photos) == ["Some Viewer"] * 4


def test_a_survey_names_them(tmp_path):
    for i in range(5):
        pixels = np.roll(PIXELS, i, 0)
        (tmp_path / f"{i}.jpg").write_bytes(jpeg(pixels=pixels, subsampling=1 if i < 4 else 2))
    survey = read_survey(tmp_path)
    assert [p.editor for p in survey.photos] == [None] * 4 + [UNNAMED]
    assert any(n.startswith("1 photo") and "4.jpg" in n and "rewritten" in n for n in survey.notes)
