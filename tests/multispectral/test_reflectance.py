"""Counts made of known reflectances by the makers' published models come back."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from skyquilt.multispectral.reflectance import KINDS, Reflectance, common_kind, smoothed_irradiance
from skyquilt.photos.band_tags import BandTags, Vignetting, read_band_tags
from tests.photos.band_files import dji, micasense, sequoia

HEIGHT, WIDTH = 128, 200
Y, X = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
SHARE = 0.04 + 0.3 * (X + Y) / (HEIGHT + WIDTH) + 0.02 * np.sin(X / 7) * np.cos(Y / 5)
"""Reflectance of the ground."""


def radial(coefficients, centre):
    r = np.sqrt((X - centre[0]) ** 2 + (Y - centre[1]) ** 2)
    return 1 + sum(k * r ** (n + 1) for n, k in enumerate(coefficients))


def of_micasense(share, tags, bits=16):
    """Counts by "RedEdge Camera Radiometric Calibration Model", read backwards."""
    radiance = share * tags.irradiance / math.pi
    a1, a2, a3 = tags.radiometric
    t, V = tags.exposure_s, 1 / radial(tags.vignetting.coefficients, tags.vignetting.centre)
    p = radiance * tags.gain * (t + a2 * Y - a3 * t * Y) / (V * a1) + tags.black_level / 2**bits
    return p * 2**bits


def of_dji(share, tags, factor=0.05):
    """Counts by the guides to the P4 Multispectral and the Mavic 3M, read backwards."""
    camera = share * tags.irradiance / tags.gain_adjustment * factor
    normalised = camera * tags.gain * tags.exposure_s
    normalised = normalised / radial(tags.vignetting.coefficients, tags.vignetting.centre)
    return normalised * 2**16 + tags.black_level


def of_sequoia(share, tags, factor=500.0):
    """Counts by SEQ-AN-01, read backwards."""
    a, b, c = tags.sensor_model
    pairs = zip(tags.vignetting.powers, tags.vignetting.coefficients, strict=True)
    arrives = sum(k * (X / WIDTH) ** i * (Y / HEIGHT) ** j for (i, j), k in pairs)
    light = share * arrives * factor * tags.irradiance
    return light * (a * tags.exposure_s * 100 * tags.gain + c) / tags.f_number**2 + b


@pytest.fixture
def tags_of(tmp_path):
    def read(write, **changes):
        return read_band_tags(write(tmp_path / "a.tif", np.zeros((HEIGHT, WIDTH), "u2"), **changes))

    return read


def recorded(counts):
    assert 5000 < counts.min() and counts.max() < 60_000, (counts.min(), counts.max())
    return np.round(counts).astype(np.uint16)


@pytest.mark.parametrize(
    ("write", "model", "kind"),
    [
        (micasense, of_micasense, "reflectance"),
        (dji, of_dji, "relative"),
        (sequoia, of_sequoia, "by-band"),
    ],
)
def test_known_reflectances_come_back(tags_of, write, model, kind):
    """Within half a count, with one factor where the maker states no absolute one."""
    tags = tags_of(write)
    convert = Reflectance.of(tags, WIDTH, HEIGHT)
    assert (convert.kind, convert.notes) == (kind, ())
    found = convert(recorded(model(SHARE, tags)))
    assert found.dtype == np.float32
    factor = 1.0 if kind == "reflectance" else float(np.median(found / SHARE))
    again = model(found.astype(float) / factor, tags)
    assert np.abs(again - model(SHARE, tags)).max() < 0.55
    assert_allclose(found / factor, SHARE, rtol=3e-3)


def test_bands_of_dji_have_one_factor(tags_of):
    """Whatever the exposure, the gain, and the irradiance of each."""
    told = {"SensorGain": "5", "ExposureTime": "1300", "Irradiance": "16077"}
    told |= {"SensorGainAdjustment": "1.5", "BlackCurrent": "4096"}
    found = []
    for tags in (tags_of(dji), tags_of(dji, **{f"dji__{k}": v for k, v in told.items()})):
        counts = of_dji(SHARE / 2, tags)
        found.append(Reflectance.of(tags, WIDTH, HEIGHT)(counts))
    assert_allclose(*found, rtol=1e-4)


def test_exposures_of_the_sequoia_are_comparable(tags_of):
    """Exposure time, ISO, f-number and light of one photo are not those of the next."""
    tags = tags_of(sequoia)
    other = replace(tags, exposure_s=0.0007, gain=4.0, f_number=2.8, irradiance=2.1)
    found = [Reflectance.of(t, WIDTH, HEIGHT)(of_sequoia(SHARE, t)) for t in (tags, other)]
    assert_allclose(*found, rtol=1e-4)


def test_twelve_bits(tags_of):
    tags = replace(tags_of(micasense), bits=12, black_level=300.0)
    counts = of_micasense(SHARE, tags, 12)
    assert counts.max() < 4092
    convert = Reflectance.of(tags, WIDTH, HEIGHT)
    assert_allclose(convert(counts), SHARE, rtol=1e-4)
    assert np.isnan(convert(np.full((2, 2), 4095, np.uint16))).all()


@pytest.mark.parametrize(("write", "model"), [(micasense, of_micasense), (sequoia, of_sequoia)])
def test_a_part_of_a_photo_is_converted_as_in_the_whole(tags_of, write, model):
    tags = tags_of(write)
    convert, counts = Reflectance.of(tags, WIDTH, HEIGHT), recorded(model(SHARE, tags))
    part = convert(counts[37:90, 110:160], 37, 110)
    assert np.array_equal(part, convert(counts)[37:90, 110:160])


@pytest.mark.parametrize(
    ("dtype", "bits", "full", "most"),
    [
        (np.uint16, 16, 65535, 65471),
        (np.uint16, 16, 65520, 65471),  # 12 bits in 16
        (np.uint16, 16, 65472, 65471),  # 10 bits in 16
        (np.uint16, 12, 4095, 4091),
        (np.uint8, 8, 255, 254),
    ],
)
def test_what_is_saturated_is_not_known(dtype, bits, full, most):
    tags = BandTags(bits=bits, black_level=10, exposure_s=0.001, gain=1.0)
    found = Reflectance.of(tags, 4, 3)(np.array([[full, most, 10, 0]], dtype))
    assert np.isnan(found[0, 0]) and found[0, 1] > 0
    assert list(found[0, 2:]) == [0, 0]


def test_no_measurement_stays_none():
    tags = BandTags(bits=16, black_level=10, exposure_s=0.001, gain=1.0)
    assert np.isnan(Reflectance.of(tags, 4, 3)(np.array([[np.nan]]))).all()


@pytest.mark.parametrize(
    ("write", "changes", "kind"),
    [
        (micasense, {"DLS__HorizontalIrradiance": "0", "DLS__SpectralIrradiance": "0"}, "radiance"),
        (micasense, {"MicaSense__RadiometricCalibration": None}, "by-band"),
        (micasense, {"exposure": 0.0}, "counts"),
        (micasense, {"Camera__BandName": "LWIR"}, "counts"),
        (micasense, {"Camera__IsNormalized": "1"}, "counts"),
        (dji, {"dji__Irradiance": "0"}, "radiance"),
        (dji, {"dji__SensorGainAdjustment": None}, "by-band"),
        (dji, {"dji__BlackCurrent": None}, "counts"),
        (dji, {"dji__SensorGain": "0"}, "counts"),
        (sequoia, {"Camera__IrradianceList": None}, "radiance"),
    ],
)
def test_kinds(tags_of, write, changes, kind):
    convert = Reflectance.of(tags_of(write, **changes), WIDTH, HEIGHT)
    assert convert.kind == kind
    counts = np.full((HEIGHT, WIDTH), 30_000, np.uint16)
    assert (convert(counts) == 30_000).all() == (kind == "counts")


def test_a_file_that_tells_nothing():
    convert = Reflectance.of(BandTags(), WIDTH, HEIGHT)
    counts = np.array([[0, 65535]], np.uint16)
    assert convert.kind == "counts" and np.array_equal(convert(counts), [[0, 65535]])


def test_radiance_is_what_reflectance_is_made_of(tags_of):
    tags = tags_of(micasense)
    full = Reflectance.of(tags, WIDTH, HEIGHT)
    radiance = full.as_kind("radiance")
    counts = recorded(of_micasense(SHARE, tags))
    assert_allclose(radiance(counts), SHARE * tags.irradiance / math.pi, rtol=3e-3)
    assert radiance.with_irradiance(1.0) == radiance
    relative = full.as_kind("relative")(counts)
    assert_allclose(relative * math.pi, full(counts), rtol=1e-5)
    assert np.array_equal(full.as_kind("counts")(counts), counts)
    with pytest.raises(ValueError, match="radiance cannot become reflectance"):
        radiance.as_kind("reflectance")


def test_bands_are_compared_as_the_weakest_of_their_kinds(tags_of):
    full = Reflectance.of(tags_of(dji), WIDTH, HEIGHT)
    bands = [full, full.with_irradiance(None), full]
    assert common_kind(bands) == "radiance"
    assert {b.as_kind("radiance").kind for b in bands} == {"radiance"}
    assert [common_kind([full.as_kind(k), full]) for k in KINDS[:4]] == list(KINDS[:4])
    assert common_kind([]) == "counts"


@pytest.mark.parametrize("broken", [None, 0.0, -1.0, math.nan, math.inf, 3.5])
def test_a_broken_sun_sensor_is_not_divided_by(tags_of, broken):
    """A reading that others replace later makes it reflectance again."""
    tags = tags_of(micasense)
    full = Reflectance.of(tags, WIDTH, HEIGHT)
    assert full.with_irradiance(broken) == replace(full, kind="radiance", irradiance=None)
    assert full.with_irradiance(broken).with_irradiance(tags.irradiance) == full


@pytest.mark.parametrize(
    ("vignetting", "told"),
    [
        (Vignetting(coefficients=(-0.05,), centre=(98, 61)), "between"),
        (Vignetting(coefficients=(1e9,) * 8, centre=(98, 61)), "between"),
        (Vignetting(coefficients=(-1e-4,), centre=(800, 600)), "not in the middle"),
        (Vignetting(coefficients=(0.0,), powers=((0, 0),)), "between"),
    ],
)
def test_a_fall_off_that_no_lens_has_is_not_corrected(tags_of, vignetting, told):
    tags = replace(tags_of(micasense), vignetting=vignetting)
    found = Reflectance.of(tags, WIDTH, HEIGHT)
    assert found.vignetting is None and told in found.notes[0]
    assert found == replace(
        Reflectance.of(replace(tags, vignetting=None), WIDTH, HEIGHT), notes=found.notes
    )


def test_a_gradient_of_rows_that_no_shutter_has_is_not_corrected(tags_of):
    tags = replace(tags_of(micasense), radiometric=(1e-4, -0.1, 0.0))
    found = Reflectance.of(tags, WIDTH, HEIGHT)
    assert found.gradient == 0 and "gradient of rows" in found.notes[0]


# -- the sun sensor

readings = st.lists(st.floats(0.01, 100), min_size=1, max_size=40)
quick = settings(max_examples=40, deadline=None)


@quick
@given(readings, st.floats(0.01, 100), st.randoms(use_true_random=False))
def test_smoothing_keeps_units_order_and_range(values, factor, random):
    times = [2.0 * k for k in range(len(values))]
    found = smoothed_irradiance(times, values)
    assert found == pytest.approx(smoothed_irradiance(times, np.multiply(values, factor)) / factor)
    assert min(values) * 0.999 <= found.min() and found.max() <= max(values) * 1.001
    order = list(range(len(values)))
    random.shuffle(order)
    mixed = smoothed_irradiance([times[k] for k in order], [values[k] for k in order])
    assert mixed == pytest.approx(found[order])


@quick
@given(st.lists(st.booleans(), min_size=24, max_size=60), st.data())
def test_lasting_changes_stay_and_single_readings_do_not(bad, data):
    """Light that changes at most once in 11 captures, and at most two wild readings in each 11."""
    bad = [b and not any(bad[max(k - 5, 0) : k]) for k, b in enumerate(bad)]
    step = data.draw(st.integers(11, len(bad) - 11))
    light = np.where(np.arange(len(bad)) < step, 1.0, 0.4)
    wild = data.draw(st.lists(st.sampled_from([0.0, -1.0, np.nan, 0.01, 9.0]), min_size=60))
    seen = [w if b else v for v, b, w in zip(light, bad, wild, strict=False)]
    found = smoothed_irradiance(np.arange(len(bad)) * 2.0, seen)
    far = np.abs(np.arange(len(bad)) - step) > 2
    assert found[far] == pytest.approx(light[far])


@pytest.mark.parametrize("count", [3, 4, 5, 12])
@pytest.mark.parametrize("wild", [0.3, 2.5])
def test_one_wild_reading_of_a_few(count, wild):
    for at in range(count):
        seen = [wild if k == at else 1.0 for k in range(count)]
        assert list(smoothed_irradiance(range(count), seen)) == [1.0] * count


def test_jitter_is_smoothed():
    rng = np.random.default_rng(1)
    light = np.where(np.arange(400) % 100 < 60, 1.0, 0.5)
    seen = light * (1 + 0.03 * rng.normal(size=400))
    off = smoothed_irradiance(np.arange(400.0), seen) / light - 1
    assert np.std(seen / light) > 0.027 and np.std(off) < 0.014
    assert np.abs(off).max() < 0.06


def test_readings_long_ago_and_without_a_time():
    times = [0, 1, 2, 500, 501, 502, np.nan]
    found = smoothed_irradiance(times, [1, 1, 1, 2, 2, 2, 5])
    assert list(found) == [1, 1, 1, 2, 2, 2, 5]
    assert np.isnan(smoothed_irradiance([0, 1], [0, np.nan])).all()
    assert smoothed_irradiance([0, 1, 2], [1, np.nan, 1])[1] == 1
    assert smoothed_irradiance([], []).shape == (0,)
    with pytest.raises(ValueError, match="readings"):
        smoothed_irradiance([0, 1], [1])
