"""Photos of a second camera beside those of the map: both pictures of one trigger, with what the
map knows of the ground and of the flight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.band_rig import BandRig
from skyquilt.coregistration.beside import Together
from skyquilt.coregistration.rig import Rig
from skyquilt.errors import PhotoFailedError
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import on_ground
from skyquilt.model.photo import Photo, evenly
from skyquilt.model.poses import Pose
from skyquilt.workflows.flow import Scene
from skyquilt.workflows.photo_features import pixels_again

LONGEST = 1600
"""Longest side in px of the pictures that are compared."""
_NOWHERE = np.zeros(3)
"""(3,) m that a camera is ahead of where its rig has it, where nothing tells."""
_FAR = 0.6
"""Share of the usual height above the ground from which a capture can tell the camera."""
_PLACES = 65
"""Places along a side of a photo at which the depth of the ground is looked up."""


def far(scene: Scene, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """The pairs without those taken on the way up or down: the few centimetres between cameras are
    many pixels of near ground.
    """
    if not pairs:
        return []
    C = np.array([scene.aligned.alignment.poses[i].map_C for i, _ in pairs])
    heights = C[:, 2] - scene.ground.surface.at(C[:, 0], C[:, 1])
    high = heights > _FAR * np.median(heights)
    return [pair for pair, used in zip(pairs, high, strict=True) if used]


def pose_beside(
    pose: Pose,
    rig: Rig | BandRig,
    velocity: NDArray[np.float64],
    ahead: NDArray[np.float64] = _NOWHERE,
) -> Pose:
    """The pose of the second camera when the map's photo had this one; `velocity` (3,) of the
    latter, m/s in the map frame; `ahead`: `Together.ahead`.
    """
    moved = (rig.a_t_b + ahead) @ pose.cam_R_map + rig.delay_s * velocity
    return Pose(cam_R_map=rig.b_R_a @ pose.cam_R_map, map_C=pose.map_C + moved)


def seen_together(
    scene: Scene,
    pairs: Sequence[tuple[int, int]],
    photos: Sequence[Photo],
    velocities: Mapping[int, NDArray[np.float64]],
    most: int,
    *,
    ahead: Mapping[int, NDArray[np.float64]] = MappingProxyType({}),
    coloured: bool = False,
) -> list[Together]:
    """Pictures of at most so many pairs, spread evenly over the flight, without those whose file
    cannot be read. A pair: indices of the map's photo and of one of `photos`; `velocities` (3,) of
    the former, m/s in the map frame; `ahead`: `Together.ahead`, by the index of the
    latter. `coloured`: with the colours of the map's photos.
    """
    asked = [pairs[k] for k in evenly(len(pairs), most)]
    found = (
        replace(pictures, ahead=ahead.get(j, _NOWHERE))
        for i, j in asked
        if (pictures := _together(scene, i, photos[j], velocities[i], coloured)) is not None
    )
    return list(found)


def _together(
    scene: Scene, index: int, other: Photo, velocity: NDArray[np.float64], coloured: bool
) -> Together | None:
    """Pictures of one capture; None where a file of it cannot be read any more."""
    aligned = scene.aligned
    kind = aligned.photos[index].channels, aligned.photos[index].dtype
    coloured = coloured and kind == (3, "uint8")
    try:
        theirs = shrink(to_grey8(pixels_again(other)), LONGEST)[0]
        ours = aligned.grey(index, LONGEST)
        colours = shrink(aligned.pixels(index), LONGEST)[0] if coloured else None
    except PhotoFailedError:  # told when it is drawn; the map shows its own already
        return None
    camera = aligned.alignment.camera(index)
    return Together(
        a=ours,
        camera_a=camera,
        b=theirs,
        nearness=_nearness(scene, index),
        velocity=aligned.alignment.poses[index].cam_R_map @ velocity,
        colours=colours,
    )


def _nearness(scene: Scene, index: int) -> NDArray[np.float64]:
    """(r, c) 1 over the depth in m of the ground in a photo of the map, at places from corner to
    corner; 0 where its rays meet none.
    """
    alignment, camera = scene.aligned.alignment, scene.aligned.alignment.camera(index)
    pose = alignment.poses[index]
    x, y = np.meshgrid(
        np.linspace(0, camera.width - 1, _PLACES), np.linspace(0, camera.height - 1, _PLACES)
    )
    view = View(photo=index, camera=camera, pose=pose, footprint=np.zeros((0, 2)))
    ground = on_ground(view, np.c_[x.ravel(), y.ravel()], scene.ground.surface)
    depth = ((ground - pose.map_C) @ pose.cam_R_map[2]).reshape(x.shape)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(depth > 0, 1 / depth, 0.0))
