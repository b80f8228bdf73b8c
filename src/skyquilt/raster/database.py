"""SQLite files that Skyquilt itself wrote: the ledger and the tiles of a live map. They are opened
for one writer and many readers.

A folder of unknown origin may hold anything under these names. Triggers, views, computed columns
and conditions are programs that SQLite would run, so a file is refused unless each of its tables is
one of ours, to the letter. Values have a largest size and queries a longest time: pages may refer
to one another in circles.
"""

import sqlite3
from pathlib import Path
from typing import Any

from skyquilt.errors import OutputError
from skyquilt.outside import Database, open_regular, plain

_OWN = "sqlite_"
_MOST_TABLES = 100


def open_database(path: Path, tables: str, *, write: bool) -> Database:
    """A connection to a file that consists of `tables` (statements, one after the other); with
    `write` it is created if it is missing. There are no transactions but explicit ones.

    Raises:
        OutputError: it cannot be opened or written, is damaged, or holds something else.
    """
    try:
        if path.exists():
            with open_regular(path):
                pass  # it is a file
        uri = f"{path.absolute().as_uri()}?mode={'rwc' if write else 'ro'}"
        db = sqlite3.connect(
            uri,
            uri=True,
            timeout=30,
            check_same_thread=False,
            isolation_level=None,
            factory=Database,
        )
    except (sqlite3.Error, OSError) as error:
        raise _refused(path, error) from error
    try:
        db.limit()
        db.execute("pragma trusted_schema=off")
        _check(db, tables)
        if write:
            db.execute("pragma journal_mode=wal")
            db.execute("pragma synchronous=full")
            db.execute("begin immediate")  # fails where the file is read-only
            db.execute("rollback")
            db.executescript(tables)
    except (sqlite3.Error, ValueError) as error:
        db.close()
        raise _refused(path, error) from error
    return db


def _refused(path: Path, error: Exception) -> OutputError:
    return OutputError(f"{path} cannot be opened ({plain(str(error), 200)}); use another folder")


def _check(db: Database, tables: str) -> None:
    """Raises ValueError where a file holds anything but these tables and their indices."""
    known = sqlite3.connect(":memory:")
    known.executescript(tables)
    ours = {_plain(row) for row in known.execute(_CONTENT)}
    known.close()
    found = db.execute(f"{_CONTENT} limit {_MOST_TABLES}").fetchall()
    for row in found:
        if not str(row[1]).startswith(_OWN) and _plain(row) not in ours:
            raise ValueError(f"its {row[0]} {plain(str(row[1]), 40)!r} is none of Skyquilt's")
    if len(found) == _MOST_TABLES:
        raise ValueError("it has too many tables")


_CONTENT = "select type, name, sql from sqlite_master"


def _plain(row: tuple[Any, ...]) -> tuple[str, ...]:
    return tuple(" ".join(str(v).lower().split()) for v in row)
