"""The log of errors in a run's folder: where the program failed on a photo, for a report of it."""

import time
import traceback
from contextlib import suppress
from pathlib import Path

from skyquilt.outside import plain

NAME = "errors.log"
"""Name of the file in the run's folder. It exists only if something failed."""
MOST_BYTES = 1_000_000
"""Largest size of the file; what comes after is not written."""


def log_error(folder: Path, what: str, error: BaseException | str) -> None:
    """Appends an error, or its traceback as text, with the photo or step that it concerns. Never
    raises: a full disk must not turn a lost photo into a lost run.
    """
    trace = error if isinstance(error, str) else "".join(traceback.format_exception(error))
    path = folder / NAME
    with suppress(OSError):
        if path.exists() and path.stat().st_size > MOST_BYTES:
            return
        with path.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {plain(what)}\n{trace[-20_000:]}\n")
