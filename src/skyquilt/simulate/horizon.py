"""What a photo shows beyond the drawn terrain: land that repeats it mirrored, haze, and the sky."""

import cv2
import numpy as np

from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Floats
from skyquilt.simulate.raycast import FLATTEST
from skyquilt.simulate.scene import Scene

_HAZE = np.array([205.0, 216.0, 228.0], dtype=np.float32)  # RGB of the sky at the horizon
_ZENITH = np.array([70.0, 120.0, 200.0], dtype=np.float32)
_HAZE_M = 900.0  # distance at which haze hides two thirds of the colours
_FARTHEST = 60.0  # horizontal over vertical: land beyond is all haze


def with_horizon(seen: Floats, scene: Scene, directions: Floats, shot: Shot) -> Floats:
    """The colours (h, w, 3) with far land and sky where rays are flatter than `FLATTEST`.

    `seen` holds the colours of all other rays; `directions` (h, w, 2) are the photo's undistorted
    image coordinates.
    """
    to_map = shot.rotation.T.astype(np.float32)
    x, y = directions[..., 0], directions[..., 1]
    dx, dy, dz = (to_map[i, 0] * x + to_map[i, 1] * y + to_map[i, 2] for i in range(3))
    flat = np.hypot(dx, dy)
    far = -dz * np.float32(FLATTEST) < flat
    if not far.any():
        return seen
    out = seen.copy()
    out[far] = _beyond(scene, shot, dx[far], dy[far], dz[far], flat[far])
    return out


def _beyond(scene: Scene, shot: Shot, dx: Floats, dy: Floats, dz: Floats, flat: Floats) -> Floats:
    """Colours (n, 3) of rays to level land at the median height, or to the sky."""
    rise = np.degrees(np.arctan2(dz, flat))
    sky = _HAZE + (_ZENITH - _HAZE) * (1 - np.exp(-np.maximum(rise, 0) / 18))[:, None]
    above = shot.centre[2] - float(np.median(scene.height[::64, ::64]))
    run = above / np.maximum(-dz, flat / np.float32(_FARTHEST))
    x, y = shot.centre[0] + dx * run, shot.centre[1] + dy * run
    share = np.exp(-(flat * run) / np.float32(_HAZE_M))[:, None]
    land = _HAZE + (_mirrored(scene, x, y) - _HAZE) * share
    below = dz[:, None] < -flat[:, None] / _FARTHEST
    return np.asarray(np.where(below, land, sky), np.float32)


def _mirrored(scene: Scene, x: Floats, y: Floats) -> Floats:
    """Colours (n, 3) at map places; beyond the drawn terrain those of its mirror image, so that all
    photos see the same there.
    """
    step = 4  # far away, a pixel shows several cells
    small = cv2.resize(
        np.asarray(scene.rgb), None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA
    )
    pixels = scene.grid.pixels(np.stack([x, y], axis=1)) / step
    h, w = small.shape[:2]
    column, row = (
        n - np.abs(np.floor(pixels[:, k]).astype(np.int64) % (2 * n) - n)
        for k, n in ((0, w - 1), (1, h - 1))
    )
    return np.asarray(small[row, column], np.float32)
