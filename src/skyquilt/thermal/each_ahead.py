"""How far the drone had flown between a visual photo and the thermal one that was released later.

A second at 6 m/s is 6 m, and a drone's speed is known to some hundredths of that: several pixels of
a thermal photo. So each photo tells by itself how far it was, by patches of both pictures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from skyquilt.coregistration.band_rig import FindBandRig, shifts
from skyquilt.coregistration.beside import Beside, Together, oriented, seen_by
from skyquilt.coregistration.rig import Rig
from skyquilt.geometry.camera import rays
from skyquilt.imaging.grey import full_px
from skyquilt.model.photo import Photo
from skyquilt.workflows.flow import Scene
from skyquilt.workflows.second_camera import seen_together

Array = NDArray[np.float64]
_ROUNDS = ((256, 12), (640, 6))
"""Sides in px of the squares to whose areas photos are reduced, and the largest shift in px that is
looked for there, one round each.
"""
_FEWEST = 8
"""Fewest patches that must be matched."""


def beside_of(rig: Rig) -> Beside:
    """The second camera of a rig beside the first."""
    turn = np.asarray(Rotation.from_matrix(rig.b_R_a).as_rotvec())
    return Beside(turn=turn, place=rig.a_t_b[:2], camera=rig.camera_b, delay_s=rig.delay_s)


def each_ahead(
    scene: Scene,
    pairs: Sequence[tuple[int, int]],
    thermal: Sequence[Photo],
    velocities: Mapping[int, Array],
    ahead: Mapping[int, Array],
    rig: Rig,
    *,
    rough: bool = False,
) -> dict[int, Array]:
    """Index of a thermal photo -> (3,) `Together.ahead`, of those whose patches confirm one. A
    pair: indices of the visual photo and of the thermal one; `ahead`: what is known so far;
    `velocities`: of the visual photos, m/s in the map frame; `rough`: by coarse structure only, as
    long as the lens is not known.
    """
    there, found = beside_of(rig), dict[int, Array]()
    for pair in pairs:
        for seen in seen_together(
            scene, [pair], thermal, velocities, 1, ahead=ahead, coloured=True
        ):
            own = ahead_of(seen, there, rough=rough)
            if own is not None:
                found[pair[1]] = own
    return found


def ahead_of(pair: Together, there: Beside, *, rough: bool = False) -> Array | None:
    """(3,) how far ahead of where the rig has it the second camera was, m along the axes of the
    first; by colours where patches of these confirm it, else by brightness. None where neither do.
    """
    first = _ahead(pair, there, *_ROUNDS[0], coloured=False)
    if first is None or rough:
        return first
    pair = replace(pair, ahead=first)
    for coloured in (True, False) if pair.colours is not None else (False,):
        found = _ahead(pair, there, *_ROUNDS[1], coloured=coloured)
        if found is not None:
            return found
    return None


def _ahead(pair: Together, there: Beside, side: int, reach: int, *, coloured: bool) -> Array | None:
    """The same by one round of patches."""
    find = FindBandRig()
    b = oriented(pair.b, side)
    a = seen_by(pair, there, b.shape, coloured=coloured)
    px, shift = shifts(a, b, reach, 1.0)
    px_a, near = there.in_photo(px, there.reduced(b.shape), pair)
    known = np.isfinite(px_a).all(1)
    if known.sum() < _FEWEST:
        return None
    px_a, near = px_a[known], near[known]
    px_b = full_px((px + shift)[known], b.shape, (there.camera.height, there.camera.width))
    ray_a, scale = rays(pair.camera_a, px_a), there.camera.width / b.shape[1]

    def off(moved: Array) -> Array:
        ahead = pair.ahead + np.array([*moved, 0.0])
        px_there = there.sees(ray_a, near, pair.velocity, ahead)
        return np.asarray(np.nan_to_num(px_there - px_b, nan=1e3) / scale)

    moved = least_squares(
        lambda x: off(x).ravel(), np.zeros(2), loss="cauchy", f_scale=find.scatter_px
    ).x
    agree = np.linalg.norm(off(moved), axis=1) < find.agree_px
    if agree.sum() < _FEWEST or agree.mean() < find.least_share:
        return None
    return np.asarray(pair.ahead + np.array([*moved, 0.0]))
