"""The folder of a finished run, as the server shows it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.errors import SideFileError, UsageError
from skyquilt.outside import is_file, is_folder, plain, read_bounded, real
from skyquilt.raster.map_source import FileSource, MapSource, between
from skyquilt.runs.layers import RunLayer, figures_of, layers_in
from skyquilt.server.shown import Shown, base_map

NAMED = "named"
"""Folder of the photos of a live survey's final map, beside the run."""


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
            path=path if inside and path is not None and is_file(path) else None,
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
    return next((p for p in (*places, beside) if is_folder(p)), None)
