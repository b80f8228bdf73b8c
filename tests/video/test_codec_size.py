"""Sizes in the headers of codecs: against OpenCV for recorded clips, and as an attacker writes
them.
"""

import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from skyquilt.model.photo import RejectedPhoto
from skyquilt.video.codec_size import codec_sizes
from skyquilt.video.container import read_container
from skyquilt.video.read import read_clip
from tests.video.clips import numbered, write_clip

RECORDED = sorted((Path(__file__).parent / "recorded").glob("*.mp4"))


def golomb(number):
    bits = f"{number + 1:b}"
    return "0" * (len(bits) - 1) + bits


def sps(width, height, *, lists=False, order=0, interlaced=False):
    """An H.264 sequence parameter set of profile High, in bits by 7.3.2.1."""
    bits = f"{100:08b}{0:08b}{51:08b}" + golomb(0) + golomb(1) + golomb(0) * 2 + "0"
    factors = "1" + (golomb(1) + golomb(0) * 15)  # the first factor is 9, and so are all
    bits += "1" + factors + "0" * 7 if lists else "0"
    bits += golomb(4) + golomb(order)
    bits += golomb(4) if order == 0 else "1" + golomb(3) + golomb(2) + golomb(2) + golomb(1) * 2
    rows = height // 16 // (2 if interlaced else 1)
    bits += golomb(4) + "0" + golomb(width // 16 - 1) + golomb(rows - 1)
    bits += "0" if interlaced else "1"
    bits += "1" * 9
    bits += "0" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big")
    for last in range(4):  # as an encoder protects it from looking like a start code
        data = data.replace(bytes([0, 0, last]), bytes([0, 0, 3, last]))
    return b"\x67" + data


def described(unit):
    return b"avc1" + bytes(78) + b"avcC" + b"\1\x64\0\x33\xff\xe1" + struct.pack(
        ">H", len(unit)
    ) + unit + b"\1\0\4\x68\xee\x3c\x80"  # fmt: skip


@pytest.mark.parametrize("path", RECORDED, ids=lambda p: p.name)
def test_recorded_clips_have_the_size_that_opencv_sees(path):
    clip = cv2.VideoCapture(str(path))
    size = (clip.get(cv2.CAP_PROP_FRAME_WIDTH), clip.get(cv2.CAP_PROP_FRAME_HEIGHT))
    assert read_container(path).coded == (size,)


def test_mpeg4_has_the_size_that_was_written(tmp_path):
    path = write_clip(tmp_path / "a.mp4", numbered(3))
    assert read_container(path).coded == (read_container(path).size,)


@pytest.mark.parametrize("size", [(1920, 1088), (16384, 16384), (65536, 512)])
@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("order", [0, 1])
@pytest.mark.parametrize("interlaced", [False, True])
def test_every_form_of_the_header_is_read(size, lists, order, interlaced):
    unit = sps(*size, lists=lists, order=order, interlaced=interlaced)
    assert codec_sizes(described(unit)) == [size]


def test_torn_headers_tell_nothing():
    whole = described(sps(1920, 1088))
    for end in range(len(whole)):
        assert codec_sizes(whole[:end]) in ([], [(1920, 1088)])


def test_a_codec_that_contradicts_its_container_allocates_nothing(tmp_path, monkeypatch):
    """The container says 320 x 240, the codec 16384 x 16384, 400 MB a frame."""
    source = next(p for p in RECORDED if p.name == "h264.mp4")
    data = bytearray(source.read_bytes())
    at = data.index(b"avcC") + 10
    (old,) = struct.unpack(">H", data[at : at + 2])
    unit = sps(16384, 16384)
    data[at : at + 2 + old] = struct.pack(">H", len(unit)) + unit
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1", b"avcC"):
        box = data.index(name) - 4
        (size,) = struct.unpack(">I", data[box : box + 4])
        data[box : box + 4] = struct.pack(">I", size + len(unit) - old)
    path = tmp_path / "a.mp4"
    path.write_bytes(bytes(data))
    assert read_container(path).size == (320, 240)
    monkeypatch.setattr("skyquilt.video.read.Decoder", None)
    read = read_clip(path, name="a.mp4")
    assert isinstance(read, RejectedPhoto)
    assert read.reason == "it has 16384x16384 px, and 50 megapixels are the most of a frame"


READ = """
import resource, sys
from pathlib import Path
from skyquilt.video.read import read_clip
first = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(getattr(read_clip(Path(sys.argv[1]), name="a"), "reason", "taken"))
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - first) // 1024)
"""


@pytest.mark.parametrize("ending", ["avi", "mkv"])
def test_jpegs_larger_than_avi_and_matroska_say_allocate_nothing(tmp_path, ending):
    """These containers say 320 x 240, the pictures in them 16384 x 16384."""
    path = write_clip(tmp_path / f"a.{ending}", numbered(3), fourcc="MJPG")
    data = path.read_bytes()
    was, now = (
        b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", *s) for s in ((240, 320), (16384,) * 2)
    )
    assert data.count(was) == 3
    path.write_bytes(data.replace(was, now))
    told = subprocess.run(
        [sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True
    )
    reason, grown = told.stdout.splitlines()
    assert reason == "it is a video without a frame that can be decoded"
    assert int(grown) < 200  # MB; a frame of them would take 800
    assert told.stderr == ""


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "fourcc"), [("avi", "XVID"), ("mkv", "mp4v"), ("mts", "mp4v")])
def test_frames_larger_than_the_container_says_are_refused(tmp_path, ending, fourcc):
    side = 7104
    frame = np.full((side, side, 3), 90, np.uint8)
    written = tmp_path / f"a.{'ts' if ending == 'mts' else ending}"
    path = write_clip(written, [frame], fourcc=fourcc)
    data = bytearray(path.read_bytes())
    if ending == "avi":
        for name, offset in ((b"avih", 40), (b"strf", 12)):
            at = data.index(name) + offset
            assert struct.unpack("<ii", data[at : at + 8]) == (side, side)
            data[at : at + 8] = struct.pack("<ii", 320, 240)
    if ending == "mkv":  # PixelWidth and PixelHeight
        for name, value in ((b"\xb0", 320), (b"\xba", 240)):
            at = data.index(name + b"\x82" + struct.pack(">H", side))
            data[at + 2 : at + 4] = struct.pack(">H", value)
    path = tmp_path / f"b.{ending}"
    path.write_bytes(data)
    read = read_clip(path, name=path.name)
    assert isinstance(read, RejectedPhoto)
    assert read.reason == f"it has {side}x{side} px, and 50 megapixels are the most of a frame"
