"""Shadows of clouds that drift over the site with the wind."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.grid import Doubles, Floats
from skyquilt.simulate.smoke import billows, billows_at

DARKER = 0.55
"""Share of the light that a cloud takes."""
WIND_MS = 6.0
PERIOD_M = 500.0
"""Distance at which the clouds repeat; single ones are some 60 to 150 m wide."""
EDGE = 0.12
"""Half width of a shadow's soft edge, in deviations of the clouds' thickness."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Clouds:
    """Clouds between the sun and the site."""

    share: float
    """Share of the ground in shadow."""
    start: Doubles
    """(2,) where the pattern lies at the beginning, m."""
    downwind: Doubles
    """(2,) unit vector."""

    def light(self, x: Floats, y: Floats, time: float) -> Floats:
        """Factor (h, w) on the light at places x, y (h, w), m on the map, after so many seconds."""
        level = float(np.quantile(billows(), 1 - self.share))
        moved = self.start + self.downwind * (WIND_MS * time)
        thick = billows_at((x - moved[0]) / PERIOD_M, (y - moved[1]) / PERIOD_M)
        shadow = 1 / (1 + np.exp(-(thick - level) / EDGE))
        return np.asarray(1 - DARKER * shadow, np.float32)


def clouds_of(share: float, seed: int) -> Clouds | None:
    """Clouds whose shadows cover a share of the ground; None without any."""
    if not share:
        return None
    rng = np.random.default_rng([seed, 56])
    angle = rng.uniform(0, 2 * np.pi)
    start: NDArray[np.float64] = rng.uniform(0, PERIOD_M, 2)
    return Clouds(share=share, start=start, downwind=np.array([np.cos(angle), np.sin(angle)]))
