"""Options of a plan."""

import math
from dataclasses import dataclass

from skyquilt.errors import UsageError
from skyquilt.typed import typed


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """What is asked for. Give `gsd_cm` or `height_m`."""

    gsd_cm: float | None = None
    """Ground size of a pixel."""
    height_m: float | None = None
    """Height above the ground."""
    overlap: float = 80.0
    """Along the lines, percent of a footprint."""
    sidelap: float = 70.0
    """Between the lines, percent of a footprint."""
    views: int | None = None
    """Photos that see each cell; None = as many as the overlaps give."""
    width_m: float | None = None
    """Width of corridors."""
    clearance_m: float = 10.0
    """Distance kept from keep-out areas, and above the surface."""
    separation_m: float = 20.0
    """Distance kept between drones in the air."""
    wind_ms: float = 0.0
    """Speed of the wind."""
    wind_from_deg: float = 0.0
    """Where it comes from."""
    deadline_s: float | None = None
    """The last drone has to land by then."""
    seconds: float = 12.0
    """Time to search for routes."""

    def __post_init__(self) -> None:
        typed(self)

    def checked(self) -> "PlanSettings":
        """The settings unchanged; raises UsageError where values cannot be meant."""
        if (self.gsd_cm is None) == (self.height_m is None):
            raise UsageError("give either --gsd (cm) or --height (m)")
        minutes = None if self.deadline_s is None else self.deadline_s / 60
        for name, value, low, high, unit in (
            ("--gsd", self.gsd_cm, 0.01, 1000, "cm"),
            ("--height", self.height_m, 2, 10_000, "m"),
            ("--overlap", self.overlap, 0, 97, "%"),
            ("--sidelap", self.sidelap, 0, 97, "%"),
            ("--views", self.views, 1, 200, ""),
            ("--width", self.width_m, 0.1, 100_000, "m"),
            ("--clearance", self.clearance_m, 0, 1000, "m"),
            ("--separation", self.separation_m, 0, 1000, "m"),
            ("--wind", self.wind_ms, 0, 60, "m/s"),
            ("--deadline", minutes, 0.02, 20_000, "minutes"),
            ("--seconds", self.seconds, 0.1, 3600, "s"),
        ):
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise UsageError(
                    f"{name} must be {low:g} to {high:g} {unit}".rstrip() + f", not {value:g}"
                )
        return self
