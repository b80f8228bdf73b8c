"""The growing map: square tiles on the survey's own grid, with coarser levels, in one SQLite
file.
"""

import sqlite3
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from skyquilt.errors import OutputError
from skyquilt.model.raster import Grid
from skyquilt.outside import whole
from skyquilt.raster.database import open_database
from skyquilt.raster.halving import halve

SIDE = 256
"""Side of a tile in px."""
LEVELS = 10
"""Number of levels, each with pixels twice as large as the one before."""
QUALITY = 90
MOST_BANDS = 4
"""Largest number of values of a pixel."""
FARTHEST = 2**31
"""Largest row and column of a tile."""
KEPT = 256
"""Number of decoded tiles that are cached."""
TABLES = """
create table if not exists tile(layer text, level integer, row integer, col integer, version
  integer not null, body blob not null, primary key(layer, level, row, col)) without rowid;
create table if not exists owed(layer text, level integer, row integer, col integer,
  primary key(layer, level, row, col)) without rowid;
"""
PUT = (
    "insert into tile values (?, ?, ?, ?, 1, ?) on conflict do update set version = version + 1,"
    " body = excluded.body"
)
TOP = "select 1 from tile where layer=? and level=? limit 1"
PAID = "delete from owed where layer=? and level=? and row=? and col=?"


