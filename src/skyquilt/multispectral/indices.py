"""Indices of vegetation: normalised differences of two bands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST = 1e-6
"""Sum of two values below which their difference says nothing."""


@dataclass(frozen=True, kw_only=True)
class Index:
    """(a - b) / (a + b) of two bands, -1 to 1."""

    name: str
    """Name, also of its file."""
    title: str
    """What it is called in lists."""
    a: str
    """The band that is bright where the index is high."""
    b: str
    """The band that is bright where it is low."""

    def __call__(self, a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
        """The index of values (h, w); NaN where either is not known or both are dark."""
        total = a + b
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(total > LEAST, (a - b) / total, np.float32(np.nan)).astype(np.float32)


INDICES = (
    Index(name="ndvi", title="NDVI", a="nir", b="red"),
    Index(name="ndre", title="NDRE", a="nir", b="red edge"),
    Index(name="gndvi", title="GNDVI", a="nir", b="green"),
)
"""NDVI: Rouse et al. 1974; NDRE: Barnes et al. 2000; GNDVI: Gitelson et al. 1996. GNDVI is below 0
on water (its negative is McFeeters' NDWI, 1996).
"""


def indices_of(bands: Sequence[str]) -> tuple[Index, ...]:
    """Those that these bands (names) have."""
    return tuple(i for i in INDICES if {i.a, i.b} <= set(bands))
