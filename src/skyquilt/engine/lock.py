"""One run, or one live map, writes to a folder at a time."""

import errno
import json
import os
import sys
from contextlib import suppress
from pathlib import Path

from skyquilt.errors import OutputError
from skyquilt.outside import plain, read_bounded

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

FAR = 1 << 30
"""The byte that is locked on Windows: others read no byte that is, and do read the text."""
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What file systems without locks answer; work goes on there as if nobody else worked."""


class FolderLock:
    """Holds a folder against other processes, and tells them who holds it. The system releases the
    lock when its process ends, however it ends.
    """

    def __init__(self, folder: Path, name: str, what: str) -> None:
        """Takes the lock: `name`, the path of its file in the folder; `what` holds it.

        Raises:
            OutputError: the folder cannot be written, or another process holds the lock.
        """
        self.folder, self.path, self._handle = folder, folder / name, -1
        try:
            self._take()
            self.tell("")
        except (BlockingIOError, PermissionError) as error:
            self.close()
            raise OutputError(
                f"another {what} works in {folder}{self._other()}; end that one, or choose"
                " another folder"
            ) from error
        except OSError as error:
            self.close()
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> OutputError:
        why = error.strerror or error
        return OutputError(f"cannot write to {self.folder}: {why}; choose another output folder")

    def _take(self) -> None:
        """Opens and locks the file; again where another process removed it in between."""
        while True:
            try:
                self._handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
            except OSError as error:
                raise self._unwritable(error) from error
            self._lock()
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self._handle), self.path.stat()):
                    return
            self.close()

    def _lock(self) -> None:
        try:
            if sys.platform == "win32":
                os.lseek(self._handle, FAR, os.SEEK_SET)
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.lockf(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise

    def tell(self, url: str) -> None:
        """Writes the process and the URL of its viewer into the file."""
        said = json.dumps({"process": os.getpid(), "url": url}).encode()
        os.ftruncate(self._handle, 0)
        os.lseek(self._handle, 0, os.SEEK_SET)
        os.write(self._handle, said)

    def _other(self) -> str:
        with suppress(OSError, ValueError, LookupError, TypeError):
            said = json.loads(read_bounded(self.path, 10_000))
            url = f", {plain(str(said['url']), 200)}" if said["url"] else ""
            return f" (process {int(said['process'])}{url})"
        return ""

    def close(self) -> None:
        """Releases the lock."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def remove(self) -> None:
        """Removes the file and releases the lock; the file's folder goes too if it is empty."""
        if sys.platform == "win32":
            self.close()  # it removes no open files
        with suppress(OSError):
            self.path.unlink()
            self.path.parent.rmdir()
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_handle", -1) >= 0:
            self.close()
