"""Opens what the server shows: a growing survey, read from its folder, or a finished run."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skyquilt.errors import SideFileError, UsageError
from skyquilt.live.ledger import NAME, STAND_IN, Ledger, footprint_from
from skyquilt.outside import real
from skyquilt.raster.map_source import FileSource, MapSource, TileSource
from skyquilt.raster.tile_store import TileStore
from skyquilt.runs.layers import UNITS, RunLayer, figures_of, is_tiff, layers_in
from skyquilt.server.finished_survey import FinishedSurvey
from skyquilt.server.shown import Shown, base_map

GROWING = {
    "visible": RunLayer(name="visible", title="Growing map", file=""),
    "visible-newest": RunLayer(name="visible-newest", title="Growing map, newest on top", file=""),
    "thermal": RunLayer(name="thermal", title="Thermal", file="", measured=True),
    "thermal-newest": RunLayer(
        name="thermal", title="Thermal, newest on top", file="", measured=True
    ),
    "thermal-counts": RunLayer(
        name="thermal-counts", title="Thermal, values without a unit", file="", measured=True
    ),
    "thermal-counts-newest": RunLayer(
        name="thermal-counts",
        title="Thermal, values without a unit, newest on top",
        file="",
        measured=True,
    ),
    "thermal-colours": RunLayer(
        name="thermal-colours", title="Thermal, a palette's colours", file=""
    ),
    "thermal-colours-newest": RunLayer(
        name="thermal-colours", title="Thermal, a palette's colours, newest on top", file=""
    ),
    "base": RunLayer(name="base", title="Older map", file=""),
}
"""How growing maps are shown."""
GROWING_UNITS = {"thermal": "celsius", "thermal-counts": "counts"}
"""Units of the values of growing maps."""
PHOTOS, TILES, FINISHED = "photos", "tiles.db", "finished"


def open_survey(
    folder: Path, base: Path | None = None, photos: Path | None = None
) -> "LiveSurvey | FinishedSurvey":
    """Opens the survey in a folder; `photos`: where the photos of a finished run are now.

    Raises:
        UsageError: it contains none. SideFileError: a file of the run is damaged.
    """
    if photos is not None and not photos.is_dir():
        raise UsageError(f"--photos {photos} is not a folder")
    if (folder / NAME).is_file():
        if photos is not None:
            raise UsageError(
                f"--photos would have no effect: {folder} is a live survey, which holds its photos"
            )
        return LiveSurvey(folder, base=base)
    if is_tiff(folder / "mosaic.tif"):
        return FinishedSurvey(folder, base=base, photos=photos)
    raise UsageError(
        f"{folder} contains neither a live survey ({NAME}) nor a finished run (mosaic.tif); name"
        " the folder given to -o"
    )


def is_final(layer: str) -> bool:
    """Whether a layer of a live survey is one of its final map."""
    return layer == FINISHED or layer.startswith(f"{FINISHED}-")


class LiveSurvey:
    """A live survey, read from its folder while the mapping writes to it."""

    growing = True

    def __init__(self, folder: Path, *, base: Path | Sequence[Path] | None = None) -> None:
        """Opens it for reading; `base` are older maps.

        Raises:
            OutputError: it cannot be read. UsageError: `base` is not a map.
        """
        self.folder, self.base = folder, base_map(base)
        self.ledger = Ledger(folder, write=False)
        self.tiles = TileStore(folder / TILES, write=False)
        self._sources: dict[Path, tuple[tuple[int, int, int], FileSource]] = {}

    def layers(self) -> dict[str, MapSource]:
        """Layers of the tiles, if the map has a place, and the final map if there is one."""
        frame = self.ledger.meta("frame")
        found = self._tiled(frame["crs"]) if frame and frame["crs"] is not None else {}
        for name, final in self._final().items():
            with suppress(OSError, SideFileError):  # it is just being replaced
                source = self._source(self.folder / FINISHED / final.file)
                if source.crs:  # else it has no place to be shown at: its files are there
                    found[name] = source
        return found | self.base

    def placeless(self) -> dict[str, MapSource]:
        """Layers of a map without a place, for the page alone: about longitude and latitude 0, in
        metres that are those of the map. Empty where there is a map with a place.
        """
        frame = self.ledger.meta("frame")
        if not frame or frame["crs"] is not None or self.layers().keys() - self.base.keys():
            return {}
        return self._tiled(STAND_IN)

    def _tiled(self, crs: str) -> dict[str, MapSource]:
        """Layers of the tiles, visible ones first."""
        frame, gsd = self.ledger.meta("frame"), self.ledger.meta("gsd")
        names = sorted(self.tiles.layers(), key=lambda n: (not n.startswith("visible"), n))
        if not frame or not gsd:
            return {}
        x, y = frame["origin"]
        return {
            name: TileSource(tiles=self.tiles, layer=name, crs=crs, origin=(x, y), gsd=gsd)
            for name in names
        }

    def _source(self, path: Path) -> FileSource:
        """A file of the final map, opened anew where it has been replaced.

        Raises:
            OSError: it is not there. SideFileError: it cannot be read.
        """
        info = path.stat()
        stamp = (info.st_ino, info.st_mtime_ns, info.st_size)
        known = self._sources.get(path)
        if known is None or known[0] != stamp:
            source = FileSource(path=path)
            source.about()
            known = self._sources[path] = (stamp, source)
        return known[1]

    def _final(self) -> dict[str, RunLayer]:
        """Layers of the final map, if there is one."""
        return {
            FINISHED if name == "mosaic" else f"{FINISHED}-{name}": layer
            for name, layer in layers_in(self.folder / FINISHED).items()
        }

    def styles(self) -> dict[str, RunLayer]:
        """Growing maps, and layers of the final one."""
        final = {
            name: replace(layer, title=f"Final {layer.title.lower()}")
            for name, layer in self._final().items()
        }
        older = {
            name: replace(GROWING["base"], name=name, title=f"Older map {number}")
            for number, name in enumerate(self.base, 1)
            if number > 1
        }
        return GROWING | older | final

    def unit(self, layer: str) -> str:
        """Unit of a growing map's values as printed; empty for other layers."""
        style = GROWING.get(layer)
        return UNITS.get(GROWING_UNITS.get(style.name, "") if style else "", "")

    def figures(self) -> Mapping[str, Any]:
        """The figures of the final map; empty while there is none."""
        return figures_of(self.folder / FINISHED)

    def results(self) -> Path | None:
        """Folder of the final map; None while there is none."""
        home = self.folder / FINISHED
        return home if is_tiff(home / "mosaic.tif") else None

    def photos(self) -> list[Shown]:
        """All accepted photos."""
        query = (
            "select id, name, source, state, reason, footprint, file, received, digest, shot"
            " from photo order by id"
        )
        found = (self._shown(row) for row in self.ledger.rows(query))
        return [photo for photo in found if photo is not None]

    def photo(self, number: int) -> Shown | None:
        """One accepted photo."""
        query = (
            "select id, name, source, state, reason, footprint, file, received, digest, shot"
            " from photo where id = ?"
        )
        row = self.ledger.row(query, number)
        return None if row is None else self._shown(row)

    def _shown(self, row: tuple[Any, ...]) -> Shown | None:
        """A photo; None where what is stored of it is damaged."""
        number, _, _, _, _, place, file, received, digest, shot = row
        name, source, state, reason = (str(v) for v in row[1:5])
        held = footprint_from(place or "{}")
        if held is None or real(received) is None:
            return None
        ring = tuple((lon, lat) for lon, lat in held["ring"])
        record = {
            "id": number,
            "name": name,
            "source": source,
            "state": state,
            "reason": "" if state in ("refined", "superseded") else reason,
            "time": _taken(str(shot)),
            "at": held["at"],
            "ring": [list(p) for p in ring],
            "received": received,
        }
        # the file's name is the digest, whatever a folder of unknown origin says
        path = self.folder / PHOTOS / Path(str(file)).name
        return Shown(
            id=int(number),
            name=name,
            state=state,
            record=record,
            ring=ring,
            path=path,
            digest=str(digest),
        )

    def refused(self) -> list[dict[str, Any]]:
        """Files that were refused, the latest first."""
        rows = self.ledger.rows(
            "select name, source, reason, at from refused order by id desc limit 200"
        )
        return [
            {"name": str(n), "source": str(s), "reason": str(r), "at": real(a), "state": "refused"}
            for n, s, r, a in rows
        ]

    def version(self) -> int:
        """Number of the newest event."""
        return self.ledger.last_event()

    def stamp(self) -> int:
        """The change counter of the ledger's file."""
        return self.ledger.stamp()


def _taken(shot: str) -> float | None:
    """Capture time (seconds since 1970) from the key of a shot (`photo_intake.shot_of`)."""
    for part in shot.split("|")[3:4]:
        with suppress(ValueError):
            at = datetime.fromisoformat(part)
            return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
    return None
