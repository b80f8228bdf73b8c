import json
import math
from dataclasses import replace
from datetime import datetime

import pyproj
import pytest
from pyproj import Geod, Transformer

from skyquilt.alignment.setup import intrinsic_priors
from skyquilt.errors import SideFileError
from skyquilt.geometry.camera_formats import camera_to_opensfm
from skyquilt.model.camera import Camera
from skyquilt.photos.cameras_json import apply_cameras, read_cameras_json
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.photos.read import read_photo
from skyquilt.photos.side_files import apply_positions, read_geo_txt, read_mrk, read_positions_csv
from skyquilt.photos.side_rows import PhotoNames, SideRow, apply_rows
from skyquilt.photos.srt import read_srt

from .conftest import dji_exif, dji_xmp, gps_exif


def written(tmp_path, text, name="side.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.fixture
def photo(make_jpeg):
    return read_photo(
        make_jpeg("DJI_0001.JPG", exif=dji_exif(), xmp=dji_xmp(RelativeAltitude="40"))
    )


@pytest.mark.parametrize(
    "crs", ["EPSG:32615", "WGS84 UTM 15N", "+proj=utm +zone=15 +datum=WGS84 +units=m"]
)
def test_geo_txt_in_utm(tmp_path, crs):
    x, y = pyproj.Transformer.from_crs(4326, 32615, always_xy=True).transform(-92.0, 46.5)
    rows = read_geo_txt(
        written(tmp_path, f"{crs}\n# words\n\nmy photo 1.JPG {x} {y} 210.5 45 2 -1 0.03 0.05\n")
    )
    (row,) = rows
    assert (row.name, row.altitude_m, row.datum) == ("my photo 1.JPG", 210.5, "sea_level")
    assert (row.longitude_deg, row.latitude_deg) == (
        pytest.approx(-92, abs=1e-8),
        pytest.approx(46.5, abs=1e-8),
    )
    assert (row.angles_deg, row.sigma_xy_m, row.sigma_z_m) == ((45, 2, -1), 0.03, 0.05)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:4326\n", "1 lines"),
        ("not a system\na.jpg 1 2\n", "coordinate system"),
        ("EPSG:4326\na.jpg 9\n", "line 2"),
        ("EPSG:4326\na.jpg 9 46 1 2\n", "line 2"),
    ],
)
def test_bad_geo_txt_names_the_line(tmp_path, text, words):
    with pytest.raises(SideFileError, match=words):
        read_geo_txt(written(tmp_path, text))


def test_void_row_is_an_error_and_missing_height_keeps_the_old_one(tmp_path, photo):
    with pytest.raises(SideFileError, match="outside the valid range"):
        apply_positions([photo], written(tmp_path, "EPSG:4326\nDJI_0001 9 146\n"))
    ((after,), _) = apply_positions([photo], written(tmp_path, "EPSG:4326\nDJI_0001 9 46\n"))
    assert (after.position.latitude_deg, after.position.altitude_m, after.position.datum) == (
        46,
        40,
        "takeoff",
    )
    assert after.attitude is photo.attitude


def test_rows_override_position_and_angles(photo):
    row = SideRow(
        name="dji_0001", latitude_deg=46, longitude_deg=9, altitude_m=77, angles_deg=(10, -90, 0)
    )
    ((after,), notes) = apply_rows(
        [photo], [row, SideRow(name="other")], file=photo.path, source="csv"
    )
    assert (after.position.altitude_m, after.position.datum, after.position.takeoff_m) == (
        77,
        "sea_level",
        40,
    )
    assert (after.attitude.yaw_deg, after.attitude.pitch_deg) == (
        pytest.approx(10),
        pytest.approx(0, abs=1e-9),
    )
    assert any("other" in n for n in notes)


def test_names_are_found_by_path_name_or_stem_but_never_guessed():
    names = PhotoNames(["a/x1.JPG", "b/x1.JPG", "b/x2.JPG"])
    assert names.find("A/X1.jpg") == "a/x1.JPG"
    assert names.find("x2") == "b/x2.JPG"
    assert names.find("x1.JPG") is None
    assert names.find("C:\\flights\\x2.jpg") == "b/x2.JPG"
    assert names.find("C:\\flights\\B\\x1.jpg") == "b/x1.JPG"
    assert names.find("./photos/a/x1.JPG") == "a/x1.JPG"
    assert names.find("/ab/x1.JPG") is None


