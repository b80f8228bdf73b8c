"""Photos that are missing, broken, foreign or lying: a clear sentence each, and no good photo
lost.
"""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import piexif
import pytest
import rasterio
import tifffile
from PIL import Image

from skyquilt.errors import UnreadablePhotoError
from skyquilt.photos.read import read_photo
from skyquilt.simulate import FlightSettings, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Reporting, Route
from tests.end_to_end.conftest import (
    HIGH,
    WIDE,
    keep,
    named,
    other_camera,
    pixels_of,
    relabel,
    taken_apart,
)
from tests.photos.conftest import jpeg_bytes, with_segment

pytestmark = pytest.mark.filterwarnings(
    "error::RuntimeWarning", "error::scipy.linalg.LinAlgWarning"
)

# nothing to map


def test_an_empty_folder(mosaic, tmp_path):
    (tmp_path / "empty").mkdir()
    told = mosaic(tmp_path / "empty").refused(3, "no photo", "it contains nothing", "JPEG")
    assert not told.output.exists()


def test_a_folder_that_does_not_exist(mosaic, tmp_path):
    told = mosaic(tmp_path / "nowhere").refused(2, "nowhere", "does not exist", "choose a folder")
    assert not told.output.exists()


def test_a_folder_of_other_files(mosaic, tmp_path):
    folder = tmp_path / "other"
    folder.mkdir()
    (folder / "notes.txt").write_text("hello")
    (folder / "flight.wmv").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    mosaic(folder).refused(3, "only other files", "flight.wmv", "notes.txt")


def test_only_a_torn_clip(mosaic, tmp_path):
    folder = tmp_path / "other"
    folder.mkdir()
    (folder / "notes.txt").write_text("hello")
    (folder / "flight.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    mosaic(folder).refused(3, "flight.mp4", "cut off", "copy them again")


def test_no_photo_is_readable(mosaic, photos):
    for path in named(photos):
        path.write_bytes(path.read_bytes()[:2000])
    mosaic(photos).refused(3, "none of the 9 image files", "SIM_0001.jpg", "copy them again")


@pytest.mark.slow
def test_no_photo_can_be_decoded(mosaic, photos):
    for path in named(photos):
        garble(path)
    mosaic(photos).refused(3, "none of 9 photos could be decoded", "damaged")


# bad photos among good ones


def garble(path: Path) -> None:
    """Random bytes in place of the scan; header, length and end marker stay."""
    data = bytearray(path.read_bytes())
    start = data.rindex(b"\xff\xda") + 14
    data[start:-2] = (
        np.random.default_rng(1).integers(0, 255, len(data) - start - 2, np.uint8).tobytes()
    )
    path.write_bytes(bytes(data))


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_but_ended(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2] + b"\xff\xd9")


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def late(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def renamed_text(path: Path) -> None:
    path.write_text("these are no pixels\n" * 100)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        late(truncated, "truncated"),
        (garble, "damaged"),
        late(cut_but_ended, "damaged"),
        late(emptied, "0 bytes"),
        late(renamed_text, "neither JPEG, TIFF, PNG nor WebP"),
    ],
)
def test_one_bad_photo_costs_that_photo_only(mosaic, photos, spoil, reason):
    bad = keep(photos, 0, 1, 2, 3, 4)[2]
    spoil(bad)
    told = mosaic(photos).made()
    assert list(told.metrics["photos_rejected"]) == [bad.name]
    assert reason in told.metrics["photos_rejected"][bad.name]
    assert (told.metrics["photos_total"], told.metrics["photos_used"]) == (5, 4)
    assert f"left out: {bad.name}: " in told.out
    assert bad.name in (told.output / "report.html").read_text()


@pytest.mark.slow
def test_all_kinds_of_bad_at_once(mosaic, photos):
    for path, spoil in zip(named(photos), (truncated, emptied, garble, renamed_text), strict=False):
        spoil(path)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 5
    assert len(told.metrics["photos_rejected"]) == 4


