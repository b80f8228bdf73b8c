import math
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
import tifffile

from skyquilt.errors import NoPhotosError
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.flir import FlirCamera
from skyquilt.photos.pixels import read_color, read_gray
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import read_survey
from skyquilt.photos.thermal import thermal_frame_of_values

from .conftest import jpeg_bytes, pixels, with_segment

R1, B, F, OFFSET, R2 = 17096.453, 1428.0, 1.0, -342, 0.046642166
EMISSIVITY, REFLECTED_K, AIR_K, HUMIDITY, DISTANCE = 0.95, 295.15, 290.15, 0.5, 20.0
ALPHA1, ALPHA2, BETA1, BETA2, X = 0.006569, 0.01262, -0.002276, -0.00667, 1.9


def planck_counts(celsius):
    """Counts of a black body; the published calibration curve."""
    return R1 / (R2 * (np.exp(B / (np.asarray(celsius) + 273.15)) - F)) - OFFSET


def seen_counts(celsius):
    """Counts of a grey body behind air, with what it reflects: the forward radiance budget."""
    t = AIR_K - 273.15
    water = math.sqrt(
        HUMIDITY * math.exp(1.5587 + 6.939e-2 * t - 2.7816e-4 * t * t + 6.8455e-7 * t**3)
    )
    d = math.sqrt(DISTANCE)
    tau = X * math.exp(-d * (ALPHA1 + BETA1 * water)) + (1 - X) * math.exp(
        -d * (ALPHA2 + BETA2 * water)
    )
    own = EMISSIVITY * tau * planck_counts(celsius)
    return (
        own
        + (1 - EMISSIVITY) * tau * planck_counts(REFLECTED_K - 273.15)
        + (1 - tau) * planck_counts(t)
    )


def camera_record():
    record = bytearray(0x400)
    struct.pack_into("<H", record, 0, 2)
    for offset, value in {
        0x20: EMISSIVITY,
        0x24: DISTANCE,
        0x28: REFLECTED_K,
        0x2C: AIR_K,
        0x30: 293.15,
        0x34: 1.0,
        0x3C: HUMIDITY,
        0x58: R1,
        0x5C: B,
        0x60: F,
        0x30C: R2,
        0x70: ALPHA1,
        0x74: ALPHA2,
        0x78: BETA1,
        0x7C: BETA2,
        0x80: X,
    }.items():
        struct.pack_into("<f", record, offset, value)
    struct.pack_into("<i", record, 0x308, OFFSET)
    return bytes(record)


def flir_jpeg(counts, *, as_png=True, camera=True, chunk=3000):
    """A FLIR radiometric JPEG by the published layout, its FFF block split over several
    segments.
    """
    height, width = counts.shape
    body = (
        cv2.imencode(".png", counts.byteswap())[1].tobytes()
        if as_png
        else counts.astype("<u2").tobytes()
    )
    raw = struct.pack("<HHH", 2, width, height).ljust(32, b"\0") + body
    records = [(1, raw)] + ([(0x20, camera_record())] if camera else [])
    offset = 64 + 32 * len(records)
    directory, bodies = b"", b""
    for kind, record in records:
        directory += struct.pack(
            ">HHIIIIIII", kind, 0, 0, 0, offset + len(bodies), len(record), 0, 0, 0
        )
        bodies += record
    head = b"FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 101, 64, len(records))
    block = head.ljust(64, b"\0") + directory + bodies
    chunks = [block[i : i + chunk] for i in range(0, len(block), chunk)]
    data = jpeg_bytes(pixels(80, 60))
    for i, part in reversed(list(enumerate(chunks))):
        data = with_segment(data, 0xE1, b"FLIR\0\x01" + bytes([i, len(chunks) - 1]) + part)
    return data


def scene(height=60, width=80):
    return np.linspace(-20, 60, height * width).reshape(height, width)


