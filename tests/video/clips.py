"""Clips whose truth is known, made of a texture over which a frame moves."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.texture import texture

SIZE = (320, 240)


def write_clip(path: Path, frames, fps: float = 10.0, fourcc: str = "mp4v") -> Path:
    """A clip of frames (h, w, 3)."""
    frames = list(frames)
    height, width = frames[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*fourcc)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return path


def numbered(count: int):
    """Frames that show their number as nine white or black stripes."""
    for number in range(count):
        frame = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        for bit in range(9):
            frame[:, bit * 32 : (bit + 1) * 32] = 255 * (number >> bit & 1)
        yield frame


def number_of(frame) -> int:
    """What `numbered` wrote."""
    return sum(int(frame[100, bit * 32 + 16, 0] > 128) << bit for bit in range(9))


@cache
def ground(size: int = 2400):
    """A texture (size, size, 3)."""
    grey = np.clip(texture(size, size), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def flown(places, yaws=None, blurred=(), size=SIZE):
    """Frames of `ground` with their middle at `places` (n, 2) px and turned by `yaws` in rad
    clockwise; those in `blurred` with a motion blur of 11 px.
    """
    picture, (width, height) = ground(), size
    yaws = np.zeros(len(places)) if yaws is None else yaws
    for i, ((x, y), yaw) in enumerate(zip(places, yaws, strict=True)):
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s], [s, c]])
        shift = np.array([x, y]) - turn @ [(width - 1) / 2, (height - 1) / 2]
        matrix = np.hstack([turn, shift[:, None]])
        frame = cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        yield cv2.blur(frame, (11, 1)) if i in blurred else frame


SRT = (
    "{n}\n00:00:{a:06.3f} --> 00:00:{b:06.3f}\n2024-05-01 10:00:{a:06.3f}\n[focal_len: 24.00]"
    " [latitude: {lat:.6f}] [longitude: 14.300000] [rel_alt: 50.000 abs_alt: 480.000]"
    " [gb_yaw: 30.0 gb_pitch: -88.0 gb_roll: 0.0]\n\n"
)


def filmed(folder: Path, frames: int = 40) -> Path:
    """A clip of a straight flight, A.MP4, with telemetry beside it."""
    places = np.stack([np.full(frames, 500.0), 900 - 6.0 * np.arange(frames)], axis=1)
    path = write_clip(folder / "A.MP4", flown(places), fps=5.0)
    rows = (SRT.format(n=i + 1, a=i / 5, b=(i + 1) / 5, lat=46.6 + 1e-5 * i) for i in range(frames))
    path.with_suffix(".SRT").write_text("".join(rows))
    return path
