"""Files of a rig by band and capture; indices."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from skyquilt.multispectral import captures
from skyquilt.multispectral.captures import bands_of_files, captured_together
from skyquilt.multispectral.indices import INDICES, indices_of
from skyquilt.photos.band_tags import BandTags
from tests.alignment.surveys import photo

NOON = datetime(2024, 7, 15, 12)
TOLD = BandTags(
    black_level=3200, bits=16, exposure_s=1e-3, gain=1.0, gain_adjustment=1.0, irradiance=100.0
)


@pytest.fixture
def files(monkeypatch):
    """Files of three bands and five captures, and what each tells, by its name."""
    told = {}
    found = []
    for shot in range(5):
        for name, nm in (("NIR", 860.0), ("Green", 560.0), ("RedEdge", 730.0)):
            one = photo(f"{shot}{name}.tif")
            time = NOON + timedelta(seconds=2 * shot)
            one = replace(one, band_name=name.lower(), time=time, position=None, channels=1)
            found.append(one)
            told[one.name] = replace(
                TOLD, name=name.lower(), wavelength_nm=nm, capture=f"capture {shot}"
            )
    monkeypatch.setattr(captures, "read_band_tags", lambda path: told[path.name])
    return found, told


def test_bands_are_in_order_of_wavelength(files):
    found = bands_of_files(files[0])
    assert [b.name for b in found] == ["green", "red edge", "nir"]
    assert [b.wavelength_nm for b in found] == [560.0, 730.0, 860.0]
    assert all(len(b.photos) == len(b.tags) == len(b.converts) == 5 for b in found)
    assert {b.kind for b in found} == {"relative"}


def test_irradiance_is_smoothed(files):
    photos, told = files
    told["2NIR.tif"] = replace(told["2NIR.tif"], irradiance=250.0)  # a glint on the sensor
    *_, nir = bands_of_files(photos)
    assert [c.irradiance for c in nir.converts] == [pytest.approx(100.0)] * 5


def test_captures_are_told_by_their_identifiers_whatever_the_time(files):
    photos, _ = files
    green, _, nir = bands_of_files(photos)
    late = [replace(p, time=p.time + timedelta(seconds=2)) for p in nir.photos]
    late = replace(nir, photos=tuple(late[::-1]), tags=nir.tags[::-1])
    found = captured_together(green.photos, [t.capture for t in green.tags], late)
    assert found == {k: 4 - k for k in range(5)}


def test_captures_without_identifiers_are_told_by_their_times(files):
    photos, told = files
    told |= {name: replace(t, capture="") for name, t in told.items()}
    green, _, nir = bands_of_files(photos)
    lost = replace(nir, photos=nir.photos[1:], tags=nir.tags[1:])
    found = captured_together(green.photos, ["" for _ in green.tags], lost)
    assert found == {k: k - 1 for k in range(1, 5)}


def test_a_file_that_is_gone_keeps_its_band(files, monkeypatch):
    def gone(path):
        raise FileNotFoundError(path)

    monkeypatch.setattr(captures, "read_band_tags", gone)
    assert {b.name for b in bands_of_files(files[0])} == {"green", "red edge", "nir"}


def test_indices_are_normalised_differences():
    ndvi, *_ = indices_of(["red", "nir"])
    a = np.array([[0.5, 0.3, 0.0, np.nan]], np.float32)
    b = np.array([[0.1, 0.3, 0.0, 0.2]], np.float32)
    found = ndvi(a, b)
    assert found[0, :2] == pytest.approx([2 / 3, 0.0])
    assert np.isnan(found[0, 2:]).all()
    scaled = ndvi(7 * a, 7 * b)  # a factor of both bands does not matter
    np.testing.assert_allclose(scaled[0, :2], found[0, :2], rtol=1e-6)
    assert indices_of(["blue", "green", "red"]) == ()
    assert indices_of(["green", "red", "red edge", "nir"]) == INDICES
