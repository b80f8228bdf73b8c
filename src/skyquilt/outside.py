"""Checks of what comes from outside: numbers, files, the declared size of pictures, text to show.

Readers and endpoints use these functions and no others for the purpose, so that a limit stands in
one place. docs/security.md lists the limits.
"""

import codecs
import errno
import math
import os
import re
import shutil
import sqlite3
import stat
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from skyquilt.errors import UnreadablePhotoError

if TYPE_CHECKING:
    from zipfile import ZipFile

MOST_MP = 160.0
"""Largest area of a photo in megapixels, unless --max-mp says otherwise: the largest cameras that
drones carry have 150.
"""
BUDGET_PER_PX = 4
"""Bytes per pixel of the largest allowed area that decoding one photo may need."""
MOST_VALUE_BYTES = 256_000_000
"""Largest value of a row: a layer as text has some 100 MB."""
MOST_QUERY_S = 60.0
"""CPU time after which a query is given up."""
ACCESS_DENIED, SHARING_VIOLATION = 5, 32
"""Windows's numbers of errors (`winerror`) for a file that is open elsewhere."""
BUSY_S = 3.0
"""Time in s for which a file that another program reads is waited for."""
MOST_ASPECT = 20
"""Largest ratio of a photo's sides."""
LEAST_SIDE = 32
"""Smallest side of a photo in px."""
SLACK_BYTES = 64_000_000
"""Bytes that a file may have beyond those that its pixels can need."""
MOST_TEXT_BYTES = 64_000_000
"""Largest side file in bytes."""
MOST_DIGITS = 64
"""Largest number of characters of a number."""
_CV_NO_MEMORY = -4
"""OpenCV's code of an error (`Error::StsNoMem`)."""
_REAL = re.compile(r"[+-]?(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][+-]?\d{1,4})?+", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d{1,30}", re.ASCII)


def real(value: Any, low: float = -math.inf, high: float = math.inf) -> float | None:
    """A finite number within the limits, from text or a number; None for anything else.

    Text is what a person would write: at most 64 ASCII characters, no `nan`, `inf`, `1_000`.
    """
    if isinstance(value, str):
        text = value.strip()
        value = text if len(text) <= MOST_DIGITS and _REAL.fullmatch(text) else None
    if value is None or isinstance(value, (bool, bytes, bytearray)):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) and low <= number <= high else None


def whole(value: Any, low: int = -(2**63), high: int = 2**63 - 1) -> int | None:
    """A whole number within the limits, from text or an integer; None for anything else."""
    if isinstance(value, str):
        text = value.strip()
        value = int(text) if _WHOLE.fullmatch(text) else None
    if not isinstance(value, int) or isinstance(value, bool):
        return None
    return value if low <= value <= high else None


def shown(text: object, most: int = 4000) -> str:
    """Text that can be written to a terminal: control, escape and direction characters and lone
    surrogates are shown as escapes, and what is longer than `most` characters is cut.
    """
    words = str(text)
    cut = words[:most] + " ..." if len(words) > most else words
    return "".join(c if c == "\n" or _harmless(c) else _escaped(c) for c in cut)


def plain(text: str, most: int = 4000) -> str:
    """The same for a name or a word of metadata, which stand in one line."""
    return shown(text, most).replace("\n", "\\x0a")


def _harmless(c: str) -> bool:
    return " " <= c <= "~" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Zl", "Zp")


def _escaped(c: str) -> str:
    return c.encode("unicode_escape").decode("ascii")


def open_regular(path: Path) -> BinaryIO:
    """Opens a file for reading; raises `OSError` where it is missing, or is a pipe, a socket, a
    device or a folder. It never waits for another program.
    """
    try:
        file = open(path, "rb", opener=_at_once)  # noqa: SIM115 - Path.open has no opener
    except ValueError as error:  # a zero character
        raise OSError(errno.EINVAL, "it is not the name of a file", str(path)) from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return file