@pytest.mark.slow
def test_a_photo_that_cannot_be_read_any_more_when_the_map_is_drawn(mosaic, photos, monkeypatch):
    """A photo goes away in the middle: it is named and left out, and the map is made without it."""
    from skyquilt.workflows import flow, photo_features

    read, seen = photo_features.read_color, set()

    def once(photo):
        if photo.name in seen and photo.name == "SIM_0005.jpg":
            raise UnreadablePhotoError("it cannot be read (Input/output error)")
        seen.add(photo.name)
        return read(photo)

    monkeypatch.setattr(photo_features, "read_color", once)
    monkeypatch.setattr(flow, "pixel_budget", lambda memory: 0)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 8
    assert "Input/output error" in told.metrics["photos_rejected"]["SIM_0005.jpg"]


@pytest.mark.slow
def test_png_tiff_and_a_torn_clip_among_jpegs(mosaic, photos):
    first, second, *_ = keep(photos, 0, 1, 2, 3)
    block = taken_apart(first.read_bytes())[0]
    Image.fromarray(pixels_of(first)).save(photos / "SIM_0001.png", exif=block)
    first.unlink()
    tifffile.imwrite(photos / "SIM_0002.tif", pixels_of(second), photometric="rgb")
    second.unlink()
    (photos / "DJI_0001.MP4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(1000))
    (photos / "._SIM_0003.jpg").write_bytes(b"\0\5\x16\7")
    told = mosaic(photos).made()
    assert told.metrics["photos_total"] == 5
    assert told.metrics["photos_used"] == 4
    assert list(told.metrics["photos_rejected"]) == ["DJI_0001.MP4"]
    assert "cut off" in told.metrics["photos_rejected"]["DJI_0001.MP4"]


@pytest.mark.slow
def test_photos_of_five_bands_give_a_map_of_five(mosaic, photos):
    """The last two bands of the photos are 3/4 of the first two, and so are the map's."""
    rows = ["EPSG:4326"]
    for path in named(photos):
        at = read_photo(path).position
        rows.append(f"{path.stem}.tif {at.longitude_deg} {at.latitude_deg}")
        rgb = pixels_of(path).astype(np.uint16)
        bands = np.dstack([rgb * 200, rgb[..., :2] * 150])
        kind = {"photometric": "minisblack", "planarconfig": "contig"}
        tifffile.imwrite(path.with_suffix(".tif"), bands, **kind)
        path.unlink()
    (photos / "geo.txt").write_text("\n".join(rows) + "\n")
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    found = tifffile.imread(told.output / "mosaic.tif").astype(float)
    assert found.shape[2] == 5
    shown = found[..., :2].min(axis=2) > 1000
    assert shown.mean() > 0.3
    assert found[shown][:, 3:] == pytest.approx(0.75 * found[shown][:, :2], abs=1.5)


@pytest.mark.slow
def test_two_cameras_are_both_used(mosaic, photos, flight):
    for path in named(photos)[-4:]:
        path.unlink()
    others = other_camera(flight, photos)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 5 + len(others)
    assert len(told.metrics["cameras"]) == 2
    assert "There are 2 cameras" in told.notes
    first, second = (c["focal"]["value"] for c in told.metrics["cameras"].values())
    assert sorted([first, second])[0] == pytest.approx(0.75 * max(first, second), rel=0.05)


@pytest.mark.slow
def test_colour_and_single_band_mixed(mosaic, photos):
    """A map has one kind of pixel: the frequent one; those of other cameras are named. Of the same
    camera, files that a program saved in grey stay in the map, and are not tinted.
    """
    *grey, saved = named(photos)[:3]
    for path in (*grey, saved):
        block, xmp, _ = taken_apart(path.read_bytes())
        if path is not saved:
            block = block.replace(b"Simulated", b"Different")
        data = jpeg_bytes(np.asarray(Image.fromarray(pixels_of(path)).convert("L")))
        data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode())
        path.write_bytes(with_segment(data, 0xE1, block))
    told = mosaic(photos).made()
    assert set(told.metrics["photos_rejected"]) == {p.name for p in grey}
    assert all("differ from the survey's" in r for r in told.metrics["photos_rejected"].values())
    assert told.metrics["photos_used"] == 7 and f"are in colour: {saved.name}" in told.notes
    with rasterio.open(told.output / "mosaic.tif") as map_:
        shown = map_.read()
    with rasterio.open(told.output / "provenance.tif") as raster:
        place = cv2.resize(raster.read(1), shown.shape[:0:-1], interpolation=cv2.INTER_NEAREST)
    inner = cv2.erode((place == 1).astype(np.uint8), np.ones((25, 25))) > 0  # the first in order
    spread = np.ptp(shown[:, inner].astype(int), axis=0)
    assert inner.sum() > 50 and np.percentile(spread, 95) <= 3


