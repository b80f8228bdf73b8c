"""Errors of single photos: where they arise they are told from errors of the disk, and
`LiveMap.work` sets the photo aside.
"""

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from skyquilt.errors import OutputError

_SYSTEM = frozenset(
    {
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EIO,
        errno.EROFS,
        errno.EMFILE,
        errno.ENFILE,
        errno.ENOMEM,
        errno.ESTALE,
        errno.ENODEV,
        errno.ENXIO,
    }
)
"""Errors of the disk or the system, which are no photo's fault."""


class MemberFailedError(Exception):
    """A step failed on one photo; the cause is in `__cause__`."""

    def __init__(self, number: int) -> None:
        super().__init__(f"photo {number}")
        self.number = number


@contextmanager
def concerning(number: int) -> Iterator[None]:
    """Whatever fails inside is an error of this photo, unless the disk or the system failed.

    Raises:
        MemberFailedError: an error of the photo. OutputError: of the disk or the system.
    """
    try:
        yield
    except (OutputError, MemberFailedError):
        raise
    except Exception as error:
        raise of_the_system(error) or MemberFailedError(number) from error


def of_the_system(error: BaseException) -> OutputError | None:
    """The error of the disk or the system behind an error; None where there is none."""
    found: BaseException | None = error
    while found is not None:
        if isinstance(found, sqlite3.Error):
            return OutputError(f"the database of the survey cannot be used ({found})")
        if isinstance(found, OSError) and found.errno in _SYSTEM:
            return OutputError(f"the disk or the system fails ({found.strerror})")
        found = found.__cause__
    return None
