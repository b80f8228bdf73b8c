"""What the server shows, whatever it comes from: a growing survey or a finished run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from skyquilt.raster.map_source import MapSource
from skyquilt.raster.older_map import older_map
from skyquilt.runs.layers import RunLayer


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """One photo as viewers see it."""

    id: int
    """Number of the photo."""
    name: str
    """Name of the photo; must be escaped in HTML."""
    state: str
    """received, kept, waiting, placed, refined, superseded or refused."""
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


def base_map(paths: Path | Sequence[Path] | None) -> dict[str, MapSource]:
    """Older maps (GeoTIFF, COG, MBTiles) as layers `base`, `base-2` ...; empty if none is given.

    Raises:
        UsageError: one is not a georeferenced raster, or lies in a local system.
    """
    found: dict[str, MapSource] = {}
    for number, path in enumerate([paths] if isinstance(paths, Path) else paths or (), 1):
        found["base" if number == 1 else f"base-{number}"] = older_map(path)
    return found


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