@pytest.mark.slow
def test_sizes_of_one_pixel_are_refused_not_met_with_a_crash(mosaic, photos):
    Image.new("RGB", (1, 1)).save(photos / "dot.jpg")
    Image.new("RGB", (40, 2000)).save(photos / "sliver.jpg")
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert "1x1 px" in told.metrics["photos_rejected"]["dot.jpg"]
    assert "sliver.jpg" in told.metrics["photos_rejected"]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "noise"), [(4, 0.0), (0, 1.5)])
def test_a_black_photo(mosaic, photos, number, noise):
    """It shows nothing: it is left out, not drawn where its metadata say, and is named. Noise of a
    sensor has features that match nothing, and at the rim no other photo shows what it would.
    """
    path = named(photos)[number]
    block, xmp, _ = taken_apart(path.read_bytes())
    dark = np.random.default_rng(0).normal(2 * noise, noise, (HIGH, WIDE, 3))
    data = jpeg_bytes(np.clip(dark, 0, 255).astype(np.uint8))
    data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode())
    path.write_bytes(with_segment(data, 0xE1, block))
    told = mosaic(photos).made()
    assert told.metrics["photos_total"] == 9
    assert path.name in told.notes
    assert "black" in told.metrics["photos_rejected"][path.name]
    assert max(told.metrics["blocks"]) == 8


@pytest.mark.slow
def test_copies_are_left_out_and_named(mosaic, photos):
    first = named(photos)[0]
    shutil.copy(first, photos / "copy of 1.jpg")
    shutil.copy(first, photos / "zz.JPG")
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert len(told.metrics["photos_rejected"]) == 2
    assert all("same file content" in r for r in told.metrics["photos_rejected"].values())
    assert "2 files are copies" in told.notes


@pytest.mark.slow
def test_the_same_picture_saved_anew(mosaic, photos):
    """Other bytes, same place and pixels: coincident positions must not break anything."""
    first = named(photos)[0]
    block, xmp, _ = taken_apart(first.read_bytes())
    data = jpeg_bytes(pixels_of(first))
    data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode())
    (photos / "again.jpg").write_bytes(with_segment(data, 0xE1, block))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 10


# few photos


def test_one_photo(mosaic, photos):
    keep(photos, 4)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 1
    assert told.metrics["crs"] == "EPSG:32633"
    assert told.metrics["method"] == "pose"


def test_one_photo_without_metadata(mosaic, photos):
    (only,) = keep(photos, 4)
    relabel(only, strip=True)
    told = mosaic(photos, "--gsd", "20").made()
    assert told.metrics["photos_used"] == 1
    assert told.metrics["crs"] is None
    assert "not georeferenced" in told.err


def test_one_photo_with_heights_above_sea_level_only(mosaic, photos):
    (only,) = keep(photos, 4)
    relabel(only, drop=["xmp"])
    mosaic(photos).refused(4, "heights above ground", "sea level", "--height")
    mosaic(photos, "--method", "position", "--height", "60", output=photos.parent / "two").made()


@pytest.mark.parametrize("numbers", [(0, 1), (0, 1, 2)])
@pytest.mark.slow
def test_few_photos_in_one_line(mosaic, photos, numbers):
    keep(photos, *numbers)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == len(numbers)
    assert told.metrics["blocks"] == [len(numbers)]


def unrelated(photos: Path) -> tuple[Path, Path]:
    """Two photos that show nothing in common (one is mirrored, which no flight does)."""
    a, b = keep(photos, 0, 8)
    block, xmp, _ = taken_apart(b.read_bytes())
    data = jpeg_bytes(pixels_of(b)[:, ::-1])
    data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode())
    b.write_bytes(with_segment(data, 0xE1, block))
    return a, b


@pytest.mark.slow
def test_two_photos_without_overlap_lie_where_they_say(mosaic, photos):
    unrelated(photos)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 2
    assert told.metrics["method"] == "pose"
    assert "no two photos could be linked" in told.metrics["why"]


