"""Settings of a live map."""

from dataclasses import dataclass
from typing import Any

from skyquilt.errors import UsageError
from skyquilt.outside import MOST_MP
from skyquilt.settings import THERMAL_UNITS, VERTICAL_DATUMS, check_shutter, one_of
from skyquilt.typed import typed

NEIGHBOURS = 8
"""Largest number of placed photos with which a new one is compared."""
YOUNG = 10
"""Blocks of at most this number of photos are adjusted as a whole with every photo that joins."""
CLOSING, WHOLE = 150, 500
"""Blocks of at most the first number of photos are adjusted as a whole in the background. Those of
at most the second are when they have grown or photos pause, and otherwise in part, as larger ones
always are.
"""
PART = 120
"""Number of photos that may move in such a part."""
SWEEPING = 60
"""For blocks of at most this number of photos, ground heights are computed as in `mosaic` when no
photos arrive.
"""
GROWTH = 1.3
"""A block is adjusted in the background when it has grown by this factor since its last
adjustment.
"""


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """Options of a live map. The defaults suit most surveys."""

    gsd_cm: float | None = None
    """Ground size of a pixel of the growing map in cm; None = about three times the photos' own."""
    crs: str | None = None
    """CRS of the map; None = the UTM zone of the first photo."""
    reposition: bool = True
    """Whether later photos may move earlier ones; False = no repositioning, as in the thesis (Y
    4.1).
    """
    deterministic: bool = False
    """Whether background work runs in sequence and after fixed numbers of photos, so that the same
    photos in the same order give the same poses.
    """
    thermal_unit: str | None = None
    """One of `THERMAL_UNITS`: the unit of values in single-band TIFFs. None = detected, together
    with whether they are thermal.
    """
    band: str | None = None
    """Band that the map shows, of cameras that write a file for each; None = that of the first
    file, until there are more of another.
    """
    shutter: str | None = None
    """One of `settings.SHUTTERS`: how the cameras expose; None = as metadata and table of cameras
    say.
    """
    shutter_readout_ms: float | None = None
    """Time in ms in which a rolling shutter reads a photo out; None = as the table says."""
    vertical_datum: str | None = None
    """One of `VERTICAL_DATUMS`: zero of the map's heights; None = what the first photo states."""
    max_view_angle: float = 70.0
    """Largest angle from the vertical in degrees at which a photo is shown."""
    features: int = 1200
    """Features per photo, as in the batch workflow."""
    most_bytes: int = 500_000_000
    """Largest photo file in bytes."""
    most_clip_bytes: int = 8_000_000_000
    """Largest uploaded clip in bytes."""
    most_mp: float = MOST_MP
    """Largest area of a photo in megapixels."""
    most_photos: int = 100_000
    """Largest number of photos accepted."""

    def __post_init__(self) -> None:
        typed(self)
        if self.thermal_unit is not None:
            one_of("--thermal-unit", self.thermal_unit, THERMAL_UNITS)
        check_shutter(self.shutter, self.shutter_readout_ms)
        if self.crs is not None:
            from skyquilt.alignment.priors import checked_crs

            checked_crs(self.crs)
        if self.vertical_datum is not None:
            one_of("--vertical-datum", self.vertical_datum, VERTICAL_DATUMS)
        for name, value, low, high in (
            ("--gsd", self.gsd_cm, 0.05, 10000),
            ("--features", self.features, 100, 50000),
            ("--max-view-angle", self.max_view_angle, 1, 90),
            ("--max-photos", self.most_photos, 1, 10**7),
            ("--max-mb", self.most_bytes / 1e6, 0.01, 1e5),
            ("--max-clip-mb", self.most_clip_bytes / 1e6, 0.01, 1e6),
            ("--max-mp", self.most_mp, 0.01, 1e4),
        ):
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} {value} lies outside {low} to {high}")

    def shaping(self) -> dict[str, Any]:
        """The settings that must stay the same when a survey continues after a restart."""
        return {
            "reposition": self.reposition,
            "features": self.features,
            "deterministic": self.deterministic,
            "thermal_unit": self.thermal_unit,
            "band": self.band,
            "shutter": self.shutter,
            "shutter_readout_ms": self.shutter_readout_ms,
            "max_view_angle": self.max_view_angle,
            "gsd_cm": self.gsd_cm,
            "crs": self.crs,
            "vertical_datum": self.vertical_datum,
        }
