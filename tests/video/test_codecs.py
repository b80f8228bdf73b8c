"""Clips in the codecs of drones. `recorded/` holds the 120 frames of `clips.numbered` at 25 per
second as H.264 (3 B-frames, a key frame a second), H.265 (the same, open groups of pictures) and
H.265 in 10 bits, from FFmpeg's encoders: OpenCV's wheels write none of these.
"""

from pathlib import Path

import numpy as np
import pytest

from skyquilt.model.clip import Clip
from skyquilt.video.decoder import Decoder, frame_of
from skyquilt.video.looks import Looker
from skyquilt.video.read import read_clip
from tests.video.clips import number_of

RECORDED = Path(__file__).parent / "recorded"
CLIPS = ("h264.mp4", "h265.mp4", "h265-10bit.mp4")


@pytest.mark.parametrize("name", CLIPS)
def test_frames_are_found_by_their_times_among_reordered_ones(name):
    path = RECORDED / name
    order = [0, 119, 3, 3, 77, 12, 118, 1, 60, 61, 59, 24, 25, 26, 50, 49, 51]
    assert [number_of(frame_of(path, i / 25)) for i in order] == order
    decoder = Decoder(path)
    assert [number_of(decoder.at(i / 25)[1]) for i in range(120)] == list(range(120))
    assert decoder.at(4.8) is None
    clip = read_clip(path, name=name)
    assert isinstance(clip, Clip)
    assert (clip.width, clip.height, clip.fps, clip.frames) == (320, 240, 25.0, 120)
    assert clip.codec == ("h264" if name.startswith("h264") else "hevc")


@pytest.mark.parametrize("name", CLIPS)
def test_grey_frames_are_the_brightness_of_the_coloured_ones(name):
    """Ten bits have no plane of 8 bits that could be taken as it is."""
    grey, colours = Decoder(RECORDED / name, grey=True), Decoder(RECORDED / name)
    for time in (0.0, 4.0, 1.0):
        (at, seen), (also_at, true) = grey.at(time), colours.at(time)
        assert at == also_at
        assert seen.shape == (240, 320)
        # of both a limited and a full range: black and white in the same places
        assert np.array_equal(seen > 128, true.mean(axis=2) > 128)


def test_looks_at_recorded_clips_are_the_same_whatever_the_codec():
    seen = []
    for name in CLIPS:
        decoder = Decoder(RECORDED / name, grey=True)
        *_, looks = Looker()(decoder, 0, last=None, open_end=True)
        seen.append(looks.time_s)
    assert np.allclose(seen[0], np.arange(0, 4.8, 0.2))
    assert np.allclose(seen, seen[0])
