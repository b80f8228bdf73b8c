"""Photos reduced to the resolution that the growing map needs."""

from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store, digest
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.live.failures import concerning
from skyquilt.live.members import Member
from skyquilt.photos.pixels import Reduction, read_color

SHARPNESS = 1.2
"""Photo pixels per map pixel, along a side."""
QUALITY = 95
"""Quality of the stored reduced images."""
PICTURES_BYTES = 150_000_000
"""Bytes of reduced images kept in memory."""
STAGE = "small"
"""Their kind in the store."""


def measured(member: Member) -> bool:
    """Whether a photo contains measured values of one band (such as temperatures) instead of
    colours.
    """
    return member.photo.band == "thermal" and bool(member.photo.unit)


class SmallPictures:
    """Reduced images by photo, with one band or three; each is made once.

    They are kept in the store: on a large map each is needed many times, and reading a small file
    takes a quarter of the time of the photo.
    """

    def __init__(
        self, full: PixelCache[NDArray[Any]], members: dict[int, Member], store: Store
    ) -> None:
        self.full, self.members, self.store = full, members, store
        self._longest: dict[int, int] = {}
        self._at_hand = PixelCache(read=self._read, budget_bytes=PICTURES_BYTES)

    def __call__(self, number: int) -> NDArray[Any]:
        """Pixels (h, w, bands) of a photo, read-only; `longest` must have been called for it
        before.
        """
        return self._at_hand(number)

    @property
    def decoded(self) -> int:
        """How many times an image was read."""
        return self._at_hand.decoded

    def longest(self, member: Member, gsd: float, ground: float) -> int:
        """Longest side in px that a photo needs on a map of this pixel size in m over the ground.
        The first result is kept for later calls.
        """
        if member.id not in self._longest:
            photo, pose = member.photo, member.pose
            above = float(pose.map_C[2]) - ground if pose is not None else 50.0
            factor = max(1.0, gsd * photo.focal.px / (SHARPNESS * max(above, 1.0)))
            self._longest[member.id] = max(64, round(max(photo.width, photo.height) / factor))
        return self._longest[member.id]

    def _read(self, number: int) -> NDArray[Any]:
        with concerning(number):
            return self._reduced(number)

    def _reduced(self, number: int) -> NDArray[Any]:
        member = self.members[number]
        if measured(member):
            small = self._shrunken(member)
            return small.astype(np.float32).reshape(*small.shape[:2], -1)[..., :1]
        key = digest(member.photo.digest, self._longest[number], QUALITY, shrink, to_grey8)
        body = self.store.get_or(STAGE, key, lambda: _encoded(self._shrunken(member)))
        return np.asarray(simplejpeg.decode_jpeg(body.tobytes()))

    def _shrunken(self, member: Member) -> NDArray[Any]:
        photo, longest = member.photo, self._longest[member.id]
        factor = max(photo.width, photo.height) / longest
        ready = self.full.peek(member.id)
        if ready is None:
            # a last row or column of less than a whole step would count as a whole one
            steps: tuple[Reduction, ...] = (8, 4, 2)
            fits = (s for s in steps if factor >= s and not (photo.width % s or photo.height % s))
            ready = read_color(photo, reduction=next(fits, 1))
        return np.ascontiguousarray(shrink(ready, longest)[0])


def _encoded(small: NDArray[Any]) -> NDArray[np.uint8]:
    if small.dtype != np.uint8 or small.ndim == 2 or small.shape[2] < 3:
        small = np.repeat(to_grey8(small)[..., None], 3, 2)
    rgb = np.ascontiguousarray(small[..., :3])
    return np.frombuffer(simplejpeg.encode_jpeg(rgb, quality=QUALITY, colorspace="RGB"), np.uint8)
