"""Positions that say less than they seem to: rounded ones, and ones that a receiver repeats.

Their deviations are made as large as they are, so that they do not shrink or turn a map.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Photo
from skyquilt.photos.position_groups import on_sphere
from skyquilt.photos.side_rows import sentence_of

_STEPS_DEG = (0.1, 1 / 60, 1e-2, 1e-3, 1 / 3600, 1e-4)
"""What degrees are rounded to, coarse to fine: finer steps are below a receiver's own error."""
_EXACT_DEG = 1e-8
"""Difference from a multiple of a step, or from another position, that counts as none."""
_ROUNDED_PHOTOS = 4
"""So many photos of a camera must agree before their positions are called rounded."""
_METRES_PER_DEGREE = 111_320.0
Array = NDArray[np.float64]


def with_coarse_deviations(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos (in order of capture) with larger deviations where their positions are rounded or
    repeat the one before, and notes on these.
    """
    kept, notes = list(photos), list[str]()
    for key in dict.fromkeys(p.camera_key for p in photos if p.position):
        own = [i for i, p in enumerate(photos) if p.position and p.camera_key == key]
        for coarse in (_rounded, _repeated):
            given = [kept[i] for i in own]
            found, note = coarse(given)
            for i, photo in zip(own, found, strict=True):
                kept[i] = photo
            changed = [new.name for old, new in zip(given, found, strict=True) if new is not old]
            if changed:
                notes.append(f"{len(changed)} photos ({sentence_of(changed)}) {note}")
    return tuple(kept), tuple(notes)


def _rounded(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Photos of a camera whose positions all are multiples of a step of degrees."""
    degrees = _degrees(photos)
    for step in _STEPS_DEG if len(photos) >= _ROUNDED_PHOTOS else ():
        if (np.abs(degrees - step * np.round(degrees / step)) < _EXACT_DEG).all():
            metres = step * _METRES_PER_DEGREE
            sigma = metres / np.sqrt(12)  # of a uniform distribution
            note = (
                f"have positions that are rounded to {metres:.0f} m; they count as uncertain by"
                f" {sigma:.1f} m."
            )
            return [_widened(p, float(sigma)) for p in photos], note
    return list(photos), ""


def _repeated(photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Photos of a camera that repeat the position of the photo before: the camera is somewhere on
    the way to the next position that differs.
    """
    degrees, xyz = _degrees(photos), on_sphere(photos)
    new = np.ones(len(photos), bool)
    new[1:] = (np.abs(np.diff(degrees, axis=0)) > _EXACT_DEG).any(1)
    starts = np.flatnonzero(new)
    if len(starts) < 2 or new.all():
        return list(photos), ""
    run = np.cumsum(new) - 1
    to_next = np.linalg.norm(np.diff(xyz[starts], axis=0), axis=1)
    away = np.append(to_next, to_next[-1])[run]
    found = [
        p if first else _widened(p, float(m)) for p, first, m in zip(photos, new, away, strict=True)
    ]
    note = (
        "repeat the position of the photo before: a receiver that was slow or stuck; they count as"
        f" uncertain by up to {away[~new].max():.0f} m."
    )
    return found, note


def _degrees(photos: Sequence[Photo]) -> Array:
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    return np.array(places, np.float64).reshape(-1, 2)


def _widened(photo: Photo, sigma_xy_m: float) -> Photo:
    """The photo whose position has at least that deviation."""
    if photo.position is None or sigma_xy_m <= photo.position.sigma_xy_m:
        return photo
    return replace(photo, position=replace(photo.position, sigma_xy_m=sigma_xy_m))
