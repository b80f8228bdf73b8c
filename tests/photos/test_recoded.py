"""Files that another program wrote, told by their coding."""

import io

import numpy as np
import pytest
from PIL import Image

from skyquilt.photos.headers import read_jpeg_header
from skyquilt.photos.recoded import UNNAMED, recoded
from skyquilt.photos.survey import read_survey

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


def odd(codings, cameras=None):
    return [i for i, other in enumerate(recoded(cameras or "x" * len(codings), codings)) if other]


def test_the_few_that_are_coded_otherwise_were_rewritten():
    assert odd("aaba") == [2]


def test_nothing_is_told_by_few_files_or_halves():
    assert odd("aba") == odd("ababab") == odd("") == []


def test_each_camera_codes_its_own_way():
    assert odd("aaabbbb", "xxxyyyy") == []
    assert odd("aaabbbba", "xxxyyyyy") == [7]


def test_a_survey_names_them(tmp_path):
    for i in range(5):
        pixels = np.roll(PIXELS, i, 0)
        (tmp_path / f"{i}.jpg").write_bytes(jpeg(pixels=pixels, subsampling=1 if i < 4 else 2))
    survey = read_survey(tmp_path)
    assert [p.editor for p in survey.photos] == [None] * 4 + [UNNAMED]
    assert any(n.startswith("1 photo") and "4.jpg" in n and "rewritten" in n for n in survey.notes)
