"""Cache of decoded photos, or of what was computed from them, within a memory budget."""

import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from tempfile import gettempdir
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.memory_watch import resident_bytes
from skyquilt.geometry.set_aside import InFile, folder_on_disk
from skyquilt.settings import USUAL_GB

LEAST_BYTES = 150_000_000
"""Bytes of decoded photos that are kept whatever else is in memory."""
LEFT_FREE_BYTES = 2_000_000_000
"""Bytes of disk that are left to others."""
MOST_OF = 0.8
"""Share of what is held from which it is not worth a copy to hold less."""
Box = tuple[slice, slice]
"""Rows and columns of a photo."""
Step = tuple[int, int]
"""Name of a step of a work: the place of what is drawn."""
UNFORESEEN: Step = (-1, -1)
"""Stands for all steps, for what they ask for beyond what was said."""


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
    leaving: Callable[[int, Kept], None] | None = None
    """Hears of each photo that is dropped for others."""
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
            "leaving": self.leaving,
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
        for left in self._put(photo, pixels):
            if self.leaving is not None:
                self.leaving(*left)

    def _put(self, photo: int, pixels: Kept) -> list[tuple[int, Kept]]:
        """Keeps pixels; those that are dropped for them."""
        out: list[tuple[int, Kept]] = []
        with self._lock:
            self.decoded += 1
            if pixels.nbytes > self.budget_bytes:
                return out
            self._bytes += pixels.nbytes - (self._kept[photo].nbytes if photo in self._kept else 0)
            self._kept[photo] = pixels
            self._kept.move_to_end(photo)
            allowed = self._allowed()
            while self._bytes > allowed and len(self._kept) > 1:
                out.append(self._kept.popitem(last=False))
                self._bytes -= out[-1][1].nbytes
                self.dropped += 1
        return out

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

    def drop(self, photo: int) -> None:
        """Drops one photo, if it is kept."""
        with self._lock:
            if (held := self._kept.pop(photo, None)) is not None:
                self._bytes -= held.nbytes

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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """A part of a photo."""

    pixels: NDArray[Any]
    """(h, w[, bands])."""
    row: int
    """Row of the photo that is the first."""
    column: int
    """Column of the photo that is the first."""
    file: InFile | None = None
    """The file that holds the pixels; None = they are in memory."""

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return int(self.pixels.nbytes) if self.file is None else 0

    def within(self, rows: slice, columns: slice) -> NDArray[Any] | None:
        """Rows and columns of the photo; None where the part does not hold all of them."""
        top, left = rows.start - self.row, columns.start - self.column
        bottom, right = rows.stop - self.row, columns.stop - self.column
        h, w = self.pixels.shape[:2]
        inside = top >= 0 and left >= 0 and bottom <= h and right <= w
        return self.pixels[top:bottom, left:right] if inside else None

    def cut(self, box: Box) -> "_Part":
        """A copy of what it holds of a box; itself where that is nearly all of it, or in a file."""
        if self.file is not None:
            return self
        top, left = (
            max(s.start - at, 0) for s, at in zip(box, (self.row, self.column), strict=True)
        )
        pixels = self.pixels[top : box[0].stop - self.row, left : box[1].stop - self.column]
        if pixels.size > MOST_OF * self.pixels.size:
            return self
        pixels = pixels.copy()
        pixels.setflags(write=False)
        return _Part(pixels=pixels, row=self.row + top, column=self.column + left)


class PhotoParts:
    """The parts of decoded photos that the steps of a work still ask for, within a memory budget.
    What finds no room in memory waits in temporary files: reading there costs a twentieth of
    decoding, and of photos of 48 megapixels hardly two have room. Thread-safe.
    """

    def __init__(
        self,
        read: Callable[[int], NDArray[Any]],
        asked: Mapping[int, Mapping[Step, Box]],
        like: PixelCache[NDArray[Any]],
    ) -> None:
        """`read` decodes a photo by its index; `asked`: what each step asks for of each photo,
        about. `like`: a cache of whole photos with the same budget.
        """
        self._read = read
        self._asked = {photo: dict(steps) for photo, steps in asked.items()}
        self._shows: dict[Step, list[int]] = {}
        for photo, steps in asked.items():
            for step in steps:
                self._shows.setdefault(step, []).append(photo)
        self._kept = PixelCache(
            read=self._cut,
            budget_bytes=like.budget_bytes,
            resident_bytes=like.resident_bytes,
            leaving=self._put_aside,
        )
        self._aside: dict[int, _Part] = {}
        self._writing = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """A copy in another process begins empty."""
        return self.__dict__ | {"_aside": {}, "_writing": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._writing = threading.Lock()

    def __call__(self, photo: int, rows: slice, columns: slice) -> NDArray[Any]:
        """Pixels of these rows and columns of a photo, read-only."""
        while (found := self._part(photo).within(rows, columns)) is None:
            more = self._asked.setdefault(photo, {})
            more[UNFORESEEN] = _around([(rows, columns), *more.values()])
            self._drop(photo)
        return found

    def done(self, step: Step) -> None:
        """Drops what only this step asked for."""
        for photo in self._shows.get(step, ()):
            asked = self._asked[photo]
            asked.pop(step, None)
            if not asked.keys() - {UNFORESEEN}:
                self._drop(photo)
            elif (held := self._kept.peek(photo)) is not None:
                part = held.cut(_around([*asked.values()]))
                if part is not held:
                    self._kept.put(photo, part)
        for part in [*self._aside.values()]:
            if part.file is not None:
                part.file.release()

    def _part(self, photo: int) -> _Part:
        """What is held of a photo; it is decoded if that is nothing."""
        return self._aside.get(photo) or self._kept(photo)

    def _put_aside(self, photo: int, part: _Part) -> None:
        """Puts a part that steps still ask for into a file, where there is disk for it."""
        with self._writing:
            if photo in self._aside or not self._asked.get(photo):
                return
            if not _room_on_disk():
                return
            file = InFile(part.pixels)
            if file.values is not part.pixels:
                self._aside[photo] = replace(part, pixels=file.values, file=file)

    def _drop(self, photo: int) -> None:
        """Drops what is held of a photo."""
        self._kept.drop(photo)
        self._aside.pop(photo, None)

    def _cut(self, photo: int) -> _Part:
        whole = self._read(photo)
        part = _Part(pixels=whole, row=0, column=0)
        if whole.nbytes > LEAST_BYTES:  # there may never be room for two of them
            self._put_aside(photo, part)
        asked = self._asked.get(photo)
        if not asked or photo in self._aside:
            return self._aside.get(photo, part)
        return part.cut(_around([*asked.values()]))


def _room_on_disk() -> bool:
    """Whether there is disk for a decoded photo."""
    with suppress(OSError):
        return shutil.disk_usage(folder_on_disk() or gettempdir()).free > LEFT_FREE_BYTES
    return False


def _around(boxes: Sequence[Box]) -> Box:
    """The rows and columns around boxes."""
    rows, columns = (
        slice(min(s.start for s in side), max(s.stop for s in side))
        for side in zip(*boxes, strict=True)
    )
    return rows, columns


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