GCP = """WGS84 UTM 15N
544256.7 5320919.9 5 3044 2622 DJI_0001.JPG gcp1
544256.7 5320919.9 5 4193.5 1552 DJI_0002.JPG gcp1
544157.7 5320899.2 NaN 2860 2621 DJI_0001.JPG
544157.7 5320899.2 NaN 3385 1100 DJI_0002.JPG
544033.4 5320876.0 7 100 200 DJI_0001.JPG check-a
544000.0 5320000.0 7 100 200 DJI_0002.JPG plain check
544000.0 5320500.0 7 100 200 DJI_0099.JPG lost
"""


def test_gcp_list(tmp_path):
    points, notes = read_gcp_list(written(tmp_path, GCP), ["DJI_0001.JPG", "DJI_0002.JPG"])
    by_name = {p.name: p for p in points}
    assert list(by_name) == ["gcp1", "point 2", "check-a", "plain"]
    assert by_name["gcp1"].crs == "EPSG:32615"
    assert [(o.photo, o.x, o.y) for o in by_name["gcp1"].observations] == [
        ("DJI_0001.JPG", 3044, 2622),
        ("DJI_0002.JPG", 4193.5, 1552),
    ]
    assert by_name["point 2"].z is None and len(by_name["point 2"].observations) == 2
    assert [p.check for p in points] == [False, False, True, True]
    assert any("DJI_0099.JPG" in n for n in notes) and any("lost" in n for n in notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:32615\n1 2 3 4 5\n", "line 2"),
        ("EPSG:32615\n1 2 3 4 x a.jpg\n", "line 2"),
        ("EPSG:32615\n1 2 3 4 5 b.jpg\n", "no photo of the survey"),
        ("EPSG:32615\n1 2 3 4 5 a.jpg p\n1 3 3 4 5 a.jpg p\n", "two different places"),
        ("EPSG:999999\n1 2 3 4 5 a.jpg\n", "coordinate system"),
    ],
)
def test_bad_gcp_list(tmp_path, text, words):
    with pytest.raises(SideFileError, match=words):
        read_gcp_list(written(tmp_path, text), ["a.jpg"])


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_csv(tmp_path, mark):
    lines = [
        "File Name,Latitude [deg],LON,Rel_Alt,Yaw,Pitch,Roll,Accuracy",
        "a.jpg,46.5,9.1,40.5,359,1,2,0.5",
        "b.jpg,,,,10,,,",
    ]
    rows = read_positions_csv(written(tmp_path, "\n".join(lines).replace(",", mark), "p.csv"))
    first, second = rows
    assert (first.name, first.latitude_deg, first.longitude_deg) == ("a.jpg", 46.5, 9.1)
    assert (first.altitude_m, first.datum, first.angles_deg) == (40.5, "takeoff", (359, 1, 2))
    assert (first.sigma_xy_m, first.sigma_z_m) == (0.5, 0.5)
    assert (second.latitude_deg, second.angles_deg) == (None, (10, 0, 0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("a,b\n1,2\n", "header"),
        ("name,lat,lon\na.jpg,north,3\n", "row 1"),
        ("name,lat\na,1\n", "header"),
    ],
)
def test_bad_csv(tmp_path, text, words):
    with pytest.raises(SideFileError, match=words):
        read_positions_csv(written(tmp_path, text, "p.csv"))


