"""Values that stand for none, although a file does not say so."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FILLS = (-9999.0, -10000.0, -32767.0, -32768.0, -99999.0)
"""Values with which programs fill pixels that have none, often without stating it."""
LARGEST = 1e19
"""Values beyond this are fillings, too (1e20, 9.97e36, -3.4e38)."""


def filling(low: float) -> float | None:
    """The lowest value of a file where programs fill pixels with it, else None."""
    return low if low in FILLS else None


def without_fillings(values: NDArray[np.float32]) -> NDArray[Any]:
    """Real numbers of any shape with NaN in place of fillings: infinite values, those beyond
    `LARGEST`, and the lowest of all others where it is one of `FILLS`.
    """
    usual = np.abs(values) < LARGEST  # false where it is not a number
    low = float(values.min(where=usual, initial=np.inf))
    if (fill := filling(low)) is not None:
        usual &= values != np.float32(fill)
    return values if usual.all() else np.where(usual, values, np.float32(np.nan))
