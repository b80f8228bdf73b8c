from datetime import UTC, datetime, timedelta, timezone

import piexif
import pytest

from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.read import read_photo

from .conftest import dji_exif, dji_xmp, gps_exif, jpeg_bytes, pixels


def test_exif_alone(make_jpeg):
    photo = read_photo(make_jpeg(exif=dji_exif()))
    assert isinstance(photo, Photo)
    assert (photo.width, photo.height, photo.channels, photo.dtype) == (96, 64, 3, "uint8")
    assert photo.position.latitude_deg == pytest.approx(46.5, abs=1e-7)
    assert photo.position.longitude_deg == pytest.approx(-92.0, abs=1e-7)
    assert (photo.position.altitude_m, photo.position.datum) == (pytest.approx(198.3), "sea_level")
    assert photo.time == datetime(2016, 6, 23, 16, 31, 59)
    assert (photo.focal.source, photo.rolling_shutter) == ("sensor", True)
    assert photo.focal.px == pytest.approx(3.61 / 6.25 * 96)
    assert photo.attitude is None


@pytest.mark.parametrize("form", ["attributes", "elements"])
@pytest.mark.parametrize("prefix", ["drone-dji", "ns7"])
def test_xmp_goes_before_exif_in_either_form_and_under_any_prefix(make_jpeg, form, prefix):
    xmp = dji_xmp(
        form,
        prefix,
        GpsLatitude="46.6",
        GpsLongtitude="-91.9",
        AbsoluteAltitude="+198.31",
        RelativeAltitude="+39.80",
        GimbalYawDegree="+45.00",
        GimbalPitchDegree="-89.90",
        GimbalRollDegree="+0.00",
        FlightYawDegree="+46.00",
    )
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp))
    where = photo.position
    assert (where.latitude_deg, where.longitude_deg, where.source) == (46.6, -91.9, "xmp")
    assert (where.altitude_m, where.datum, where.takeoff_m, where.sea_level_m) == (
        39.8,
        "takeoff",
        39.8,
        198.31,
    )
    assert photo.attitude.yaw_deg == pytest.approx(45)
    assert photo.attitude.pitch_deg == pytest.approx(0.1)
    assert photo.flight_yaw_deg == 46


@pytest.mark.parametrize(("orientation", "top"), [(1, 30.0), (6, 120.0), (3, 210.0), (8, 300.0)])
def test_the_direction_of_a_picture_is_its_heading(make_jpeg, orientation, top):
    """A picture is turned clockwise by a quarter to be shown by 6: its first row is then right."""
    gps = {piexif.GPSIFD.GPSImgDirectionRef: "T", piexif.GPSIFD.GPSImgDirection: (3000, 100)}
    exif = dji_exif(GPS=gps, **{"0th": {piexif.ImageIFD.Orientation: orientation}})
    photo = read_photo(make_jpeg(exif=exif))
    assert photo.attitude is None
    assert (photo.flight_yaw_deg, photo.flight_yaw_source) == (pytest.approx(top), "exif")
    angles = dji_xmp(GimbalYawDegree="+45", GimbalPitchDegree="-90", GimbalRollDegree="0")
    photo = read_photo(make_jpeg(exif=exif, xmp=angles))
    assert photo.attitude.yaw_deg == pytest.approx(45)
    assert photo.flight_yaw_deg is None


@pytest.mark.parametrize("direction", [(0, 100), (99900, 100), (1, 0)])
def test_a_direction_that_is_none_is_no_heading(make_jpeg, direction):
    photo = read_photo(make_jpeg(exif=dji_exif(GPS={piexif.GPSIFD.GPSImgDirection: direction})))
    assert photo.flight_yaw_deg is None


def test_rtk_fix_brings_its_deviations_and_the_ellipsoid(make_jpeg):
    xmp = dji_xmp(
        GpsLatitude="46.6",
        GpsLongitude="-91.9",
        AbsoluteAltitude="+170.1",
        RelativeAltitude="+40.0",
        RtkFlag="50",
        RtkStdLon="0.012",
        RtkStdLat="0.014",
        RtkStdHgt="0.03",
    )
    where = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp)).position
    assert (where.altitude_m, where.datum, where.ellipsoid_m) == (170.1, "ellipsoid", 170.1)
    assert (where.sigma_xy_m, where.sigma_z_m) == (0.014, 0.03)


