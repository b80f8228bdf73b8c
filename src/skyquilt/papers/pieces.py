"""Poses of a mosaic made in the plane, and the georeferencing of its pieces where it was made
without metadata.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.alignment.start import NOMINAL_HEIGHT_M
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.poses import Pose, Prior

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


GAP = 0.1
"""Gap between pieces without position, as a share of the size of the larger."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """Photos registered to each other."""

    plane_H_cam: dict[int, Array]
    """By photo: homography (3, 3) from its undistorted image plane to the plane of the piece (x
    right, y down).
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Laid:
    """Pieces on the map."""

    poses: dict[int, Pose]
    """By photo."""
    metric: bool
    """False if the scale had to be assumed."""


def lay(pieces: Sequence[Piece], priors: Sequence[Prior], height_m: float | None) -> Laid:
    """Places every piece by one similarity (4 degrees of freedom) from the photos' centres to their
    positions.

    This georeferences the mosaic and changes nothing inside a piece. A piece with fewer than two
    positions is scaled by the height above ground (`height_m`, otherwise heights above take-off,
    otherwise a nominal one) and rotated by the reported headings; without any position it is placed
    beside the others.
    """
    poses: dict[int, Pose] = {}
    metric = True
    east = None
    for piece in pieces:
        map_H_plane, known, placed = _similarity(piece, priors, height_m)
        metric &= known
        own = _posed(piece, map_H_plane)
        if not placed and own:
            own, east = _beside(own, piece, map_H_plane, east)
        poses |= own
    return Laid(poses=poses, metric=metric)


def _posed(piece: Piece, map_H_plane: Array) -> dict[int, Pose]:
    """Poses of a piece's photos on the map, without degenerate ones."""
    poses = {}
    for photo, plane_H_cam in piece.plane_H_cam.items():
        try:
            poses[photo] = planar_pose(map_H_plane @ plane_H_cam)
        except ValueError:
            continue
    return poses


def centre(H: Array) -> complex:
    """The transformed image centre (principal point) as x + iy."""
    return complex(H[0, 2] / H[2, 2], H[1, 2] / H[2, 2])


def _similarity(
    piece: Piece, priors: Sequence[Prior], height_m: float | None
) -> tuple[Array, bool, bool]:
    """(3, 3) from the piece's plane to the map; whether its scale and whether its place are
    known.
    """
    photos = list(piece.plane_H_cam)
    # y of the map points north, y of the plane down: conjugate
    plane = np.conj([centre(piece.plane_H_cam[i]) for i in photos])
    position = np.array([complex(*priors[i].map_C[:2]) for i in photos])
    known = np.isfinite(position)
    sigma = np.array([priors[i].sigma_C[0] for i in photos])
    spread = float(np.abs(position[known] - position[known].mean()).max()) if known.any() else 0.0
    if known.sum() >= 2 and spread > 2 * float(np.median(sigma[known])):
        g, c, _ = fit_similarity(plane[known], position[known], sigma[known])
        return _matrix(g, c), True, True
    height, metric = _height(piece, priors, height_m)
    g = height * _turn(piece, priors)
    if not known.any():
        return _matrix(g, 0j), metric, False
    return _matrix(g, complex(np.mean(position[known] - g * plane[known]))), metric, True


def _matrix(g: complex, c: complex) -> Array:
    """The similarity z -> g conj(z) + c as a matrix: x + iy of a plane with y down to the map."""
    return np.array([[g.real, g.imag, c.real], [g.imag, -g.real, c.imag], [0, 0, 1]])


def _height(piece: Piece, priors: Sequence[Prior], height_m: float | None) -> tuple[float, bool]:
    """Metres per unit of the plane, in which a photo of scale 1 is one focal length above the
    ground.
    """
    heights = np.array([priors[i].map_C[2] for i in piece.plane_H_cam])
    if height_m is not None:
        return height_m, True
    if np.isfinite(heights).any() and np.nanmedian(heights) > 1:
        return float(np.nanmedian(heights)), True
    return NOMINAL_HEIGHT_M, False


def _turn(piece: Piece, priors: Sequence[Prior]) -> complex:
    """Rotation that brings the photos to the reported headings; 1 if none is reported."""
    units = []
    for photo, H in piece.plane_H_cam.items():
        if np.isfinite(priors[photo].yaw_deg):
            top = -(H[:2, 1] * H[2, 2] - H[:2, 2] * H[2, 1])
            seen = np.conj(complex(top[0], top[1]))
            units.append(1j * np.exp(-1j * np.radians(priors[photo].yaw_deg)) / (seen / abs(seen)))
    return (
        complex(np.mean(units) / abs(np.mean(units)))
        if units and abs(np.mean(units)) > 1e-6
        else 1 + 0j
    )


def _beside(
    poses: dict[int, Pose], piece: Piece, map_H_plane: Array, east: float | None
) -> tuple[dict[int, Pose], float]:
    """The piece moved east of the previous ones, and its eastern end."""
    x = np.array([p.map_C[0] for p in poses.values()])
    reach = float(max(p.map_C[2] for p in poses.values()))
    if east is None:
        return poses, float(x.max()) + reach
    shift = np.eye(3)
    shift[0, 2] = east + GAP * reach - (float(x.min()) - reach)
    moved = _posed(piece, shift @ map_H_plane)
    return moved, float(max(p.map_C[0] for p in moved.values())) + reach