def _at_once(path: str, flags: int) -> int:
    """Opens without waiting for a writer at the other end of a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def in_use(error: OSError, path: Path) -> str:
    """The sentence where Windows refused to change a file because a program has it open, for which
    it gives the same reason as where a file is read-only; empty for other errors.
    """
    if getattr(error, "winerror", None) not in (ACCESS_DENIED, SHARING_VIOLATION):
        return ""
    return (
        f"{path} cannot be written: another program has it open, or this user may not write there."
        " Close that program, or choose another output folder."
    )


def put_in_place(partial: Path, path: Path) -> None:
    """Gives a complete file or folder its name, in place of the file that had it. Raises `OSError`
    where the system refuses that.
    """
    _unless_read(lambda: partial.replace(path))


def remove_file(path: Path) -> None:
    """Removes a file; one that is not there is no error. Raises `OSError` where the system refuses
    that.
    """
    _unless_read(lambda: path.unlink(missing_ok=True))


def remove_folder(path: Path, *, whole: bool = False) -> None:
    """Removes a folder with all that is in it; what the system refuses to remove stays, and where
    the `whole` folder must go, `OSError` is raised.
    """
    try:
        _unless_read(lambda: shutil.rmtree(path))
    except OSError:
        if whole:
            raise
        shutil.rmtree(path, ignore_errors=True)


def _unless_read(change: Callable[[], object]) -> None:
    """Makes a change that Windows refuses while another program reads the file, as viewers and
    virus scanners do for a moment: there it is tried again for a short time.
    """
    until = time.monotonic() + BUSY_S
    while True:
        try:
            change()
            return
        except PermissionError:
            if sys.platform != "win32" or time.monotonic() > until:
                raise
        time.sleep(0.02)


def is_file(path: Path) -> bool:
    """Whether a regular file has this name; False also for a name that the system refuses, such as
    one that is too long.
    """
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """The same for a folder."""
    try:
        return path.is_dir()
    except OSError:
        return False


def read_bounded(path: Path, most: int = MOST_TEXT_BYTES) -> bytes:
    """The bytes of a regular file; raises `OSError` as `open_regular`, and where it has more than
    `most`.
    """
    with open_regular(path) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most // 10**6} MB", str(path))
    return data


def text_of(data: bytes) -> str:
    """A text file's content: UTF-16 where it begins with that mark, as Windows programs save it,
    else UTF-8, else Latin-1, of which any bytes are.
    """
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return data.decode("utf-16", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def unzipped(archive: "ZipFile", name: str, most: int) -> bytes:
    """The content of a file in an archive, of at most `most` bytes whatever it declares.

    Raises:
        ValueError: it is damaged, encrypted, or larger.
    """
    import lzma  # needed by few commands
    import zlib
    from zipfile import BadZipFile

    try:
        with archive.open(name) as member:
            content = member.read(most + 1)
    # the decoders' own errors; those of the archive; an encrypted file; an unknown method
    except (
        zlib.error,
        lzma.LZMAError,
        EOFError,
        OSError,
        BadZipFile,
        RuntimeError,
        NotImplementedError,
    ) as error:
        raise ValueError(f"{plain(name, 80)} in it is damaged or encrypted") from error
    if len(content) > most:
        raise ValueError(f"it unpacks to more than {most / 1e6:g} MB")
    return content


def same_folder(a: Path, b: Path) -> bool:
    """Whether two paths lead to one place, in large and small letters on Windows. Unlike
    `Path.resolve`, links in a circle do no harm.
    """
    return os.path.normcase(os.path.realpath(a)) == os.path.normcase(os.path.realpath(b))


PHOTO_ENDINGS = (".jpg", ".jpeg", ".jpe", ".jfif", ".tif", ".tiff", ".png", ".webp")
"""Endings of photos' files, in lower case."""
_NOT_PHOTOS = frozenset(
    {"@eadir", "@recycle", "#recycle", "#snapshot", "$recycle.bin", "lost+found", "__macosx"}
)
"""Folders in which storage systems keep previews and what was removed, in lower case."""