def test_accuracy_tags_are_the_deviations(make_jpeg):
    camera = (
        'xmlns:Camera="http://pix4d.com/camera/1.0/" Camera:GPSXYAccuracy="0.7"'
        ' Camera:GPSZAccuracy="1.4"'
    )
    xmp = dji_xmp(RelativeAltitude="40").replace("xmlns:drone-dji", camera + " xmlns:drone-dji")
    where = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp)).position
    assert (where.sigma_xy_m, where.sigma_z_m) == (0.7, 1.4)
    exif = dji_exif(GPS={piexif.GPSIFD.GPSHPositioningError: (25, 10)})
    assert read_photo(make_jpeg(exif=exif)).position.sigma_xy_m == 2.5


@pytest.mark.parametrize(
    ("gps", "words"),
    [
        (gps_exif(0, 0), "(0, 0)"),
        (gps_exif(95, 10), "outside the valid range"),
        ({1: "N", 2: ((46, 1), (0, 1), (0, 1))}, "missing"),
        (
            {1: "N", 2: ((46, 1), (0, 0), (0, 0)), 3: "E", 4: ((9, 0), (0, 1), (0, 1))},
            "not a number",
        ),
        ({}, "no GPS position"),
    ],
)
def test_void_positions_are_none_with_a_note(make_jpeg, gps, words):
    exif = dji_exif()
    exif["GPS"] = gps
    photo = read_photo(make_jpeg(exif=exif))
    assert photo.position is None
    assert any(words in note for note in photo.notes), photo.notes


def test_a_height_above_take_off_stays_without_a_position(make_jpeg):
    exif = dji_exif()
    exif["GPS"] = {}
    photo = read_photo(make_jpeg(exif=exif, xmp=dji_xmp(RelativeAltitude="+39.80")))
    assert (photo.position, photo.height_m) == (None, 39.8)
    placed = read_photo(make_jpeg(exif=dji_exif(), xmp=dji_xmp(RelativeAltitude="+39.80")))
    assert (placed.position.takeoff_m, placed.height_m) == (39.8, None)


def test_void_xmp_position_falls_back_to_exif(make_jpeg):
    photo = read_photo(
        make_jpeg(exif=dji_exif(), xmp=dji_xmp(GpsLatitude="0.0", GpsLongitude="0.0"))
    )
    assert photo.position.source == "exif"
    assert any("XMP is invalid" in note for note in photo.notes)


def test_insane_altitude_is_noted_and_ignored(make_jpeg):
    exif = dji_exif()
    exif["GPS"] = gps_exif(46, 9, 123_456)
    photo = read_photo(make_jpeg(exif=exif))
    assert (photo.position.altitude_m, photo.position.datum) == (None, "unknown")
    assert any("123456 m" in note for note in photo.notes)


def test_below_sea_level_is_negative(make_jpeg):
    exif = dji_exif()
    exif["GPS"] = gps_exif(31.5, 35.5, -380)
    assert read_photo(make_jpeg(exif=exif)).position.altitude_m == pytest.approx(-380)


def test_time_with_subseconds_and_offset(make_jpeg):
    tags = {piexif.ExifIFD.SubSecTimeOriginal: "250", piexif.ExifIFD.OffsetTimeOriginal: "+02:00"}
    time = read_photo(make_jpeg(exif=dji_exif(Exif=tags))).time
    assert time == datetime(2016, 6, 23, 16, 31, 59, 250_000, tzinfo=timezone(timedelta(hours=2)))


def test_time_falls_back_to_the_gps_clock(make_jpeg):
    clock = {
        piexif.GPSIFD.GPSTimeStamp: ((18, 1), (20, 1), (515, 10)),
        piexif.GPSIFD.GPSDateStamp: "2014:10:19",
    }
    exif = dji_exif(GPS=clock, Exif={piexif.ExifIFD.DateTimeOriginal: "0000:00:00 00:00:00"})
    assert read_photo(make_jpeg(exif=exif)).time == datetime(
        2014, 10, 19, 18, 20, 51, 500_000, tzinfo=UTC
    )


def test_editor_is_named_but_firmware_is_none(make_jpeg):
    viewer = "Microsoft Windows Photo Viewer 10.0"
    assert read_photo(make_jpeg(exif=dji_exif(**{"0th": {305: viewer}}))).editor == viewer
    assert read_photo(make_jpeg(exif=dji_exif(**{"0th": {305: "v01.23.4920"}}))).editor is None
    creator = dji_xmp().replace(
        "xmlns:drone-dji",
        'xmlns:q="http://ns.adobe.com/xap/1.0/" q:CreatorTool="GIMP 2" xmlns:drone-dji',
    )
    assert read_photo(make_jpeg(exif=dji_exif(), xmp=creator)).editor == "GIMP 2"


