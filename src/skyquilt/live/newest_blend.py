"""A blending method for growing maps: the newest photo is on top."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.ortho.blend import First, Float, Layer, Order


@dataclass(frozen=True, kw_only=True)
class Newest:
    """The photo taken last is shown, with hard seams."""

    margin: ClassVar[int] = 0
    version: ClassVar[int] = 1

    def rank(self, order: Order, score: Float) -> Float:
        """Order of capture, newest first."""
        return np.where(np.isfinite(score), np.float32(-order), np.float32(np.inf))

    def reach(self, gsd: float) -> float:
        """Zero, since only one photo contributes to each pixel."""
        return 0.0

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Takes each pixel from the last layer that covers it; layers are in order of capture."""
        return First().merge(list(reversed(layers)), gsd)