@pytest.mark.parametrize("as_png", [True, False])
def test_flir_counts_become_the_temperatures_they_came_from(tmp_path, as_png):
    celsius = scene()
    counts = np.round(seen_counts(celsius)).astype(np.uint16)
    (tmp_path / "a.jpg").write_bytes(flir_jpeg(counts, as_png=as_png))
    photo = read_photo(tmp_path / "a.jpg")
    assert (photo.band, photo.unit, photo.dtype, photo.channels) == (
        "thermal",
        "celsius",
        "float32",
        1,
    )
    assert (photo.width, photo.height) == (80, 60)
    values = read_color(photo)
    assert values.dtype == np.float32
    assert np.abs(values - celsius).max() < 0.06  # one count is 0.02 to 0.05 K here
    assert read_gray(photo).dtype == np.uint8


def test_flir_without_constants_keeps_counts(tmp_path):
    counts = np.round(planck_counts(scene())).astype(np.uint16)
    (tmp_path / "a.jpg").write_bytes(flir_jpeg(counts, camera=False))
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.unit == "counts"
    assert np.array_equal(read_color(photo), counts)


def test_counts_that_are_no_radiance_are_nan():
    camera = FlirCamera(planck_r1=R1, planck_b=B, planck_f=F, planck_o=OFFSET, planck_r2=R2)
    celsius = camera.celsius(np.array([[0, 14000]], np.uint16))
    assert np.isnan(celsius[0, 0])
    assert np.isfinite(celsius[0, 1])


def dji_jpeg(tmp_path, counts, short=0, name="t.jpg"):
    exif = {"0th": {0x010F: "DJI", 0x0110: "MAVIC2-ENTERPRISE-ADVANCED"}}
    data = jpeg_bytes(pixels(counts.shape[1], counts.shape[0]), exif)
    raw = counts.astype("<u2").tobytes()[: -short or None]
    for i in reversed(range(0, len(raw), 65532)):
        data = with_segment(data, 0xE3, raw[i : i + 65532])
    (tmp_path / name).write_bytes(data)
    return read_photo(tmp_path / name)


def test_dji_counts_come_back_and_the_palette_does_not(tmp_path):
    counts = np.arange(640 * 512, dtype=np.uint32).reshape(512, 640).astype(np.uint16)
    photo = dji_jpeg(tmp_path, counts)
    assert (photo.band, photo.unit, photo.focal.source, photo.focal.px) == (
        "thermal",
        "counts",
        "sensor",
        750,
    )
    assert np.array_equal(read_color(photo), counts)
    assert read_color(photo, reduction=4).shape == (128, 160)


def test_dji_frame_of_a_wrong_size_is_no_frame(tmp_path):
    photo = dji_jpeg(tmp_path, np.zeros((512, 640), np.uint16), short=2)
    assert isinstance(photo, Photo)
    assert (photo.band, photo.unit, photo.dtype) == (
        "thermal",
        "",
        "uint8",
    )  # the model is known to be thermal


@pytest.mark.parametrize(
    ("values", "unit", "first"),
    [
        (np.full((9, 9), 29515, np.uint16), "celsius", 22.0),
        (np.full((9, 9), 2951, np.uint16), "celsius", 21.95),
        (np.full((9, 9), 300.15, np.float32), "celsius", 27.0),
        (np.full((9, 9), 21.5, np.float32), "celsius", 21.5),
        (np.full((9, 9), 7000, np.uint16), "counts", 7000.0),
    ],
)
def test_units_of_thermal_tiffs(values, unit, first):
    frame = thermal_frame_of_values(values)
    assert (frame.unit, float(frame.values[0, 0])) == (unit, pytest.approx(first, abs=1e-3))
    assert f"{np.median(values):g}" in frame.note


