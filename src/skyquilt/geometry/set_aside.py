"""Large values that are not needed for a while: in a temporary file instead of the memory."""

import mmap
import os
import pickle
import sys
from tempfile import TemporaryFile
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


def folder_on_disk() -> str | None:
    """A folder for temporary files that is not memory itself, as `/tmp` is on some systems."""
    return "/var/tmp" if os.access("/var/tmp", os.W_OK) else None


class SetAside(Generic[T]):
    """A value that lies in a temporary file until it is asked for. Where there is no disk for it,
    it stays in memory.
    """

    def __init__(self, value: T, *, large: bool = True) -> None:
        """Puts it aside if it is `large`."""
        self._value: T | None = None
        try:
            if large:
                self._file = TemporaryFile(dir=folder_on_disk())  # noqa: SIM115 - closed with this
                pickle.dump(value, self._file, protocol=pickle.HIGHEST_PROTOCOL)
                self._file.flush()
        except OSError:
            large = False
        if not large:
            self._value = value

    def get(self) -> T:
        """The value, read anew each time."""
        if self._value is not None:
            return self._value
        self._file.seek(0)
        value: T = pickle.load(self._file)
        return value


class InFile:
    """An array in a temporary file: only the parts that are used are in memory, until they are
    released. Where there is no disk for it, it stays in memory.
    """

    def __init__(self, values: NDArray[Any], *, large: bool = True) -> None:
        """Writes it to a file if it is `large`."""
        self.values: NDArray[Any] = values
        """The array, read-only where it lies in a file."""
        self._map: mmap.mmap | None = None
        if not large or not values.size:
            return
        try:
            with TemporaryFile(dir=folder_on_disk()) as file:
                file.write(np.ascontiguousarray(values).data)
                file.flush()
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError:
            return
        self.values = np.frombuffer(self._map, values.dtype).reshape(values.shape)

    def release(self) -> None:
        """Gives the memory of what was used back; what is used again is read again."""
        if sys.platform != "win32" and self._map is not None:
            self._map.madvise(mmap.MADV_DONTNEED)