def hidden(name: str) -> bool:
    """Whether a folder or file is none of the user's: hidden, a system's previews, or removed."""
    return name.startswith(".") or name.lower() in _NOT_PHOTOS


def walk(
    top: Path, unread: Callable[[Path, OSError], None] | None = None
) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Folders below `top`, each with the names of its subfolders, from which the caller may remove
    some, and of its other files, both sorted. Hidden folders are named, not entered. Links to
    folders are not followed; folders that cannot be read count as empty, and `unread` is told of
    them. Unlike `os.walk` it takes any depth.
    """
    waiting = [top]
    while waiting:
        here = waiting.pop()
        try:
            with os.scandir(here) as found:
                entries = [(e.name, e.is_dir(follow_symlinks=False)) for e in found]
        except OSError as error:
            if unread is not None:
                unread(here, error)
            continue
        folders = sorted(name for name, folder in entries if folder)
        yield here, folders, sorted(name for name, folder in entries if not folder)
        waiting += [here / name for name in reversed(folders) if not hidden(name)]


def check_picture(
    width: int,
    height: int,
    bytes_per_px: float,
    *,
    file_bytes: int = 0,
    most_mp: float = MOST_MP,
    option: str = " (--max-mp)",
) -> None:
    """Refuses a picture by its declared size, before anything of that size is allocated.

    `bytes_per_px`: memory that decoding needs for each pixel; `file_bytes`: size of the file;
    `option`: how to raise the limit.

    Raises:
        UnreadablePhotoError: it is too small, too large, too long, or its file is far larger than
            its pixels can need.
    """
    most = most_mp * 1e6
    if min(width, height) < LEAST_SIDE:
        raise UnreadablePhotoError(
            f"it has only {width}x{height} px; at least {LEAST_SIDE} a side are needed"
        )
    if max(width, height) > MOST_ASPECT * min(width, height):
        raise UnreadablePhotoError(
            f"it has {width}x{height} px; one side may be {MOST_ASPECT} times the other at most"
        )
    area = width * height
    if area > most:
        raise UnreadablePhotoError(
            f"it has {width}x{height} px, and {most_mp:g} megapixels are the most{option}"
        )
    if area * bytes_per_px > BUDGET_PER_PX * most:
        raise UnreadablePhotoError(
            f"decoding its {width}x{height} px would need {area * bytes_per_px / 1e6:.0f} MB, and"
            f" {BUDGET_PER_PX * most / 1e6:.0f} MB are the most{option}"
        )
    if file_bytes > SLACK_BYTES + 2 * area * bytes_per_px:
        raise UnreadablePhotoError(
            f"its file of {file_bytes // 10**6} MB is far larger than its {width}x{height} px can"
            " need"
        )


def out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, is that the system gave no more memory or threads: not
    the fault of the file that was read just then.
    """
    while error is not None:
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return True
        if type(error).__module__ == "cv2" and getattr(error, "code", 0) == _CV_NO_MEMORY:
            return True
        if isinstance(error, RuntimeError) and "start new thread" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


class Database(sqlite3.Connection):
    """A connection whose queries end; those of several threads follow one another."""

    _end = float("inf")

    def limit(self) -> None:
        """Sets the limits."""
        self.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE_BYTES)
        self.set_progress_handler(lambda: time.thread_time() > self._end, 100_000)

    def execute(self, *query: Any) -> sqlite3.Cursor:
        """As `sqlite3.Connection.execute`, for so much CPU time until its last row."""
        self._end = time.thread_time() + MOST_QUERY_S
        return super().execute(*query)

    def executemany(self, *query: Any) -> sqlite3.Cursor:
        """The same for many rows of values."""
        self._end = time.thread_time() + MOST_QUERY_S
        return super().executemany(*query)
