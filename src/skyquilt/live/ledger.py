"""The ledger: the database of a live survey, with photos, links, cameras, heights, events and
layers.

SQLite in WAL mode with `synchronous=FULL`: committed data survive a kill and a power cut; an
uncommitted transaction leaves nothing behind. There is one writer (the mapping) and any number of
readers, in this process or in others.

Also the crash points: names for the moments at which data has just become durable. Crash tests end
the process there.
"""

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skyquilt.errors import OutputError

POINTS = (
    "photo file synced",
    "photo file named",
    "photo row committed",
    "photo placed",
    "tiles written",
    "drawing told",
    "photo refined",
    "block closed",
    "folder seen",
    "published",
)
"""All crash points, in the order in which a photo passes them."""


def _nothing(name: str) -> None:
    """Does nothing: the default outside tests."""


watcher: Callable[[str], None] = _nothing
"""Called with the name of each point that is reached. Tests replace it."""


def hit(name: str) -> None:
    """Reports that a point was reached."""
    watcher(name)


NAME = "live.db"
"""Name of the file in the survey's folder."""
FORMAT = 1
"""Version of the tables below."""
TABLES = """
create table if not exists meta(key text primary key, value text not null);
create table if not exists photo(
  id integer primary key, digest text not null unique, name text not null, source text not null,
  file text not null, bytes integer not null, received real not null,
  shot text not null, width integer not null, state text not null,
  reason text not null default '', pose text, camera text, footprint text, about text);
create table if not exists refused(
  id integer primary key, name text not null, source text not null, reason text not null,
  at real not null);
create table if not exists link(a integer not null, b integer not null, body blob,
  primary key(a, b));
create table if not exists camera(key text primary key, body text not null);
create table if not exists height(col integer, row integer, z real not null,
  primary key(col, row)) without rowid;
create table if not exists event(seq integer primary key autoincrement, at real not null,
  kind text not null, body text not null);
create table if not exists layer(name text primary key, body text not null, at real not null);
create table if not exists seen(path text primary key, size integer not null,
  mtime integer not null);
create index if not exists photo_state on photo(state);
create index if not exists photo_shot on photo(shot);
create index if not exists link_b on link(b);
"""


def connected(path: Path, *, write: bool) -> sqlite3.Connection:
    """A connection to a database that other threads and processes can read while one writes.

    Raises:
        OutputError: it cannot be opened.
    """
    try:
        mode = "rwc" if write else "ro"
        uri = f"{path.absolute().as_uri()}?mode={mode}"
        db = sqlite3.connect(
            uri, uri=True, timeout=30, check_same_thread=False, isolation_level=None
        )
        if write:
            db.execute("pragma journal_mode=wal")
            db.execute("pragma synchronous=full")
            db.execute("begin immediate")  # fails where the file is read-only
            db.execute("rollback")
        db.execute("select count(*) from sqlite_master").fetchone()
    except sqlite3.Error as error:
        raise OutputError(
            f"{path} cannot be opened ({error}); choose another output folder"
        ) from error
    return db


@contextmanager
def transaction(db: sqlite3.Connection, path: Path) -> Iterator[None]:
    """A transaction: all changes are stored, or none.

    Raises:
        OutputError: the disk is full, or the file cannot be written.
    """
    try:
        db.execute("begin immediate")
        yield
        db.execute("commit")
    except sqlite3.OperationalError as error:
        _rolled_back(db)
        if "full" in str(error) or "disk I/O" in str(error):
            raise OutputError(
                f"the disk is full: {path} cannot grow. Free some space; accepted photos are"
                " safe and mapping continues"
            ) from error
        raise OutputError(f"{path} cannot be written: {error}") from error
    except BaseException:
        _rolled_back(db)
        raise


def _rolled_back(db: sqlite3.Connection) -> None:
    if db.in_transaction:
        db.execute("rollback")


