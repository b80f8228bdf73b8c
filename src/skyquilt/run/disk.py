"""What the operating system's refusals mean to somebody who wants a file written."""

import errno
from pathlib import Path

from skyquilt.errors import OutputError

FULL = (errno.ENOSPC, errno.EDQUOT)


def refusal(path: Path, error: OSError) -> OutputError:
    """The error with the next step: make room and resume, or another folder."""
    if error.errno in FULL:
        return OutputError(
            f"the disk is full: cannot write to {path}. Make room and run the same command again to"
            " resume"
        )
    return OutputError(
        f"cannot write to {path}: {error.strerror or error}; choose another output folder"
    )
