"""Frames by time: the picture itself tells which frame it is."""

import re
import struct

import numpy as np
import pytest

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.clip import Clip
from skyquilt.model.photo import RejectedPhoto
from skyquilt.video.decoder import Decoder, frame_of
from skyquilt.video.read import read_clip
from tests.video.clips import SIZE, number_of, numbered, write_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("clip") / "a.mp4", numbered(150), fps=29.97)


def test_a_seek_gives_the_same_frame_as_going_there(clip):
    decoder = Decoder(clip)
    order = [0, 149, 3, 3, 77, 12, 148, 1, 60, 61, 59]
    assert [number_of(decoder.at(i / 29.97)[1]) for i in order] == order
    assert decoder.at(10.0) is None
    assert number_of(decoder.at(0.0)[1]) == 0
    decoder.close()


def test_distant_frames_are_sought_and_near_ones_gone_to(clip, monkeypatch):
    """Each in the way that decodes fewer frames; OpenCV's seek decodes 16 and more."""
    decoder, sought = Decoder(clip), []
    seek = decoder._seek
    monkeypatch.setattr(decoder, "_seek", lambda t: (sought.append(round(t * 29.97)), seek(t)))
    order = [0, 20, 40, 80, 120, 140]
    assert [number_of(decoder.at(i / 29.97)[1]) for i in order] == order
    assert sought == [80, 120]


def test_frames_of_many_clips_are_told_apart_and_missing_ones_refused(tmp_path):
    paths = [write_clip(tmp_path / f"{k}.mp4", list(numbered(20))[k:], fps=10) for k in range(6)]
    assert [number_of(frame_of(p, 0.5)) for p in [*paths, *paths[::-1]]] == [
        5, 6, 7, 8, 9, 10, 10, 9, 8, 7, 6, 5,
    ]  # fmt: skip
    with pytest.raises(UnreadablePhotoError, match="no frame at 9"):
        frame_of(paths[0], 9.0)


