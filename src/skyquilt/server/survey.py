"""The data that the server shows: a growing survey or a finished run, with the same interface."""

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from skyquilt.errors import SideFileError, UsageError
from skyquilt.live.ledger import NAME, Ledger
from skyquilt.outside import plain, read_bounded, real
from skyquilt.raster.map_source import FileSource, MapSource, TileSource, between
from skyquilt.raster.read_map import open_map
from skyquilt.raster.tile_store import TileStore
from skyquilt.runs.layers import RunLayer, figures_of, is_tiff, layers_in

GROWING = {
    "visible": RunLayer(name="visible", title="Growing map", file=""),
    "visible-newest": RunLayer(name="visible-newest", title="Growing map, newest on top", file=""),
    "thermal": RunLayer(name="thermal", title="Thermal", file="", measured=True),
    "thermal-newest": RunLayer(
        name="thermal", title="Thermal, newest on top", file="", measured=True
    ),
    "base": RunLayer(name="base", title="Older map", file=""),
}
"""How growing maps are shown."""
PHOTOS, TILES, FINISHED, NAMED = "photos", "tiles.db", "finished", "named"


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """One photo as viewers see it."""

    id: int
    """Number of the photo."""
    name: str
    """Name of the photo; must be escaped in HTML."""
    state: str
    """received, waiting, placed, refined, superseded or refused."""
    record: Mapping[str, Any]
    """All data that are sent to viewers."""
    ring: tuple[tuple[float, float], ...]
    """Footprint: longitude and latitude of its vertices in degrees."""
    path: Path | None
    """Its file; None if it no longer exists."""
    digest: str
    """Hash of the content that its file must have to be shown."""


class Survey(Protocol):
    """Interface of the data that the server shows."""

    growing: bool
    """Whether more photos may arrive."""
    folder: Path
    """Its folder."""

    def layers(self) -> dict[str, MapSource]:
        """Map layers by name; the first one is the default."""

    def styles(self) -> dict[str, RunLayer]:
        """How layers are shown, by name; others are colour images under their own name."""

    def figures(self) -> Mapping[str, Any]:
        """The figures of the finished map; empty while there is none."""

    def results(self) -> Path | None:
        """Folder of the finished map; None while there is none."""

    def photos(self) -> list[Shown]:
        """All photos in order."""

    def photo(self, number: int) -> Shown | None:
        """One photo."""

    def version(self) -> int:
        """A number that grows with every change."""

    def stamp(self) -> int:
        """A number that differs if something may have changed; fast to read."""


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
        return LiveSurvey(folder, base=base)
    if is_tiff(folder / "mosaic.tif"):
        return FinishedSurvey(folder, base=base, photos=photos)
    raise UsageError(
        f"{folder} contains neither a live survey ({NAME}) nor a finished run (mosaic.tif); name"
        " the folder given to -o"
    )


def base_map(path: Path | None) -> dict[str, MapSource]:
    """An older orthophoto as a layer; empty if no path is given.

    Raises:
        UsageError: it is not a georeferenced raster.
    """
    if path is None:
        return {}
    if open_map(path) is None or not FileSource(path=path).crs:
        raise UsageError(f"--base {path} is not a georeferenced map that GDAL can read")
    return {"base": FileSource(path=path)}


