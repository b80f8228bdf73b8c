"""Photos and side files that were made to break the readers: the sentence, the time, the memory."""

import shutil
import struct
import time

import numpy as np
import pytest
import tifffile

from skyquilt.errors import SideFileError, UnreadablePhotoError
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.cameras_json import read_cameras_json
from skyquilt.photos.distances import read_distances
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.side_files import read_geo_txt, read_mrk, read_positions_csv
from skyquilt.photos.srt import read_srt
from skyquilt.photos.tags import parse_xmp
from skyquilt.raster.boundary import read_boundary
from tests.attacks import SHARED, deflated_zeros, jpeg, needs_attacks, resident_mb, xmp

REASONS = {
    "thin-20000x32.jpg": "one side",
    "bomb-jpeg-245201": "megapixels",
    "bomb-jpeg-245204": "megapixels",
    "bomb-png-164340": "megapixels",
    "bomb-png-52556": "one side",
    "bomb-tiff-13130": "one side",
    "bomb-tiff-58951": "megapixels",
    "bomb-tiff-7530": "one side",
    "flir-png-bomb.jpg": "megapixels",
    "xmp-64k.jpg": "",
    "xmp-ext-640k.jpg": "",
    "markup-model.jpg": "",
}


@needs_attacks
@pytest.mark.parametrize("name", REASONS)
def test_attacks_on_photos(tmp_path, name):
    ends = {"jpeg": ".jpg", "png": ".png", "tiff": ".tif"}
    path = tmp_path / (name if "." in name else name + ends[name.split("-")[1]])
    shutil.copyfile(SHARED / name, path)
    before, began = resident_mb(), time.process_time()
    photo = read_photo(path)
    if isinstance(photo, Photo):
        read_color(photo)
    assert time.process_time() - began < 2
    assert resident_mb() - before < 400
    if REASONS[name]:
        assert isinstance(photo, RejectedPhoto) and REASONS[name] in photo.reason
        assert not photo.trace  # foreseen
    else:
        assert isinstance(photo, Photo)


@pytest.mark.parametrize(
    "body",
    [
        b"a" * 1_000_000,
        b"<x:xmpmeta " * 90_000,
        b"a:b" + b" " * 1_000_000,
        b"<a:b>" * 200_000,
        b"<a:" + b"b" * 1_000_000,
        b"<x xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>"
        + b"<rdf:Description>" * 20_000
        + b"</rdf:Description>" * 20_000
        + b"</x>",
    ],
    ids=["letters", "envelopes", "blanks", "elements", "name", "nested"],
)
def test_packets_are_read_in_linear_time(body):
    began = time.process_time()
    parse_xmp((body,))
    assert time.process_time() - began < 1.5


def test_many_scans_are_refused(tmp_path):
    data = jpeg(640, 480, progressive=True)
    at = data.rindex(b"\xff\xda")
    (tmp_path / "a.jpg").write_bytes(data[:at] + data[at:-2] * 200 + data[-2:])
    photo = read_photo(tmp_path / "a.jpg")
    assert isinstance(photo, RejectedPhoto) and "scans" in photo.reason
    (tmp_path / "b.jpg").write_bytes(data)
    assert isinstance(read_photo(tmp_path / "b.jpg"), Photo)


@pytest.mark.parametrize("what", ["segments", "fill"])
def test_endless_headers_are_refused(tmp_path, what):
    more = b"\xff\xe5\x00\x02" * 200_000 if what == "segments" else b"\xff" * 5_000_000
    data = jpeg()
    (tmp_path / "a.jpg").write_bytes(data[:2] + more + data[2:])
    began = time.process_time()
    assert isinstance(read_photo(tmp_path / "a.jpg"), RejectedPhoto)
    assert time.process_time() - began < 1