def test_mrk_moves_the_antenna_to_the_camera(tmp_path):
    shot = (
        "23\t264013.12\t[2120]\t  1000,N\t -2000,E\t"
        " 190,V\t46.50000000,Lat\t9.00000000,Lon\t92.345,Ellh"
    )
    line = shot + "\t0.012, 0.011, 0.024\t50,Q\n"
    names = ["100_0001_0023.JPG", "100_0001_0024.JPG"]
    (row,) = read_mrk(written(tmp_path, line, "t.MRK"), names)
    x, y = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(
        row.longitude_deg, row.latitude_deg
    )
    x0, y0 = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(9, 46.5)
    assert (x - x0, y - y0) == (pytest.approx(-2, abs=0.01), pytest.approx(1, abs=0.01))
    assert (row.altitude_m, row.datum) == (pytest.approx(92.155), "ellipsoid")
    assert (row.sigma_xy_m, row.sigma_z_m) == (0.012, 0.024)
    with pytest.raises(SideFileError, match="shots 23 to 23"):
        read_mrk(tmp_path / "t.MRK", ["IMG_1.JPG"])


MRK = "".join(
    f"{k}\t1.0\t[2120]\t0,N\t0,E\t0,V\t46.{k}000,Lat\t-92.0,Lon\t92,Ellh\t0.01, 0.01, 0.02\t50,Q\n"
    for k in (1, 2)
)


def flights(make_jpeg, *names):
    return [
        replace(read_photo(make_jpeg(n, exif=dji_exif(), seed=k)), name=n)
        for k, n in enumerate(names)
    ]


def test_shots_of_a_flight_are_not_given_to_another(tmp_path, make_jpeg):
    """Numbers begin anew with each flight: those beside the file are meant."""
    photos = flights(make_jpeg, "a/DJI_0001.JPG", "a/DJI_0002.JPG", "b/DJI_0001.JPG")
    (after, notes) = apply_positions(photos, written(tmp_path, MRK, "a/t.MRK"))
    assert [p.position.latitude_deg for p in after] == [
        pytest.approx(46.1),
        pytest.approx(46.2),
        photos[2].position.latitude_deg,
    ]
    assert notes[0] == "t.MRK placed 2 of 3 photos." and "b/DJI_0001.JPG" in notes[1]
    with pytest.raises(SideFileError, match="one flight, and both a/DJI_0001.JPG and b/DJI_0001"):
        apply_positions(photos, written(tmp_path, MRK, "t.MRK"))
    (after, _) = apply_positions(photos[1:], tmp_path / "t.MRK")  # no number twice: both are of it
    assert [p.position.latitude_deg for p in after] == [pytest.approx(46.2), pytest.approx(46.1)]


def test_names_that_two_cards_share_are_told(tmp_path, make_jpeg):
    photos = flights(make_jpeg, "a/DJI_0001.JPG", "b/DJI_0001.JPG", "b/DJI_0002.JPG")
    side = written(tmp_path, "EPSG:4326\nDJI_0001.JPG -92 46.501\n")
    with pytest.raises(SideFileError, match=r"several photos are called that \(a/DJI_0001.JPG, b/"):
        apply_positions(photos, side)
    side = written(tmp_path, "EPSG:4326\nDJI_0001.JPG -92 46.501\nDJI_0002.JPG -92 46.502\n")
    (after, notes) = apply_positions(photos, side)
    assert after[2].position.latitude_deg == pytest.approx(46.502)
    assert after[0].position == photos[0].position
    assert any("several photos are called that" in n for n in notes)
    side = written(tmp_path, "EPSG:4326\nD:\\x\\b\\DJI_0001.JPG -92 46.503\n")
    (after, _) = apply_positions(photos, side)
    assert after[1].position.latitude_deg == pytest.approx(46.503)


def test_photos_of_one_shot_in_several_bands_have_its_place(tmp_path, make_jpeg):
    photos = flights(make_jpeg, "DJI_0001_W.JPG", "DJI_0001_T.JPG")
    (after, _) = apply_positions(photos, written(tmp_path, MRK, "t.MRK"))
    assert [p.position.latitude_deg for p in after] == [pytest.approx(46.1)] * 2


@pytest.mark.parametrize(
    "name",
    [
        "DJI_20230309104838_0002_V.JPG",
        "DJI_20230309104838_0002_W_field 7.JPG",
        "DJI_20230309104838_0002_D_2024.JPG",
        "100_0003_0002.JPG",
    ],
)
def test_the_number_of_a_shot_in_names_of_missions(tmp_path, make_jpeg, name):
    (after, _) = apply_positions(flights(make_jpeg, name), written(tmp_path, MRK, "t.MRK"))
    assert after[0].position.latitude_deg == pytest.approx(46.2)