class LiveSurvey:
    """A live survey, read from its folder while the mapping writes to it."""

    growing = True

    def __init__(self, folder: Path, *, base: Path | None = None) -> None:
        """Opens it for reading; `base` is an older orthophoto.

        Raises:
            OutputError: it cannot be read. UsageError: `base` is not a map.
        """
        self.folder, self.base = folder, base_map(base)
        self.ledger = Ledger(folder, write=False)
        self.tiles = TileStore(folder / TILES, write=False)

    def layers(self) -> dict[str, MapSource]:
        """Layers of the tiles, and the final map if there is one."""
        frame, gsd = self.ledger.meta("frame"), self.ledger.meta("gsd")
        found: dict[str, MapSource] = {}
        if frame and gsd:
            x, y = frame["origin"]
            for layer in sorted(
                self.tiles.layers(), key=lambda n: (not n.startswith("visible"), n)
            ):
                found[layer] = TileSource(
                    tiles=self.tiles, layer=layer, crs=frame["crs"], origin=(x, y), gsd=gsd
                )
        home = self.folder / FINISHED
        for name, final in self._final().items():
            found[name] = FileSource(path=home / final.file)
        return found | self.base

    def _final(self) -> dict[str, RunLayer]:
        """Layers of the final map, if there is one."""
        return {
            "finished" if name == "mosaic" else f"finished-{name}": layer
            for name, layer in layers_in(self.folder / FINISHED).items()
        }

    def styles(self) -> dict[str, RunLayer]:
        """Growing maps, and layers of the final one."""
        final = {
            name: replace(layer, title=f"Final {layer.title.lower()}")
            for name, layer in self._final().items()
        }
        return GROWING | final

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
        return [self._shown(row) for row in self.ledger.rows(query)]

    def photo(self, number: int) -> Shown | None:
        """One accepted photo."""
        query = (
            "select id, name, source, state, reason, footprint, file, received, digest, shot"
            " from photo where id = ?"
        )
        row = self.ledger.row(query, number)
        return None if row is None else self._shown(row)

    def _shown(self, row: tuple[Any, ...]) -> Shown:
        number, name, source, state, reason, place, file, received, digest, shot = row
        held = json.loads(place) if place else {}
        ring = tuple((float(a), float(b)) for a, b in held.get("ring", ()))
        record = {
            "id": number,
            "name": name,
            "source": source,
            "state": state,
            "reason": "" if state in ("refined", "superseded") else reason,
            "time": _taken(str(shot)),
            "at": held.get("at"),
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
            {"name": n, "source": s, "reason": r, "at": a, "state": "refused"}
            for n, s, r, a in rows
        ]

    def version(self) -> int:
        """Number of the newest event."""
        return self.ledger.last_event()

    def stamp(self) -> int:
        """The change counter of the ledger's file."""
        return self.ledger.stamp()


class FinishedSurvey:
    """The folder of a finished run."""

    growing = False

    def __init__(
        self, folder: Path, *, base: Path | None = None, photos: Path | None = None
    ) -> None:
        """Reads the files of the run; `photos`: where its photos are, if not where they were.

        Raises:
            UsageError: it is not georeferenced, or `base` is not a map. SideFileError: a file of
                the run is damaged.
        """
        self.folder, self.base = folder, base_map(base)
        self._photos: list[Shown] = []
        self._source = FileSource(path=folder / "mosaic.tif")
        self._layers, self._figures = layers_in(folder), figures_of(folder)
        self._sources: dict[str, MapSource] = {
            name: FileSource(path=folder / layer.file) for name, layer in self._layers.items()
        }
        if not self._source.crs:
            raise UsageError(
                f"{folder / 'mosaic.tif'} is not georeferenced; open report.html instead"
            )
        self.home = home = photos or _photo_folder(folder)
        try:
            shots = json.loads(read_bounded(folder / "shots.geojson"))["features"]
            prints = json.loads(read_bounded(folder / "footprints.geojson"))
            rings = {
                f["properties"]["filename"]: f["geometry"]["coordinates"][0]
                for f in prints["features"]
            }
            for k, shot in enumerate(shots, 1):
                name = str(shot["properties"]["filename"])
                self._photos.append(self._shown(k, name, shot, rings.get(name, []), home))
        except OSError as error:
            raise SideFileError(
                f"{folder} is not a whole run: {Path(str(error.filename)).name} cannot be read"
                f" ({error.strerror or error}). Make the map again."
            ) from error
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            raise SideFileError(
                f"shots.geojson or footprints.geojson in {folder} is damaged"
                f" ({type(error).__name__}: {plain(str(error), 100)}). Make the map again."
            ) from error

    def _shown(
        self, k: int, name: str, shot: dict[str, Any], ring: list[Any], home: Path | None
    ) -> Shown:
        x, y = (real(v) for v in shot["properties"]["translation"][:2])
        if x is None or y is None:
            raise ValueError("a position is not a number")
        lon, lat = between(self._source.crs, "EPSG:4326").transform(x, y)
        corners = np.array(_flat(ring), float)
        if not (np.isfinite(corners).all() and math.isfinite(lon) and math.isfinite(lat)):
            raise ValueError("a place is not on Earth")
        path = home / name if home is not None and "\0" not in name else None
        inside = (
            path is not None and home is not None and path.resolve().is_relative_to(home.resolve())
        )
        ring_ll = tuple((float(a), float(b)) for a, b in corners.reshape(-1, 2))
        return Shown(
            id=k,
            name=name,
            state="used",
            record={
                "id": k,
                "name": name,
                "source": _drone(name, str(shot["properties"]["camera"])),
                "state": "used",
                "reason": "",
                "time": real(shot["properties"].get("capture_time")),
                "at": [lon, lat],
                "ring": [list(p) for p in ring_ll],
            },
            ring=ring_ll,
            path=path if inside and path is not None and path.is_file() else None,
            digest=str(shot["properties"].get("digest", "")),
        )

    def layers(self) -> dict[str, MapSource]:
        """The rasters of the run."""
        return self._sources | self.base

    def styles(self) -> dict[str, RunLayer]:
        """The rasters of the run."""
        return self._layers

    def figures(self) -> Mapping[str, Any]:
        """The content of metrics.json."""
        return self._figures

    def results(self) -> Path | None:
        """The folder of the run."""
        return self.folder

    def photos(self) -> list[Shown]:
        """All placed photos."""
        return self._photos

    def photo(self, number: int) -> Shown | None:
        """One placed photo."""
        return self._photos[number - 1] if 0 < number <= len(self._photos) else None

    def refused(self) -> list[dict[str, Any]]:
        """Photos that were left out."""
        try:
            metrics = json.loads(read_bounded(self.folder / "metrics.json"))
            return [
                {"name": str(n), "reason": str(r), "state": "left out"}
                for n, r in metrics.get("photos_rejected", {}).items()
            ]
        except (OSError, ValueError, AttributeError, RecursionError):
            return []

    def version(self) -> int:
        """Constant, since a finished run does not change."""
        return 1

    def stamp(self) -> int:
        """Constant, since a finished run does not change."""
        return 1