@pytest.mark.slow
def test_two_photos_without_overlap_or_positions(mosaic, photos):
    for path in unrelated(photos):
        relabel(path, strip=True)
    mosaic(photos).refused(4, "no two of 2 photos", "none has a position", "--geo")


# positions


@pytest.mark.slow
def test_gps_zero_zero_of_all(mosaic, photos, finished):
    """Heights above take-off tell the scale, to 4 % where the ground is as uneven as here."""
    for path in named(photos):
        relabel(path, place=(0.0, 0.0))
    told = mosaic(photos).made()
    assert told.metrics["crs"] is None
    assert told.metrics["photos_used"] == 9
    assert told.metrics["gps_residual_rms_m"] is None
    assert "GPS" in told.notes and "tell the scale" in told.notes
    native = json.loads((finished / "metrics.json").read_text())["native_gsd_m"]
    assert told.metrics["native_gsd_m"] == pytest.approx(native, rel=0.04)


@pytest.mark.slow
def test_gps_zero_zero_of_one(mosaic, photos):
    relabel(named(photos)[3], place=(0.0, 0.0))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["blocks"] == [9]
    assert told.metrics["crs"] == "EPSG:32633"
    assert "1 of 9 photos lack a usable GPS position" in told.notes


@pytest.mark.slow
def test_gps_of_one_photo_300_km_away(mosaic, photos, finished):
    far = named(photos)[3]
    relabel(far, place=(49.3, 14.3))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["blocks"] == [9]
    assert f"{far.name} reports a position" in told.notes
    w, h = told.metrics["size_px"]
    assert max(w, h) < 1000
    assert (
        any(c["photo"] == far.name for c in told.metrics["metadata_conflicts"])
        or far.name in told.notes
    )


@pytest.mark.slow
def test_gps_of_one_photo_400_m_away(mosaic, photos):
    """Too near to be absurd by itself: the pixels say that it lies."""
    far = named(photos)[3]
    relabel(far, place=(46.6035, 14.3))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["blocks"] == [9]


@pytest.mark.slow
def test_gps_of_one_of_two_photos_300_km_away(mosaic, photos):
    _, b = keep(photos, 0, 1)
    relabel(b, place=(49.3, 14.3))
    told = mosaic(photos).refused(2, "km wide", "positions", "--geo")
    assert "report positions 301 km apart" in told.err


@pytest.mark.slow
def test_all_positions_the_same(mosaic, photos):
    for path in named(photos):
        relabel(path, place=(46.6, 14.3))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["crs"] is None
    assert "All 9 positions are identical" in told.notes


# calibrations


@pytest.mark.slow
def test_a_calibration_that_no_lens_has_is_ignored_and_named(mosaic, tmp_path):
    """The factory calibration of all photos has the sign of its focal lengths wrong."""
    settings = FlightSettings(
        seed=7,
        lens=Lens().scaled(800, 600),
        route=Route(photos=4),
        reporting=Reporting(dewarp=(0.0, 0.0)),
        control=Control(points=0, checks=0),
    )
    for _ in simulate(settings, tmp_path / "flight", overwrite=True):
        pass
    for path in named(tmp_path / "flight" / "photos"):
        held = path.read_bytes()
        assert held.count(b"2026-01-01;6") == 1
        path.write_bytes(held.replace(b"2026-01-01;6", b"2026-01-01;-"))
    told = mosaic(tmp_path / "flight" / "photos").made()
    assert told.metrics["photos_used"] == 4
    (found,) = (c for c in told.metrics["metadata_conflicts"] if c["field"] == "calibration")
    assert found["reported"] is None and found["estimated"] == pytest.approx(666, rel=0.05)
    assert "DewarpData: a focal length of -" in found["meaning"]
    assert found["meaning"].split(" (")[0] in (told.output / "report.html").read_text()


# heights


@pytest.mark.slow
def test_height_of_one_photo_off_by_100_m(mosaic, photos):
    wrong = named(photos)[4]
    relabel(wrong, heights=100.0)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert [c["photo"] for c in told.metrics["metadata_conflicts"] if c["field"] == "altitude"] == [
        wrong.name
    ]


