"""Sunlight on a height field: slopes and cast shadows."""

import cv2
import numpy as np

from skyquilt.simulate.grid import Floats
from skyquilt.simulate.weather import Weather

_AMBIENT = 0.42
_TALLEST_M = 16.0
_SKY_TINT = np.array([0.90, 0.99, 1.12], dtype=np.float32)
_SUN_TINT = np.array([1.02, 1.0, 0.97], dtype=np.float32)


def shadow_reach(weather: Weather) -> float:
    """Length in m of the longest shadow that is drawn."""
    slope = max(float(weather.sun[2]), 0.12) / float(np.hypot(*weather.sun[:2]))
    return _TALLEST_M / slope


def lit(height: Floats, res: float, weather: Weather) -> Floats:
    """Share (h, w) of direct sunlight, 1 on level open ground, 0 in shadow, from heights in m."""
    east, north, up = weather.sun
    up = max(float(up), 0.12)
    soft = cv2.GaussianBlur(height, (0, 0), 1.0)
    slope_x = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=1 / (8 * res))
    slope_y = -cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=1 / (8 * res))
    facing = (up - east * slope_x - north * slope_y) / np.sqrt(1 + slope_x**2 + slope_y**2)
    open_ = 1 - _shadow(height, res, np.array([east, north, up]))
    return np.asarray(np.clip(facing / up, 0, 1.45) * open_, dtype=np.float32)


def _shadow(height: Floats, res: float, sun: Floats) -> Floats:
    """1 in shadow: the running maximum of the surface towards the sun, minus the rise of the ray,
    computed by doubling.
    """
    flat = float(np.hypot(sun[0], sun[1]))
    rise = float(sun[2]) / flat * res
    reach = int(np.ceil(_TALLEST_M / rise))
    best = np.full_like(height, -1e9)
    highest, done = height, 1
    offset = 1
    while True:  # `highest` covers `done` cells from its own position; continue one cell away
        shifted = _shifted(highest, sun[0] / flat * offset, -sun[1] / flat * offset) - np.float32(
            rise * offset
        )
        best = np.maximum(best, shifted)
        offset += done
        if offset > reach:
            break
        further = _shifted(highest, sun[0] / flat * done, -sun[1] / flat * done) - np.float32(
            rise * done
        )
        highest, done = np.maximum(highest, further), 2 * done
    dark = np.clip((best - height) / 0.12, 0, 1)
    return np.asarray(cv2.GaussianBlur(dark, (0, 0), 0.8))


def _shifted(raster: Floats, dx: float, dy: float) -> Floats:
    """The raster shifted by `dx`, `dy` cells: out(r, c) = raster(r + dy, c + dx)."""
    h, w = raster.shape
    dx, dy = int(np.clip(round(dx), 1 - w, w - 1)), int(np.clip(round(dy), 1 - h, h - 1))
    stays = raster[max(dy, 0) : h + min(dy, 0), max(dx, 0) : w + min(dx, 0)]
    above, below, left, right = max(-dy, 0), max(dy, 0), max(-dx, 0), max(dx, 0)
    return np.asarray(cv2.copyMakeBorder(stays, above, below, left, right, cv2.BORDER_REPLICATE))


def shine(look: Floats, direct: Floats, weather: Weather) -> Floats:
    """(h, w, 4) colours and temperatures with sunlight: visible shading, and heating where the sun
    shines.
    """
    strength = np.float32(0.25 + 0.75 * weather.strength)
    sun, sky = (1 - _AMBIENT) * direct, _AMBIENT * _SKY_TINT
    out = look.copy()
    for band in range(3):
        out[..., band] *= strength * (sun * _SUN_TINT[band] + sky[band])
    out[..., 3] += np.float32(7.0 * weather.warmth) * (np.minimum(direct, 1.3) - 1)
    return out
