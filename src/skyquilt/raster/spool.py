"""Encoded tiles before the file is assembled: an append-only heap and a journal of what is
finished.

The heap grows with every tile. Each record of the journal holds the heap's length when a piece of
work was finished. After a kill, everything behind the last complete record is cut off on reopening.
"""

import os
import struct
import threading
import zlib
from pathlib import Path
from typing import IO

from skyquilt.outside import open_regular, remove_folder
from skyquilt.raster.atomic import CHUNK, mended

_HEAD = struct.Struct("<IIQ")


class Spool:
    """A folder with `tiles.bin` and `journal.bin`, valid for one key only. Thread-safe.

    Content under another key is discarded; with `fresh` any content is.
    """

    def __init__(self, folder: Path, key: str, *, fresh: bool = False, fsync: bool = False) -> None:
        self.folder, self._fsync = Path(folder), fsync
        self._lock = threading.Lock()
        heap, journal = self.folder / "tiles.bin", self.folder / "journal.bin"
        with mended(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            heap.touch()
            journal.touch()
            with open_regular(heap), open_regular(journal) as file:  # not pipes
                found = _whole_records(file.read(), heap.stat().st_size)
            if fresh or not found or found[0][0] != key.encode():
                found = []
            self.records = tuple(payload for payload, _, _ in found[1:])
            """Payloads passed to `commit`, in earlier runs too."""
            self._heap, self._journal = heap.open("r+b", CHUNK), journal.open("r+b", 0)
            self._reader = heap.open("rb", 0)
            self._end = found[-1][1] if found else 0
            _cut(self._heap, self._end)
            _cut(self._journal, found[-1][2] if found else 0)
        if not found:
            self.commit(key.encode())

    def append(self, data: bytes) -> int:
        """Appends bytes to the heap; returns their offset."""
        with self._lock, mended(self.folder):
            offset = self._end
            self._heap.write(data)
            self._end += len(data)
            return offset

    def commit(self, payload: bytes) -> None:
        """Makes everything appended so far survive a kill, and stores `payload` with it."""
        with self._lock, mended(self.folder):
            self._heap.flush()
            if self._fsync:
                os.fsync(self._heap.fileno())
            head = _HEAD.pack(len(payload), zlib.crc32(payload, self._end & 0xFFFFFFFF), self._end)
            self._journal.write(head + payload)
            if self._fsync:
                os.fsync(self._journal.fileno())

    def read(self, offset: int, size: int) -> bytes:
        """Reads bytes from the heap."""
        with self._lock, mended(self.folder):
            self._heap.flush()
            self._reader.seek(offset)
            return self._reader.read(size)

    def close(self, *, remove: bool = False) -> None:
        """Closes the files; with `remove` the folder is removed too."""
        for file in (self._heap, self._journal, self._reader):
            try:
                file.close()
            except OSError:  # bytes that could not be flushed were never committed
                continue
        if remove:
            remove_folder(self.folder)


def _cut(file: IO[bytes], end: int) -> None:
    file.truncate(end)
    file.seek(end)


def _whole_records(journal: bytes, heap_size: int) -> list[tuple[bytes, int, int]]:
    """(payload, end of heap, end of record) of every record up to the first incomplete one."""
    found, at = [], 0
    while at + _HEAD.size <= len(journal):
        size, crc, heap_end = _HEAD.unpack_from(journal, at)
        payload = journal[at + _HEAD.size : at + _HEAD.size + size]
        if (
            len(payload) < size
            or crc != zlib.crc32(payload, heap_end & 0xFFFFFFFF)
            or heap_end > heap_size
        ):
            break
        at += _HEAD.size + size
        found.append((payload, heap_end, at))
    return found
