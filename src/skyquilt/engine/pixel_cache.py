"""Cache of decoded photos, or of what was computed from them, within a memory budget."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from skyquilt.engine.memory_watch import resident_bytes
from skyquilt.settings import USUAL_GB

LEAST_BYTES = 150_000_000
"""Bytes of decoded photos that are kept whatever else is in memory."""


class HasBytes(Protocol):
    """An array, or a record that tells its size."""

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""


Kept = TypeVar("Kept", bound=HasBytes)


@dataclass(kw_only=True)
class PixelCache(Generic[Kept]):
    """Keeps decoded photos; the least recently used are dropped when the budget is exceeded.
    Thread-safe.
    """

    read: Callable[[int], Kept]
    """Decodes a photo by its index."""
    budget_bytes: int
    """Most bytes kept; a photo larger than that is returned but not kept."""
    resident_bytes: int = 0
    """Resident memory of the process above which fewer are kept, but at least `LEAST_BYTES`; 0 = as
    many as the budget allows.
    """
    decoded: int = 0
    """How many times a photo was decoded."""
    dropped: int = 0
    """How many were dropped for others."""
    _bytes: int = 0
    _kept: OrderedDict[int, Kept] = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _busy: dict[int, threading.Lock] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """A copy in another process begins empty."""
        return {
            "read": self.read,
            "budget_bytes": self.budget_bytes,
            "resident_bytes": self.resident_bytes,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def __call__(self, photo: int) -> Kept:
        """Pixels of a photo, read-only."""
        with self._lock:
            own = self._busy.setdefault(photo, threading.Lock())
        with own:  # two threads that request the same photo decode it once
            with self._lock:
                if photo in self._kept:
                    self._kept.move_to_end(photo)
                    return self._kept[photo]
            pixels = self.read(photo)
            if isinstance(pixels, np.ndarray):
                pixels.setflags(write=False)
            self.put(photo, pixels)
            return pixels

    def once(self, photo: int) -> Kept:
        """Pixels of a photo that is not asked for again soon: they are not kept where not all of
        them fitted so far.
        """
        if not self.dropped:
            return self(photo)
        held = self.peek(photo)
        return self.read(photo) if held is None else held

    def put(self, photo: int, pixels: Kept) -> None:
        """Keeps pixels that the caller decoded, if they fit."""
        with self._lock:
            self.decoded += 1
            if pixels.nbytes > self.budget_bytes:
                return
            self._bytes += pixels.nbytes - (self._kept[photo].nbytes if photo in self._kept else 0)
            self._kept[photo] = pixels
            self._kept.move_to_end(photo)
            allowed = self._allowed()
            while self._bytes > allowed and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
                self.dropped += 1

    def _allowed(self) -> int:
        """Bytes that may be kept now."""
        if not self.resident_bytes:
            return self.budget_bytes
        room = self._bytes + self.resident_bytes - resident_bytes()
        return min(self.budget_bytes, max(room, LEAST_BYTES))

    def peek(self, photo: int) -> Kept | None:
        """Pixels of a photo if they are cached; nothing is decoded."""
        with self._lock:
            return self._kept.get(photo)

    def make_room(self) -> None:
        """Drops all photos unless every one fitted so far: of a survey that does not fit, few of
        those that are kept are asked for again before they would be dropped.
        """
        if self.dropped:
            self.clear()

    def clear(self) -> None:
        """Drops all photos."""
        with self._lock:
            self._kept.clear()
            self._bytes = 0


def pixel_budget(memory_gb: float | None) -> int:
    """Bytes for decoded photos: the memory allowed (None = `USUAL_GB`) less that of code, features
    and tiles.
    """
    return int(max(LEAST_BYTES, ((memory_gb or USUAL_GB) - 0.6) * 1e9))


def resident_budget(memory_gb: float | None) -> int:
    """Resident memory in bytes above which decoded photos make room: what is allowed, less what a
    step takes for a moment.
    """
    return int(((memory_gb or USUAL_GB) - 0.4) * 1e9)
