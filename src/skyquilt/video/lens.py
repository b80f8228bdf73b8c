"""Focal length and shutter of a video mode, as far as the files tell."""

import math

from skyquilt.model.photo import Focal, Shutter

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_TALLEST = 0.72
"""Height over width of the sensors of drones, 3:4 and 2:3: a 16:9 clip is cut from their full
width, and the 35 mm equivalent is that of the whole sensor.
"""
_GUESS, _GUESS_SIGMA = 0.72, 0.25
_STATED_SIGMA = 0.10
"""Stabilisation and modes of more frames per second cut more off than the equivalent says."""
_READOUT_S, _READOUT_SIGMA_S = 0.020, 0.010


def video_focal(width: int, height: int, focal_35mm: float | None, zoom: float) -> Focal:
    """Focal length in px of a clip, from the 35 mm equivalent in mm where the telemetry gives it;
    a guess with a wide deviation otherwise. The adjustment finds the rest.
    """
    long, short = max(width, height), min(width, height)
    if focal_35mm is None:
        return Focal(px=_GUESS * long, sigma_px=_GUESS_SIGMA * _GUESS * long, source="guess")
    diagonal = long * math.hypot(1.0, max(short / long, _TALLEST))
    px = focal_35mm / _DIAGONAL_35MM * diagonal * zoom
    return Focal(px=px, sigma_px=_STATED_SIGMA * px, source="35mm")


def video_shutter(fps: float) -> Shutter:
    """Cameras film with rolling shutters, whose readout takes no longer than a frame; how long, the
    adjustment finds.
    """
    readout = min(_READOUT_S, 0.6 / fps)
    return Shutter(
        readout_s=readout, sigma_s=min(_READOUT_SIGMA_S, 0.4 * readout + 0.002), source="guess"
    )
