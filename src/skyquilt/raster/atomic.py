"""Files that appear complete or not at all, and errors that say what is wrong with the disk."""

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from skyquilt.errors import OutputError
from skyquilt.outside import in_use, put_in_place

CHUNK = 1 << 20


@contextmanager
def whole_file(path: Path, *, needed: int = 0) -> Iterator[BinaryIO]:
    """Opens a file for writing. It gets its name when the block ends without error, and is removed
    otherwise.

    `needed` is its size in bytes, if known: too little space is an `OutputError` before the first
    byte.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    with mended(path, needed=needed):
        if needed > (free := free_bytes(path.parent)):
            raise OutputError(_too_small(path, needed, free))
        try:
            with partial.open("wb", buffering=CHUNK) as file:
                yield file
            put_in_place(partial, path)
        except BaseException:
            with suppress(OSError):
                partial.unlink()
            raise


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically, UTF-8."""
    # file names may hold bytes that are no valid text
    data = text.encode("utf-8", "backslashreplace")
    with whole_file(path, needed=len(data)) as file:
        file.write(data)


@contextmanager
def mended(path: Path, *, needed: int = 0) -> Iterator[None]:
    """Turns an operating system error while writing `path` into an `OutputError` with the next
    step.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(_sentence(Path(path), error, needed)) from error


def free_bytes(folder: Path) -> int:
    """Free space in bytes on the disk where `folder` is, or will be."""
    folder = Path(folder).absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return shutil.disk_usage(folder).free


def _sentence(path: Path, error: OSError, needed: int) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return _too_small(path, needed, free_bytes(path.parent))
    if words := in_use(error, path):
        return words
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        why = "is read-only" if error.errno == errno.EROFS else "may not be written by this user"
        return f"{path} cannot be written: {path.parent} {why}. Choose another output folder."
    if error.errno == errno.ENOENT:
        return (
            f"{path} cannot be written: the folder {path.parent} does not exist. Create it first."
        )
    return f"{path} cannot be written: {error.strerror or error}."


def _too_small(path: Path, needed: int, free: int) -> str:
    need = f"needs about {_mb(needed)} MB" if needed else "needs more room"
    return (
        f"the disk is full: {path.name} {need} in {path.parent}, {_mb(free)} MB free. "
        "Make room or choose another output folder."
    )


def _mb(size: int) -> str:
    return f"{size / 1e6:.1f}" if size < 10e6 else f"{size / 1e6:.0f}"
