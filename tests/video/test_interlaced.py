"""Frames woven of two simulated ones, half a frame apart."""

import cv2
import numpy as np
import pytest

from skyquilt.video.decoder import Decoder
from skyquilt.video.interlaced import first_field

WIDTH, HEIGHT = 720, 576


def ground(seed=3):
    """Grey texture (h, w, 3), smooth enough for a camera to resolve."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(HEIGHT + 64, WIDTH + 64)).astype(np.float32)
    smooth = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.2, 4, 12))
    grey = np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def frame(seen, moved):
    return seen[moved : moved + HEIGHT, 2 * moved : 2 * moved + WIDTH]


def woven(seen, moved, by):
    out = frame(seen, moved).copy()
    out[1::2] = frame(seen, moved + by)[1::2]
    return out


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("by", [2, 5])
def test_a_combed_frame_is_that_of_its_first_field(by, grey):
    seen = ground()
    seen = seen[..., 1] if grey else seen
    true, combed = frame(seen, 7), woven(seen, 7, by)
    got = first_field(combed)
    np.testing.assert_array_equal(got[::2], true[::2])

    def off(a):
        return np.abs(a.astype(float) - true).mean()

    assert off(got) < 0.25 * off(combed)
    # its lines lie where they were: the true frame is where it best fits
    shifted = [off(np.roll(got, k, 0)) for k in (-1, 0, 1)]
    assert min(shifted) == shifted[1]


def test_whole_frames_stay_as_they_are():
    seen = ground()
    stripes = np.repeat((np.arange(HEIGHT) // 2 % 2 * 200).astype(np.uint8)[:, None], WIDTH, 1)
    for whole in (frame(seen, 3), stripes, np.full((HEIGHT, WIDTH), 9, np.uint8)):
        assert first_field(whole) is whole
    odd = woven(seen, 3, 5)[:500]  # no standard interlaces 500 lines
    assert first_field(odd) is odd


@pytest.mark.parametrize("grey", [False, True])
def test_frames_of_an_interlaced_clip_are_decoded_without_combs(tmp_path, grey):
    seen, path = ground(), tmp_path / "a.avi"
    out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for k in range(5):
        out.write(woven(seen, 6 * k, 3))
    out.release()
    decoder = Decoder(path, grey=grey)
    got = decoder.at(3 / 25)[1]
    decoder.close()
    true, combed = frame(seen, 18), woven(seen, 18, 3)
    if grey:
        true, combed = true[..., 0], combed[..., 0]
    off_got, off_combed = (np.abs(f.astype(float) - true).mean() for f in (got, combed))
    assert 2 * off_got < off_combed
