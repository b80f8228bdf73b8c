"""Where the photos of a finished run show a place: poses and cameras from its files."""

from functools import cached_property
from pathlib import Path

import numpy as np

from skyquilt.geometry.camera import monotone_radius, project
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.runs.opened import Run, open_run

Xyz = tuple[float, float, float]
STEPS = 3
"""Repetitions until the row, on which the pose during readout depends, no longer changes."""


class Projection:
    """Projects places into the photos of a run."""

    def __init__(self, folder: Path) -> None:
        """Opens the run; raises `UsageError` or `SideFileError` where its files are damaged."""
        self.run: Run = open_run(folder)

    def size(self, name: str) -> tuple[int, int]:
        """Width and height of a photo in px."""
        camera = self._camera(name)
        return camera.width, camera.height

    def _camera(self, name: str) -> Camera:
        return self.run.cameras[self.run.camera_of[name]]

    @cached_property
    def _lowest(self) -> float:
        return float(min(p.map_C[2] for p in self.run.poses.values()))

    def ground(self) -> float:
        """A height for places where the surface has none: that of its middle."""
        names = self.run.layers
        if "heights" in names:
            coarse = self.run.raster("heights", gsd_m=50 * self.run.source("heights").resolution())
            if coarse.shown.any():
                return float(np.median(coarse.pixels[coarse.shown]))
        return self._lowest

    def pixel(self, name: str, place: Xyz, *, beyond: bool = False) -> tuple[float, float] | None:
        """The pixel at which a photo shows a place (map's projection, m); None if it does not, or,
        with `beyond`, only where the place is not in front of the camera.
        """
        pose, camera = self.run.poses.get(name), self._camera(name)
        if pose is None:
            return None
        return pixel_of(pose, camera, place, beyond=beyond)


def pixel_of(
    pose: Pose, camera: Camera, place: Xyz, *, beyond: bool = False
) -> tuple[float, float] | None:
    """The pixel at which a camera shows a place (m, in the frame of its pose); None as in
    `Projection.pixel`.
    """
    row = (camera.height - 1) / 2
    px = np.full(2, np.nan)
    for _ in range(STEPS if pose.motion is not None else 1):
        local = local_of(pose, camera, np.array(place), row)
        if local[2] <= 0 or np.hypot(*(local[:2] / local[2])) > monotone_radius(camera):
            return None
        px = project(camera, local[None])[0]
        row = float(px[1])
    inside = -0.5 <= px[0] <= camera.width - 0.5 and -0.5 <= px[1] <= camera.height - 0.5
    return (float(px[0]), float(px[1])) if inside or beyond else None


def local_of(pose: Pose, camera: Camera, place: np.ndarray, row: float) -> np.ndarray:
    """A place in the coordinates of the camera while it read out a row."""
    local = np.asarray(pose.to_camera(place))
    if pose.motion is None:
        return local
    s = (row - (camera.height - 1) / 2) / (camera.height - 1)
    moved = np.cross(pose.motion.turn_rad, local) - pose.cam_R_map @ pose.motion.shift_m
    return np.asarray(local + s * moved)