def test_thermal_tiff_from_file(tmp_path):
    values = np.full((60, 80), 29515, np.uint16)
    values[0, 0] = 0
    tifffile.imwrite(tmp_path / "t.tif", values, extratags=[(272, "s", 0, "Vue Pro R", True)])
    assert (
        read_photo(tmp_path / "t.tif").unit == ""
    )  # a camera of that name has no 80 px mode: not known as thermal
    tifffile.imwrite(tmp_path / "u.tif", values.astype(np.float32) / 100)
    photo = read_photo(tmp_path / "u.tif")
    assert (photo.band, photo.unit) == ("thermal", "celsius")
    assert read_color(photo)[1, 1] == pytest.approx(22.0, abs=1e-3)


@pytest.mark.parametrize(
    ("stated", "values", "unit", "first"),
    [
        (
            "unit: centikelvin (temperature in K times 100)",
            np.full((60, 80), 29515, np.uint16),
            "celsius",
            22.0,
        ),
        ("Unit=Kelvin", np.full((60, 80), 300.15, np.float32), "celsius", 27.0),
        (
            "unit: celsius",
            np.full((60, 80), 290.0, np.float32),
            "celsius",
            290.0,
        ),  # a furnace, not 17 degrees
        ("unit: counts", np.full((60, 80), 29515, np.uint16), "counts", 29515.0),
        ("unit: decikelvin", np.full((60, 80), 2951, np.uint16), "celsius", 21.95),
    ],
)
def test_a_stated_unit_is_believed_whatever_the_values(tmp_path, stated, values, unit, first):
    tifffile.imwrite(tmp_path / "t.tif", values, description=stated)
    photo = read_photo(tmp_path / "t.tif")
    assert (photo.band, photo.unit) == ("thermal", unit)
    assert read_color(photo)[1, 1] == pytest.approx(first, abs=1e-3)
    assert any("as stated by the file or --thermal-unit" in n for n in photo.notes)


def test_gdal_says_the_unit_of_a_band(tmp_path):
    xml = '<GDALMetadata><Item name="UNITTYPE" sample="0" role="unittype">K</Item></GDALMetadata>'
    tifffile.imwrite(
        tmp_path / "t.tif",
        np.full((60, 80), 300.15, np.float32),
        extratags=[(42112, "s", 0, xml, True)],
    )
    assert read_color(read_photo(tmp_path / "t.tif"))[0, 0] == pytest.approx(27.0, abs=1e-3)


def test_sixteen_bits_without_a_word_are_a_picture_until_somebody_says_what_they_are(tmp_path):
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), 29515, np.uint16))
    assert (read_photo(tmp_path / "t.tif").band, read_photo(tmp_path / "t.tif").unit) == (
        "visible",
        "",
    )
    found = {
        u: read_photo(tmp_path / "t.tif", thermal_unit=u) for u in ("auto", "centikelvin", "counts")
    }
    assert {u: p.unit for u, p in found.items()} == {
        "auto": "celsius",
        "centikelvin": "celsius",
        "counts": "counts",
    }
    assert any("no unit is stated" in n for n in found["auto"].notes)
    assert float(read_color(found["counts"])[0, 0]) == 29515


def test_a_note_says_what_to_give_if_sixteen_bits_are_temperatures(tmp_path):
    for k in range(3):
        tifffile.imwrite(tmp_path / f"t{k}.tif", np.full((60, 80), 29515 + k, np.uint16))
    told = read_survey(tmp_path).notes
    assert any("3 photos have one band of 16 bits" in n and "--thermal-unit" in n for n in told)
    (tmp_path / "rgb").mkdir()
    tifffile.imwrite(tmp_path / "rgb" / "t.tif", np.full((60, 80, 3), 29515, np.uint16))
    assert not any("--thermal-unit" in n for n in read_survey(tmp_path / "rgb").notes)


