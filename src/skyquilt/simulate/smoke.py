"""Smoke of fires on the site: plumes that drift with the wind between camera and ground."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Doubles, Floats

GREY = np.array([216.0, 215.0, 210.0], np.float32)
"""Red, green and blue of dense smoke."""
LEVELS_M = (8.0, 16.0, 24.0, 32.0)
"""Heights above the base at which a plume is cut."""
RISE = 0.5
"""Way downwind that smoke drifts while it rises, over the height."""
SPREAD, WIDTH_M, THINNER_M = 0.28, 4.0, 90.0
"""Half width of a plume: its growth along the way, and at the fire; way over which it thins to
1/e.
"""
WIND_MS = 3.0
CLOUDS_M = 60.0
"""Period of the clouds of smoke."""
DENSITY = 0.3
"""Optical depth of a level in the middle of a plume."""
_TEXTURE_PX = 512
_STEP_PX = 2
"""A veil is computed on every so manieth pixel."""


@cache
def billows() -> Floats:
    """A periodic texture (n, n) of zero mean and unit deviation, as smoke and clouds have it."""
    white = np.random.default_rng(11).standard_normal((_TEXTURE_PX, _TEXTURE_PX), np.float32)
    sigmas = (40, 22, 12, 6.5, 3.5, 2)
    layers = [gaussian_filter(white, s, mode="wrap") for s in sigmas]
    whole = sum(0.55**k * layer / layer.std() for k, layer in enumerate(layers))
    return np.asarray((whole - np.mean(whole)) / np.std(whole), np.float32)


def billows_at(x: NDArray[Any], y: NDArray[Any]) -> Floats:
    """The texture at places x, y (h, w), in its periods."""
    u, v = ((p % 1 * _TEXTURE_PX).astype(np.float32) for p in (x, y))
    return np.asarray(cv2.remap(billows(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoke:
    """Plumes over the site."""

    fires: Doubles
    """(n, 2) places in m on the map."""
    downwind: Doubles
    """(2,) unit vector."""

    def veil(self, directions: Floats, shot: Shot) -> Floats:
        """The share (h, w) of the light that smoke takes on its way to the camera of a photo, whose
        pixels look along `directions` (h, w, 2) as of `Lens.rays`.
        """
        some = directions[::_STEP_PX, ::_STEP_PX]
        ray = np.concatenate([some, np.ones_like(some[..., :1])], axis=2) @ shot.rotation
        down = np.maximum(-ray[..., 2], 0.2)
        depth = np.zeros(down.shape)
        for z in LEVELS_M:
            xy = shot.place[:2] + ray[..., :2] * ((shot.centre[2] - z) / down)[..., None]
            drifted = xy - self.downwind * (WIND_MS * shot.waypoint.time)
            for number, fire in enumerate(self.fires):
                depth += self._density(xy - fire, z) * _thickness(drifted, number)
        veil = (1 - np.exp(-DENSITY * depth)).astype(np.float32)
        size = directions.shape[1::-1]
        return np.asarray(cv2.resize(veil, size, interpolation=cv2.INTER_LINEAR))

    def _density(self, off: Doubles, z: float) -> Doubles:
        """Density at offsets (h, w, 2) in m from a fire, at a height, without clouds."""
        along = off @ self.downwind - RISE * z
        across = off @ np.array([-self.downwind[1], self.downwind[0]])
        width = WIDTH_M + SPREAD * np.maximum(along, 0)
        begun = np.clip(along / 6, 0, 1)
        thin = np.exp(-((across / width) ** 2) - np.maximum(along, 0) / THINNER_M)
        return np.asarray(begun * thin)


def _thickness(drifted: Doubles, number: int) -> Floats:
    """Factor (h, w) by which clouds of a plume change its density, from places that drift along."""
    clouds = billows_at(*cv2.split(drifted / CLOUDS_M + 0.37 * number))
    return np.asarray(np.clip(1 + 0.9 * clouds, 0, 4), np.float32)


def smoke_of(fires: int, shots: Sequence[Shot], seed: int) -> Smoke | None:
    """Fires within the middle of a flight; None without any."""
    if not fires:
        return None
    rng = np.random.default_rng([seed, 55])
    places = np.stack([s.place[:2] for s in shots])
    spread = 0.8 * np.ptp(places, axis=0)
    angle = rng.uniform(0, 2 * np.pi)
    return Smoke(
        fires=places.mean(0) + (rng.random((fires, 2)) - 0.5) * spread,
        downwind=np.array([np.cos(angle), np.sin(angle)]),
    )
