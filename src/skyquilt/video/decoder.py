"""Decodes frames of clips by OpenCV: one decoder per clip, which seeks.

A frame is named by its time, because frame numbers do not tell where a frame is in a clip of
variable frame rate. Pixels are in sensor coordinates: rotation flags are not applied. Those of
recordings with oblong pixels (analog cameras, HDV) are made square, as players show them, and
interlaced frames have the lines of one field.
"""

import os
import threading
from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.video.interlaced import first_field

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its complaints would go to the terminal
# a container that names other files or addresses shall not open any
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
_OPEN, _ERRORS = 4, 2
_AHEAD = 30
"""Frames up to which it is cheaper to go on than to seek: OpenCV seeks to the key frame before the
sixteenth frame before, and decodes all from there.
"""
_TOLERANCE = 0.4
_OBLONG = (0.3, 3.0)
"""Ratios of width to height that pixels may have; others are errors of the file."""
_PLANAR = int.from_bytes(b"I420", "little")
"""Pixel format whose first plane is the brightness in 8 bits: 8-bit H.264, H.265 and MPEG-4."""
Frame = NDArray[np.uint8]


class Decoder:
    """Frames of one clip; not to be used by two threads at once."""

    def __init__(self, path: Path, *, grey: bool = False) -> None:
        """With `grey`, frames have one channel, which saves the conversion to RGB: as much as the
        decoding itself.

        Raises `UnreadablePhotoError` where the file holds no video that can be decoded.
        """
        self.path, self._grey, self._plane = path, grey, False
        self._time = -1.0
        self._open()

    def _open(self) -> None:
        cv2.utils.logging.setLogLevel(_ERRORS)  # its warnings would go to the terminal too
        cap = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        if not cap.isOpened():
            cap.release()
            raise UnreadablePhotoError("no video in it can be decoded")
        cap.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._cap = cap
        fps = float(cap.get(cv2.CAP_PROP_FPS))
        self.fps = fps if 0.1 <= fps <= 1000 else 30.0
        self.frames = max(int(cap.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        width = int(cap.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(cap.get(cv2.CAP_PROP_FRAME_HEIGHT))
        across = cap.get(cv2.CAP_PROP_SAR_NUM) / (cap.get(cv2.CAP_PROP_SAR_DEN) or 1.0)
        if not _OBLONG[0] < across < _OBLONG[1]:
            across = 1.0
        self.width = round(width * max(across, 1.0))
        self.height = round(height / min(across, 1.0))
        self._oblong = (width, height) != (self.width, self.height)
        self.rotation_deg = int(cap.get(cv2.CAP_PROP_ORIENTATION_META))
        code = int(cap.get(cv2.CAP_PROP_FOURCC))
        self.codec = "".join(chr(code >> 8 * i & 255) for i in range(4)).strip("\0 ")
        if self._grey and int(cap.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) == _PLANAR:
            self._plane = bool(cap.set(cv2.CAP_PROP_CONVERT_RGB, 0))
        self._time = -1.0

    def close(self) -> None:
        """Releases the decoder."""
        self._cap.release()

    def at(self, time_s: float) -> tuple[float, Frame] | None:
        """Time in s and pixels (height, width, 3) RGB, or (height, width) grey, of the first frame
        from `time_s` on; None after the last one.
        """
        near = _TOLERANCE / self.fps
        if not self._time - near <= time_s <= self._time + _AHEAD / self.fps:
            self._seek(time_s - near)
        while self._time < time_s - near:
            if not self.skip():
                return None
        found, pixels = self._cap.retrieve()
        if not found or pixels is None:
            return None
        if not self._plane:
            code = cv2.COLOR_BGR2GRAY if self._grey else cv2.COLOR_BGR2RGB
            pixels = cv2.cvtColor(pixels, code)
        frame = first_field(np.asarray(pixels, dtype=np.uint8))
        if self._oblong:
            frame = np.asarray(cv2.resize(frame, (self.width, self.height)), dtype=np.uint8)
        return self._time, frame

    def skip(self) -> bool:
        """Goes on by one frame; False after the last one."""
        before = self._time
        if not self._cap.grab():
            self._time = float("inf")
            return False
        time = float(self._cap.get(cv2.CAP_PROP_POS_MSEC)) / 1000
        # containers without times per frame: counted
        self._time = time if time > before or before == float("inf") else before + 1 / self.fps
        return True

    def _seek(self, target: float) -> None:
        """Goes to a frame at or before `target`."""
        margin = 2 / self.fps
        while target - margin > 0:
            self._time = -1.0
            self._cap.set(cv2.CAP_PROP_POS_MSEC, 1000 * (target - margin))
            if self.skip() and self._time <= target + 1e-9:
                return
            margin = 4 * margin + 1
        self._cap.release()
        self._open()


_decoders: OrderedDict[Path, tuple[Decoder, threading.Lock]] = OrderedDict()
_guard = threading.Lock()


def _decoder(path: Path) -> tuple[Decoder, threading.Lock]:
    """The decoder of a clip; those used least recently are closed."""
    with _guard:
        if path not in _decoders:
            _decoders[path] = Decoder(path), threading.Lock()
            while len(_decoders) > _OPEN:
                _, (old, lock) = _decoders.popitem(last=False)
                with lock:
                    old.close()
        _decoders.move_to_end(path)
        return _decoders[path]


def close_clip(path: Path) -> None:
    """Closes the decoder of a clip of which no frame is asked for soon: Windows lets nobody remove
    a clip before.
    """
    with _guard:
        found = _decoders.pop(path, None)
    if found is not None:
        decoder, lock = found
        with lock:
            decoder.close()


def frame_of(path: Path, time_s: float) -> Frame:
    """Pixels (height, width, 3) RGB of the frame of a clip at a time in s.

    Raises `UnreadablePhotoError` where it cannot be decoded.
    """
    decoder, lock = _decoder(path)
    with lock:
        found = decoder.at(time_s)
        if found is None or abs(found[0] - time_s) > 0.6 / decoder.fps:
            raise UnreadablePhotoError(f"the clip has no frame at {time_s:.3f} s")
        return found[1]
