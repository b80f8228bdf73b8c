"""Cameras of a rig, and what each sees of a picture."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import Camera

NODE = 8
"""Pixels between places that are projected: lenses bend little over a few pixels."""


@dataclass(frozen=True)
class BandCamera:
    """One camera of the rig."""

    camera: Camera
    turn: np.ndarray
    """(3,) rotation vector, rad, from the camera of the picture to this one."""


def rig(seed: int, width: int, height: int, focal: float, number: int = 2) -> list[BandCamera]:
    """Cameras that are turned by about half a degree, with focal lengths off by 1 %, principal
    points by 5 px, and lenses that differ.
    """
    rng = np.random.default_rng(seed)
    plain, found = Camera.ideal(width=width, height=height, focal=focal), []
    for _ in range(number):
        lens = replace(
            plain,
            focal=focal * (1 + 0.01 * rng.normal()),
            cx=plain.cx + 5 * rng.normal(),
            cy=plain.cy + 5 * rng.normal(),
            k1=-0.1 + 0.02 * rng.normal(),
            k2=0.05 + 0.02 * rng.normal(),
        )
        found.append(BandCamera(camera=lens, turn=np.radians(0.4) * rng.normal(size=3)))
    return found


def seen(
    picture: np.ndarray, taken: Camera, band: BandCamera, moved: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """What a camera of the rig sees of a picture that another camera took, of a plane; `moved`: how
    far it is beside that camera, over the depth of the plane.
    """
    R, lens = rotation_from_vector(band.turn), band.camera
    across, down = (np.arange(0, n + NODE, NODE, dtype=float) for n in (lens.width, lens.height))
    x, y = np.meshgrid(across, down)
    ray = rays(lens, np.c_[x.ravel(), y.ravel()]) @ R
    px = project(taken, ray / ray[:, 2:] + [*moved, 0.0]).astype(np.float32)
    at = np.meshgrid(*(np.arange(n, dtype=np.float32) / NODE for n in (lens.width, lens.height)))
    u, v = (
        cv2.remap(np.ascontiguousarray(p), *at, cv2.INTER_LINEAR)
        for p in px.reshape(*x.shape, 2).transpose(2, 0, 1)
    )
    return cv2.remap(picture, u, v, cv2.INTER_LINEAR)