@pytest.mark.parametrize(
    ("kind", "unit", "per", "zero"),
    [
        (np.int16, "decicelsius", 10, 0.0),
        (np.int16, "centicelsius", 100, 0.0),
        (np.int16, "decikelvin", 10, 273.15),
        (np.uint16, "decikelvin", 10, 273.15),
        (np.uint16, "centikelvin", 100, 273.15),
        (np.int32, "centikelvin", 100, 273.15),
    ],
)
def test_integers_with_a_sign_may_be_parts_of_a_degree(tmp_path, kind, unit, per, zero):
    """Programs write tenths of a degree Celsius into 16 bits with a sign; these were taken for
    kelvin, 38 degrees below zero, or mapped as brightness without a word.
    """
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80))
    values = np.round((degrees + zero) * per).astype(kind)
    tifffile.imwrite(tmp_path / "t.tif", values)
    assert read_photo(tmp_path / "t.tif").unit == ""
    assert any("give --thermal-unit" in n for n in read_survey(tmp_path).notes)
    for said in ("auto", unit):
        photo = read_photo(tmp_path / "t.tif", thermal_unit=said)
        assert (photo.unit, photo.stored) == ("celsius", unit)
        np.testing.assert_allclose(read_color(photo), degrees, atol=0.06)


def test_a_unit_that_was_derived_is_told_with_what_it_makes_of_the_values(tmp_path):
    """23.5 degrees in hundredths, of which only the user knows that they are not kelvin."""
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), 2350, np.uint16))
    told = " ".join(read_survey(tmp_path, thermal_unit="auto").notes)
    assert "decikelvin, -38.1 degrees Celsius; no unit is stated (set it with" in told
    stated = " ".join(read_survey(tmp_path, thermal_unit="decikelvin").notes)
    assert "degrees" not in stated and "Thermal TIFFs are read as decikelvin (1)." in stated


@pytest.mark.parametrize("name", ["", "Red"])
def test_shares_of_light_are_no_temperatures(tmp_path, name):
    """A reflectance of 0.05 to 0.4, an index, or a band of a multispectral camera."""
    values = np.random.default_rng(6).uniform(0.05, 0.4, (60, 80)).astype(np.float32)
    if name:
        values *= 50
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        f' xmlns:Camera="http://pix4d.com/camera/1.0" Camera:BandName="{name}"/></rdf:RDF>'
        "</x:xmpmeta>"
    )
    more = [(700, "B", len(xmp), xmp.encode(), True)] if name else []
    tifffile.imwrite(tmp_path / "t.tif", values, extratags=more)
    photo = read_photo(tmp_path / "t.tif")
    assert (photo.band, photo.unit, photo.band_name) == ("visible", "", name.lower())
    assert any("give --thermal-unit" in n for n in read_survey(tmp_path).notes) == (not name)


def test_frames_of_one_survey_are_read_alike(tmp_path):
    """A hot frame's median lies where no temperature of tenths of a kelvin is; what was decided is
    what is read.
    """
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), 43000, np.uint16))
    assert read_photo(tmp_path / "t.tif", thermal_unit="auto").unit == "counts"
    hot = read_photo(tmp_path / "t.tif", thermal_unit="centikelvin")
    assert read_color(hot)[0, 0] == pytest.approx(156.85, abs=1e-2)


def test_a_broken_flir_block_is_no_temperature(tmp_path):
    """What remains is the palette, and nothing calls it degrees."""
    data = bytearray(flir_jpeg(np.round(planck_counts(scene())).astype(np.uint16)))
    at = data.index(b"FFF\0")
    data[at + 24 : at + 32] = b"\xff" * 8  # where the records lie
    (tmp_path / "a.jpg").write_bytes(bytes(data))
    photo = read_photo(tmp_path / "a.jpg")
    assert isinstance(photo, Photo) and photo.unit == "" and photo.dtype == "uint8"


def void_tag(text):
    return (42113, "s", 0, str(text), True)


