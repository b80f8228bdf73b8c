"""Cameras that are not what they are taken for: shutters that expose row by row without a word, and
pictures that were resized along one side.

Such a camera is adjusted again with a readout time and an aspect ratio that pictures alone tell. A
drone that turns with its lines hardly tells the two apart, so they are loosened together.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.enlarged import misfit_px
from skyquilt.alignment.outcome import ASPECT, NO_FIT
from skyquilt.alignment.problem import READOUT
from skyquilt.alignment.setup import SIGMA_ASPECT, Setup
from skyquilt.model.poses import Alignment

Floats = NDArray[np.float64]
CONTRADICTED = 2.2
"""A readout time and an aspect ratio that together lie so many deviations off their priors
contradict these.
"""
ASSUMED = {READOUT: 8e-3, ASPECT: SIGMA_ASPECT}
"""Priors at least as wide are assumed; narrower ones are stated, and stay."""
LOOSE = {READOUT: 0.1, ASPECT: 0.1}
"""Deviations (s, ratio) of what pictures alone tell."""
WORSE = 1.03
"""The larger freedom is taken where photos fit at most so many times as badly with it."""


def unfit_cameras(
    found: Alignment, priors: Mapping[str, tuple[Floats, Floats, NDArray[np.bool_]]]
) -> frozenset[str]:
    """Names of cameras whose photos contradict the shutter or the shape of pixels that is assumed
    of them, or fit no camera as it is assumed. `priors`: of each camera the values, their
    deviations, and which are estimated (`setup.priors_by_camera`).
    """
    unfit = set[str]()
    for key, (K0, sigma, free) in priors.items():
        if (camera := found.cameras.get(key)) is None:
            continue
        apart = np.abs(np.r_[camera.vector, camera.readout_s] - K0) / sigma
        assumed = [c for c in ASSUMED if free[c] and sigma[c] >= ASSUMED[c]]
        other = float(np.linalg.norm(apart[assumed])) > CONTRADICTED
        told = any(note.startswith(f"The photos of {key} {NO_FIT}") for note in found.notes)
        if other or (told and assumed):
            unfit.add(key)
    return frozenset(unfit)


def loosened(setup: Setup, cameras: Collection[str]) -> Setup:
    """The same for an adjustment in which pictures alone tell the readout times and the aspect
    ratios that are assumed of some cameras.
    """
    if not cameras:
        return setup
    own = np.array([key in cameras for key in setup.camera_keys])
    sigma: Floats = setup.base.sigma_K.copy()
    for c, least in ASSUMED.items():
        wide = own & setup.base.free[:, c] & (sigma[:, c] >= least)
        sigma[wide, c] = LOOSE[c]
    return replace(setup, base=replace(setup.base, sigma_K=sigma))


def fits_as_well(other: Alignment, found: Alignment) -> bool:
    """Whether an alignment holds as many photos as another, and fits the pictures about as well or
    better.
    """
    as_well = misfit_px(other) <= WORSE * misfit_px(found)
    return as_well and len(other.held) >= len(found.held)


def unfit_notes(found: Alignment, cameras: Collection[str]) -> tuple[str, ...]:
    """What the user is told of each camera."""
    notes = []
    for key in sorted(cameras):
        ms, ratio = 1000 * found.cameras[key].readout_s, found.cameras[key].aspect
        order = ", the last row first" if ms < -0.5 else ""
        notes.append(
            f"The photos of {key} do not fit the camera that they were taken for. The pictures tell"
            f" that its rows are exposed within {abs(ms):.0f} ms{order} (0: all at once), and that"
            f" its focal lengths along columns and rows have the ratio {ratio:.3f} (1: nobody"
            " resized the pictures along one side). State them by --shutter-readout and --cameras"
            " if you know better."
        )
    return tuple(notes)
