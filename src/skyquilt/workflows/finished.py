"""What a finished map leaves for photos that are added to it later."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.engine.folder import stamps
from skyquilt.engine.store import Store, digest
from skyquilt.errors import OutputError
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import Alignment, MapFrame
from skyquilt.model.raster import Grid
from skyquilt.ortho.earlier import EarlierMap
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.former_files import FILES
from skyquilt.ortho.labels import Labels
from skyquilt.workflows.keys import photo_key

STAGE, NAME = "finished", "map"
"""Where the record is in the store."""
LEVEL_M = 0.5
"""A map goes on where the take-off point, as a median of all photos tells it, lies no further in m
from where it lay by the first ones: of a few photos it is metres off.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Finished:
    """Where the results of a finished map are in its store."""

    recipe: str
    """Settings and methods that it was made with (`recipe_of`)."""
    control: str
    """Its control points, with their sightings (`control_key`)."""
    photos: tuple[str, ...]
    """Each photo that took part, by content and metadata (`photo_key`)."""
    names: tuple[str, ...]
    """Their names."""
    frame: MapFrame
    """The frame that its metadata were read in."""
    alignment: str
    """Key of the alignment."""
    surface: str
    """Key of the heights."""
    labels: str
    """Key of the labels; empty where there are none."""
    grid: Grid
    """Pixels of the map."""
    exposure: Exposure
    """Corrections of brightness."""
    shown: tuple[int, ...]
    """The photos that it shows, by their number in provenance.tif, from 1."""
    files: tuple[str, ...]
    """What tells its rasters from others (`stamp`)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Earlier:
    """A finished map that photos are added to, as it is found in the store."""

    finished: Finished
    """Its record."""
    key: str
    """Names it in the keys of what is made from it."""
    alignment: Alignment
    """Its poses, by its own numbers of photos."""

    def check(self, photos: Sequence[Photo], output: Path) -> None:
        """Raises OutputError if photos of the map are gone or have changed."""
        there, known = {photo_key(p) for p in photos}, self.finished
        gone = [n for n, k in zip(known.names, known.photos, strict=True) if k not in there]
        if gone:
            others = f" and {len(gone) - 1} others" if len(gone) > 1 else ""
            raise OutputError(
                f"{gone[0]}{others} of the map in {output} are not among the photos any more, or"
                " have changed, and --add only adds; use --overwrite instead"
            )

    def complete(
        self, photos: Sequence[Photo], control: Sequence[ControlPoint], frame: MapFrame
    ) -> bool:
        """Whether all its photos are among these, the same control points hold it, and its heights
        count from where they do by the `frame` of all photos.
        """
        held = self.finished.control == control_key(control)
        zeros = [f.takeoff_m or 0.0 for f in (self.finished.frame, frame)]
        level = abs(zeros[0] - zeros[1]) <= LEVEL_M
        return held and level and len(self._where(photos)) == len(self.finished.photos)

    def alignment_of(self, photos: Sequence[Photo]) -> Alignment:
        """Its poses by the numbers of the photos now."""
        return renumbered(self.alignment, self._where(photos))

    def map_of(self, photos: Sequence[Photo], store: Store, output: Path) -> EarlierMap | None:
        """The map by the numbers of the photos now; None where its store is not complete."""
        known, where = self.finished, self._where(photos)
        surface = store.get("surface", known.surface)
        labels = store.get("seams", known.labels) if known.labels else None
        if surface is None or (known.labels and labels is None):
            return None
        return EarlierMap(
            alignment=renumbered(self.alignment, where),
            surface=surface,
            grid=known.grid,
            exposure=_exposure(known.exposure, where),
            labels=labels and _labels(labels, where),
            shown=tuple(where.get(i, -1) for i in known.shown),
            key=self.key,
            files=known.files == stamps_of(output),
        )

    def _where(self, photos: Sequence[Photo]) -> dict[int, int]:
        """Number then -> number now."""
        now = {photo_key(p): i for i, p in enumerate(photos)}
        found = ((i, now.get(key)) for i, key in enumerate(self.finished.photos))
        return {i: n for i, n in found if n is not None}


def control_key(control: Sequence[ControlPoint]) -> str:
    """Control points with their sightings, of which those on photos that are not there are none."""
    return digest(list(control))


def stamps_of(output: Path) -> tuple[str, ...]:
    """Stamps of a run's rasters: whether they are still those that were written."""
    return tuple(stamps(output, FILES).values())


def earlier_map(store: Store, recipe: str, output: Path) -> Earlier | None:
    """The map that a run left in its store, for photos that are added to it; None where there is
    none.

    Raises:
        OutputError: it was made with other settings.
    """
    found: Finished | None = store.get(STAGE, NAME)
    if found is None:
        return None
    if found.recipe != recipe:
        raise OutputError(
            f"the map in {output} was made with other settings or another version,"
            " and --add needs the same; use the same options, or --overwrite instead of --add"
        )
    alignment = store.get("alignment", found.alignment)
    if alignment is None:
        return None
    key = digest(found.alignment, found.surface, found.labels, found.grid, found.files)
    return Earlier(finished=found, key=key, alignment=alignment)


def renumbered(alignment: Alignment, where: Mapping[int, int]) -> Alignment:
    """An alignment by other numbers of its photos; those without one are left out."""
    ties = alignment.ties
    table = np.full(max([*where, int(ties.photo.max(initial=0))]) + 1, -1)
    table[list(where)] = list(where.values())
    blocks = (tuple(sorted(where[i] for i in b if i in where)) for b in alignment.blocks)
    return replace(
        alignment,
        poses={where[i]: p for i, p in alignment.poses.items() if i in where},
        camera_of={where[i]: n for i, n in alignment.camera_of.items() if i in where},
        rejected={where[i]: r for i, r in alignment.rejected.items() if i in where},
        blocks=tuple(b for b in blocks if b),
        ties=replace(ties, photo=table[ties.photo]),
        joins=tuple(
            replace(j, photo=where[j.photo], onto=where.get(j.onto, -1))
            for j in alignment.joins
            if j.photo in where
        ),
    )


def _exposure(exposure: Exposure, where: Mapping[int, int]) -> Exposure:
    def moved(given: Mapping[int, Any]) -> dict[int, Any]:
        return {where[i]: v for i, v in given.items() if i in where}

    return replace(
        exposure,
        gains=moved(exposure.gains),
        fields=moved(exposure.fields),
        offsets=moved(exposure.offsets),
        patterns=moved(exposure.patterns),
        shades=moved(exposure.shades),
    )


def _labels(labels: Labels, where: Mapping[int, int]) -> Labels:
    table = np.full(max(int(labels.photo.max(initial=0)), *where, 0) + 2, -1, np.int32)
    for before, now in where.items():
        table[before] = now
    return replace(labels, photo=table[labels.photo])
