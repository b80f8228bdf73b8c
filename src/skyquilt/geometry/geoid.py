"""Height of the geoid EGM96 above the WGS 84 ellipsoid, without a network.

The grid is WW15MGH of NIMA and NASA (Lemoine et al. 1998), 15 minutes, as PROJ ships it
(`egm96_15.gtx` of the package proj-data 9.1.1; a work of the US government, in the public domain).
It is stored in `egm96_15.zlib` in whole millimetres, the resolution of the original: second
differences of both axes as 32-bit integers, split by bytes.
"""

import zlib
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 721, 1440
STEP_DEG = 0.25
ACCURACY_M = 0.5
"""Standard deviation of EGM96 in m (Lemoine et al. 1998: 0.5 to 1 m on land)."""

Array = NDArray[np.float64]


@cache
def egm96_grid() -> NDArray[np.int32]:
    """(721, 1440) heights of the geoid in mm: rows from 90 degrees south northwards, columns from
    180 degrees west eastwards.
    """
    packed = (files("skyquilt.geometry") / "egm96_15.zlib").read_bytes()
    planes = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(4, ROWS, COLUMNS)
    grid = np.ascontiguousarray(planes.transpose(1, 2, 0)).view("<i4")[..., 0]
    for _ in range(2):
        grid = np.cumsum(np.cumsum(grid, 1, np.int32), 0, np.int32)
    return grid


def geoid_height(latitude_deg: Array | float, longitude_deg: Array | float) -> Array:
    """Height in m of the geoid EGM96 above the WGS 84 ellipsoid, interpolated linearly, at places
    of any shape; ellipsoidal height = height above the geoid + this.
    """
    grid = egm96_grid()
    row = (np.asarray(latitude_deg, np.float64) + 90) / STEP_DEG
    column = (np.asarray(longitude_deg, np.float64) + 180) % 360 / STEP_DEG
    r = np.clip(np.floor(row), 0, ROWS - 2).astype(np.int64)
    c = np.floor(column).astype(np.int64) % COLUMNS
    v, u = row - r, column - np.floor(column)
    right = (c + 1) % COLUMNS
    low = grid[r, c] * (1 - u) + grid[r, right] * u
    high = grid[r + 1, c] * (1 - u) + grid[r + 1, right] * u
    return np.asarray((low * (1 - v) + high * v) / 1000)