@pytest.mark.slow
def test_all_heights_off_by_100_m(mosaic, photos, finished):
    """The positions hold the scale, so the map is as large as it was."""
    for path in named(photos):
        relabel(path, heights=100.0)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert max(told.metrics["size_px"]) < 1000


@pytest.mark.slow
def test_negative_heights(mosaic, photos):
    for path in named(photos):
        relabel(path, heights=-200.0)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_negative_heights_by_pose(mosaic, photos):
    for path in named(photos):
        relabel(path, heights=-200.0)
    mosaic(photos, "--method", "pose", "--trust-metadata").refused(4, "--height")
    told = mosaic(
        photos, "--method", "pose", output=photos.parent / "two"
    ).made()  # image scale and positions tell the height
    assert told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_heights_missing(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["altitude"])
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["crs"] == "EPSG:32633"


@pytest.mark.slow
def test_heights_missing_by_pose(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["altitude"])
    mosaic(photos, "--method", "pose", "--trust-metadata").refused(4, "--height")
    mosaic(photos, "--method", "pose", "--height", "60", output=photos.parent / "two").made()


# cameras


@pytest.mark.slow
def test_focal_length_missing(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["focal"])
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert "focal length is guessed" in told.notes


@pytest.mark.slow
def test_rolling_shutter_is_named_and_modelled(mosaic, photos):
    for path in named(photos):
        relabel(path, xmp={"ShutterType": "Electronic"})
    told = mosaic(photos).made()
    assert "Rolling (electronic) shutter" in told.notes
    (shutter,) = told.metrics["shutter"].values()
    assert shutter["source"] == "guess" and shutter["prior_ms"] == 30
    assert "shutter" in (told.output / "report.html").read_text()


@pytest.mark.slow
def test_angles_missing(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["xmp"])
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_camera_aimed_at_the_horizon_by_pose(mosaic, photos):
    for path in named(photos):
        text = path.read_bytes()
        path.write_bytes(
            text.replace(b'GimbalPitchDegree="-9', b'GimbalPitchDegree="-0').replace(
                b'GimbalPitchDegree="-8', b'GimbalPitchDegree="-0'
            )
        )
    mosaic(photos, "--method", "pose", "--max-view-angle", "20").refused(2, "no photo shows")
    told = mosaic(photos, "--method", "pose", "--overwrite").made()
    low, high = 50.0, 80.0  # flown about 60 m above the ground
    reach = high * np.tan(np.radians(70))
    width, height = (n * told.metrics["gsd_m"] for n in told.metrics["size_px"])
    assert low < max(width, height) < 2 * reach + 150  # the centres lie within 150 m


@pytest.mark.slow
def test_photos_that_show_no_ground_within_the_largest_angle_have_a_reason(mosaic, photos):
    level = named(photos)[3:5]
    for path in level:
        text = path.read_bytes().replace(b'GimbalPitchDegree="-9', b'GimbalPitchDegree="-0')
        path.write_bytes(text.replace(b'GimbalPitchDegree="-8', b'GimbalPitchDegree="-0'))
    told = mosaic(photos, "--method", "pose", "--max-view-angle", "40").made()
    reasons = told.metrics["photos_rejected"]
    assert reasons.keys() == {path.name for path in level}
    assert all("40 degrees from the vertical" in why for why in reasons.values())
    assert told.metrics["photos_used"] == 7


# no metadata at all


@pytest.mark.slow
def test_all_metadata_stripped(mosaic, photos):
    for path in named(photos):
        relabel(path, strip=True)
    told = mosaic(photos).made()
    m = told.metrics
    assert (m["photos_used"], m["blocks"], m["crs"], m["georeferenced"]) == (9, [9], None, False)
    assert m["gps_residual_rms_m"] is None
    assert m["gps_leave_one_out_rms_m"] is None
    assert "not georeferenced" in told.err
    assert "not georeferenced" in told.out


@pytest.mark.slow
def test_all_metadata_stripped_but_control_points(mosaic, photos, flight):
    for path in named(photos):
        relabel(path, strip=True)
    told = mosaic(photos, "--gcp", flight / "gcp_list.txt").made()
    m = told.metrics
    assert m["crs"] == "EPSG:32633"
    assert m["georeferenced"]
    errors = [np.hypot(c["dx_m"], c["dy_m"]) for c in m["control"] if not c["check"]]
    assert len(errors) >= 3
    assert max(errors) < 0.2


