"""The camera database: sensor width, native lens and shutter by model."""

import csv
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One row of `sensors.csv`."""

    make: str
    """As in EXIF."""
    model: str
    """As in EXIF."""
    image_width: int | None
    """Long side in px of the images this row is for; None = all of the model."""
    width_mm: float
    """Length of the sensor's long side in mm."""
    focal_mm: float | None
    """Focal length of a lens that cannot be changed, in mm; used where EXIF has none."""
    shutter: Literal["rolling", "global", ""]
    """`global` stands for mechanical shutters too."""
    band: Literal["visible", "thermal"]
    """Spectrum."""


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9+]", "", text.lower())


def _row(row: dict[str, str]) -> Sensor:
    return Sensor(
        make=row["make"],
        model=row["model"],
        image_width=int(row["image_width"]) if row["image_width"] else None,
        width_mm=float(row["sensor_width_mm"]),
        focal_mm=float(row["focal_mm"]) if row["focal_mm"] else None,
        shutter=row["shutter"],  # type: ignore[arg-type]
        band=row["band"],  # type: ignore[arg-type]
    )


@cache
def _table() -> dict[str, tuple[Sensor, ...]]:
    text = files("skyquilt.photos").joinpath("sensors.csv").read_text("utf-8")
    table: dict[str, tuple[Sensor, ...]] = {}
    for row in map(_row, csv.DictReader(text.splitlines())):
        table[_plain(row.model)] = (*table.get(_plain(row.model), ()), row)
    return table


def find_sensor(*, model: str, long_side: int) -> Sensor | None:
    """The row for an EXIF model name and the long side in px of its images as taken; None if
    unknown.

    A model with rows for several image sizes (a visible and a thermal eye) needs the right size.
    """
    rows = _table().get(_plain(model), ())
    exact = [r for r in rows if r.image_width == long_side]
    general = [r for r in rows if r.image_width is None]
    return next(iter(exact + general), None)