@pytest.mark.parametrize(
    ("kind", "per", "zero", "fill", "told"),
    [
        (np.float32, 1, 0.0, -9999, False),
        (np.float32, 1, 0.0, -9999, True),
        (np.float32, 1, 0.0, 0, True),
        (np.float32, 1, 0.0, -3.4028234663852886e38, True),
        (np.float64, 1, 0.0, -1.7976931348623157e308, True),
        (np.float32, 1, 0.0, 1e20, False),
        (np.float32, 1, 0.0, np.inf, False),
        (np.float32, 1, 0.0, -np.inf, False),
        (np.float32, 1, 273.15, -9999, False),
        (np.int16, 10, 0.0, -9999, False),
        (np.int16, 10, 0.0, -32768, False),
        (np.int16, 100, 0.0, -9999, False),
        (np.int16, 100, 0.0, 32767, True),
        (np.uint16, 100, 273.15, 65535, True),
        (np.int32, 100, 273.15, -2147483648, False),
    ],
)
def test_values_with_which_programs_fill_gaps_are_no_temperatures(
    tmp_path, kind, per, zero, fill, told
):
    """They were mapped as temperatures, of -9999 degrees or infinite, without a word."""
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80))
    values = ((degrees + zero) * per).astype(kind)
    values[:40] = fill  # most of the frame
    tags = [void_tag(repr(fill))] if told else []
    tifffile.imwrite(tmp_path / "t.tif", values, extratags=tags)
    photo = read_photo(tmp_path / "t.tif", thermal_unit="auto")
    assert photo.unit == "celsius"
    found = read_color(photo)
    assert np.isnan(found[:40]).all()
    np.testing.assert_allclose(found[40:], degrees[40:], atol=0.11)


def test_pictures_are_black_where_gdal_says_that_there_is_none(tmp_path):
    values = np.random.default_rng(5).integers(10, 250, (60, 80, 3)).astype(np.uint8)
    values[:20] = 255
    values[30, 30] = 255, 10, 255  # pink, and no gap
    tifffile.imwrite(tmp_path / "t.tif", values, photometric="rgb", extratags=[void_tag(255)])
    found = read_color(read_photo(tmp_path / "t.tif"))
    assert (found[:20] == 0).all()
    assert np.array_equal(found[20:], values[20:])


def test_a_preview_before_the_measurements_is_not_taken_for_them(tmp_path):
    """Programs write a picture in false colours first; it was mapped, without a word."""
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80)).astype(np.float32)
    preview = np.zeros((120, 160, 3), np.uint8)
    with tifffile.TiffWriter(tmp_path / "t.tif") as out:
        out.write(preview, photometric="rgb", extratags=[(272, "s", 0, "Camera", True)])
        out.write(degrees)
    with tifffile.TiffWriter(tmp_path / "u.tif") as out:
        out.write(preview[::3, ::3], photometric="rgb", subfiletype=1, subifds=1)
        out.write(degrees)
    for name in "tu":
        photo = read_photo(tmp_path / f"{name}.tif", thermal_unit="auto")
        assert (photo.width, photo.height, photo.unit) == (80, 60, "celsius")
        assert any("first page is a preview" in n for n in photo.notes)
        np.testing.assert_array_equal(read_color(photo), degrees)
    with tifffile.TiffWriter(tmp_path / "v.tif") as out:
        out.write(degrees)
        out.write(preview, photometric="rgb")
    photo = read_photo(tmp_path / "v.tif")
    assert any("It has 2 pages; the first (80x60 px" in n for n in photo.notes)
    np.testing.assert_array_equal(read_color(photo), degrees)


@pytest.mark.parametrize("planar", ["separate", "contig"])
def test_a_second_band_of_unknown_meaning_is_left_out(tmp_path, planar):
    """Such files ended the run with an error of OpenCV."""
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80)).astype(np.float32)
    both = np.stack([degrees, np.ones_like(degrees)], 0 if planar == "separate" else -1)
    tifffile.imwrite(
        tmp_path / "t.tif", both, planarconfig=planar, photometric="minisblack", metadata=None
    )
    photo = read_photo(tmp_path / "t.tif")
    assert (photo.channels, photo.unit) == (1, "celsius")
    assert any("second band" in n for n in photo.notes)
    np.testing.assert_array_equal(read_color(photo), degrees)


