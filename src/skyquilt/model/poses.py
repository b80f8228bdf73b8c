"""Where photos are: the map frame, poses, and the result of an alignment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.camera import Camera
from skyquilt.model.photo import Datum

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class MapFrame:
    """The local map frame: x east, y north, z up in m, relative to `origin` in `crs`."""

    crs: str | None
    """As pyproj reads it; None when nothing says where on Earth the survey is."""
    origin: tuple[float, float]
    """Easting and northing in m of the frame's origin; heights are not shifted."""
    vertical_datum: Datum
    """What heights refer to."""
    takeoff_m: float | None = None
    """Height of the take-off point above `vertical_datum` in m, by which heights above take-off are
    converted; None = they are not.
    """
    control_datum: Datum = "control"
    """What heights refer to once control points with heights hold the map."""
    convergence_deg: float = 0.0
    """Meridian convergence: grid yaw = true yaw - convergence."""
    metric: bool = True
    """False when even the scale is unknown (no positions, no height): then 1 m is an arbitrary
    unit.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Prior:
    """What the metadata report about one photo's pose, in the map frame; NaN where they report
    nothing.
    """

    map_C: Array
    """(3,) camera centre in m."""
    sigma_C: Array
    """(3,) standard deviations in m."""
    yaw_deg: float
    """Grid yaw of the image top, clockwise from the map's north."""
    pitch_deg: float
    """Degrees from nadir; 0 where unknown."""
    roll_deg: float
    """Degrees; 0 where unknown."""
    sigma_yaw_deg: float
    """Standard deviation of the yaw."""
    sigma_tilt_deg: float
    """Standard deviation of pitch and roll."""
    yaw_source: str = ""
    """Which metadata the yaw was read from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Movement of a camera from the exposure of its photo's first row to that of the last.

    A point that has coordinates L in the camera of the middle row has, in that of row y,
    L + s (turn x L - R shift), s = (y - (height - 1) / 2) / (height - 1).
    """

    shift_m: Array
    """(3,) movement of the centre in m in the map frame."""
    turn_rad: Array
    """(3,) small rotation about the camera's axes in rad."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pose:
    """Exterior orientation of one photo."""

    cam_R_map: Array
    """(3, 3) rotation from map to camera."""
    map_C: Array
    """(3,) centre of projection in m in the map frame."""
    cam_H_map: Array | None = None
    """(3, 3) for methods that place photos in the plane, not in space: takes (x, y, 1) of the map
    to the undistorted image plane, whatever the height; rotation and centre are then those of the
    nearest vertical view.
    """
    sigma_m: Array | None = None
    """(3,) deviation of the centre in m; None where it is not known."""
    motion: Motion | None = None
    """How the camera moved while its rows were read out; None = not at all."""

    def to_camera(self, xyz_map: Array) -> Array:
        """Transforms points (..., 3) from the map frame to camera coordinates (for a photo placed
        in the plane: up to scale), those of the middle row where the camera moved.
        """
        if self.cam_H_map is not None:
            return np.asarray(xyz_map[..., :2] @ self.cam_H_map[:, :2].T + self.cam_H_map[:, 2])
        return np.asarray((xyz_map - self.map_C) @ self.cam_R_map.T)

    def planes_to_camera(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        """`to_camera` for separate coordinate arrays, which are broadcast: three times as fast for
        many points.
        """
        if self.cam_H_map is not None:
            a, b, c = (row[0] * x + row[1] * y + row[2] for row in self.cam_H_map)
            return a, b, c
        dx, dy, dz = x - self.map_C[0], y - self.map_C[1], z - self.map_C[2]
        a, b, c = (row[0] * dx + row[1] * dy + row[2] * dz for row in self.cam_R_map)
        return a, b, c


@dataclass(frozen=True, kw_only=True, eq=False)
class TiePoints:
    """Points on the ground and their observations."""

    xyz: Array
    """(P, 3) in m in the map frame."""
    point: NDArray[np.integer[Any]]
    """(N,) index into `xyz` of each observation, ascending."""
    photo: NDArray[np.integer[Any]]
    """(N,) index of the photo of each observation."""
    px: NDArray[np.floating[Any]]
    """(N, 2) observed pixel, to some 0.0001 px: there are millions of large surveys."""
    residual_px: NDArray[np.floating[Any]]
    """(N, 2) projected minus observed."""

    def of_photos(self, photos: Sequence[int]) -> dict[int, NDArray[np.int64]]:
        """The observations of each of these photos, as indices in ascending order."""
        order = np.argsort(self.photo, kind="stable")
        cuts = np.searchsorted(self.photo[order], [[i, i + 1] for i in photos]).reshape(-1, 2)
        return {i: order[a:b] for i, (a, b) in zip(photos, cuts.tolist(), strict=True)}


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlResidual:
    """Residuals of a control or check point."""

    name: str
    """Label."""
    check: bool
    """True: not used in the adjustment."""
    error_m: Array
    """(3,) solution minus survey in m: x, y, z (NaN where the survey gives no height)."""
    reprojection_px: float
    """RMS over its observations in px."""
    observations: int
    """Number of photos in which it was observed."""
    sigma_m: Array | None = None
    """(3,) predicted deviation of `error_m` in m, the survey's included; of a control point, which
    holds the map, this is the most it can be. None where it is not known.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Accuracy:
    """How far ground points may be wrong, as the adjustment predicts."""

    xyz: Array
    """(k, 3) tie points in m, a sample spread over the map."""
    sigma_m: Array
    """(k, 3) deviations of their coordinates in m."""
    shared_m: tuple[float, float]
    """Horizontal and vertical deviation in m of a shift of the whole map that no photo shows: that
    of the positions where no control point ties the map to the ground.
    """
    focal_shares: Mapping[str, float]
    """Deviation of each camera's focal length after the adjustment over that before: 1 = the flight
    tells nothing about it, and heights follow the metadata.
    """
    design_effect: float
    """Observations that tell as much as an independent one (`alignment.deviations`)."""

    @property
    def focal_share(self) -> float:
        """The largest of these."""
        return max(self.focal_shares.values(), default=0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Join:
    """How a method that adds photos one after the other registered this photo to those before
    it.
    """

    photo: int
    """Index of the photo."""
    onto: int
    """Index of the photo it was registered to; -1 = the map so far."""
    matches: int
    """Putative correspondences, or 0 where pixels were compared."""
    inliers: int
    """Matches that agree with the transformation."""
    ste_px2: float
    """Symmetric transfer error per inlier in px^2 (A 15) of the working image; NaN where pixels
    were compared.
    """
    score: float
    """Quality of the placement (Y 4.6) where pixels were compared, otherwise NaN."""
    moved_m: float
    """Distance of the photo's nadir from its reported position in m; NaN where none is known."""
    px: Array
    """(M, 2) inliers before levelling in px of the photo."""
    d_px: Array
    """(M, 2) their disparity vectors (Y 4.8) in px of the working image."""
    levelled: NDArray[np.bool_]
    """(M,) False for features off the dominant plane; they are left out (Y 4.9)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Poses and calibration of a survey, and how they were found."""

    method: str
    """Name of the method."""
    why: str
    """Why it was chosen, one sentence."""
    frame: MapFrame
    """Frame of everything below."""
    poses: dict[int, Pose]
    """By index of the photo."""
    cameras: dict[str, Camera]
    """Calibrations by name: `Photo.camera_key`, or that plus `/turned` for files rewritten upside
    down.
    """
    camera_of: dict[int, str]
    """Photo index -> name of its calibration."""
    blocks: tuple[tuple[int, ...], ...]
    """Photos connected by tie points, largest block first; single photos placed by metadata
    last.
    """
    ties: TiePoints
    """Tie points; empty for methods that compute none."""
    rejected: dict[int, str] = field(default_factory=dict)
    """Photo index -> reason."""
    control: tuple[ControlResidual, ...] = ()
    """Control and check points."""
    loo_rms_m: tuple[float, float, float] | None = None
    """RMS over photos of the position residual of each photo predicted from all the others."""
    accuracy: Accuracy | None = None
    """Predicted accuracy; None for methods that predict none."""
    notes: tuple[str, ...] = ()
    """Messages for the user."""
    joins: tuple[Join, ...] = ()
    """Steps of a method that adds one photo after the other, in that order."""

    @property
    def held(self) -> tuple[int, ...]:
        """Placed photos that are connected to others by tie points, ascending."""
        return tuple(
            sorted(i for block in self.blocks if len(block) > 1 for i in block if i in self.poses)
        )

    @property
    def ground_m(self) -> float:
        """Height of the ground in m: the median of the tie points; without them that of the level
        ground which photos were laid on.
        """
        z = self.ties.xyz[:, 2]
        return float(np.median(z)) if len(z) else self.frame.takeoff_m or 0.0

    def camera(self, photo: int) -> Camera:
        """The calibration of a photo."""
        return self.cameras[self.camera_of[photo]]

    def carried(
        self, turn: Array, factor: float, middle: Array, to: Array | None = None
    ) -> "Alignment":
        """The alignment of photos placed in space without control points, turned by `turn` (3, 3)
        and enlarged by a factor about a point (3,), which comes to lie at `to` (None: where it
        was): photos show what they did.
        """
        at = middle if to is None else to

        def there(places: Array) -> Array:
            return np.asarray(at + factor * (places - middle) @ turn.T)

        def pose(p: Pose) -> Pose:
            motion = p.motion
            if motion is not None:
                motion = replace(motion, shift_m=factor * turn @ motion.shift_m)
            return replace(p, cam_R_map=p.cam_R_map @ turn.T, map_C=there(p.map_C), motion=motion)

        told = self.accuracy
        return replace(
            self,
            poses={i: pose(p) for i, p in self.poses.items()},
            ties=replace(self.ties, xyz=there(self.ties.xyz)),
            accuracy=None if told is None else replace(told, xyz=there(told.xyz)),
        )


def no_ties() -> TiePoints:
    """Tie points of a method that has none."""
    return TiePoints(
        xyz=np.zeros((0, 3)),
        point=np.zeros(0, np.int32),
        photo=np.zeros(0, np.int32),
        px=np.zeros((0, 2), np.float32),
        residual_px=np.zeros((0, 2), np.float32),
    )
