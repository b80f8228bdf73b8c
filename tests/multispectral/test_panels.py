"""Pictures of a panel make reflectances true, with and without a sun sensor."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose

from skyquilt.multispectral.captures import bands_of_files
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.multispectral.panels import by_panels
from skyquilt.photos.band_tags import Panel, read_band_tags
from skyquilt.photos.read import read_photo
from tests.multispectral.test_reflectance import HEIGHT, SHARE, WIDTH, of_micasense
from tests.photos.band_files import micasense

NOON = datetime(2024, 7, 15, 12)
PANEL = {"red": 0.49, "nir": 0.52}
"""Its reflectance in each band."""
PLACE = "70,30, 110,34, 106,80, 66,76"
"""Its corners in the picture, as the camera writes them."""
TIMES_S = (0, 100, 200, 300)
"""Of a panel, two photos of the flight, and a panel again."""


def sun(name, time_s):
    """The true irradiance: it falls during the flight."""
    return (1.0 if name == "red" else 0.8) * (1 - time_s / 1000)


@pytest.fixture
def take(tmp_path):
    """Takes the files of both bands: the index of those with a panel, and what the sun sensor
    reads over the truth, by band; None: there is none. `level`: reflectance at the panel's place,
    `lying`: of something across it, `place`: its corners, `shadow`: files with a shadow on it.
    """

    def files(
        sensor=None, panels=(0, 3), level=None, lying=None, place=PLACE, shadow=(), times=TIMES_S
    ):
        found = []
        for name, nm in (("red", 668), ("nir", 842)):
            for k, time_s in enumerate(times):
                told = {"Camera__BandName": name, "Camera__CentralWavelength": str(nm)}
                told["MicaSense__CaptureId"] = f"capture{k}"
                told |= dict.fromkeys(("DLS__SpectralIrradiance", "DLS__HorizontalIrradiance"))
                if sensor:
                    told["DLS__HorizontalIrradiance"] = f"{100 * sensor[name] * sun(name, time_s)}"
                share = SHARE.copy()
                if k in panels:
                    told |= {"Camera__Albedo": str(PANEL[name]), "Camera__ReflectArea": place}
                    share[25:85, 60:116] = (level or PANEL)[name] * (0.35 if k in shadow else 1)
                    if lying:
                        share[50:60] = lying
                path = tmp_path / f"IMG_{k}_{name}.tif"
                tags = read_band_tags(micasense(path, np.zeros((HEIGHT, WIDTH), "u2"), **told))
                counts = of_micasense(share, replace(tags, irradiance=sun(name, time_s)))
                micasense(path, np.clip(np.rint(counts), 0, 65535).astype("u2"), **told)
                found.append(replace(read_photo(path), time=NOON + timedelta(seconds=time_s)))
        shot = bands_of_files(found)
        return [PlacedBand(files=b, of_photo={1: 1, 2: 2}) for b in shot], shot

    return files


def errors(bands):
    """Reflectance of the photos of the flight over the true one: the median, and how far it is
    from that anywhere.
    """
    found = []
    for band in bands:
        for j in band.of_photo.values():
            share = band.files.converts[j](tifffile.imread(band.files.photos[j].path)) / SHARE
            found.append(np.median(share))
            assert_allclose(share, found[-1], rtol=0.01)
    return np.array(found)


def test_a_panel_before_and_after_the_flight_tells_the_light(take):
    placed, shot = take()
    assert {c.kind for b in placed for c in b.files.converts} == {"radiance"}
    bands, note = by_panels(placed, shot)
    assert {c.kind for b in bands for c in b.files.converts} == {"reflectance"}
    assert_allclose(errors(bands), 1, rtol=0.003)
    assert note.text == "Values are reflectances by 2 pictures of a panel." and not note.warning


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ({"red": 0.8, "nir": 1.2}, "multiplied by 0.83 to 1.25."),
        ({"red": 1.0, "nir": 0.5}, "multiplied by 1.00 to 2.00: one of both is far off"),
    ],
)
def test_a_sun_sensor_is_corrected(take, sensor, words):
    """One panel is enough: the sensor tells how the light changes."""
    placed, shot = take(sensor, panels=(0,))
    assert np.abs(errors(placed) - 1).max() > 0.15
    bands, note = by_panels(placed, shot)
    assert_allclose(errors(bands), 1, rtol=0.003)
    assert words in note.text and note.warning == ("far off" in words)


@pytest.mark.parametrize("sensor", [None, {"red": 0.8, "nir": 1.2}])
@pytest.mark.parametrize("shadow", [0, 3])
def test_of_two_pictures_of_one_moment_the_one_without_a_shadow_counts(take, sensor, shadow):
    """It was the later one, or the mean of both: 2.9 or 1.5 times too bright, without a word."""
    placed, shot = take(sensor, shadow=(shadow,), times=(0, 20, 30, 5))
    bands, note = by_panels(placed, shot)
    assert_allclose(errors(bands), 1, rtol=0.04)
    assert f"times as much light as by IMG_{shadow}_" in note.text and note.warning


def test_pictures_of_a_panel_that_contradict_each_other_are_told(take):
    placed, shot = take(panels=(0, 3), shadow=(3,))
    _, note = by_panels(placed, shot)
    assert "as much light as by IMG_3_" in note.text and note.warning


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"level": {"red": 0.49, "nir": 3.0}}, "IMG_0_nir.tif is overexposed"),
        ({"lying": 0.1}, "IMG_0_red.tif is not evenly bright"),
        ({"place": "900,30, 940,34, 940,80, 900,76"}, "lies outside the picture"),
    ],
)
def test_panels_that_tell_nothing_are_named(take, changes, why):
    placed, shot = take({"red": 0.8, "nir": 1.2}, **changes)
    bands, note = by_panels(placed, shot)
    assert bands == placed and why in note.text and note.warning


def test_a_band_without_a_panel_keeps_all_as_they_are(take):
    placed, shot = take()
    red, nir = shot
    bare = replace(nir, tags=tuple(replace(t, panel=None) for t in nir.tags))
    bands, note = by_panels(placed, [red, bare])
    assert bands == placed and "the band nir has none" in note.text
    assert by_panels(placed, [replace(red, tags=bare.tags), bare]) == (placed, None)


def test_temperatures_stay(take):
    placed, shot = take()
    hot = replace(placed[1], files=replace(placed[1].files, name="lwir"))
    bands, _ = by_panels([placed[0], hot], shot)
    assert bands[1] is hot and bands[0].files.converts[1].kind == "reflectance"


def test_what_files_tell_of_a_panel(tmp_path):
    def told(**changes):
        counts = np.zeros((HEIGHT, WIDTH), "u2")
        return read_band_tags(micasense(tmp_path / "a.tif", counts, **changes))

    whole = {"Camera__Albedo": "0.49", "Camera__ReflectArea": PLACE}
    corners = ((70, 30), (110, 34), (106, 80), (66, 76))
    assert told(**whole).panel == Panel(reflectance=0.49, corners=corners)
    assert told(Camera__Albedo="0.49").panel is None
    for albedo, place in (("0", PLACE), ("49", PLACE), ("nan", PLACE), ("0.49", "1,2,3")):
        found = told(Camera__Albedo=albedo, Camera__ReflectArea=place)
        assert found.panel is None and len(found.notes) == 1
