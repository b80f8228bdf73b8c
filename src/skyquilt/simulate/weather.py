"""Season and hour: direction and strength of the sun, air temperature."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal

import numpy as np

from skyquilt.simulate.grid import Doubles

Season = Literal["summer", "winter"]
_LATITUDE_DEG = 46.6
_DECLINATION_DEG = {"summer": 20.0, "winter": -17.0}
_AIR_C = {"summer": 22.0, "winter": 1.0}


@dataclass(frozen=True, kw_only=True)
class Weather:
    """A moment with a cloudless sky."""

    season: Season = "summer"
    """Affects the vegetation, the sun's elevation and the temperature."""
    hour: float = 10.5
    """Local solar time, 0-24."""

    @property
    def moment(self) -> datetime:
        """A day of the season at this hour; clocks show solar time."""
        day = datetime(2024, 7, 15) if self.season == "summer" else datetime(2025, 1, 15)
        return day + timedelta(hours=self.hour)

    @property
    def sun(self) -> Doubles:
        """Unit vector (east, north, up) towards the sun; below the horizon at night."""
        phi, delta = np.radians(_LATITUDE_DEG), np.radians(_DECLINATION_DEG[self.season])
        h = np.radians(15.0 * (self.hour - 12.0))
        east = -np.cos(delta) * np.sin(h)
        north = np.sin(delta) * np.cos(phi) - np.cos(delta) * np.cos(h) * np.sin(phi)
        up = np.sin(phi) * np.sin(delta) + np.cos(phi) * np.cos(delta) * np.cos(h)
        return np.array([east, north, up])

    @property
    def strength(self) -> float:
        """Strength of the sunlight: 0 at night, 1 for a high sun."""
        return float(np.clip(self.sun[2] / 0.5, 0.0, 1.0))

    @property
    def warmth(self) -> float:
        """Heating by the sun: two hours behind the light, 0 at night."""
        earlier = Weather(season=self.season, hour=self.hour - 2.0)
        scale = 1.0 if self.season == "summer" else 0.45
        return scale * float(np.clip(0.35 * self.strength + 0.65 * earlier.strength, 0.0, 1.0))

    @property
    def air_c(self) -> float:
        """Air temperature, degrees Celsius."""
        return _AIR_C[self.season] + 6.0 * (self.warmth - 0.5)
