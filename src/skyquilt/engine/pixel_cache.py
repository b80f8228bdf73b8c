"""Cache of decoded photos, or of what was computed from them, within a memory budget."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np


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
    decoded: int = 0
    """How many times a photo was decoded."""
    _kept: OrderedDict[int, Kept] = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _busy: dict[int, threading.Lock] = field(default_factory=dict)

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

    def put(self, photo: int, pixels: Kept) -> None:
        """Keeps pixels that the caller decoded, if they fit."""
        with self._lock:
            self.decoded += 1
            if pixels.nbytes > self.budget_bytes:
                return
            self._kept[photo] = pixels
            self._kept.move_to_end(photo)
            while sum(p.nbytes for p in self._kept.values()) > self.budget_bytes:
                self._kept.popitem(last=False)

    def peek(self, photo: int) -> Kept | None:
        """Pixels of a photo if they are cached; nothing is decoded."""
        with self._lock:
            return self._kept.get(photo)

    def clear(self) -> None:
        """Drops all photos."""
        with self._lock:
            self._kept.clear()


def pixel_budget(memory_gb: float | None) -> int:
    """Bytes for decoded photos: the memory allowed (None = 1.2 GB) less that of code, features and
    tiles.
    """
    return int(max(0.15, (memory_gb or 1.2) - 0.6) * 1e9)
