"""Reports files that were closed after writing or moved into a folder. Uses inotify, so it works on
Linux only; on other systems nothing is reported.
"""

import ctypes
import os
import struct
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skyquilt.outside import is_folder, walk

CLOSE_WRITE, MOVED_TO, CREATE, DELETE = 0x8, 0x80, 0x100, 0x200
IS_DIR, OVERFLOW = 0x40000000, 0x4000
IGNORED, MOVE_SELF = 0x8000, 0x800
_HEAD = struct.Struct("iIII")


@dataclass(kw_only=True)
class ClosedFiles:
    """Watches a folder and all its subfolders for completed files."""

    folder: Path
    """The folder that is watched."""
    told: bool = False
    """Whether this system reports closed files."""
    removed: set[str] = field(default_factory=set)
    """Paths of files that were deleted between the last two calls of `look`."""
    _libc: Any = None
    _handle: int = -1
    _lost: bool = False
    _folders: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if sys.platform != "linux":
            return
        try:
            self._libc = ctypes.CDLL(None, use_errno=True)
            self._handle = self._libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        except (AttributeError, OSError, TypeError):
            return
        self.told = self._handle >= 0 and self._watch(str(self.folder))

    def _watch(self, folder: str) -> bool:
        """Watches a folder and its subfolders, not following links; False if the system refuses
        more watches.
        """
        every = True
        for here, _, _ in walk(Path(folder)):
            number = self._libc.inotify_add_watch(
                self._handle,
                os.fsencode(here),
                CLOSE_WRITE | MOVED_TO | CREATE | DELETE | MOVE_SELF,
            )
            every &= number >= 0
            if number < 0:
                break
            self._folders[number] = str(here)
        return every

    def look(self) -> tuple[set[str], bool]:
        """Paths closed since the last call, and whether the whole folder must be scanned as well.

        A scan is needed after a new subfolder appeared, since files may have arrived before it was
        watched, and after the queue of events overflowed.
        """
        closed: set[str] = set()
        self.removed = set()
        everything = False
        if self._lost and is_folder(self.folder):
            self._lost, everything = not self._watch(str(self.folder)), True
        while data := self._read():
            at = 0
            while at < len(data):
                number, mask, _, size = _HEAD.unpack_from(data, at)
                name = os.fsdecode(data[at + _HEAD.size : at + _HEAD.size + size].rstrip(b"\0"))
                at += _HEAD.size + size
                path = str(Path(self._folders.get(number, "")) / name)
                if mask & MOVE_SELF and self._folders.get(number) == str(self.folder):
                    # renamed; another one may take its place
                    self._libc.inotify_rm_watch(self._handle, number)
                if mask & IGNORED and self._folders.pop(number, "") == str(self.folder):
                    self._lost = True  # the folder was removed, or its disk
                if mask & IS_DIR:
                    self.told &= self._watch(path) or not is_folder(Path(path))
                if mask & DELETE and not mask & IS_DIR:
                    self.removed.add(path)
                everything |= bool(mask & (IS_DIR | OVERFLOW))
                if mask & (CLOSE_WRITE | MOVED_TO) and not mask & IS_DIR:
                    closed.add(path)
        return closed, everything

    def _read(self) -> bytes:
        try:
            return os.read(self._handle, 1 << 16) if self._handle >= 0 else b""
        except OSError:
            return b""

    def close(self) -> None:
        """Stops watching."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle, self.told = -1, False