class Ledger:
    """The database of one live survey. Can be shared between threads."""

    def __init__(self, folder: Path, *, write: bool) -> None:
        """Opens `folder/live.db`; with `write` it is created if it is missing.

        Raises:
            OutputError: it cannot be opened, or is of another format.
        """
        self.path = Path(folder) / NAME
        self.lock = threading.RLock()
        self.db = connected(self.path, write=write)
        if write:
            self.db.executescript(TABLES)
        found = self.meta("format", FORMAT if write else None)
        if found != FORMAT:
            raise OutputError(
                f"{self.path} has format {found}, this version reads {FORMAT}; choose another"
                " folder"
            )
        if write and self.meta("began") is None:
            with self.change():
                self.put_meta("format", FORMAT)
                self.put_meta("began", time.time())

    @contextmanager
    def change(self) -> Iterator[sqlite3.Connection]:
        """A transaction: the changes inside it are stored together or not at all."""
        with self.lock:
            if self.db.in_transaction:
                yield self.db
                return
            with transaction(self.db, self.path):
                yield self.db

    @contextmanager
    def lightly(self) -> Iterator[None]:
        """Transactions without waiting for the disk. A power cut may undo them, a kill may not;
        used for changes that need not be durable.
        """
        with self.lock:
            light = not self.db.in_transaction
            if light:
                self.db.execute("pragma synchronous=normal")
            try:
                yield
            finally:
                if light:
                    self.db.execute("pragma synchronous=full")

    def rows(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        """All rows of a query."""
        with self.lock:
            return self.db.execute(query, values).fetchall()

    def row(self, query: str, *values: Any) -> tuple[Any, ...] | None:
        """The first row of a query."""
        with self.lock:
            found: tuple[Any, ...] | None = self.db.execute(query, values).fetchone()
            return found

    def meta(self, key: str, default: Any = None) -> Any:
        """A value of the survey as a whole."""
        found = self.row("select value from meta where key = ?", key)
        return default if found is None else json.loads(found[0])

    def put_meta(self, key: str, value: Any) -> None:
        """Sets a value of the survey as a whole."""
        with self.change() as db:
            db.execute("insert or replace into meta values (?, ?)", (key, json.dumps(value)))

    def tell(self, kind: str, body: dict[str, Any]) -> None:
        """Appends an event for viewers."""
        with self.change() as db:
            db.execute(
                "insert into event(at, kind, body) values (?, ?, ?)",
                (time.time(), kind, json.dumps(body)),
            )

    def told(self, after: int, limit: int = 500) -> list[tuple[int, str, str]]:
        """(number, kind, JSON) of events after a number."""
        found = self.rows(
            "select seq, kind, body from event where seq > ? order by seq limit ?", after, limit
        )
        return [(int(n), str(k), str(b)) for n, k, b in found]

    def stamp(self) -> int:
        """A number that changes when another connection has written. Reading it is much faster than
        a query for new events.
        """
        with self.lock:
            return int(self.db.execute("pragma data_version").fetchone()[0])

    def last_event(self) -> int:
        """Number of the newest event; 0 if there is none."""
        found = self.row("select max(seq) from event")
        return int(found[0] or 0) if found else 0

    def refuse(self, name: str, source: str, reason: str) -> None:
        """Records a refused file and reports it as an event."""
        with self.lightly(), self.change() as db:
            db.execute(
                "insert into refused(name, source, reason, at) values (?, ?, ?, ?)",
                (name, source, reason, time.time()),
            )
            self.tell("refused", {"name": name, "source": source, "reason": reason})

    def set_photo(self, photo: int, **columns: Any) -> None:
        """Changes columns of a photo; dicts and lists become JSON."""
        names = ", ".join(f"{k} = ?" for k in columns)
        values = [json.dumps(v) if isinstance(v, dict | list) else v for v in columns.values()]
        with self.change() as db:
            db.execute(f"update photo set {names} where id = ?", (*values, photo))

    def counts(self) -> dict[str, int]:
        """Number of photos by state, including `refused`."""
        found = {
            str(s): int(n) for s, n in self.rows("select state, count(*) from photo group by state")
        }
        refused = self.row("select count(*) from refused")
        return {**found, "refused": int(refused[0]) if refused else 0}

    def put_links(self, links: Sequence[tuple[int, int, bytes | None]]) -> None:
        """Stores links (a < b); None = the pair was compared and does not match."""
        with self.change() as db:
            db.executemany("insert or replace into link values (?, ?, ?)", links)

    def close(self) -> None:
        """Closes the file."""
        with self.lock:
            self.db.close()
