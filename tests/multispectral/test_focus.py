"""A band out of focus is told by name, and a file that a shake blurred by its own."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.multispectral.captures import BandFiles, tags_of
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.multispectral.focus import relative_detail, typical, unsharp_notes
from skyquilt.multispectral.recorded import look_at
from skyquilt.multispectral.reflectance import Reflectance
from skyquilt.photos.read import read_photo
from tests.photos.band_files import dji
from tests.texture import texture

BANDS = ("green", "red", "red edge", "nir")
CAPTURES = 3


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Makes four bands, and what each file recorded; `blurred`: px by band, `shaken`: a file."""
    folder = tmp_path_factory.mktemp("bands")

    def made(blurred=None, shaken=""):
        bands, recorded = [], {}
        for k, name in enumerate(BANDS):
            photos = []
            for shot in range(CAPTURES):
                # bands show the same ground, brighter or darker
                counts = 5000 + (80 + 40 * k) * texture(360, 480, seed=shot)
                sigma = (blurred or {}).get(name, 0)
                counts = cv2.GaussianBlur(counts, (0, 0), sigma) if sigma else counts
                file = f"{shot}_{name.replace(' ', '')}.tif"
                counts = cv2.blur(counts, (15, 1)) if file == shaken else counts
                path = dji(folder / file, counts.astype(np.uint16), BandName=name)
                photo, tags = read_photo(path), tags_of(read_photo(path))
                convert = Reflectance.of(tags, photo.width, photo.height)
                recorded[photo.name] = look_at((photo, convert))
                photos.append((photo, tags, convert))
            one, two, three = zip(*photos, strict=True)
            files = BandFiles(name=name, photos=one, tags=two, converts=three)
            bands.append(PlacedBand(files=files, of_photo={i: i for i in range(CAPTURES)}))
        return bands, recorded

    return made


def test_bands_of_one_lens_are_alike(told):
    bands, recorded = told()
    detail = relative_detail(bands, recorded)
    assert [typical(detail[name]) for name in BANDS] == pytest.approx([1] * 4, abs=0.2)
    assert unsharp_notes(bands, detail) == []


def test_a_band_out_of_focus_is_told(told):
    bands, recorded = told({"nir": 1.5})
    detail = relative_detail(bands, recorded)
    assert typical(detail["nir"]) < 0.25
    (note,) = unsharp_notes(bands, detail)
    assert note.startswith("The band nir is not sharp: it has ")
    assert "green 1" in note and "red edge " in note


def test_a_shaken_file_is_told(told):
    bands, recorded = told(shaken="1_red.tif")
    (note,) = unsharp_notes(bands, relative_detail(bands, recorded))
    assert note.startswith("1 of 3 files of the band red are blurred") and "1_red.tif" in note


def test_two_bands_cannot_be_compared(told):
    bands, recorded = told({"nir": 1.5})
    detail = relative_detail(bands[2:], recorded)
    assert unsharp_notes(bands, detail) == [] and typical(detail["nir"]) is None


def test_bands_of_other_sizes_are_not_compared(told):
    """A panchromatic band has finer pixels, and temperatures other ones."""
    bands, recorded = told({"nir": 1.5})
    nir = bands[3].files
    small = replace(nir, photos=tuple(replace(p, width=100) for p in nir.photos))
    detail = relative_detail([*bands[:3], replace(bands[3], files=small)], recorded)
    assert "nir" not in detail and len(detail) == 3
