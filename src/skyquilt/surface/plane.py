"""Level ground."""

import numpy as np

from skyquilt.model.surface import Surface


def level(z: float) -> Surface:
    """A level surface at height z in m."""
    return Surface(z=np.full((2, 2), z, np.float32), x0=0.0, y0=0.0, cell=1.0, source="plane")