def test_a_tag_that_claims_the_whole_file_many_times(tmp_path):
    """EXIF of 5000 tags, each of which points to all of it."""
    entries = b"".join(struct.pack("<HHII", 0x9C00 + k % 50, 7, 60_000, 8) for k in range(5000))
    block = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 5000) + entries
    (tmp_path / "a.jpg").write_bytes(jpeg(64, 48, (0xE1, block.ljust(65_000, b"\0"))))
    before, began = resident_mb(), time.process_time()
    assert isinstance(read_photo(tmp_path / "a.jpg"), Photo)
    assert resident_mb() - before < 50 and time.process_time() - began < 1


def test_strips_that_unpack_to_more_than_they_hold(tmp_path):
    """A strip of 1 MB that inflates to 1 GB."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((64, 64, 3), np.uint8), photometric="rgb", compression=8)
    bomb = deflated_zeros(2**30)
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        for tag, value in ((273, len(data)), (279, len(bomb))):
            entry = tiff.pages[0].tags[tag]
            data[entry.offset + 2 : entry.offset + 12] = struct.pack("<HII", 4, 1, value)
    path.write_bytes(bytes(data) + bomb)
    photo = read_photo(path)
    before, began = resident_mb(), time.process_time()
    if isinstance(photo, Photo):
        with pytest.raises(UnreadablePhotoError):
            read_color(photo)
            raise UnreadablePhotoError("it was cut to its size")
    assert resident_mb() - before < 400 and time.process_time() - began < 2


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"GpsLatitude": "90", "GpsLongitude": "13"}, "pole"),
        ({"GpsLatitude": "52", "GpsLongitude": "13", "RelativeAltitude": "9500"}, "take-off"),
        ({"GimbalYawDegree": "1e300", "GimbalPitchDegree": "-90"}, "angles"),
        ({"FlightYawDegree": "1e9"}, "flight yaw"),
        (
            {"GpsLatitude": "52", "GpsLongitude": "13", "RtkFlag": "50", "RtkStdLon": "-3"},
            "accuracy",
        ),
        (
            {"DewarpData": "x;" + ",".join(["1e308"] * 9), "CalibratedFocalLength": "1e308"},
            "calibration",
        ),
    ],
)
def test_impossible_metadata_are_ignored_and_named(tmp_path, values, word):
    (tmp_path / "a.jpg").write_bytes(jpeg(64, 48, xmp(**values)))
    photo = read_photo(tmp_path / "a.jpg")
    assert isinstance(photo, Photo)
    assert word in " ".join(photo.notes).lower()
    assert photo.calibration is None and np.isfinite(photo.focal.px)
    assert photo.attitude is None and photo.flight_yaw_deg is None
    if photo.position:
        assert photo.position.takeoff_m is None and 0 < photo.position.sigma_xy_m < 10


def test_a_file_that_is_replaced_by_a_larger_one_is_not_decoded(tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg())
    photo = read_photo(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(jpeg(5000, 5000))
    before = resident_mb()
    with pytest.raises(UnreadablePhotoError, match="5000x5000"):
        read_color(photo)
    assert resident_mb() - before < 50


NAMES = ["SIM_0001.jpg", "SIM_0002.jpg"]
READ = {
    "geo": lambda p: read_geo_txt(p),
    "csv": lambda p: read_positions_csv(p),
    "mrk": lambda p: read_mrk(p, ["SIM_0001.jpg"]),
    "srt": lambda p: read_srt(p, []),
    "cameras": lambda p: read_cameras_json(p),
    "distances": lambda p: read_distances(p, NAMES),
    "boundary": lambda p: read_boundary(p, "EPSG:32633"),
}
BAD = {
    "geo-negative": ("geo", "g.txt", b"EPSG:4326\nSIM_0001.jpg 1 5 3 1 -9 0 -.2\n", "line 2.*-0.2"),
    "csv-negative": (
        "csv",
        "p.csv",
        b"name,lat,lon,accuracy\nSIM_0001.jpg,52,13,-3\n",
        "row 1.*-3",
    ),
    "mrk-negative": (
        "mrk",
        "p.MRK",
        b"1\t3.1\t[2043]\t-11,N\t2,E\t190,V\t52,Lat\t13.1,Lon\t100,Ellh\t-0.01, 0.02, 0.03\n",
        "line 1.*-0.01",
    ),
    "local-crs": (
        "geo",
        "g.txt",
        b'LOCAL_CS["x",UNIT["metre",1]]\nSIM_0001.jpg 1 2 3\n',
        "coordin",
    ),
    "long-field": ("csv", "p.csv", b"name,lat,lon\n" + b"a" * 140_000 + b",1,2\n", "not a table"),
    "open-quote": (
        "distances",
        "q.csv",
        b'point_a,point_b,metres\n"a,b,10\nc,d,10\n',
        "table|quote",
    ),
    "nested": ("cameras", "c.json", b"[" * 100_000, "not JSON"),
    "infinite": ("cameras", "c.json", b'{"all":{"width":1e400,"height":300,"focal":1}}', "width"),
    "nan": ("cameras", "c.json", b'{"all":{"width":4,"height":3,"focal":1,"k1":NaN}}', "k1"),
    "focal": ("cameras", "c.json", b'{"all":{"width":400,"height":300,"focal":1e308}}', "focal"),
    "digits": ("cameras", "c.json", b'{"all":{"width":' + b"9" * 5000 + b"}}", "JSON|width"),
    "superscript": (
        "srt",
        "s.srt",
        "²\n00:00:00,000 --> 00:00:01,000\nGPS(13.1,52.1,15)\n".encode(),
        "no subtitles",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_side_files_end_in_a_sentence(tmp_path, case):
    reader, name, data, word = BAD[case]
    (tmp_path / name).write_bytes(data)
    began = time.process_time()
    with pytest.raises(SideFileError, match=word):
        READ[reader](tmp_path / name)
    assert time.process_time() - began < 2


@needs_attacks
@pytest.mark.parametrize(
    "path",
    [p for p in SHARED.rglob("*") if p.is_file() and p.suffix != ".md"] if SHARED.is_dir() else [],
    ids=lambda p: p.name,
)
def test_every_attack_on_side_files_ends_soon_and_in_a_sentence(tmp_path, path):
    word = path.name.split("-")[0]
    reader, ending = {
        "geo": ("geo", ".txt"),
        "csv": ("csv", ".csv"),
        "mrk": ("mrk", ".MRK"),
        "cameras": ("cameras", ".json"),
        "distances": ("distances", ".csv"),
        "geojson": ("boundary", ".geojson"),
        "shp": ("boundary", ".shp"),
        "wkt": ("boundary", ".wkt"),
        "d.json": ("cameras", ".json"),
        "i.json": ("cameras", ".json"),
        "j.json": ("cameras", ".json"),
        "k.json": ("cameras", ".json"),
        "e.txt": ("geo", ".txt"),
        "f.csv": ("csv", ".csv"),
        "f.MRK": ("mrk", ".MRK"),
        "g.MRK": ("mrk", ".MRK"),
        "f.srt": ("srt", ".srt"),
        "q.csv": ("distances", ".csv"),
        "q2.csv": ("distances", ".csv"),
    }.get(word, ("", ""))
    if not reader:
        pytest.skip("a photo, or for another reader")
    copy = tmp_path / ("a" + ending)
    shutil.copyfile(path, copy)
    before, began = resident_mb(), time.process_time()
    try:
        READ[reader](copy)
    except SideFileError as error:
        assert "\x00" not in str(error) and len(str(error)) < 3000
    else:
        assert word in ("geojson", "csv", "shp", "wkt")  # harmless in themselves
    assert time.process_time() - began < 2
    assert resident_mb() - before < 400


def test_names_with_odd_digits_are_sorted():
    names = ["²1.jpg", "b10.jpg", "b9.jpg", "b" + "9" * 5000 + ".jpg", "١.jpg"]
    order = [names[i] for i in sequence_of(names, "name")]
    assert order.index("b9.jpg") < order.index("b10.jpg") < order.index(names[3])


def test_a_thin_picture_shrinks_to_no_less_than_a_pixel():
    from skyquilt.imaging.grey import shrink

    assert shrink(np.zeros((32, 20_000, 3), np.uint8), 256)[0].shape == (1, 256, 3)
