"""MBTiles 1.3: web tiles in one SQLite file, which QGIS and tablets can open while it is being
written.
"""

import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

from skyquilt.errors import OutputError
from skyquilt.raster.map_source import MERCATOR, Bounds

TABLES = """
create table if not exists metadata(name text primary key, value text);
create table if not exists tiles(zoom_level integer, tile_column integer, tile_row integer,
  tile_data blob);
create unique index if not exists tile_index on tiles(zoom_level, tile_column, tile_row);
"""


def write_mbtiles(
    path: Path,
    tiles: Iterable[tuple[int, int, int, bytes | None]],
    *,
    name: str,
    bounds: Bounds,
    zooms: tuple[int, int],
) -> None:
    """Adds or replaces tiles (zoom, column, row from the north, WebP; None removes) in one
    transaction.

    `bounds` in degrees. Raises OutputError where the file cannot be written.
    """
    west, south, east, north = bounds
    about = {
        "name": name,
        "format": "webp",
        "type": "overlay",
        "version": "1.3",
        "minzoom": str(zooms[0]),
        "maxzoom": str(zooms[1]),
        "bounds": ",".join(f"{v:.8f}" for v in bounds),
        "center": f"{(west + east) / 2:.8f},{(south + north) / 2:.8f},{zooms[1] - 2}",
    }
    try:
        with closing(sqlite3.connect(path, timeout=10)) as db:
            db.executescript(TABLES)
            with db:
                db.executemany("insert or replace into metadata values (?, ?)", list(about.items()))
                for z, x, y, data in tiles:
                    key = (z, x, 2**z - 1 - y)  # MBTiles counts rows from the south
                    if data is None:
                        db.execute(
                            "delete from tiles where zoom_level=? and tile_column=? and tile_row=?",
                            key,
                        )
                    else:
                        db.execute("insert or replace into tiles values (?, ?, ?, ?)", (*key, data))
    except sqlite3.Error as error:
        raise OutputError(
            f"{path} cannot be written ({error}); make room; it will be tried again"
        ) from error


def touched(boxes: Sequence[Bounds], z: int) -> set[tuple[int, int]]:
    """Columns and rows of the tiles of a zoom level that intersect boxes in EPSG:3857."""
    size = 2 * MERCATOR / 2**z
    found = set()
    for west, south, east, north in boxes:
        for x in range(int((west + MERCATOR) // size), int((east + MERCATOR) // size) + 1):
            for y in range(int((MERCATOR - north) // size), int((MERCATOR - south) // size) + 1):
                found.add((x, y))
    return found
