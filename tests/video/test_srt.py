"""DJI's telemetry in every layout at hand, against what its makers meant."""

from pathlib import Path

import pytest

from skyquilt.errors import SideFileError
from skyquilt.video.tracks import read_track
from tests.video.clips import SRT

SAMPLES = Path(__file__).parents[2] / ".." / "shared" / "data" / "srt"
NAN = "nan"
# file: rows, rows without position; of the first row latitude, longitude, height above take-off and
# above the sea; 35 mm equivalent, the clock at the clip's start. Read by eye in the files.
MEANT = {
    "MAVIC3.srt": (139, 1, 3.41531, -3.37440, -2.4, 0.401, 24.0, "2021-12-25 12:27:52.373000"),
    "air2s.srt": (17, 0, 41.424724, 2.234156, NAN, 117.0, 24.0, "2022-08-07 13:40:40.774000"),
    "matrice_300.srt": (381, 0, 36.6146, -6.1120, 0.3, NAN, None, "2022-06-21 16:06:17"),
    "mavic_air2.srt": (25, 0, 41.420684, 2.162162, NAN, 27.3, 24.0, "2022-05-01 15:01:58.531000"),
    "mix_p4rtk_mavic2pro.srt": (12, 0, -34.650200, -59.409424, 17.39, NAN, 28.0, None),
    "broken_incomplete.SRT": (20, 1, -34.7383, -58.4563, 20.1, NAN, None, "2017-07-03 10:15:02"),
    "broken_incomplete2.SRT": (6, 1, -34.86995, -57.823395, NAN, 74.725998, 28.0, None),
    "embedder_Avata360.SRT": (5, 0, 53.365080, 6.460739, 5.4, -124.744, 28.0, None),
    "embedder_Mini5PRO.SRT": (5, 0, 53.365108, 6.460719, 6.0, -122.769, 24.0, None),
    "embedder_air3.SRT": (2, 0, 59.1111, 18.2222, 5.0, 105.0, None, "2024-01-01 12:00:00"),
    "embedder_air3S.SRT": (5, 0, 34.270373, -84.176160, 0.0, 302.208, 24.0, None),
    "embedder_avata2.SRT": (2, 0, 39.906217, 116.391305, 91.2, NAN, None, None),
    "embedder_mini4pro.SRT": (2, 0, 59.0, 18.0, 1.0, 100.0, None, None),
    "embedder_neo2.SRT": (5, 0, 45.607181, 13.753860, 0.0, 113.9, None, None),
    "m2zoom.SRT": (136, 1, 31.452012, 74.398751, NAN, 213.983002, 24.0, None),
    "mavic_2_style.SRT": (468, 0, -20.2533, 149.0251, NAN, NAN, None, None),
    "mavic_2pro_new.SRT": (146, 1, -35.080155, -60.286702, NAN, NAN, 28.0, None),
    "mavic_mini.SRT": (117, 0, 48.0771, -121.7458, 200.7, NAN, None, None),
    "mavic_pro.SRT": (468, 0, -20.2533, 149.0251, 1.9, NAN, None, "2017-08-05 14:11:50"),
    "mavic_pro_buggy.SRT": (546, None, 42.4668, -1.2218, 0.0, NAN, None, None),
    "old_format.SRT": (468, 0, -20.2533, 149.0251, 1.9, NAN, None, "2017-08-05 14:11:50"),
    "p4_rtk.SRT": (55, 0, -34.237922, -58.851745, 85.8, NAN, None, None),
    "p4p_sample.SRT": (5, 0, 47.4692, 8.2090, 45.6, NAN, None, None),
}
REFUSED = {
    "broken_empty.SRT": "contains no subtitles",
    "broken_empty2.SRT": "contains no subtitles",
    "mavic_air.SRT": "contains no position",
}


@pytest.mark.real
@pytest.mark.parametrize("name", [*MEANT, *REFUSED, "embedder_neo2_nogps.SRT"])
def test_samples_are_read_as_their_makers_meant(name):
    if not SAMPLES.is_dir():
        pytest.skip("samples of telemetry are not there")
    if name in REFUSED:
        with pytest.raises(SideFileError, match=REFUSED[name]):
            read_track(SAMPLES / name)
        return
    track = read_track(SAMPLES / name)
    if name == "embedder_neo2_nogps.SRT":  # zeros at the start, then a position
        assert track.zeros == 3
        assert abs(track.latitude_deg).min() > 30
        return
    rows, zeros, latitude, longitude, takeoff, sea, focal, clock = MEANT[name]
    assert track.rows == rows
    assert zeros is None or track.zeros - zeros in (0, 1)  # a torn last row lacks its position
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (latitude, longitude)
    assert str(track.takeoff_m[0]) == str(takeoff)
    assert str(track.sea_level_m[0]) == str(sea)
    assert track.focal_35mm == focal
    assert clock is None or str(track.start) == clock
    # no flight goes further: an exchanged order or a torn number would
    assert abs(track.latitude_deg - latitude).max() < 0.02
    assert abs(track.longitude_deg - longitude).max() < 0.02


