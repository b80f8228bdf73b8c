"""The ledger: the database of a live survey, with photos, links, cameras, heights, events and
layers.

SQLite in WAL mode with `synchronous=FULL`: committed data survive a kill and a power cut; an
uncommitted transaction leaves nothing behind. There is one writer (the mapping) and any number of
readers, in this process or in others.

Also the crash points: names for the moments at which data has just become durable. Crash tests end
the process there.
"""

import json
import os
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skyquilt.errors import OutputError
from skyquilt.outside import plain, real
from skyquilt.raster.database import open_database

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


DAMAGED = (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError)
"""What reading a record raises that nobody of ours has written."""
NO_VALUE = "(?!)"
"""A regular expression that nothing matches."""
STAND_IN = "EPSG:3857"
"""The projection in which the page draws a map without a place, about its origin, where its metres
are those of the map. Nothing else is told of it as if the map were there.
"""
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
create table if not exists band(photo integer primary key, name text not null);
create table if not exists seen(path text primary key, size integer not null,
  mtime integer not null);
create index if not exists photo_state on photo(state);
create index if not exists photo_shot on photo(shot);
create index if not exists link_b on link(b);
create index if not exists band_name on band(name);
"""


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


def _identity(path: Path) -> tuple[int, int] | None:
    """What tells a file from others that bear its name later; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class Ledger:
    """The database of one live survey. Can be shared between threads."""

    def __init__(self, folder: Path, *, write: bool) -> None:
        """Opens `folder/live.db`; with `write` it is created if it is missing.

        Raises:
            OutputError: it cannot be opened, or is of another format.
        """
        self.path = Path(folder) / NAME
        self.lock = threading.RLock()
        self.db = open_database(self.path, TABLES, write=write)
        self._opened = _identity(self.path)
        try:
            self._check()
            found = self.meta("format", FORMAT if write else None)
        except sqlite3.Error as error:
            raise self.damaged(plain(str(error), 100)) from error
        if found != FORMAT:
            raise OutputError(
                f"{self.path} has format {found}, this version reads {FORMAT}; choose another"
                " folder"
            )
        if write and self.meta("began") is None:
            with self.change():
                self.put_meta("format", FORMAT)
                self.put_meta("began", time.time())

    def _check(self) -> None:
        """Refuses a survey whose values as a whole cannot be: all else depends on them.

        Raises:
            OutputError: it is damaged.
        """
        frame = self.meta("frame")
        if frame is not None and not _is_frame(frame):
            raise self.damaged("its frame is no place on Earth")
        for key, low, high in NUMBERS:
            value = self.meta(key)
            if value is not None and real(value, low, high) is None:
                raise self.damaged(f"{key} is {plain(repr(value), 40)}")
        for key in ("settings", "schedule"):
            if not isinstance(self.meta(key, {}), dict):
                raise self.damaged(f"{key} is no record")

    @property
    def in_place(self) -> bool | None:
        """Whether the file is still the one that was opened; None where there is none."""
        now = _identity(self.path)
        return None if now is None else now == self._opened

    def damaged(self, why: str) -> OutputError:
        """The error that ends what uses this survey."""
        return OutputError(f"{self.path} is damaged ({why}); use another folder")

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
        try:
            return default if found is None else json.loads(found[0])
        except DAMAGED as error:
            raise self.damaged(f"{key} is not JSON") from error

    def put_meta(self, key: str, value: Any) -> None:
        """Sets a value of the survey as a whole."""
        text = json.dumps(value)
        with self.change() as db:
            db.execute("insert or replace into meta values (?, ?)", (key, text))

    def tell(self, kind: str, body: dict[str, Any]) -> None:
        """Appends an event for viewers."""
        with self.change() as db:
            db.execute(
                "insert into event(at, kind, body) values (?, ?, ?)",
                (time.time(), kind, json.dumps(body)),
            )

    def tell_new(
        self, notes: Iterable[str], key: str, values: str = NO_VALUE, before: str = "So far: "
    ) -> None:
        """Appends notes for viewers that were not told before, but for other values (inside a
        transaction). `key`: under which what was told is remembered; `values`: a regular expression
        for what differs where a note is the same; `before`: what each note begins with.
        """
        said = self.meta(key)
        told = {str(text) for text in said} if isinstance(said, list) else set[str]()
        for note in notes:
            if (kind := re.sub(values, "", note)) not in told:
                told.add(kind)
                self.tell("note", {"text": f"{before}{note}"})
        self.put_meta(key, sorted(told))

    def told(self, after: int, limit: int = 500) -> list[tuple[int, str, str]]:
        """(number, kind, JSON) of events after a number."""
        found = self.rows(
            "select seq, kind, body from event where seq > ? order by seq limit ?", after, limit
        )
        return [(int(n), *_event(k, b)) for n, k, b in found]

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

    def taken_after_all(self, name: str, source: str) -> None:
        """Forgets that a file was refused: one of its name came whole from the same drone."""
        with self.change() as db:
            db.execute("delete from refused where name = ? and source = ?", (name, source))

    def forget_refused(self, digest: str) -> None:
        """Forgets a photo that is refused, and whose file was gone until it arrived again, so that
        it counts as new.
        """
        with self.change() as db:
            own = "in (select id from photo where digest = ? and state = 'refused')"
            db.execute(f"delete from link where a {own} or b {own}", (digest, digest))
            db.execute(f"delete from band where photo {own}", (digest,))
            db.execute(f"delete from photo where id {own}", (digest,))

    def lost(self, photo: int, name: str, source: str, reason: str) -> None:
        """Refuses a photo whose stored file cannot be read any more. Where it came from a folder,
        it is taken from there again.
        """
        with self.change() as db:
            self.set_photo(photo, state="refused", reason=reason, pose=None, footprint="")
            db.execute("update link set body = null where a = ? or b = ?", (photo, photo))
            db.execute(
                "delete from seen where path = ? or substr(path, -length(?) - 1) = ? || ?",
                (name, name, os.sep, name),
            )
            said = {"id": photo, "name": name, "source": source, "state": "refused"}
            self.tell("photo", {**said, "time": None, "reason": reason})

    def set_photo(self, photo: int, **columns: Any) -> None:
        """Changes columns of a photo; dicts and lists become JSON."""
        names = ", ".join(f"{k} = ?" for k in columns)
        values = [json.dumps(v) if isinstance(v, dict | list) else v for v in columns.values()]
        with self.change() as db:
            db.execute(f"update photo set {names} where id = ?", (*values, photo))

    def counts(self) -> dict[str, int]:
        """Number of photos by state, including `refused`: photos, and files that became none."""
        found = {
            str(s): int(n) for s, n in self.rows("select state, count(*) from photo group by state")
        }
        refused = self.row("select count(*) from refused")
        files = int(refused[0]) if refused else 0
        return {**found, "refused": found.get("refused", 0) + files}

    def put_links(self, links: Sequence[tuple[int, int, bytes | None]]) -> None:
        """Stores links (a < b); None = the pair was compared and does not match."""
        with self.change() as db:
            db.executemany("insert or replace into link values (?, ?, ?)", links)

    def forget_unlike(self, photos: Iterable[int]) -> None:
        """Forgets that these photos were compared with others that they did not match."""
        with self.change() as db:
            query = "delete from link where body is null and (a = ? or b = ?)"
            db.executemany(query, [(i, i) for i in photos])

    def unlike(self, photo: int) -> list[tuple[int, int]]:
        """Pairs of a photo and one before it that were compared and do not match."""
        found = self.rows("select a, b from link where body is null and b = ?", photo)
        return [(int(a), int(b)) for a, b in found]

    def compared(self, one: int, other: int) -> bool:
        """Whether two photos were compared, in any order."""
        pair = min(one, other), max(one, other)
        query = "select 1 from link where (a, b) in (values (?, ?), (?, ?))"
        return self.row(query, *pair, *reversed(pair)) is not None

    def compared_with(self, photo: int) -> int:
        """Number of photos with which one was compared."""
        row = self.row("select count(*) from link where a = ? or b = ?", photo, photo)
        return 0 if row is None else int(row[0])

    def close(self) -> None:
        """Closes the file."""
        with self.lock:
            self.db.close()