def test_orientation_is_told_but_never_applied(make_jpeg):
    photo = read_photo(make_jpeg(exif=dji_exif(**{"0th": {274: 6}})))
    assert (photo.orientation_tag, photo.width, photo.height) == (6, 96, 64)


def test_pix4d_angles_count_from_nadir(make_jpeg):
    angles = (
        'xmlns:Camera="http://pix4d.com/camera/1.0" Camera:Yaw="30" Camera:Pitch="2"'
        ' Camera:Roll="-1"'
    )
    xmp = dji_xmp().replace("xmlns:drone-dji", angles + " xmlns:drone-dji")
    attitude = read_photo(make_jpeg(xmp=xmp)).attitude
    assert (attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg) == (30, 2, -1)
    assert attitude.source == "xmp-camera"


@pytest.mark.parametrize(("pitch", "down"), [("-90", 0), ("+90", 0), ("+88", 2), ("-88", 2)])
def test_a_gimbal_that_looks_to_the_zenith_has_the_other_sign(make_jpeg, pitch, down):
    xmp = dji_xmp(GimbalYawDegree="20", GimbalPitchDegree=pitch, GimbalRollDegree="0")
    photo = read_photo(make_jpeg(xmp=xmp))
    assert photo.attitude.yaw_deg == pytest.approx(20)
    assert (photo.attitude.pitch_deg, photo.attitude.roll_deg) == pytest.approx((down, 0))
    assert any("taken for" in note for note in photo.notes) == pitch.startswith("+")


def test_gimbal_angles_that_are_all_zero_were_not_measured(make_jpeg):
    xmp = dji_xmp(GimbalYawDegree="0.00", GimbalPitchDegree="0.00", GimbalRollDegree="+0.00")
    photo = read_photo(make_jpeg(xmp=xmp))
    assert photo.attitude is None
    assert any("all zero" in note for note in photo.notes)


def test_broken_xmp_is_searched_as_text(make_jpeg):
    xmp = dji_xmp(RelativeAltitude="+39.80").replace("/>", ">")
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp))
    assert photo.position.takeoff_m == 39.8
    assert any("not valid XML" in note for note in photo.notes)


def test_an_xml_bomb_is_not_expanded(make_jpeg):
    entities = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
    bomb = entities + '<x:xmpmeta xmlns:x="adobe:ns:meta/">&b;</x:xmpmeta>'
    assert isinstance(read_photo(make_jpeg(xmp=bomb)), Photo)


def test_panoramas_are_left_out(tmp_path):
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        ' xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
        ' GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
    )
    (tmp_path / "around.jpg").write_bytes(jpeg_bytes(pixels(), xmp=xmp))
    found = read_photo(tmp_path / "around.jpg")
    assert isinstance(found, RejectedPhoto)
    assert "panorama (equirectangular)" in found.reason


@pytest.mark.parametrize(
    ("parts", "degrees"),
    [
        (((46, 1), (35, 1), (59128, 1000)), 46 + 35 / 60 + 59.128 / 3600),
        (((46, 1), (35985467, 10**6), (0, 1)), 46 + 35.985467 / 60),
        (((46599758, 10**6), (0, 1), (0, 1)), 46.599758),
        (((46, 1), (35985467, 10**6), (59128, 1000)), 46 + 35 / 60 + 59.128 / 3600),
        (((46599758, 10**6), (35985467, 10**6), (59128, 1000)), 46 + 35 / 60 + 59.128 / 3600),
        (((46, 1), (59, 1), (60, 1)), 47.0),  # rounded
        (((46, 1), (35, 1), (5913, 1)), None),  # a denominator lost
        (((46, 1), (3598, 1), (0, 1)), None),
    ],
)
def test_parts_of_degrees(make_jpeg, parts, degrees):
    gps = gps_exif(46.5, -92.0) | {piexif.GPSIFD.GPSLatitude: parts}
    photo = read_photo(make_jpeg(exif=dji_exif(GPS=gps)))
    if degrees is None:
        assert photo.position is None and any("beyond 60" in n for n in photo.notes)
    else:
        assert photo.position.latitude_deg == pytest.approx(degrees, abs=1e-6)