@pytest.mark.slow
def test_two_control_points_are_too_few_without_metadata(mosaic, photos, flight):
    for path in named(photos):
        relabel(path, strip=True)
    lines = (flight / "gcp_list.txt").read_text().splitlines()
    names = list(dict.fromkeys(line.split("\t")[6] for line in lines[1:] if "chk" not in line))[:2]
    few = photos.parent / "few.txt"
    few.write_text(
        "\n".join([lines[0], *(line for line in lines[1:] if line.split("\t")[6] in names)])
    )
    mosaic(photos, "--gcp", few).refused(4, "3 control points", "2")


# names


@pytest.mark.slow
def test_names_with_spaces_accents_and_markup(mosaic, photos):
    strange = [
        "Überflug 1.jpg",
        "畑 02.jpg",
        "<script>alert('x')</script>&.jpg".replace("/", "\N{DIVISION SLASH}"),
        "a'b\"c #%20.jpg",
    ]
    folder = photos.parent / "Größe & Höhe"
    folder.mkdir()
    for path, name in zip(keep(photos, 0, 1, 2, 3, 4), strange, strict=False):
        path.rename(folder / name)
    for path in named(photos):
        path.rename(folder / path.name)
    truncated(folder / strange[2])
    told = mosaic(folder, output=photos.parent / "aus gabe é").made()
    assert told.metrics["photos_used"] == 4
    assert list(told.metrics["photos_rejected"]) == [strange[2]]
    page = (told.output / "report.html").read_text(encoding="utf-8")
    assert "<script>alert('x')" not in page
    assert "&lt;script&gt;alert(" in page or "\\u003cscript\\u003ealert(" in page


@pytest.mark.slow
def test_names_that_are_no_text(mosaic, photos):
    """Linux allows any bytes in names, also of folders: reports of these ended in a traceback."""
    first = named(photos)[0]
    try:
        first.rename(photos / os.fsdecode(b"\xff\xfe.jpg"))
        photos = photos.rename(photos.with_name(os.fsdecode(b"flight \xff")))
    except OSError:
        pytest.skip("this file system wants names to be text")
    (photos / "bad.jpg").write_bytes(b"")
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_subfolders_with_equal_names(mosaic, photos):
    for number, path in enumerate(named(photos)):
        sub = photos / f"card {number % 2}"
        sub.mkdir(exist_ok=True)
        path.rename(sub / f"DJI_{number // 2:04d}.jpg")
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_a_broken_link_and_an_unreadable_folder(mosaic, photos):
    (photos / "gone.jpg").symlink_to(photos / "nowhere.jpg")
    (photos / "folder.jpg").mkdir()
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9
    assert "gone.jpg" in told.metrics["photos_rejected"]


@pytest.mark.slow
def test_metadata_of_another_kind_than_foreseen(mosaic, photos):
    path = named(photos)[2]
    block, xmp, picture = taken_apart(path.read_bytes())
    exif = piexif.load(block)
    exif["GPS"][piexif.GPSIFD.GPSLatitude] = ((0, 0), (0, 0), (0, 0))
    data = with_segment(
        picture, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.replace('"+', '"NaN').encode()
    )
    path.write_bytes(with_segment(data, 0xE1, piexif.dump(exif)))
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 9


# maps among photos


def test_maps_among_the_photos_are_left_out(mosaic, photos, finished):
    """An orthophoto saved beside them had been drawn as one photo more."""
    for name in ("mosaic.tif", "dsm.tif"):
        shutil.copy(finished / name, photos / f"earlier {name}")
    keep(photos, 0, 1, 2)
    told = mosaic(photos).made()
    assert told.metrics["photos_used"] == 3
    rejected = told.metrics["photos_rejected"]
    assert sorted(rejected) == ["earlier dsm.tif", "earlier mosaic.tif"]
    assert all("it is a map" in why for why in rejected.values())


def test_the_folder_of_a_run_is_no_folder_of_photos(mosaic, finished, tmp_path):
    told = mosaic(finished, output=tmp_path / "again").refused(2, "folder of a finished run")
    assert not told.output.exists()
