"""What files of multispectral cameras tell of their band, as the makers write it."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.bands import canonical
from skyquilt.photos.band_tags import BandTags, Vignetting, read_band_tags
from skyquilt.photos.read import read_photo

from .band_files import DJI, MICASENSE, SEQUOIA, dji, micasense, packet, reading, sequoia
from .conftest import dji_exif

COUNTS = np.full((128, 200), 20_000, np.uint16)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.tif"


def test_micasense(path):
    assert read_band_tags(micasense(path, COUNTS)) == BandTags(
        name="red edge",
        wavelength_nm=717,
        width_nm=12,
        capture="DFj0YDYQsRJd6hDUj7qZ",
        index=4,
        black_level=4800,
        bits=16,
        exposure_s=0.0004,
        gain=2.0,
        f_number=2.8,
        radiometric=(0.00014576, 1.394e-07, 1.171e-05),
        vignetting=Vignetting(
            coefficients=MICASENSE["Camera__VignettingPolynomial"], centre=(98.5, 61.25)
        ),
        irradiance=pytest.approx(1.1825),
        irradiance_si=True,
    )


@pytest.mark.parametrize(
    ("changes", "irradiance"),
    [
        ({"DLS__IrradianceScaleToSIUnits": None}, 1.1825),
        ({"DLS__HorizontalIrradiance": None}, 1.015),
        (  # the first sun sensor: W/m2/nm, and nothing but what it measured
            {"DLS__HorizontalIrradiance": None, "DLS__IrradianceScaleToSIUnits": None}
            | {"DLS__SpectralIrradiance": "0.875"},
            0.875,
        ),
        ({"DLS__HorizontalIrradiance": None, "DLS__IrradianceScaleToSIUnits": None}, 1.015),
        ({"model": "Altum", "software": "v1.2.1"}, 1.015),
        ({"model": "Altum", "software": "v1.2.3"}, 1.1825),
        ({"model": "Altum-PT", "software": "v1.2.1"}, 1.1825),
        ({"DLS__HorizontalIrradiance": "0"}, 1.015),
        ({"DLS__HorizontalIrradiance": "11825"}, None),
        ({"DLS__HorizontalIrradiance": None, "DLS__SpectralIrradiance": None}, None),
        ({"Camera__BandName": "LWIR"}, None),
    ],
)
def test_irradiance_of_micasense(path, changes, irradiance):
    tags = read_band_tags(micasense(path, COUNTS, **changes))
    assert tags.irradiance == (irradiance and pytest.approx(irradiance))
    assert tags.irradiance_si == (irradiance is not None)


@pytest.mark.parametrize(("model", "true"), [("RedEdge", 0.000274), ("RedEdge-P", 0.000158)])
def test_the_exposure_time_that_early_cameras_write_is_wrong(path, model, true):
    tags = read_band_tags(micasense(path, COUNTS, exposure=1 / 6329, model=model))
    assert tags.exposure_s == pytest.approx(true, abs=1e-6)


def test_dji(path):
    photo, tags = read_photo(dji(path, COUNTS)), read_band_tags(path)
    assert tags == BandTags(
        name="rededge",
        wavelength_nm=730,
        width_nm=32,
        capture="3377fb05-b357-448f-b87b-7023daebbaed",
        index=3,
        black_level=3200,
        bits=16,
        exposure_s=0.0008,
        gain=2.5,
        gain_adjustment=0.9375,
        vignetting=Vignetting(
            coefficients=(1e-4, 2e-6, 1e-8, 1e-11, 1e-14, 1e-17),
            centre=(101.5, 66.5),
            corrects=True,
        ),
        irradiance=9741.75,
    )
    assert photo.band_name == "red edge"


def test_the_phantom_4_multispectral_writes_its_black_level_as_raw_pictures_do(path):
    told = {"dji__BlackCurrent": None, "dji__BandFreq": "840 (+/- 26) nm", "dji__BandName": "NIR"}
    tags = read_band_tags(dji(path, COUNTS, "FC6360", [(50714, 4096)], **told))
    assert (tags.black_level, tags.wavelength_nm, tags.width_nm) == (4096, 840, 52)


def test_dji_under_the_names_of_pix4d(path):
    more = {"Camera__VignettingCenter": "101.5,66.5", "Camera__VignettingPolynomial": "1e-4,2e-6"}
    more |= {"Camera__Irradiance": "7", "Camera__CentralWavelength": "731"}
    without = dict.fromkeys(k for k in DJI if "Vignetting" in k or "Optical" in k)
    tags = read_band_tags(dji(path, COUNTS, **without, **more))
    assert tags.vignetting == Vignetting(
        coefficients=(1e-4, 2e-6), centre=(101.5, 66.5), corrects=True
    )
    assert (tags.irradiance, tags.wavelength_nm, tags.width_nm) == (9741.75, 731, 32)
    assert read_band_tags(dji(path, COUNTS, dji__Irradiance=None, **more)).irradiance == 7


def test_bands_of_a_camera_that_names_them_in_its_own_way_are_cameras(path):
    """Each has a lens of its own; a camera that uses Pix4D's names keeps its key."""
    keys = {read_photo(dji(path, COUNTS, dji__BandName=n)).camera_key for n in ("Red", "NIR")}
    assert keys == {"dji m3m red 200x128", "dji m3m nir 200x128"}
    assert read_photo(micasense(path, COUNTS)).camera_key == "micasense rededge-m red edge 200x128"


