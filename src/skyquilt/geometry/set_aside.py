"""Large values that are not needed for a while: in a temporary file instead of the memory."""

import os
import pickle
from tempfile import TemporaryFile
from typing import Generic, TypeVar

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
