"""Flat textured ground, photographed exactly by ideal cameras, and the composer's parts around
it.
"""

from functools import cache, lru_cache

import cv2
import numpy as np

from skyquilt.geometry.camera import undistort
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import footprint
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Alignment, MapFrame, Pose
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Feather
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.exposure import NEUTRAL
from tests.texture import texture

FLAT = Surface(z=np.zeros((2, 2), np.float32), x0=0.0, y0=0.0, cell=1.0, source="plane")
CAMERA = Camera(
    width=400, height=300, focal=350.0, cx=203.0, cy=148.0, k1=-0.06, k2=0.02, p1=5e-4, p2=-3e-4
)
FINE_M = 0.025
"""Ground size of a texture pixel in m."""


@cache
def textured():
    """Ground of 80 m x 80 m about the origin, row 0 in the north; not to be written to."""
    ground = np.clip(texture(3200, 3200, seed=11, roughness=1.2), 5, 250).astype(np.float32)
    ground.setflags(write=False)
    return ground


def view(number, x, y, *, z=40.0, yaw=0.0, pitch=0.0, roll=0.0, camera=CAMERA, surface=FLAT):
    pose = Pose(cam_R_map=cam_R_map_from_angles(yaw, pitch, roll), map_C=np.array([x, y, z]))
    return View(photo=number, camera=camera, pose=pose, footprint=footprint(camera, pose, surface))


def placed(poses, ties):
    """A block of photos by one camera, in a frame of its own."""
    return Alignment(
        method="bundle",
        why="",
        frame=MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="unknown"),
        poses=poses,
        cameras={"one": CAMERA},
        camera_of=dict.fromkeys(poses, "one"),
        blocks=(tuple(poses),),
        ties=ties,
    )


def ground_of(shot, px):
    """Map coordinates (n, 2) on z = 0 of photo pixels: the pixels' rays cut with the ground."""
    return _on_ground(shot, undistort(shot.camera, px))


def _on_ground(shot, xy):
    d = np.c_[xy, np.ones(len(xy))] @ shot.pose.cam_R_map
    return shot.pose.map_C[:2] - d[:, :2] * (shot.pose.map_C[2] / d[:, 2])[:, None]


def photograph(shot, ground=None):
    """The photo's picture: every pixel the mean of 3 x 3 rays into the ground."""
    R, C = shot.pose.cam_R_map, shot.pose.map_C
    if ground is not None:
        return _photographed(shot.camera, R, C, ground)
    return _of_textured(shot.camera, tuple(R.ravel()), tuple(C)).copy()


@lru_cache(maxsize=100)
def _of_textured(camera, R, C):
    """Many tests show the same photos."""
    return _photographed(camera, np.reshape(R, (3, 3)), np.array(C), textured())


def _photographed(camera, R, C, ground):
    h, w = camera.height, camera.width
    x, y, z = C
    across, down = ground.shape[1] / 2 - 0.5, ground.shape[0] / 2 - 0.5
    ground_H_rays = [
        (x * R[:, 2] - z * R[:, 0]) / FINE_M + across * R[:, 2],
        (z * R[:, 1] - y * R[:, 2]) / FINE_M + down * R[:, 2],
        R[:, 2],
    ]
    total = np.zeros((h, w), np.float32)
    for rays in _sub_pixels(camera):
        column, row, far = (np.array(ground_H_rays, np.float32) @ rays).reshape(3, h, w)
        at = column / far, row / far
        total += cv2.remap(ground, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return total / 9


@cache
def _sub_pixels(camera):
    """Rays (3, pixels) of nine places in every pixel."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    thirds = (-1 / 3, 0, 1 / 3)
    places = [np.c_[(u + du).ravel(), (v + dv).ravel()] for du in thirds for dv in thirds]
    return [
        np.vstack([undistort(camera, px).T, np.ones(u.size)]).astype(np.float32) for px in places
    ]


def truth(grid):
    """The ground averaged over the pixels of a grid whose resolution is a multiple of the
    texture's.
    """
    ground = textured()
    k = round(grid.gsd / FINE_M)
    top = round((ground.shape[0] / 2) - grid.north / FINE_M)
    left = round(ground.shape[1] / 2 + grid.west / FINE_M)
    cut = ground[top : top + k * grid.height, left : left + k * grid.width]
    return cv2.resize(cut, (grid.width, grid.height), interpolation=cv2.INTER_AREA)


def block():
    """Six overlapping photos, tilted and turned."""
    rng = np.random.default_rng(4)
    return [
        view(
            3 * k,
            14.0 * (k % 3) - 14,
            12.0 * (k // 3) - 6,
            yaw=rng.uniform(0, 360),
            pitch=rng.normal(0, 3),
            roll=rng.normal(0, 3),
        )
        for k in range(6)
    ]


def composer(
    views, pictures, grid, blend=None, *, exposure=NEUTRAL, surface=FLAT, dtype=np.uint8, bands=1
):
    """`pictures`: photo -> pixels."""
    return Composer(
        grid=grid,
        views=views,
        surface=surface,
        blend=blend or Feather(),
        pixels=lambda i: pictures[i],
        bands=bands,
        dtype=np.dtype(dtype),
        exposure=exposure,
    )


GRID = Grid(west=-24.0, north=18.0, gsd=0.1, width=480, height=360)