def test_sequoia(path):
    tags = read_band_tags(sequoia(path, COUNTS))
    assert tags == BandTags(
        name="nir",
        wavelength_nm=790,
        width_nm=40,
        capture="B9A2F3676304A83F92261B5245124F28",
        index=3,
        bits=16,
        exposure_s=0.00125,
        gain=1.0,
        f_number=2.2,
        sensor_model=(1.04, 3997.5, 180.25),
        vignetting=Vignetting(
            coefficients=(0.55, 0.9, 0.85, -0.91, 0.01, -0.84),
            powers=((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)),
        ),
        irradiance=3.3,
    )


def test_readings_of_the_sequoia_with_another_gain_are_made_comparable(path):
    """The same light by the calibration, in which 33 and 820 counts are the same."""
    low = [reading(33, 0, 600), reading(65535, 1, 600), reading(0, 1)]
    usual = [reading(820, 1, 600)]
    found = [read_band_tags(sequoia(path, COUNTS, r)).irradiance for r in (low, usual)]
    assert found == pytest.approx([820 / 600] * 2)
    bare = {"Camera__IrradianceCalibrationMeasurement": None}
    found = [read_band_tags(sequoia(path, COUNTS, r, **bare)).irradiance for r in (low, usual)]
    assert found == [None, pytest.approx(820 / 600)]


@pytest.mark.parametrize("cut", [1, 2, 3, 7])
def test_a_torn_list_of_the_sequoia_gives_its_whole_readings(path, cut):
    xmp = sequoia(path, COUNTS, [reading(300), reading(500), reading(900)]).read_bytes()
    end = xmp.index(b"Camera:IrradianceList=") + 23 + 112
    assert xmp[end : end + 1] == b'"'
    path.write_bytes(xmp[: end - cut] + b" ..."[:cut] + b" " * (cut - 4) + xmp[end:])
    assert read_band_tags(path).irradiance == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("name", "wavelength", "same"),
    [
        ("RedEdge", None, "red edge"),
        ("Red edge", None, "red edge"),
        ("REDEDGE", 840, "red edge"),
        ("red_edge", None, "red edge"),
        ("NIR", None, "nir"),
        ("Panchro", None, "panchro"),
        ("LWIR", 11000, "lwir"),
        ("blue-444", 444, "blue-444"),
        ("", 475, "blue"),
        ("", 560, "green"),
        ("", 668, "red"),
        ("", 717, "red edge"),
        ("", 860, "nir"),
        ("", 605, ""),
        ("", None, ""),
    ],
)
def test_names(name, wavelength, same):
    assert canonical(name, wavelength) == same