def test_frames_of_two_videos_do_not_share_a_telemetry(tmp_path, make_jpeg):
    photos = flights(make_jpeg, "a/frame_0001.JPG", "b/frame_0001.JPG")
    photos = [replace(p, time=None) for p in photos]
    with pytest.raises(SideFileError, match=r"one flight, and both a/frame_0001.JPG and b/"):
        read_srt(written(tmp_path, NEW, "a.srt"), photos)


NEW = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2023-05-01 10:11:12.500
[iso: 100] [latitude: 46.50] [longitude: 9.10] [rel_alt: 40.500 abs_alt: 300.100]
[gb_yaw: 10.0 gb_pitch: -90.0 gb_roll: 0.0]</font>

2
00:00:00,033 --> 00:00:00,066
<font size="28">FrameCnt: 2, DiffTime: 33ms
2023-05-01 10:11:13.500
[latitude: 46.60] [longtitude: 9.20] [altitude: 301.0]</font>
"""
OLD = """1
00:00:01,000 --> 00:00:02,000
HOME(9.0000,46.0000) 2017.05.01 10:11:12
GPS(9.1000,46.5000,15) BAROMETER:64.3
ISO:100 Shutter:320

2
00:00:02,000 --> 00:00:03,000
F/2.8, SS 206.14, ISO 150, EV 0, GPS (9.2000, 46.6000, 17), D 24.26m, H 6.00m, H.S 0.00m/s
"""


def test_srt_by_frame_number(tmp_path, photo):
    frames = [replace(photo, name=f"frame_{i:06d}.jpg", time=None) for i in (1, 2)]
    first, second = read_srt(written(tmp_path, NEW, "a.SRT"), frames)
    assert (first.latitude_deg, first.longitude_deg, first.altitude_m, first.datum) == (
        46.5,
        9.1,
        40.5,
        "takeoff",
    )
    assert first.angles_deg == pytest.approx((10, 0, 0), abs=1e-9)
    assert (second.latitude_deg, second.longitude_deg, second.altitude_m, second.datum) == (
        46.6,
        9.2,
        301,
        "sea_level",
    )
    first, second = read_srt(written(tmp_path, OLD, "b.SRT"), frames)
    assert (first.latitude_deg, first.longitude_deg, first.altitude_m) == (46.5, 9.1, 64.3)
    assert (second.latitude_deg, second.altitude_m, second.datum) == (46.6, 6.0, "takeoff")


def test_srt_by_time_or_not_at_all(tmp_path, photo):
    path = written(tmp_path, NEW, "a.SRT")
    timed = replace(photo, name="x.jpg", time=datetime(2023, 5, 1, 10, 11, 13, 300_000))
    (row,) = read_srt(path, [timed])
    assert (row.name, row.latitude_deg) == ("x.jpg", 46.6)
    with pytest.raises(SideFileError, match="Name the frames"):
        read_srt(path, [replace(photo, name="x.jpg", time=None)])


def test_positions_by_the_files_ending(tmp_path, photo):
    ((after,), _) = apply_positions(
        [photo], written(tmp_path, "name,lat,lon\nDJI_0001,46,9\n", "p.CSV")
    )
    assert after.position.source == "csv"


CAMERAS = {
    "v2 dji fc300s 96 64 brown 0.58": {
        "projection_type": "brown",
        "width": 192,
        "height": 128,
        "focal_x": 0.58,
        "focal_y": 0.58,
        "c_x": 0.01,
        "c_y": 0.0,
        "k1": -0.01,
        "k2": 0.02,
        "p1": 0.0,
        "p2": 0.0,
        "k3": 0.0,
    }
}


def test_cameras_json_is_scaled_to_the_photo(tmp_path, photo):
    path = written(tmp_path, json.dumps(CAMERAS), "cameras.json")
    ((after,), notes) = apply_cameras([photo], read_cameras_json(path), file=path)
    assert notes == ()
    assert (after.calibration.width, after.calibration.focal) == (96, pytest.approx(0.58 * 96))
    assert after.calibration.cx == pytest.approx(47.5 + 0.96)
    assert (after.focal.source, after.focal.px) == ("calibrated", pytest.approx(0.58 * 96))


def test_deviations_of_a_calibration_are_the_adjustment_s_priors(tmp_path, photo):
    """Scaled with the photo; what states none, or too little to be true of a lens in flight, has
    the usual ones.
    """
    record = camera_to_opensfm(
        Camera(
            width=1500,
            height=1000,
            focal=1800,
            cx=750,
            cy=500,
            k1=-0.1,
            sigmas=(9.0, 4.0, 5.0, 0.03, 0.04, 0.0, 0.0, 2e-3, 1e-3),
        )
    )
    path = written(tmp_path, json.dumps({"all": record}), "cameras.json")
    ((after,), _) = apply_cameras([photo], read_cameras_json(path), file=path)
    s = max(photo.width, photo.height) / 1500
    assert after.focal.sigma_px == pytest.approx(9 * s)
    _, sigma, _ = intrinsic_priors([after], "4")
    expected = [9 * s, 4 * s, 5 * s, 0.03, 0.04, 1e-3, 1e-4, 2e-3, 1e-3]
    assert sigma[0, :9] == pytest.approx(expected)
    del record["standard_deviations"]
    path = written(tmp_path, json.dumps({"all": record}), "cameras.json")
    ((plain,), _) = apply_cameras([photo], read_cameras_json(path), file=path)
    assert plain.focal.sigma_px == pytest.approx(0.01 * plain.focal.px)
    _, sigma, _ = intrinsic_priors([plain], "4")
    assert sigma[0, 3] == 0.01


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        ("[]", "cameras by name"),
        ('{"a": {"width": 3}}', "height"),
        ("{}", "by name"),
    ],
)
def test_bad_cameras_json(tmp_path, text, words):
    with pytest.raises(SideFileError, match=words):
        read_cameras_json(written(tmp_path, text, "cameras.json"))


def test_cameras_of_another_shape_do_not_fit(tmp_path, photo):
    path = written(
        tmp_path, json.dumps({"all": {**CAMERAS["v2 dji fc300s 96 64 brown 0.58"], "height": 190}})
    )
    with pytest.raises(SideFileError, match="dji fc300s"):
        apply_cameras([photo], read_cameras_json(path), file=path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "name;lat;lon;alt\nDJI_0001;46,25;9,5;210,5\n"),
        ("a.csv", "name\tlat\tlon\talt\nDJI_0001\t46,25\t9,5\t210,5\n"),
        ("a.csv", "sep=;\nname;lat;lon;alt\nDJI_0001;46.25;9.5;210.5\n"),
        ("geo.txt", "EPSG:4326\nDJI_0001 9,5 46,25 210,5\n"),
        ("geo.txt", "EPSG:4326\nDJI_0001,9.5,46.25,210.5\n"),
    ],
)
def test_decimal_commas_and_separators_of_spreadsheets_give_the_same_position(tmp_path, name, text):
    read = read_geo_txt if name == "geo.txt" else read_positions_csv
    (row,) = read(written(tmp_path, text, name))
    assert (row.name, row.latitude_deg, row.longitude_deg) == (
        "DJI_0001",
        pytest.approx(46.25, abs=1e-9),
        pytest.approx(9.5, abs=1e-9),
    )
    assert (row.altitude_m, row.angles_deg) == (210.5, None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,lat,lon,alt [ft]\nDJI_0001,46,9,700\n", r"'alt \[ft\]' is in ft"),
        ("name,lat (rad),lon\nDJI_0001,0.8,0.1\n", "is in rad"),
        ("name,lat,lon,alt_ft\nDJI_0001,46,9,700\n", "'alt_ft' is in ft"),
        ("name,lat,lon,Altitude (US survey feet)\nDJI_0001,46,9,700\n", "is in ussurveyfeet"),
        ("name,lat,lon,height [m or ft]\nDJI_0001,46,9,700\n", "is in ft"),
        ("name,alt,lat,lon\nDJI_0001,210,5,46.25,9.5\n", "row 1 has 5 cells, and the header 4"),
        ("name,lat,lon\n", "a header only"),
        ("name;lat;lon;alt\nDJI_0001;46.25;9.5;1,210\n", "found '1,210'"),
    ],
)
def test_other_units_and_tables_without_rows_are_refused(tmp_path, text, words):
    with pytest.raises(SideFileError, match=words):
        read_positions_csv(written(tmp_path, text, "a.csv"))


def test_two_rows_of_one_photo_that_differ_are_refused(tmp_path, photo):
    head, row = "EPSG:4326\n", "DJI_0001.JPG 9 46 100\n"
    with pytest.raises(SideFileError, match=r"two rows for DJI_0001.JPG that differ"):
        apply_positions([photo], written(tmp_path, head + row + "dji_0001 9.1 46 100\n"))
    ((after,), _) = apply_positions([photo], written(tmp_path, head + row + row))
    assert after.position.longitude_deg == pytest.approx(9)


HERE = (46.5, -92.0)
"""Where `dji_exif` places its photo."""


def minutes(degrees):
    whole = int(degrees)
    return whole + (degrees - whole) * 0.6


@pytest.mark.parametrize(
    ("lat", "lon", "words"),
    [
        (14.3, 46.5, "exchanged"),
        (math.radians(HERE[0]), math.radians(HERE[1]), "its degrees are radians"),
        (minutes(46.5), minutes(-92.9), "degrees and minutes"),
        (HERE[0], HERE[1] + 6, "its UTM zone is 1 too high"),
        (HERE[0], HERE[1] - 12, "its UTM zone is 2 too low"),
    ],
)
def test_positions_that_a_mistake_of_the_file_explains_are_refused(
    tmp_path, make_jpeg, lat, lon, words
):
    there = {"exchanged": (46.5, 14.3), "degrees and minutes": (46.5, -92.9)}.get(words, HERE)
    photo = read_photo(make_jpeg("DJI_0001.JPG", exif=dji_exif(GPS=gps_exif(*there))))
    with pytest.raises(SideFileError, match=words):
        apply_positions([photo], written(tmp_path, f"EPSG:4326\nDJI_0001 {lon} {lat}\n"))


@pytest.mark.parametrize(
    ("system", "x", "y", "words"),
    [
        (32615, "y", "x", r"x and y \(easting and northing\) are exchanged"),
        (32715, "x", "y", r"the other hemisphere \(EPSG:32615 is right\)"),
        (26915, "y", "x", "are exchanged"),
    ],
)
@pytest.mark.parametrize("table", [False, True])
def test_mistakes_with_eastings_and_northings_are_refused(
    tmp_path, photo, system, x, y, words, table
):
    to_map = Transformer.from_crs(4326, 32615, always_xy=True)
    place = dict(zip("xy", to_map.transform(HERE[1], HERE[0]), strict=True))
    head = f"EPSG:{system}\n" + "name,x,y\n" * table
    row = f"DJI_0001,{place[x]},{place[y]}\n"
    side = written(tmp_path, head + (row if table else row.replace(",", " ")), "a.csv")
    with pytest.raises(SideFileError, match=words):
        apply_positions([photo], side)


def test_a_mistake_in_half_of_the_rows_is_one_of_the_file(tmp_path, make_jpeg):
    """In fewer, positions that are exchanged are turned round (`implausible_positions`)."""
    there = dji_exif(GPS=gps_exif(46.5, 14.3))
    photos = [read_photo(make_jpeg(f"{i}.jpg", exif=there, seed=i)) for i in range(6)]

    def side(wrong):
        places = ["46.5 14.3" if i < wrong else "14.3 46.5" for i in range(6)]
        rows = (f"{i}.jpg {place}\n" for i, place in enumerate(places))
        return written(tmp_path, "EPSG:4326\n" + "".join(rows))

    with pytest.raises(SideFileError, match=r"3 of 6 photos .* are exchanged"):
        apply_positions(photos, side(3))
    (_, notes) = apply_positions(photos, side(2))
    assert not any("km from" in n for n in notes)


@pytest.mark.parametrize(("east", "south"), [(0.02, 1), (0, -1)])
def test_positions_elsewhere_without_a_known_mistake_are_told_and_used(
    tmp_path, photo, east, south
):
    """Files without hemispheres are mended by such a file."""
    lat, lon = HERE[0] * south, HERE[1] + east
    side = written(tmp_path, f"EPSG:4326\nDJI_0001 {lon} {lat}\n")
    ((after,), notes) = apply_positions([photo], side)
    assert after.position.latitude_deg == pytest.approx(lat)
    (told,) = [n for n in notes if "km from where" in n]
    km = Geod(ellps="WGS84").inv(lon, lat, HERE[1], HERE[0])[2] / 1000
    stated = float(told.split("photos ")[1].split(" km")[0].replace(",", ""))
    assert stated == pytest.approx(km, rel=0.01, abs=0.6)


def test_positions_of_a_better_receiver_are_not_compared_aloud(tmp_path, photo):
    side = written(tmp_path, f"EPSG:4326\nDJI_0001 {HERE[1] + 0.0005} {HERE[0]} 199\n")
    (_, notes) = apply_positions([photo], side)
    assert notes == ("side.txt placed 1 of 1 photos.",)


@pytest.mark.parametrize(("height", "told"), [(198.3 / 0.3048, True), (230.0, False)])
def test_heights_that_look_like_feet_are_told(tmp_path, photo, height, told):
    side = written(tmp_path, f"EPSG:4326\nDJI_0001 {HERE[1]} {HERE[0]} {height}\n")
    (_, notes) = apply_positions([photo], side)
    assert any("may be in feet" in n for n in notes) == told


@pytest.mark.parametrize(
    ("system", "metres", "told"),
    [
        ("EPSG:26915+5703", 1.0, False),
        ("EPSG:26915+6360", 1200 / 3937, False),
        ("EPSG:2264", 1.0, True),
        ("EPSG:26915", 1.0, False),
    ],
)
def test_heights_have_the_unit_that_the_coordinate_system_states(tmp_path, system, metres, told):
    gcp = written(tmp_path, f"{system}\n500000 5100000 650 4 5 DJI_0001.JPG a\n")
    ((point,), notes) = read_gcp_list(gcp, ["DJI_0001.JPG"])
    assert point.z == pytest.approx(650 * metres, abs=1e-9)
    assert any("taken as metres" in n for n in notes) == told
    (row,) = read_geo_txt(written(tmp_path, f"{system}\nDJI_0001 500000 5100000 650\n"))
    assert row.altitude_m == pytest.approx(650 * metres, abs=1e-9)


@pytest.mark.parametrize(
    "line", ["DJI_0001 446,358.5 5,160,926.2 440", "DJI_0001 446,358,100 5,160,926,200 440"]
)
def test_thousands_are_not_read_as_separate_numbers(tmp_path, line):
    with pytest.raises(SideFileError, match="line 2: expected 'name x y"):
        read_geo_txt(written(tmp_path, f"EPSG:32615\n{line}\n"))


def test_there_are_sixty_zones(tmp_path):
    """EPSG:32661, the next code, is a projection of the pole."""
    with pytest.raises(SideFileError, match="no UTM zone 61"):
        read_geo_txt(written(tmp_path, "WGS84 UTM 61N\nDJI_0001 446358 5160926\n"))


def test_a_table_says_what_it_gave(tmp_path, photo):
    with pytest.raises(SideFileError, match="no photo a position or angles"):
        apply_positions([photo], written(tmp_path, "name,x,y,z\nDJI_0001,1,2,3\n", "a.csv"))
    (_, notes) = apply_positions(
        [photo], written(tmp_path, "name,x,y,yaw\nDJI_0001,1,2,90\n", "a.csv")
    )
    assert notes == (
        "a.csv gave 1 of 1 photos their angles, and placed none.",
        "a.csv has columns that are not read: x, y.",
    )