@dataclass(frozen=True, order=True)
class Address:
    """Address of a tile: row counts southwards, column eastwards from the map frame's origin, in
    tiles of that level.
    """

    layer: str
    """Name of the layer."""
    level: int
    """0 = finest."""
    row: int
    """Southwards."""
    col: int
    """Eastwards."""

    @property
    def parent(self) -> "Address":
        """The tile of the next coarser level that contains this one."""
        return Address(self.layer, self.level + 1, self.row >> 1, self.col >> 1)

    def children(self) -> list["Address"]:
        """The four tiles of the next finer level, row by row."""
        return [
            Address(self.layer, self.level - 1, 2 * self.row + r, 2 * self.col + c)
            for r in (0, 1)
            for c in (0, 1)
        ]

    def grid(self, gsd: float) -> Grid:
        """Its pixel grid; `gsd` in m is that of level 0."""
        size = gsd * 2**self.level
        return Grid(
            west=self.col * SIDE * size,
            north=-self.row * SIDE * size,
            gsd=size,
            width=SIDE,
            height=SIDE,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Tile:
    """A tile's content."""

    pixels: NDArray[Any]
    """(SIDE, SIDE, bands) uint8 or float32."""
    shown: NDArray[np.bool_]
    """(SIDE, SIDE) where there is content."""


def encoded(tile: Tile) -> bytes:
    """Encodes a tile: JPEG with a mask, or measured values without loss."""
    mask = zlib.compress(np.packbits(tile.shown).tobytes(), 1)
    if tile.pixels.dtype == np.uint8:
        body = simplejpeg.encode_jpeg(
            np.ascontiguousarray(tile.pixels), quality=QUALITY, colorspace="RGB"
        )
        return bytes(b"J" + len(mask).to_bytes(4, "little") + mask + body)
    values = zlib.compress(np.ascontiguousarray(tile.pixels, np.float32).tobytes(), 1)
    return b"F" + len(mask).to_bytes(4, "little") + mask + values


def decoded(body: bytes) -> Tile:
    """Decodes a tile; raises ValueError where it is none, whatever size it declares."""
    n = int.from_bytes(body[1:5], "little")
    mask = np.frombuffer(_inflated(body[5 : 5 + n], SIDE * SIDE // 8), np.uint8)
    shown = np.unpackbits(mask)[: SIDE * SIDE].reshape(SIDE, SIDE).astype(bool)
    rest = body[5 + n :]
    if body[:1] == b"J":
        if tuple(simplejpeg.decode_jpeg_header(rest)[:2]) != (SIDE, SIDE):
            raise ValueError("a tile of another size")
        return Tile(pixels=np.asarray(simplejpeg.decode_jpeg(rest)), shown=shown)
    values = np.frombuffer(_inflated(rest, 4 * SIDE * SIDE * MOST_BANDS), np.float32)
    return Tile(pixels=values.reshape(SIDE, SIDE, -1), shown=shown)


def _inflated(data: bytes, most: int) -> bytes:
    """What `zlib.compress` made smaller, of at most so many bytes; raises ValueError."""
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(data, most + 1)
    except zlib.error as error:
        raise ValueError("a damaged tile") from error
    if len(found) > most or not stream.eof:
        raise ValueError("a tile that is torn or too large")
    return found


class TileStore:
    """Tiles by address; one writer, many readers."""

    def __init__(self, path: Path, *, write: bool) -> None:
        """Opens the file; `write` creates it where it is missing.

        Raises:
            OutputError: it cannot be opened.
        """
        self.path, self._lock = Path(path), threading.RLock()
        self._extents: dict[
            str, tuple[tuple[int, int], tuple[float, float, float, float] | None]
        ] = {}
        self._kept: OrderedDict[Address, tuple[int, Tile]] = OrderedDict()
        self._db = open_database(self.path, TABLES, write=write)
        side = int(self._db.execute("pragma user_version").fetchone()[0])
        if write and not side:
            self._db.execute(f"pragma user_version={SIDE}")
            side = SIDE
        if side != SIDE:
            self._db.close()
            raise OutputError(
                f"{path} was written by another version of Skyquilt; use another folder"
            )

    def version(self, address: Address) -> int:
        """How often the tile was written; 0 where there is none."""
        with self._lock:
            found = self._db.execute(
                "select version from tile where layer=? and level=? and row=? and col=?",
                _key(address),
            ).fetchone()
        return int(found[0]) if found else 0

    def get(self, address: Address) -> Tile | None:
        """The tile; None where there is none, or it is damaged."""
        with self._lock:
            found = self._db.execute(
                "select version, body from tile where layer=? and level=? and row=? and col=?",
                _key(address),
            ).fetchone()
            if found is None:
                return None
            kept = self._kept.get(address)
            if kept is not None and kept[0] == found[0]:
                self._kept.move_to_end(address)
                return kept[1]
        try:
            tile = decoded(found[1])
        except (ValueError, TypeError):  # it is drawn again when a photo on it changes
            return None
        with self._lock:
            self._keep(address, int(found[0]), tile)
        return tile

    def _keep(self, address: Address, version: int, tile: Tile) -> None:
        self._kept[address] = (version, tile)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)

    def put(
        self,
        tiles: Sequence[tuple[Address, Tile]],
        *,
        owing: Iterable[Address] = (),
        drawn: Iterable[Address] = (),
    ) -> None:
        """Writes tiles, all in one transaction; the coarser ones above them are updated by
        `raise_levels`.

        `owing`: tiles of other layers that must still be drawn; they stay in the list of owed tiles
        until they are passed as `drawn`.

        Raises:
            OutputError: the disk is full.
        """
        rows = [(*_key(a), encoded(t)) for a, t in tiles]
        with self._lock:
            try:
                self._db.execute("begin immediate")
                self._db.executemany(PUT, rows)
                self._db.executemany(
                    "insert or ignore into owed values (?, ?, ?, ?)", map(_key, owing)
                )
                self._db.executemany(PAID, map(_key, drawn))
                self._db.execute("commit")
            except sqlite3.Error as error:
                if self._db.in_transaction:
                    self._db.execute("rollback")
                raise OutputError(
                    f"the disk is full: {self.path} cannot grow ({error}). Make room; mapping goes"
                    " on then"
                ) from error

    def owed(self) -> list[Address]:
        """Tiles of other layers that are still to be drawn, in order."""
        with self._lock:
            found = self._db.execute("select layer, level, row, col from owed").fetchall()
        return [
            Address(str(layer), z, r, c)
            for layer, z, r, c in found
            if whole(z, 0, LEVELS - 1) is not None
            and None not in (whole(r, -FARTHEST, FARTHEST), whole(c, -FARTHEST, FARTHEST))
        ]

    def raise_levels(self, changed: Iterable[Address], *, drawn: Iterable[Address] = ()) -> int:
        """Updates every coarser tile above those of level 0 that changed; returns how many.
        `drawn`: as for `put`.
        """
        done: dict[Address, Tile] = {}
        level = sorted(set(changed))
        while level and level[0].level + 1 < LEVELS:
            level = sorted({a.parent for a in level})
            for parent in level:
                tile = self._halved(parent, done)
                if tile is not None:
                    done[parent] = tile
        self.put(list(done.items()), drawn=drawn)
        return len(done)

    def _halved(self, parent: Address, fresh: dict[Address, Tile]) -> Tile | None:
        parts = [fresh.get(c) or self.get(c) for c in parent.children()]
        like = next((p for p in parts if p is not None), None)
        if like is None:
            return None
        half = SIDE // 2
        pixels = np.zeros((SIDE, SIDE, like.pixels.shape[2]), like.pixels.dtype)
        shown = np.zeros((SIDE, SIDE), bool)
        for k, part in enumerate(parts):
            if part is not None:
                at = (
                    slice(k // 2 * half, (k // 2 + 1) * half),
                    slice(k % 2 * half, (k % 2 + 1) * half),
                )
                small, valid = halve(
                    part.pixels, None if part.shown.all() else part.shown, "average"
                )
                pixels[at], shown[at] = small, True if valid is None else valid
        return Tile(pixels=pixels, shown=shown)

    def addresses(self, layer: str, level: int) -> list[Address]:
        """Addresses of all tiles of a level."""
        with self._lock:
            found = self._db.execute(
                "select row, col from tile where layer=? and level=?", (layer, level)
            ).fetchall()
        return [Address(layer, level, int(r), int(c)) for r, c in found]

    def layers(self) -> list[str]:
        """Names of the layers with content, without reading every tile."""
        found: list[str] = []
        with self._lock:
            while name := self._db.execute(
                "select min(layer) from tile where layer > ?", (found[-1] if found else "",)
            ).fetchone()[0]:
                found.append(str(name))
            return [n for n in found if self._db.execute(TOP, (n, LEVELS - 1)).fetchone()]

    def extent(self, layer: str, gsd: float) -> tuple[float, float, float, float] | None:
        """West, south, east, north in m (map frame) of a layer's content, accurate to a few of its
        pixels; None if it is empty.
        """
        with self._lock:
            stamp = (
                int(self._db.execute("pragma data_version").fetchone()[0]),
                self._db.total_changes,
            )
            known = self._extents.get(layer)
        if known is not None and known[0] == stamp:
            return known[1]
        found = self._extent(layer, gsd)
        self._extents[layer] = (stamp, found)
        return found

    def _extent(self, layer: str, gsd: float) -> tuple[float, float, float, float] | None:
        """The extent, from the finest level that has only a few tiles."""
        level = LEVELS - 1
        while level > 0 and len(self.addresses(layer, level - 1)) <= 6:
            level -= 1
        boxes = []
        for address in self.addresses(layer, level):
            tile = self.get(address)
            if tile is None or not tile.shown.any():
                continue
            grid = address.grid(gsd)
            rows, columns = np.flatnonzero(tile.shown.any(1)), np.flatnonzero(tile.shown.any(0))
            boxes.append(
                (
                    grid.west + columns[0] * grid.gsd,
                    grid.north - (rows[-1] + 1) * grid.gsd,
                    grid.west + (columns[-1] + 1) * grid.gsd,
                    grid.north - rows[0] * grid.gsd,
                )
            )
        if not boxes:
            return None
        low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
        return float(low[0]), float(low[1]), float(high[2]), float(high[3])

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._db.close()


def _key(address: Address) -> tuple[str, int, int, int]:
    return address.layer, address.level, address.row, address.col


def covering(layer: str, level: int, gsd: float, bounds: Iterable[float]) -> list[Address]:
    """Tiles of a level that intersect bounds (west, south, east, north) in m of the map frame;
    `gsd` of level 0.
    """
    west, south, east, north = bounds
    size = SIDE * gsd * 2**level
    rows = range(int(np.floor(-north / size)), int(np.floor(-south / size)) + 1)
    cols = range(int(np.floor(west / size)), int(np.floor(east / size)) + 1)
    return [Address(layer, level, r, c) for r in rows for c in cols]