def _drone(name: str, camera: str) -> str:
    """What tells drones of a finished run apart: camera and folder. Files that were turned upside
    down have a calibration of their own, but no drone of their own.
    """
    folder = name.rpartition("/")[0]
    return f"{camera.removesuffix('/turned')} {folder}".strip()


def _taken(shot: str) -> float | None:
    """Capture time (seconds since 1970) from the key of a shot (`photo_intake.shot_of`)."""
    for part in shot.split("|")[3:4]:
        with suppress(ValueError):
            at = datetime.fromisoformat(part)
            return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
    return None


def _flat(ring: list[Any]) -> list[Any]:
    while ring and isinstance(ring[0][0], list):
        ring = ring[0]
    return [p[:2] for p in ring]


def _photo_folder(folder: Path) -> Path | None:
    """Folder of the photos of a run, from its run.toml. The photos of a live survey's final map are
    beside the run.
    """
    import tomllib

    try:
        said = tomllib.loads(read_bounded(folder / "run.toml").decode()).get("photos")
    except (OSError, ValueError, RecursionError):
        return None
    beside = folder.parent / NAMED
    # as it was given: from the folder in which the map was made, which may be any above the run
    given = Path(str(said)) if said and "\0" not in str(said) else None
    places = [] if given is None else [given, *(p / given for p in folder.resolve().parents)]
    return next((p for p in (*places, beside) if p.is_dir()), None)


def covering(photos: list[Shown], lon: float, lat: float) -> list[Shown]:
    """Photos whose footprint contains a point, the most vertical view (nearest centre) first."""
    found = []
    for photo in photos:
        if photo.state == "superseded" or len(photo.ring) < 3 or photo.record.get("at") is None:
            continue
        ring = np.array(photo.ring)
        if (
            (ring.min(0) <= (lon, lat)).all()
            and (ring.max(0) >= (lon, lat)).all()
            and _holds(ring, lon, lat)
        ):
            x, y = photo.record["at"]
            found.append(
                (((x - lon) * np.cos(np.radians(lat))) ** 2 + (y - lat) ** 2, photo.id, photo)
            )
    return [p for _, _, p in sorted(found, key=lambda f: f[:2])]


def _holds(ring: np.ndarray, x: float, y: float) -> bool:
    """Whether a polygon contains a point, by the even-odd rule."""
    a, b = ring, np.roll(ring, -1, axis=0)
    straddles = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((straddles & (x < at)).sum() % 2)
