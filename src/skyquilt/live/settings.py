"""What a live map can be asked for."""

from dataclasses import dataclass
from typing import Any

from skyquilt.errors import UsageError
from skyquilt.settings import THERMAL_UNITS, one_of

NEIGHBOURS = 8
"""Most placed photos that a new one is compared with."""
YOUNG = 10
"""Blocks of at most so many photos are bundled as a whole with every photo that joins."""
CLOSING = 150
"""Blocks of at most so many photos are bundled as a whole in the background; of larger ones a part
is.
"""
PART = 120
"""Photos that move in such a part."""
SWEEPING = 60
"""Blocks of at most so many photos get their heights swept from the pictures when it is quiet."""
GROWTH = 1.3
"""A block is bundled in the background when it has grown by this factor since."""


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """The defaults are meant to be right."""

    gsd_cm: float | None = None
    """Ground size of a pixel of the growing map in cm; None = about three times the photos' own."""
    crs: str | None = None
    """CRS of the map; None = the UTM zone of the first photo."""
    reposition: bool = True
    """Whether later photos may move earlier ones; False = no repositioning, as in the thesis (Y
    4.1).
    """
    deterministic: bool = False
    """Background work at fixed counts of photos and in line, so that equal photos in equal order
    give equal poses.
    """
    thermal_unit: str | None = None
    """One of `THERMAL_UNITS`: what values of single-band TIFFs mean; None = found out, as is
    whether they are thermal.
    """
    features: int = 1200
    """Features per photo, as the batch story takes them."""
    most_bytes: int = 500_000_000
    """Largest photo file in bytes."""
    most_photos: int = 100_000
    """Most photos accepted."""

    def __post_init__(self) -> None:
        if self.thermal_unit is not None:
            one_of("--thermal-unit", self.thermal_unit, THERMAL_UNITS)
        for name, value, low, high in (
            ("--gsd", self.gsd_cm, 0.05, 10000),
            ("--features", self.features, 100, 50000),
            ("--max-photos", self.most_photos, 1, 10**7),
            ("--max-mb", self.most_bytes / 1e6, 0.01, 1e5),
        ):
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} {value} lies outside {low} to {high}")

    def shaping(self) -> dict[str, Any]:
        """What must stay the same when a survey goes on after a restart."""
        return {
            "reposition": self.reposition,
            "features": self.features,
            "deterministic": self.deterministic,
            "thermal_unit": self.thermal_unit,
        }