@pytest.mark.parametrize("unit", ["degC", ""])
def test_gdal_scale_and_offset_make_degrees_of_integers(tmp_path, unit):
    """They were taken for 20,000 degrees."""
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80))
    items = '<Item name="OFFSET" sample="0" role="offset">-40</Item>'
    items += '<Item name="SCALE" sample="0" role="scale">0.0025</Item>'
    items += f'<Item name="UNITTYPE" sample="0" role="unittype">{unit}</Item>' if unit else ""
    values = np.round((degrees + 40) * 400).astype(np.uint16)
    values[0] = 7
    xml = f"<GDALMetadata>{items}</GDALMetadata>"
    tifffile.imwrite(
        tmp_path / "t.tif", values, extratags=[(42112, "s", 0, xml, True), void_tag(7)]
    )
    photo = read_photo(tmp_path / "t.tif", thermal_unit=None if unit else "auto")
    assert (photo.unit, photo.stored) == ("celsius", "celsius")
    found = read_color(photo)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1:], degrees[1:], atol=0.002)


@pytest.mark.parametrize(
    ("value", "kind", "said"),
    [
        (29515, np.uint16, "celsius"),
        (29515, np.uint16, "decikelvin"),
        (2951, np.uint16, "centikelvin"),
        (22.5, np.float32, "kelvin"),
    ],
)
def test_a_unit_in_which_all_are_impossible_is_refused(tmp_path, value, kind, said):
    """A map of 29,515 degrees was made, without a word."""
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), value, kind))
    found = read_photo(tmp_path / "t.tif", thermal_unit=said)
    assert isinstance(found, RejectedPhoto)
    assert f"its values cannot be {said}" in found.reason and "--thermal-unit" in found.reason


def test_fahrenheit(tmp_path):
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80))
    tifffile.imwrite(
        tmp_path / "t.tif", (degrees * 9 / 5 + 32).astype(np.float32), description="unit: degF"
    )
    np.testing.assert_allclose(read_color(read_photo(tmp_path / "t.tif")), degrees, atol=1e-4)
    said = read_photo(tmp_path / "t.tif", thermal_unit="fahrenheit")
    np.testing.assert_allclose(read_color(said), degrees, atol=1e-4)


def test_a_compression_that_is_not_read_is_named(tmp_path):
    tifffile.imwrite(tmp_path / "t.tif", np.zeros((60, 80), np.float32), compression="lerc")
    found = read_photo(tmp_path / "t.tif")
    assert "34887 (LERC)" in found.reason and "save it uncompressed" in found.reason


def test_other_programs_complaints_stay_off_the_terminal(tmp_path):
    tags = [void_tag("-3.4028234663852886e+38")]
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), 20, np.float32), extratags=tags)
    code = "import sys; from pathlib import Path; from skyquilt.photos.read import read_photo;"
    code += (
        "from skyquilt.photos.pixels import read_color; read_color(read_photo(Path(sys.argv[1])))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "t.tif")], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("levels", "kind", "unit"),
    [
        ([4150, 4260, 4170, 4290, 4310, 4180], np.uint16, "counts"),  # some would be 141 degrees
        ([21500, 21800, 22100, 22300, 21700, 22200], np.uint16, "counts"),  # or -52
        ([29500, 29600, 29400, 29700, 29500, 43000], np.uint16, "centikelvin"),  # a fire
        ([590, 560, 640, 700, 650, 580], np.int16, "centicelsius"),  # 59 degrees, or 6.5
        ([1900, 2100, 2300, 2400, 2200, 2500], np.int16, "centicelsius"),  # 21, or -43
        ([150.0, 140.0, 120.0, 100.0, 230.0, 110.0], np.float32, "celsius"),
    ],
)
def test_frames_of_one_camera_have_one_unit(tmp_path, levels, kind, unit):
    """Each frame had a unit of its own, and a map of degrees was made of both."""
    noise = np.random.default_rng(5).normal(0, 3, (6, 60, 80))
    for k, level in enumerate(levels):
        tifffile.imwrite(tmp_path / f"t{k}.tif", (level + noise[k]).astype(kind))
    survey = read_survey(tmp_path, thermal_unit="auto")
    assert [p.stored for p in survey.photos] == [unit] * 6
    assert any(f"are read as {unit} (6)" in n for n in survey.notes)
    for k, p in enumerate(survey.photos):
        alone = thermal_frame_of_values((levels[k] + noise[k]).astype(kind), unit)
        np.testing.assert_array_equal(read_color(p), alone.values)