_KIND = re.compile("[a-z]{1,20}")
_CRS = re.compile(r"EPSG:[0-9]{4,6}")
NUMBERS = (("gsd", 1e-4, 1e3), ("cell", 1e-2, 1e4), ("ground", -1e5, 1e5), ("began", 0, 1e11))
"""Numbers of the survey as a whole, and what they can be."""


def _event(kind: Any, body: Any) -> tuple[str, str]:
    """An event as it is sent to viewers; an empty note where it is none of ours."""
    try:
        said = json.loads(body)
        if kind == "tiles":
            boxes = [*said.get("boxes", ()), said["bounds"]]
            known = isinstance(said["layer"], str) and all(
                len(box) == 4 and all(real(v, -360, 360) is not None for v in box) for box in boxes
            )
        else:
            known = isinstance(said, dict) and _KIND.fullmatch(kind) is not None
        if known and "\n" not in body and "\r" not in body:
            return kind, body
    except DAMAGED:
        pass
    return "note", "{}"


def _is_frame(said: Any) -> bool:
    """Whether a record can be that of a `MapFrame`; one without a place has no coordinate
    system.
    """
    if not isinstance(said, dict) or not isinstance(said.get("origin"), list):
        return False
    origin = [real(v, -1e8, 1e8) for v in said["origin"]]
    crs = said.get("crs")
    numbers = (said.get("takeoff_m"), said.get("convergence_deg", 0.0))
    return (
        len(origin) == 2
        and None not in origin
        and (crs is None or (isinstance(crs, str) and _CRS.fullmatch(crs) is not None))
        and all(v is None or real(v, -1e6, 1e6) is not None for v in numbers)
    )


def footprint_from(body: str) -> dict[str, Any] | None:
    """Where a photo lies, as it was drawn: `ring` (n, 2) and `at` (2,), longitude and latitude in
    degrees, `at` None where it is not known; None where the record is damaged.
    """
    try:
        said = json.loads(body)
        ring = [_place(p) for p in said.get("ring", ())]
        return {"ring": ring, "at": _place(said["at"]) if said.get("at") is not None else None}
    except DAMAGED:
        return None


def _place(values: Any) -> list[float]:
    lon, lat = (real(v, -360, 360) for v in values)
    if lon is None or lat is None:
        raise ValueError("it is no place")
    return [lon, lat]
