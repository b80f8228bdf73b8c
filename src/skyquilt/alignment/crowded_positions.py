"""Positions that crowd in one place although the pictures show photos far apart: those of the
remote control or of a phone, or of a receiver that found no satellites.

They tell nothing of a map's scale and direction, and would shrink it to the size of their error.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.start import NOMINAL_HEIGHT_M, find_start, ground_of
from skyquilt.model.poses import Alignment, MapFrame, Prior

FEWEST = 4
"""Photos with positions that are needed to judge them."""
NOISE = 5.0
"""Positions crowd if half of them lie within so many of their deviations of their middle, ..."""
FURTHER = 4.0
"""... and the pictures show photos so many times further apart, seen from the height that they
report, ...
"""
LEAST_HEIGHT_M = 8.0
"""... or from this height, where they report none: with positions that crowd, the map would show
photos taken from below 2 m.
"""
FEWEST_CONTROL = 3
"""Control points that place a map without positions."""


def without_crowded(inputs: AlignmentInputs) -> tuple[AlignmentInputs, tuple[str, ...]]:
    """The inputs without positions that crowd, and a sentence on these; the very same inputs where
    none do. Heights stay: they tell the map's scale.
    """
    told = inputs.priors
    reach = _reach(np.array([p.map_C[:2] for p in told]).reshape(-1, 2))
    if not inputs.links or inputs.frame.crs is None or not _within_noise(told, reach):
        return inputs, ()
    bare, ground = without_places(told), ground_of(inputs.frame)
    start = find_start(inputs.photos, bare, inputs.features, inputs.links, ground)
    scale = 1.0 if start.metric else LEAST_HEIGHT_M / NOMINAL_HEIGHT_M
    block = [start.placed[m][1] for m in max(start.blocks, key=len, default=())]
    shown = scale * _reach(np.array([(t.real, t.imag) for t in block]).reshape(-1, 2))
    if not shown > FURTHER * reach:
        return inputs, ()
    control = sum(not point.check for point in inputs.control) >= FEWEST_CONTROL
    frame = inputs.frame if control else unplaced(inputs.frame)
    note = (
        f"Half of the positions lie within {reach:.1f} m, where the pictures show the photos within"
        f" {shown:.0f} m: they are those of the remote control, or the receiver was stuck. They"
        " were not used. Provide positions in a geo.txt, or control points."
    )
    return replace(inputs, priors=bare, frame=frame), (note,)


def unplaced(frame: MapFrame) -> MapFrame:
    """The frame of a map whose place is not known."""
    return replace(frame, crs=None, origin=(0.0, 0.0), convergence_deg=0.0)


def without_places(priors: Sequence[Prior]) -> tuple[Prior, ...]:
    """The priors without positions, but with their heights."""
    nowhere, any_far = np.full(2, np.nan), np.full(2, np.inf)
    return tuple(
        replace(
            p, map_C=np.r_[nowhere, p.map_C[2:]], sigma_C=np.r_[any_far, np.asarray(p.sigma_C)[2:]]
        )
        for p in priors
    )


def believed(found: Alignment, frame: MapFrame, priors: Sequence[Prior]) -> Sequence[Prior]:
    """The priors that an alignment was made with, where it left the places of a frame out."""
    return without_places(priors) if frame.crs and not found.frame.crs else priors


def _within_noise(priors: Sequence[Prior], reach: float) -> bool:
    sigma = [p.sigma_C[0] for p in priors if np.isfinite(p.map_C[0])]
    return len(sigma) >= FEWEST and reach < NOISE * float(np.median(sigma))


def _reach(xy: NDArray[np.float64]) -> float:
    """Median distance of places (n, 2) from their middle; NaN without any."""
    xy = xy[np.isfinite(xy).all(1)]
    if not len(xy):
        return np.nan
    return float(np.median(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))