def test_files_of_real_numbers_and_of_integers_keep_their_units(tmp_path):
    degrees = np.random.default_rng(5).uniform(11, 21, (60, 80))
    for k in range(3):
        tifffile.imwrite(tmp_path / f"a{k}.tif", (degrees + k).astype(np.float32))
        tifffile.imwrite(tmp_path / f"b{k}.tif", ((degrees + k + 273.15) * 100).astype(np.uint16))
    survey = read_survey(tmp_path, thermal_unit="auto")
    assert sorted(p.stored for p in survey.photos) == ["celsius"] * 3 + ["centikelvin"] * 3
    for p in survey.photos:
        np.testing.assert_allclose(read_color(p), degrees + int(p.name[1]), atol=0.02)


def test_colours_without_temperatures_are_told(tmp_path):
    """A map of colours, and one beside raw data that are not read, were made without a word."""
    counts = np.zeros((512, 640), np.uint16)
    dji_jpeg(tmp_path, counts, short=2)  # as of a model whose frames have another form
    told = " ".join(read_survey(tmp_path).notes)
    assert "1 thermal photos hold a palette's colours or greys, not temperatures" in told
    assert "1 photos hold raw data, perhaps temperatures, in a form that is not read" in told
    dji_jpeg(tmp_path, counts)
    told = " ".join(read_survey(tmp_path).notes)
    assert "palette" not in told and "raw data" not in told


@pytest.mark.parametrize("plain", [1, 2, 3])
def test_measurements_beside_as_many_palettes_are_mapped_as_the_colours_they_hold(tmp_path, plain):
    """Half of a flight had been left out: of frames taken in turns, every other one."""
    counts = np.full((512, 640), 7000, np.uint16)
    for k in range(4):
        dji_jpeg(tmp_path, counts + k, short=2 * (k < plain), name=f"{k}.jpg")
    survey = read_survey(tmp_path)
    colours = [read_color(p).shape == (512, 640, 3) for p in survey.photos]
    assert colours == ([True] * 4 if plain > 1 else [True, False, False, False])
    told = " ".join(survey.notes)
    assert (f"{4 - plain} thermal photos hold measurements, {plain}.jpg" in told) == (plain > 1)
    last = survey.photos[3]
    assert (last.pixels_key == read_photo(last.path).pixels_key) == (plain == 1)


def test_copying_again_is_advised_for_damaged_files_only(tmp_path):
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, np.full((60, 80), 29515, np.uint16))
    with pytest.raises(NoPhotosError, match=r"degrees Celsius\)\.$"):
        read_survey(tmp_path, thermal_unit="celsius")
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(NoPhotosError, match=r"Copy them again\.$"):
        read_survey(tmp_path, thermal_unit="celsius")


def test_pixels_read_in_another_unit_are_others(tmp_path):
    """A folder mapped again with another --thermal-unit took small pictures in the first unit from
    the store: offsets found in counts were added to degrees, up to 64.
    """
    tifffile.imwrite(tmp_path / "t.tif", np.full((60, 80), 29515, np.uint16))
    units = ("counts", "centikelvin", None)
    photos = [read_photo(tmp_path / "t.tif", thermal_unit=u) for u in units]
    assert len({p.pixels_key for p in photos}) == 3
    said = read_photo(tmp_path / "t.tif", thermal_unit="auto")
    assert said.pixels_key == photos[1].pixels_key