def test_frames_of_variable_rate_are_found_by_their_times(clip, tmp_path):
    """The second half of the frames last three times as long: times change, not frames."""
    data = bytearray(clip.read_bytes())
    at = data.index(b"stts") + 8
    count, samples, delta = struct.unpack(">III", data[at : at + 12])
    assert (count, samples) == (1, 150)
    # two runs need 8 bytes more, so the table is written over with one run per half in a new box
    entry = struct.pack(">IIIII", 2, 75, delta // 2, 75, 2 * delta - delta // 2)
    data[at - 8 - 4 : at + 12] = struct.pack(">I4sI", 16 + 16, b"stts", 0) + entry
    _grow(data, (b"moov", b"trak", b"mdia", b"minf", b"stbl"), 8)
    path = tmp_path / "vfr.mp4"
    path.write_bytes(bytes(data))
    decoder, times, seen = Decoder(path), [], []
    for _ in range(200):
        found = decoder.at(0.0 if not times else times[-1] + 0.016)
        if found is None:
            break
        times.append(found[0])
        seen.append(number_of(found[1]))
    assert seen == list(range(150))
    steps = np.diff(times)
    assert np.allclose(steps[:73], 0.5 / 29.97, atol=2e-4)
    assert np.allclose(steps[76:], 1.5 / 29.97, atol=2e-4)
    assert [number_of(frame_of(path, times[i])) for i in (140, 20, 90, 75)] == [140, 20, 90, 75]


@pytest.mark.parametrize("shape", [(4, 3), (8, 9), (1, 1), (100, 1)])
@pytest.mark.parametrize("grey", [False, True])
def test_oblong_pixels_are_made_square(clip, tmp_path, shape, grey):
    """As the file says; what no camera has is an error of the file."""
    data = bytearray(clip.read_bytes())
    entry = data.index(b"stsd") + 12
    (length,) = struct.unpack(">I", data[entry : entry + 4])
    data[entry + length : entry + length] = struct.pack(">I4sII", 16, b"pasp", *shape)
    data[entry : entry + 4] = struct.pack(">I", length + 16)
    _grow(data, (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd"), 16)
    path = tmp_path / "oblong.mp4"
    path.write_bytes(data)
    square, oblong = Decoder(clip, grey=grey), Decoder(path, grey=grey)
    ratio = shape[0] / shape[1] if shape[0] < 10 else 1.0
    assert oblong.width == round(SIZE[0] * max(1, ratio))
    assert oblong.height == round(SIZE[1] / min(1, ratio))
    seen, before = oblong.at(1.0)[1], square.at(1.0)[1]
    assert seen.shape[:2] == (oblong.height, oblong.width)
    assert np.abs(seen.mean((0, 1)) - before.mean((0, 1))).max() < 0.5
    read = read_clip(path, name="oblong.mp4")
    assert (read.width, read.height) == (oblong.width, oblong.height)


def _grow(data, boxes, by):
    for name in boxes:
        at = data.index(name) - 4
        data[at : at + 4] = struct.pack(">I", struct.unpack(">I", data[at : at + 4])[0] + by)


def test_a_rotation_flag_is_told_and_not_applied(clip, tmp_path):
    data = bytearray(clip.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(
        ">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, SIZE[1] << 16, 0, 1 << 30
    )
    path = tmp_path / "portrait.mp4"
    path.write_bytes(bytes(data))
    read = read_clip(path, name="portrait.mp4")
    assert isinstance(read, Clip)
    assert (read.width, read.height, read.rotation_deg) == (*SIZE, 90)
    assert any("turned by 90 degrees" in n for n in read.notes)
    assert number_of(frame_of(path, 100 / 29.97)) == 100


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("torn", lambda d: d[: len(d) // 2], "cut off: it has no index"),
        ("sound", lambda d: d.replace(b"vide", b"soun"), "sound only"),
        ("empty", lambda _: b"", "0 bytes"),
        ("text", lambda _: b"no video at all, but some words" * 9, "no video in it"),
        ("none", lambda d: _without_frames(d), "without a frame|no video in it"),
    ],
)
def test_what_is_no_clip_gets_a_sentence(clip, tmp_path, capfd, name, change, reason):
    path = tmp_path / f"{name}.mp4"
    path.write_bytes(change(clip.read_bytes()))
    read = read_clip(path, name=path.name)
    assert isinstance(read, RejectedPhoto)
    assert re.search(reason, read.reason), read.reason
    assert capfd.readouterr().err == ""


def _without_frames(data):
    """Its table of samples says 0."""
    out = bytearray(data)
    for name in (b"stsz", b"stts", b"stsc", b"stco"):
        at = out.index(name) + 8
        start = at + 4 if name == b"stsz" else at
        out[start : start + 4] = bytes(4)
    return bytes(out)


@pytest.mark.parametrize(
    "text", ["ffconcat version 1.0\nfile a.mp4\n", "#EXTM3U\n#EXTINF:10,\na.mp4\n#EXT-X-ENDLIST\n"]
)
def test_text_that_names_other_files_opens_none(clip, tmp_path, text):
    """FFmpeg would play the clip beside it."""
    (tmp_path / "a.mp4").write_bytes(clip.read_bytes())
    path = tmp_path / "b.mp4"
    path.write_text(text)
    read = read_clip(path, name="b.mp4")
    assert isinstance(read, RejectedPhoto)
    assert "no video in it" in read.reason


def test_frames_of_an_absurd_size_are_refused_before_they_are_decoded(clip, tmp_path):
    data = bytearray(clip.read_bytes())
    at = data.index(b"mp4v", data.index(b"stsd")) + 28
    assert struct.unpack(">HH", data[at : at + 4]) == SIZE
    data[at : at + 4] = struct.pack(">HH", 12288, 8192)
    path = tmp_path / "large.mp4"
    path.write_bytes(bytes(data))
    read = read_clip(path, name="large.mp4")
    assert isinstance(read, RejectedPhoto)
    assert read.reason == "it has 12288x8192 px, and 50 megapixels are the most of a frame"
