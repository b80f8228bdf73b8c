"""A merge rule for maps that grow: what was seen last is shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.ortho.blend import First, Float, Layer, Order


@dataclass(frozen=True, kw_only=True)
class Newest:
    """The photo taken last wins, hard seams."""

    margin: ClassVar[int] = 0
    version: ClassVar[int] = 1

    def rank(self, order: Order, score: Float) -> Float:
        """Order of capture, from the end."""
        return np.where(np.isfinite(score), np.float32(-order), np.float32(np.inf))

    def reach(self, gsd: float) -> float:
        """Only the winner matters."""
        return 0.0

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """The last layer that sees the pixel; layers come in order of capture."""
        return First().merge(list(reversed(layers)), gsd)
