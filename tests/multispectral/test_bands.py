"""Files of a rig by band and capture; indices."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.model.camera import Camera
from skyquilt.model.photo import GeoPosition
from skyquilt.model.poses import Pose
from skyquilt.multispectral import captures
from skyquilt.multispectral.captures import bands_of_files, captured_together
from skyquilt.multispectral.draw import BandsDrawing, averaged
from skyquilt.multispectral.indices import INDICES, indices_of
from skyquilt.multispectral.placing import _like, _weaker
from skyquilt.multispectral.reflectance import common_kind
from skyquilt.photos.band_tags import BandTags
from skyquilt.photos.together import SECONDS, nearest_in_time
from skyquilt.raster import Block
from skyquilt.workflows.second_camera import far
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
    assert {common_kind(b.converts) for b in found} == {"relative"}


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


def numbered(photos, name, delay_s=0.0):
    """Files of one camera in its own folder, numbered from 1, as if the second had been lost."""
    kept = [p for k, p in enumerate(photos) if name != "nir" or k != 1]
    return [
        replace(p, name=f"{name}/IMG_{k + 1:04d}.tif", time=p.time + timedelta(seconds=delay_s))
        for k, p in enumerate(kept)
    ]


def test_numbers_in_names_do_not_outweigh_times(files):
    photos, told = files
    green, _, nir = bands_of_files(photos)
    a = numbered(green.photos, "green")
    b = replace(nir, photos=tuple(numbered(nir.photos, "nir", 0.1)))
    b = replace(b, tags=tuple(replace(TOLD, name="nir") for _ in b.photos))
    assert captured_together(a, [""] * 5, b) == {0: 0, 2: 1, 3: 2, 4: 3}


def test_times_in_whole_seconds_are_less_than_a_second_off(files):
    photos, told = files
    told |= {name: replace(t, capture="") for name, t in told.items()}
    *_, nir = bands_of_files(photos)
    colours = [
        replace(p, name=f"{9 - k}.jpg", time=p.time + timedelta(seconds=0.2 * k + 0.15))
        for k, p in enumerate(nir.photos)
    ]
    assert captured_together(colours, [""] * 5, nir) == {k: k for k in range(5)}
    assert nearest_in_time(colours, nir.photos, SECONDS) == [(k, k) for k in range(3)]


def test_files_of_two_drones_are_not_mixed():
    """Two drones that take photos at once, which tell no captures."""
    here = GeoPosition(latitude_deg=50.8, longitude_deg=-0.14, altitude_m=60.0, datum="takeoff")
    there = replace(here, latitude_deg=50.801)
    a = [replace(photo("1.tif"), time=NOON, position=p) for p in (here, there)]
    assert nearest_in_time(a, a[::-1], SECONDS) == [(1, 0), (0, 1)]


def test_a_note_tells_which_files_make_all_values_weaker():
    told = dict.fromkeys([f"{k}.tif" for k in range(9)], "relative") | {"bad.tif": "radiance"}
    (note,) = _weaker(told, "radiance")
    assert "1 of 10 files tell no usable irradiance (bad.tif" in note
    assert _weaker(dict.fromkeys(told, "radiance"), "radiance") == []
    assert _weaker(dict.fromkeys(told, "relative"), "relative") == []


def test_values_are_means_where_the_map_is_coarser():
    """Every other pixel of a fine pattern would show one of its two values."""
    rows, columns = np.mgrid[0:60, 0:80]
    values = np.where((rows + columns) % 2, 0.8, 0.2).astype(np.float32)
    values[:, 60:] = np.nan  # saturated
    values[20, 20] = np.nan
    for size, most in ((2.0, 0.15), (5.0, 0.03)):
        found = averaged(values, size)
        known = np.isfinite(found)
        np.testing.assert_allclose(found[known], 0.5, atol=most)
        assert not known[:, 63:].any() and known[:, :58].sum() >= 60 * 58 - 1
    assert averaged(values, 1.4) is values


def test_captures_on_the_way_up_do_not_tell_the_camera():
    heights = [3.0, 12.0, 30.0, 60.0, 62.0, 58.0, 61.0, 20.0]
    poses = {
        i: Pose(cam_R_map=np.diag([1.0, -1.0, -1.0]), map_C=np.array([5.0 * i, 0.0, 200.0 + h]))
        for i, h in enumerate(heights)
    }
    surface = SimpleNamespace(at=lambda x, y: np.full(np.shape(x), 200.0))
    scene = SimpleNamespace(
        aligned=SimpleNamespace(alignment=SimpleNamespace(poses=poses)),
        ground=SimpleNamespace(surface=surface),
    )
    pairs = [(i, i) for i in poses]
    assert far(scene, pairs) == [(i, i) for i in (2, 3, 4, 5, 6)]
    assert far(scene, []) == []


def test_few_blocks_of_many_bands_are_in_memory():
    """However many threads there are, a block of ten bands is forty bytes per pixel."""
    drawing = BandsDrawing(
        output=Path(),
        bands=[None] * 8,
        indices=INDICES[:2],
        ground=None,
        placed=None,
        labels=None,
        blend=None,
        boundary=None,
        pixels_bytes=4 * 2 * 40 * 64 * 64,
        key="",
        tags={},
    )
    asked = []

    def each(work, items):
        asked.append(len(items))
        return map(work, items)

    todo = [Block(row0=0, col0=64 * k, height=64, width=64, tile=64) for k in range(10)]
    found = drawing._few_at_a_time(lambda b: b.col0, todo, SimpleNamespace(each=each))
    assert list(found) == [64 * k for k in range(10)]
    assert asked == [4, 4, 2]


def test_a_guessed_focal_length_is_that_of_the_maps_camera():
    """Of files of one size; those of a smaller camera, or with a calibration, tell their own."""
    one = photo("a.tif")
    guessed = replace(one, calibration=None, focal=replace(one.focal, px=800.0, source="guess"))
    found = Camera.ideal(width=one.width, height=one.height, focal=600.0)
    assert _like(guessed, guessed, found).focal == 600
    small = replace(guessed, width=one.width // 2)
    assert _like(small, guessed, found).focal == 800
    told = replace(guessed, focal=replace(one.focal, px=800.0, source="sensor"))
    assert _like(told, guessed, found).focal == 800
