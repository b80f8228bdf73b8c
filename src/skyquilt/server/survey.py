"""The data that the server shows: a growing survey or a finished run, with the same interface."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from skyquilt.errors import SideFileError, UsageError
from skyquilt.live.ledger import NAME, Ledger
from skyquilt.outside import open_regular, plain, read_bounded, real
from skyquilt.raster.map_source import FileSource, MapSource, TileSource, between
from skyquilt.raster.read_map import open_map
from skyquilt.raster.tile_store import TileStore

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

    def layers(self) -> dict[str, MapSource]:
        """Map layers by name; the first one is the default."""

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
    if _is_tiff(folder / "mosaic.tif"):
        return FinishedSurvey(folder, base=base, photos=photos)
    raise UsageError(
        f"{folder} contains neither a live survey ({NAME}) nor a finished run (mosaic.tif); name"
        " the folder given to -o"
    )


def _is_tiff(path: Path) -> bool:
    """Whether a map is a TIFF by its content. GDAL would also read text that names other files and
    addresses.
    """
    try:
        with open_regular(path) as file:
            return file.read(4) in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
    except OSError:
        return False


def base_map(paths: Path | Sequence[Path] | None) -> dict[str, MapSource]:
    """Older maps (GeoTIFF, COG, MBTiles) as layers `base`, `base-2` ...; empty if none is given.

    Raises:
        UsageError: one is not a georeferenced raster.
    """
    found: dict[str, MapSource] = {}
    for number, path in enumerate([paths] if isinstance(paths, Path) else paths or (), 1):
        if open_map(path) is None or not FileSource(path=path).crs:
            raise UsageError(f"--base {path} is not a georeferenced map that GDAL can read")
        found["base" if number == 1 else f"base-{number}"] = FileSource(path=path)
    return found


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
        final = self.folder / FINISHED / "mosaic.tif"
        if _is_tiff(final):
            found["finished"] = FileSource(path=final)
        return found | self.base

    def photos(self) -> list[Shown]:
        """All accepted photos."""
        query = (
            "select id, name, source, state, reason, footprint, file, received, digest from photo"
            " order by id"
        )
        return [self._shown(row) for row in self.ledger.rows(query)]

    def photo(self, number: int) -> Shown | None:
        """One accepted photo."""
        query = (
            "select id, name, source, state, reason, footprint, file, received, digest from photo"
            " where id = ?"
        )
        row = self.ledger.row(query, number)
        return None if row is None else self._shown(row)

    def _shown(self, row: tuple[Any, ...]) -> Shown:
        number, name, source, state, reason, place, file, received, digest = row
        held = json.loads(place) if place else {}
        ring = tuple((float(a), float(b)) for a, b in held.get("ring", ()))
        record = {
            "id": number,
            "name": name,
            "source": source,
            "state": state,
            "reason": reason,
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
        if not self._source.crs:
            raise UsageError(
                f"{folder / 'mosaic.tif'} is not georeferenced; open report.html instead"
            )
        home = photos or _photo_folder(folder)
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
            state="refined",
            record={
                "id": k,
                "name": name,
                "source": shot["properties"]["camera"],
                "state": "refined",
                "reason": "",
                "at": [lon, lat],
                "ring": [list(p) for p in ring_ll],
            },
            ring=ring_ll,
            path=path if inside and path is not None and path.is_file() else None,
            digest=str(shot["properties"].get("digest", "")),
        )

    def layers(self) -> dict[str, MapSource]:
        """The mosaic."""
        return {"mosaic": self._source, **self.base}

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
                {"name": str(n), "reason": str(r), "state": "refused"}
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
    places = [Path(str(said))] if said else []
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