def test_every_sample_is_in_the_table():
    if not SAMPLES.is_dir():
        pytest.skip("samples of telemetry are not there")
    names = {p.name for p in SAMPLES.iterdir() if p.suffix.lower() == ".srt"}
    assert names == {*MEANT, *REFUSED, "embedder_neo2_nogps.SRT"}


def test_angles_of_the_gimbal_and_of_the_aircraft(tmp_path):
    path = tmp_path / "a.srt"
    path.write_text(
        "1\n00:00:00,000 --> 00:00:01,000\nF/5.6, SS 400, ISO 100, EV 0, GPS (-58.85, -34.23, 15),"
        " HOME (-58.84, -34.22, -57.98m), D 698.70m, H 85.80m, F.PRY (2.7°, -7.0°, 110.1°),"
        " G.PRY (-24.4°, 1.5°, 112.4°)\n"
    )
    track = read_track(path)
    assert track.gimbal_deg[0].tolist() == [112.4, -24.4, 1.5]
    assert track.flight_yaw_deg[0] == 110.1
    assert track.takeoff_m[0] == 85.8


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M", (36.6146, -6.1120)),
        ("GPS(-6.1120,36.6146,17) BAROMETER:0.3", (36.6146, -6.1120)),
        ("GPS(149.0251,-20.2533,0.0M)", (-20.2533, 149.0251)),
        ("[latitude : -20.2533] [longtitude : 149.0251]", (-20.2533, 149.0251)),
    ],
)
def test_the_order_of_latitude_and_longitude(tmp_path, text, place):
    path = tmp_path / "a.srt"
    path.write_text(f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n")
    track = read_track(path)
    assert (track.latitude_deg[0], track.longitude_deg[0]) == place


@pytest.mark.parametrize(
    "text",
    [
        "2024-05-01 12:00:00,123\n[latitude: 46,500123] [longitude: 14,300456]"
        " [rel_alt: 5,400 abs_alt: 100,250]",
        "GPS(14,300456,46,500123,16) BAROMETER:5,4",
        "GPS(14.300456,46.500123,16) BAROMETER:5,4",
        "F/5,6, GPS (14,300456, 46,500123, 15), D 150,00m, H 5,40m, H.S 6,00m/s,"
        " F.PRY (0,0°, 0,0°, 9,5°), G.PRY (-89,5°, 0,0°, 10,5°)",
    ],
)
def test_decimal_commas_are_read(tmp_path, text):
    path = tmp_path / "a.srt"
    path.write_text(f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n")
    track = read_track(path)
    assert (track.latitude_deg[0], track.longitude_deg[0]) == (46.500123, 14.300456)
    assert track.takeoff_m[0] == 5.4
    if "PRY" in text:
        assert track.gimbal_deg[0].tolist() == [10.5, -89.5, 0.0]
        assert track.flight_yaw_deg[0] == 9.5
    if "abs_alt" in text:
        assert track.sea_level_m[0] == 100.25
        assert str(track.start) == "2024-05-01 12:00:00.123000"


def test_a_number_torn_off_at_the_end_is_not_a_position(tmp_path):
    whole = "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 46.5] [longitude: 14.3] \n\n"
    path = tmp_path / "a.srt"
    for torn in ("[latitude: 46.5] [longitude: 1", "[latitude: 46.5] [longitude: 14."):
        path.write_text(whole + "2\n00:00:01,000 --> 00:00:02,000\n" + torn)
        track = read_track(path)
        assert (track.rows, track.zeros, track.longitude_deg.tolist()) == (2, 1, [14.3])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
def test_encodings_and_line_ends_change_nothing(tmp_path, encoding, ends):
    text = "".join(
        SRT.format(n=i + 1, a=i / 5, b=(i + 1) / 5, lat=46.6 + 1e-5 * i).replace("88.0", "88.0°")
        for i in range(9)
    )
    (tmp_path / "a.SRT").write_text(text, encoding="utf-8")
    (tmp_path / "b.SRT").write_bytes(text.replace("\n", ends).encode(encoding))
    plain, other = (read_track(tmp_path / f"{name}.SRT") for name in "ab")
    assert len(plain.time_s) == 9
    assert other.digest == plain.digest
    assert other.start == plain.start
