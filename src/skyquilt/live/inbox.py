"""Folder of accepted photos. A file is stored durably in the survey's folder before a row of the
ledger says that it was received.

Files are named by a hash of their content. Names that senders give are kept as text only and never
used as paths.
"""

import errno
import hashlib
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from skyquilt.errors import OutputError, UnreadablePhotoError
from skyquilt.live.ledger import Ledger, hit
from skyquilt.outside import is_folder, put_in_place
from skyquilt.photos.headers import HEAD_BYTES, Kind, kind_of
from skyquilt.video.read import CLIP_ENDINGS
from skyquilt.video.tracks import TRACK_ENDINGS

ENDINGS: dict[Kind, str] = {"jpeg": ".jpg", "tiff": ".tif", "png": ".png", "webp": ".webp"}
"""File extensions of the supported formats."""
SEEN = "clips"
"""Folder, beside that of the photos, of what was seen of clips."""


@dataclass(frozen=True, kw_only=True)
class Arrived:
    """A file that was stored in the survey's folder but is not accepted yet."""

    path: Path
    """Its path."""
    digest: str
    """BLAKE2b hash of its content (hex)."""
    size: int
    """Size in bytes."""
    anew: bool = True
    """Whether the folder had no whole file of this content."""


def ending_of(head: bytes) -> str | None:
    """The file extension that matches a file's first bytes; None if it is not a photo."""
    try:
        return ENDINGS[kind_of(head)]
    except UnreadablePhotoError:
        return None


def is_clip(path: Path) -> bool:
    """Whether a file is a clip by its name."""
    return path.suffix.lower() in CLIP_ENDINGS


def belongs_to_clip(name: str) -> bool:
    """Whether a file of this name is a clip or positions of one."""
    return Path(name).suffix.lower() in (*CLIP_ENDINGS, *TRACK_ENDINGS)


class Inbox:
    """The folder of accepted photos."""

    def __init__(
        self, ledger: Ledger, folder: Path, *, most_bytes: int = 500_000_000, tidy: bool = True
    ) -> None:
        """Photos are stored in `folder`; one file may have at most `most_bytes`. `tidy`: removes
        partly written files that a crash left behind.
        """
        self.ledger, self.folder, self.most_bytes = ledger, folder, most_bytes
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for left in folder.glob("*.partial") if tidy else ():
                left.unlink()
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error

    def bring(self, blocks: Iterable[bytes]) -> Arrived:
        """Writes a file's bytes durably under the hash of its content.

        Raises:
            OutputError: the disk is full.
            UnreadablePhotoError: it is not a photo, the file is larger than allowed, or reading it
                fails.
        """
        rest = iter(blocks)
        first = next(_read(rest), b"")
        ending = ENDINGS[kind_of(first[:HEAD_BYTES])]
        partial = self.folder / f"{time.monotonic_ns():x}-{os.getpid()}.partial"
        digest, size = hashlib.blake2b(digest_size=16), 0
        try:
            with partial.open("wb") as file:
                for block in chain((first,), _read(rest)):
                    size += len(block)
                    if size > self.most_bytes:
                        raise UnreadablePhotoError(
                            f"it has more than {self.most_bytes / 1e6:g} MB (--max-mb)"
                        )
                    digest.update(block)
                    file.write(block)
                file.flush()
                os.fsync(file.fileno())
            hit("photo file synced")
            path = self.folder / (digest.hexdigest() + ending)
            anew = _size(path) != size
            put_in_place(partial, path)
            synced(self.folder)
            hit("photo file named")
        except OSError as error:
            gone(partial)
            raise _refusal(self.folder, error) from error
        except BaseException:
            gone(partial)
            raise
        return Arrived(path=path, digest=digest.hexdigest(), size=size, anew=anew)

    def check(self) -> None:
        """Raises OutputError where the folder is gone: that a file in it cannot be read then tells
        nothing of its photo.
        """
        if not is_folder(self.folder):
            raise OutputError(_gone(self.folder))


def _read(blocks: Iterable[bytes]) -> Iterator[bytes]:
    """The blocks; an error of reading is told from one of writing."""
    try:
        yield from blocks
    except OSError as error:
        raise UnreadablePhotoError(f"it cannot be read ({error.strerror or error})") from error


def _size(path: Path) -> int | None:
    """Size in bytes; None if there is no such file."""
    try:
        return path.stat().st_size
    except OSError:
        return None


def synced(folder: Path) -> None:
    """Makes the names in a folder durable (fsync of the folder), on systems that support it."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def gone(path: Path) -> None:
    """Deletes a file that may not be there, or not be ours to delete."""
    with suppress(OSError):
        path.unlink()


def _refusal(folder: Path, error: OSError) -> OutputError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return OutputError(
            f"the disk is full: {folder} cannot take another photo. Make room and send it again"
        )
    if not is_folder(folder):
        return OutputError(_gone(folder))
    return OutputError(f"cannot write to {folder}: {error.strerror or error}")


def _gone(folder: Path) -> str:
    return (
        f"{folder} is gone: no photo is accepted until it is back. If it was removed, end the live"
        " map and start it again"
    )
