"""Photos placed in the plane: conversion between a homography from the image plane to the map and
the nearest vertical view.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.poses import Pose

Array = NDArray[np.float64]


def planar_pose(map_H_cam: Array) -> Pose:
    """The pose of a photo whose undistorted image plane (units of the focal length) `map_H_cam` (3,
    3) takes to the map in m.

    The nearest vertical view is above the point where the optical axis meets the ground, at the
    height that gives the scale there, with the heading of the homography.

    Raises:
        ValueError: the homography is degenerate, or mirrors the image.
    """
    H = np.asarray(map_H_cam, np.float64)
    if not np.isfinite(H).all() or abs(H[2, 2]) < 1e-12:
        raise ValueError(f"a homography that maps the image centre to infinity: {H}")
    H = H / H[2, 2]
    ground = H[:2, 2]
    J = H[:2, :2] - np.outer(ground, H[2, :2])
    # image axes: x right, y down; map axes: x east, y north. So a valid view reverses the
    # orientation
    if np.linalg.det(J) >= 0:
        raise ValueError(f"a homography that mirrors the image: {H}")
    height = float(np.sqrt(-np.linalg.det(J)))
    top = -J[:, 1] / np.linalg.norm(J[:, 1]) + np.array([-J[1, 0], J[0, 0]]) / np.linalg.norm(
        J[:, 0]
    )
    cam_H_map = np.linalg.inv(H)
    cam_H_map *= height / (cam_H_map[2] @ np.array([*ground, 1.0]))
    return Pose(
        cam_R_map=cam_R_map_from_angles(float(np.degrees(np.arctan2(top[0], top[1])))),
        map_C=np.array([*ground, height]),
        cam_H_map=cam_H_map,
    )


def map_H_cam_of(pose: Pose) -> Array:
    """The homography (3, 3) from the undistorted image plane to level ground at height 0, scaled so
    that its last element is 1.
    """
    if pose.cam_H_map is not None:
        cam_H_map = pose.cam_H_map
    else:
        R, C = pose.cam_R_map, pose.map_C
        cam_H_map = np.column_stack([R[:, 0], R[:, 1], -R @ C])
    H = np.linalg.inv(cam_H_map)
    return np.asarray(H / H[2, 2])