@pytest.mark.parametrize(
    ("write", "changes", "lost", "told"),
    [
        (dji, {"dji__BandFreq": "green"}, "wavelength_nm", "BandFreq"),
        (dji, {"dji__BandFreq": "5(+/-16)nm"}, "wavelength_nm", "BandFreq"),
        (dji, {"dji__SensorGain": "-1"}, "gain", "SensorGain"),
        (dji, {"dji__SensorGainAdjustment": "nan"}, "gain_adjustment", "SensorGainAdjustment"),
        (dji, {"dji__ExposureTime": "0"}, "exposure_s", "ExposureTime"),
        (dji, {"dji__Irradiance": "-5"}, "irradiance", "Irradiance"),
        (dji, {"dji__BlackCurrent": "70000"}, "black_level", "BlackCurrent"),
        (dji, {"dji__VignettingData": "1, x, 3"}, "vignetting", "VignettingData"),
        (dji, {"dji__VignettingData": ",".join("1" * 99)}, "vignetting", "VignettingData"),
        (dji, {"dji__CalibratedOpticalCenterX": "nan"}, "vignetting", "vignetting"),
        (micasense, {"MicaSense__RadiometricCalibration": (1, 2)}, "radiometric", "Radiometric"),
        (micasense, {"MicaSense__RadiometricCalibration": (0, 0, 0)}, "radiometric", "Radiometric"),
        (micasense, {"Camera__WavelengthFWHM": "1e9"}, "width_nm", "WavelengthFWHM"),
        (micasense, {"exposure": 0.0}, "exposure_s", "exposure time"),
        (sequoia, {"Camera__SensorModel": "1,2"}, "sensor_model", "SensorModel"),
        (sequoia, {"Camera__SensorModel": "1,-2,3"}, "sensor_model", "SensorModel"),
        (sequoia, {"Camera__VignettingPolynomial2D": "1"}, "vignetting", "2DName"),
        (
            sequoia,
            {"Camera__VignettingPolynomial2DName": "0,99" + ",0" * 10},
            "vignetting",
            "2DName",
        ),
        (sequoia, {"Camera__IrradianceList": "~~~"}, "irradiance", "IrradianceList"),
    ],
)
def test_nonsense_is_ignored_and_named(path, write, changes, lost, told):
    good = read_band_tags(write(path, COUNTS))
    assert good.notes == () and getattr(good, lost) is not None
    found = read_band_tags(write(path, COUNTS, **changes))
    assert getattr(found, lost) is None
    assert any(told in note for note in found.notes), found.notes
    others = {f.name for f in fields(BandTags)} - {lost, "notes", "width_nm"}
    assert all(getattr(found, n) == getattr(good, n) for n in others)


@pytest.mark.parametrize(("said", "dtype"), [("1", np.uint16), (None, np.float32)])
def test_values_that_are_no_counts(path, said, dtype):
    assert read_band_tags(
        micasense(path, COUNTS.astype(dtype), Camera__IsNormalized=said)
    ).normalised
    assert not read_band_tags(micasense(path, COUNTS)).normalised


def test_a_usual_photo_tells_no_band(make_jpeg):
    tags = read_band_tags(make_jpeg(exif=dji_exif()))
    assert tags == BandTags(bits=8)


def test_no_photo(tmp_path):
    with pytest.raises(UnreadablePhotoError):
        read_band_tags(tmp_path / "none.tif")


ANY = st.sampled_from(
    ["", "0", "-1", "nan", "1e308", "1e-308", "1,2", "a", "1/0", "9" * 60, "\u2028"]
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_any_values(make_jpeg, data):
    """Whatever is written, each value found is finite and each note one line."""
    names = st.sampled_from(sorted({*MICASENSE, *DJI, *SEQUOIA, "Camera__IrradianceList"}))
    told = data.draw(st.dictionaries(names, ANY, max_size=12))
    tags = read_band_tags(make_jpeg(exif=dji_exif(), xmp=packet("attributes", **told)))
    numbers = [v for f in fields(tags) if isinstance(v := getattr(tags, f.name), float)]
    assert np.isfinite(numbers).all()
    assert all(note.isprintable() for note in tags.notes)


@pytest.mark.parametrize(
    ("name", "wavelength", "shown"),
    [
        ("RedEdge", "730", "red edge"),
        ("Red edge", "717", "red edge"),
        (None, "842", "nir"),
        ("Red-650", "650", "red-650"),  # the second red of ten bands
        (None, None, ""),
    ],
)
def test_bands_have_one_name_however_they_are_told(tmp_path, name, wavelength, shown):
    told = {"Camera__BandName": name, "Camera__CentralWavelength": wavelength}
    path = micasense(tmp_path / "a.tif", np.zeros((60, 80), np.uint16), **told)
    assert read_photo(path).band_name == shown
