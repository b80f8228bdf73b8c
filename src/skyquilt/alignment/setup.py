"""Photos, priors and a start as the arrays of an adjustment, and its results as records."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.motion import spins, velocities
from skyquilt.alignment.problem import PART, READOUT, Problem, State
from skyquilt.alignment.same_lens import same_lens
from skyquilt.alignment.start import GROSS_DEG, UNKNOWN_YAW_DEG, Start, steered
from skyquilt.alignment.tracks import Tracks
from skyquilt.alignment.triangulate import intersect
from skyquilt.geometry.camera import tangent_over_angle
from skyquilt.geometry.frames import angle_difference_deg, cam_R_map_from_angles
from skyquilt.model.camera import PARAMETERS, Camera, order_named
from skyquilt.model.photo import Photo, Zoom
from skyquilt.model.poses import Motion, Pose, Prior

Array = NDArray[np.float64]
LEAST_FALL = np.sin(np.radians(10.0))
"""Rays flatter than this are taken for as steep as this, where they meet the ground plane."""
TOLD_APART = np.sin(np.radians(3.0))
"""Rays that differ by less than about this angle do not tell where they meet."""
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
TURNED = "/turned"
"""Suffix of the names of calibrations for files that were saved upside down."""
INDEPENDENT = 40
"""Independent observations that tell as much as a photo's many correlated ones."""
SIGMA_ASPECT = 3e-3
"""Deviation from 1 of the ratio of focal lengths along columns and rows, where no calibration gives
it; factory calibrations of drones show 0.2 to 0.5 %.
"""
TOGETHER = 500_000
"""Observations, about, of the parts in which those of all tracks are computed."""
FISHEYE = PARAMETERS.index("fisheye")
"""Column of the kind of lens among the intrinsics."""
UNKNOWN_HEIGHT = 0.5
"""Deviation of heights that are not known, as a share of that of the start, which takes the ground
for level: on a mountain side it tilts photos that weigh it more than their own tilts.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """Meaning of the rows of the adjustment's arrays."""

    members: NDArray[np.int64]
    """(n,) photo of each row."""
    camera: NDArray[np.int64]
    """(n,) camera row of each photo row."""
    camera_keys: tuple[str, ...]
    """Name of each camera row."""
    turned: NDArray[np.bool_]
    """(photos,) files that were saved upside down: their sensor image is the file turned by 180
    degrees.
    """
    size: Array
    """(photos, 2) width and height in px."""
    stated_sigma_C: Array
    """(n, 3) deviations as stated by the metadata."""
    block_rows: tuple[NDArray[np.int64], ...]
    """Rows of each block."""
    georeferenced: bool
    """Whether any block was placed by positions."""
    z_ground: float
    """Height of the ground plane of the start in m."""
    base: Problem
    """The problem without observations."""
    start_R: Array
    """(n, 3, 3)."""
    start_C: Array
    """(n, 3)."""
    plane_a: NDArray[np.complex128]
    """(n,) similarity factors of the start; they give the first points on the ground plane."""
    plane_t: NDArray[np.complex128]
    """(n,) translations of the start."""
    rewritten: tuple[str, ...]
    """(n,) the program that rewrote the file of each row; empty where none did, and where a heading
    tells how the file lies.
    """
    in_space: bool = False
    """The first points are where rays meet near the ground plane, not on it."""
    spin: tuple[Array, Array] | None = None
    """Rates (n, 3) in rad/s at which cameras turn, and their deviations (n,): `motion.spins`."""

    def file_px(self, photo: NDArray[np.integer[Any]], px: Array) -> Array:
        """Converts sensor pixels to file pixels, or back. For turned files the two differ by a
        rotation of 180 degrees.
        """
        if not self.turned.any():
            return px
        return turned_px(px, self.turned[photo], self.size[photo])

    def moving_as(self, photos: Sequence[Photo], state: State) -> "Setup":
        """The same with the velocities and turns that poses and capture times tell."""
        members = [photos[m] for m in self.members.tolist()]
        base = replace(self.base, velocity=velocities(members, state.C))
        return replace(self, base=base, spin=spins(members, state.R))

    def file_sign(self, photo: NDArray[np.int64]) -> Array:
        """(N, 1) factor that takes residuals from the sensor to the file."""
        return np.where(self.turned[photo][:, None], -1.0, 1.0)

    def sensor_tracks(self, tracks: Tracks) -> Tracks:
        """Tracks of this setup's photos in sensor pixels."""
        mine = np.isin(tracks.photo, self.members)
        own = tracks.only(mine)
        return replace(own, px=self.file_px(own.photo, own.px))

    def problem(self, tracks: Tracks) -> tuple[Problem, State]:
        """The problem with these tracks (sensor pixels), and its start: points on the ground
        plane.
        """
        row = np.searchsorted(self.members, tracks.photo)
        X = np.empty((tracks.count, 3))
        first_points = self._meeting if self.in_space else self._on_plane
        for some, points in tracks.parts(PART):
            X[points] = first_points(tracks.part(some, points), row[some])
        problem = replace(
            self.base,
            point=tracks.point,
            photo=row.astype(tracks.photo.dtype),
            px=tracks.px,
            sigma_px=tracks.sigma_px,
            relative=tracks.relative,
            X0=np.broadcast_to(np.nan, X.shape),
            sigma_X=np.broadcast_to(1.0, X.shape),
            trust=min(1.0, INDEPENDENT * len(self.members) / max(len(row), 1)),
        )
        turn = np.zeros(self.start_C.shape)
        K = self.base.K0.copy()
        return problem, State(R=self.start_R, C=self.start_C, K=K, X=X, turn=turn)

    def problems(self, tracks: Tracks) -> Iterator[Problem]:
        """The problems of parts of the tracks, in their order: of large surveys, all at once take
        more memory than all else.
        """
        for some, points in tracks.parts(TOGETHER):
            yield self.problem(tracks.part(some, points))[0]

    def _on_plane(self, tracks: Tracks, row: NDArray[np.int64]) -> Array:
        """Points (P, 3) of tracks on the plane of the start, `row` (N,) being their photos'."""
        p = self._plain(tracks, row)
        p = np.where(self.turned[tracks.photo], -p, p)
        ground = self.plane_a[row] * p + self.plane_t[row]
        X = np.full((tracks.count, 3), self.z_ground)
        number = np.bincount(tracks.point, minlength=tracks.count)
        X[:, 0] = np.bincount(tracks.point, ground.real, tracks.count) / number
        X[:, 1] = np.bincount(tracks.point, ground.imag, tracks.count) / number
        return X

    def _meeting(self, tracks: Tracks, row: NDArray[np.int64]) -> Array:
        """Points (P, 3) where the rays of tracks meet, drawn towards the ground plane as far as
        these are too parallel to tell.
        """
        p = self._plain(tracks, row)
        local = np.column_stack([p.real, -p.imag, np.ones(len(p))])
        ray = np.einsum("nji,nj->ni", self.start_R[row], local)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        C, count = self.start_C[row], tracks.count
        down = np.maximum(-ray[:, 2], LEAST_FALL)
        there = C + ray * ((C[:, 2] - self.z_ground) / down)[:, None]
        number = np.bincount(tracks.point, minlength=count)
        near = [np.bincount(tracks.point, axis, count) / number for axis in there.T]
        return intersect(tracks.point, C, ray, count, np.column_stack(near), TOLD_APART**2 * number)

    def _plain(self, tracks: Tracks, row: NDArray[np.int64]) -> NDArray[np.complex128]:
        """(N,) places in the picture over the focal length, y up, distortion neglected but for a
        fisheye's.
        """
        K = self.base.K0[self.camera[row]]
        p = ((tracks.px[:, 0] - K[:, 1]) - 1j * (tracks.px[:, 1] - K[:, 2])) / K[:, 0]
        if (fisheye := K[:, FISHEYE] > 0).any():
            p[fisheye] *= tangent_over_angle(np.abs(p[fisheye]))
        return np.asarray(p)


def turned_px(px: Array, mine: NDArray[np.bool_], size: Array) -> Array:
    """Pixels (N, 2), those marked (N,) of pictures of a size (N, 2) turned by 180 degrees."""
    return np.where(mine[:, None], size - 1 - px, px)


def set_up(
    photos: Sequence[Photo], priors: Sequence[Prior], start: Start, *, distortion: str, repair: bool
) -> Setup:
    """Builds the arrays for all photos that the start placed."""
    members = np.array(sorted(start.placed), np.int64)
    a = np.array([start.placed[m][0] for m in members.tolist()])
    t = np.array([start.placed[m][1] for m in members.tolist()])
    yaw = -np.degrees(np.angle(a))
    if repair:
        priors = steered(photos, priors, start, dict(zip(members.tolist(), yaw, strict=True)))
    lies = np.array([_yaw_lie(priors[m], y) for m, y in zip(members.tolist(), yaw, strict=True)])
    turned = np.zeros(len(photos), bool)
    for m, lie in zip(members.tolist(), lies, strict=True):
        turned[m] = abs(abs(lie) - 180) < GROSS_DEG and photos[m].editor is not None
    keys = tuple(dict.fromkeys(photos[m].camera_key for m in members.tolist()))
    camera = np.array([keys.index(photos[m].camera_key) for m in members.tolist()])
    first = [next(m for m in members.tolist() if photos[m].camera_key == key) for key in keys]
    C0, sigma_C, stated, z_ground = _positions(members, priors, start, np.abs(a), repair)
    R0, sigma_R = _attitudes(members, priors, yaw, lies, repair, turned)
    start_C = np.column_stack([t.real, t.imag, z_ground + np.abs(a)])
    start_R = np.array(
        [
            _start_R(priors[m], y, bool(turned[m]))
            for m, y in zip(members.tolist(), yaw, strict=True)
        ]
    )
    if start.in_space:
        start_R = R0.copy()
    K0, sigma_K, free = intrinsic_priors([photos[m] for m in first], distortion)
    zooms = [photos[m].zoom or Zoom(camera=photos[m].camera_key, factor=1.0) for m in first]
    size = np.array([(p.width, p.height) for p in photos], float)
    base = Problem(
        point=np.zeros(0, np.int64),
        photo=np.zeros(0, np.int64),
        px=np.zeros((0, 2)),
        sigma_px=np.zeros(0),
        camera=camera,
        free=free,
        K0=K0,
        sigma_K=sigma_K,
        common=same_lens(zooms, K0, size[first], free),
        C0=C0,
        sigma_C=sigma_C,
        R0=R0,
        sigma_R=sigma_R,
        X0=np.zeros((0, 3)),
        sigma_X=np.zeros((0, 3)),
        last_row=np.array([photos[m].height - 1.0 for m in members.tolist()]),
        velocity=velocities([photos[m] for m in members.tolist()], start_C),
        loss_px=2.0,
        loss_C=3.0 if repair else 1e6,
        loss_R=2.0 if repair else 1e6,
    )
    return Setup(
        members=members,
        camera=camera,
        camera_keys=keys,
        turned=turned,
        size=size,
        stated_sigma_C=stated,
        block_rows=tuple(np.searchsorted(members, b) for b in start.blocks),
        z_ground=z_ground,
        base=base,
        georeferenced=bool(start.georeferenced),
        start_R=start_R,
        start_C=start_C,
        plane_a=a,
        plane_t=t,
        rewritten=tuple(
            "" if np.isfinite(priors[m].yaw_deg) else photos[m].editor or ""
            for m in members.tolist()
        ),
        in_space=start.in_space,
    )


def _yaw_lie(prior: Prior, yaw_deg: float) -> float:
    """Reported minus estimated yaw in degrees; 0 if none was reported."""
    return angle_difference_deg(prior.yaw_deg, yaw_deg) if np.isfinite(prior.yaw_deg) else 0.0


def _start_R(prior: Prior, yaw_deg: float, turned: bool) -> Array:
    """A vertical camera with the yaw from the links; for a turned file, that of the sensor."""
    R = cam_R_map_from_angles(yaw_deg)
    return HALF_TURN @ R if turned else R


def _positions(
    members: NDArray[Any], priors: Sequence[Prior], start: Start, height: Array, repair: bool
) -> tuple[Array, Array, Array, float]:
    """Measured centres, deviations used, deviations stated, and the height of the ground plane."""
    C0 = np.array([priors[m].map_C for m in members])
    stated = np.array([priors[m].sigma_C for m in members])
    sigma = stated.copy()
    ground = C0[:, 2] - height
    known = np.isfinite(ground)
    z_ground = float(np.median(ground[known])) if known.any() else 0.0
    if repair and known.any():
        scatter = 1.48 * float(np.median(np.abs(ground[known] - z_ground)))
        sigma[:, 2] = np.maximum(sigma[:, 2], scatter)
        sigma[:, :2] = np.maximum(
            sigma[:, :2], [[start.sigma_xy.get(int(m), 0.0)] for m in members]
        )
    free = ~np.isfinite(C0[:, 0])
    if free.all():  # no positions: weak priors at the start keep the block in place
        a_t = np.array(
            [[start.placed[int(m)][1].real, start.placed[int(m)][1].imag] for m in members]
        )
        C0 = np.column_stack([a_t, z_ground + height])
        sigma = stated = np.full(C0.shape, 0.1 * float(np.median(height)))
    elif not known.any():  # no heights: the same for the height
        C0[:, 2] = z_ground + height
        sigma[:, 2] = stated[:, 2] = UNKNOWN_HEIGHT * float(np.median(height))
    return (
        C0,
        np.where(np.isfinite(C0), sigma, 1.0),
        np.where(np.isfinite(C0), stated, 1.0),
        z_ground,
    )


def _attitudes(
    members: NDArray[Any],
    priors: Sequence[Prior],
    yaw: Array,
    lies: Array,
    repair: bool,
    turned: NDArray[Any],
) -> tuple[Array, Array]:
    """Prior attitudes and deviations in rad. A yaw with a gross error makes the direction of the
    tilt unusable too.
    """
    R0, sigma = [], []
    for m, y, lie in zip(members.tolist(), yaw, lies, strict=True):
        prior = priors[m]
        false = repair and abs(lie) > GROSS_DEG
        trusted = np.isfinite(prior.yaw_deg) and not false
        if trusted or turned[m]:
            R0.append(cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg))
        else:
            R0.append(cam_R_map_from_angles(y, prior.pitch_deg, prior.roll_deg))
        tilt = prior.sigma_tilt_deg
        sigma.append(
            np.radians(
                [tilt, tilt, prior.sigma_yaw_deg if trusted or turned[m] else UNKNOWN_YAW_DEG]
            )
        )
    return np.array(R0), np.array(sigma)


def intrinsic_priors(
    photos: Sequence[Photo], distortion: str
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Prior values and deviations of each camera's intrinsics, and which of them are estimated."""
    K0: list[Array] = []
    sigma: list[Array | list[float]] = []
    for photo in photos:
        wide = max(photo.width, photo.height)
        lens = photo.lens
        known = lens.vector
        if lens is photo.calibration or lens is photo.shown_lens:
            deviation = _calibrated_sigma(lens, photo.focal.sigma_px)
        else:
            lengths = [photo.focal.sigma_px, 0.01 * wide, 0.01 * wide]
            deviation = np.array([*lengths, 0.1, 0.1, 0.05, 2e-3, 2e-3, SIGMA_ASPECT, 1.0])
        K0.append(np.r_[known, photo.shutter.readout_s])
        sigma.append(np.r_[deviation, max(photo.shutter.sigma_s, 1e-9)])
    order = order_named(distortion)
    terms = (True, True, True, *order.terms, order.aspect, False)
    free = np.array([(*terms, photo.shutter.sigma_s > 0) for photo in photos])
    return np.array(K0), np.array(sigma), free


def priors_by_camera(
    photos: Sequence[Photo], distortion: str
) -> dict[str, tuple[Array, Array, NDArray[np.bool_]]]:
    """`intrinsic_priors` of each camera, by its name."""
    first = {p.camera_key: p for p in reversed(photos)}
    told = zip(*intrinsic_priors(list(first.values()), distortion), strict=True)
    return dict(zip(first, told, strict=True))


def _calibrated_sigma(camera: Camera, sigma_focal: float) -> Array:
    """Standard deviations of a known calibration: those stated by it, but at least the amount by
    which a lens changes in flight.
    """
    wide = max(camera.width, camera.height)
    usual = [sigma_focal, 0.003 * wide, 0.003 * wide, 0.01, 0.01, 0.01, 1e-3, 1e-3, SIGMA_ASPECT]
    usual += [1.0]  # the kind of lens, which is held
    least = [5e-4 * camera.focal, 5e-4 * wide, 5e-4 * wide, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 5e-4, 1.0]
    stated = np.array(camera.sigmas or usual)
    if stated[8] == 0:  # a calibration with square pixels says nothing about their shape
        stated[8] = SIGMA_ASPECT
    return np.asarray(np.maximum(stated, least))


def pose_records(setup: Setup, state: State, sigmas: Array | None = None) -> dict[int, Pose]:
    """Poses of the files (for a turned file, the pose of the sensor turned by 180 degrees);
    `sigmas` (n, 3): deviations of the centres in m.
    """
    shift = setup.base.velocity * state.K[setup.camera, READOUT, None]
    poses = {}
    for row, m in enumerate(setup.members.tolist()):
        R, moves = state.R[row], bool(shift[row].any() or state.turn[row].any())
        motion = Motion(shift_m=shift[row], turn_rad=state.turn[row]) if moves else None
        if setup.turned[m]:  # the file's first row is the sensor's last
            R = HALF_TURN @ R
            motion = motion and Motion(
                shift_m=-motion.shift_m, turn_rad=-HALF_TURN @ motion.turn_rad
            )
        sigma = None if sigmas is None else sigmas[row]
        poses[m] = Pose(cam_R_map=R, map_C=state.C[row], motion=motion, sigma_m=sigma)
    return poses


def camera_records(
    photos: Sequence[Photo], setup: Setup, state: State, deviations: Array | None
) -> tuple[dict[str, Camera], dict[int, str]]:
    """Calibrations with deviations (m, 11), and the name of each photo's calibration."""
    cameras: dict[str, Camera] = {}
    for row, key in enumerate(setup.camera_keys):
        photo = next(p for p in photos if p.camera_key == key)
        *lens, readout = (float(v) for v in state.K[row])
        sigmas = sigma_readout = None
        if deviations is not None:
            spread = deviations[row] * setup.base.free[row]
            sigmas, sigma_readout = tuple(spread[:-1].tolist()), float(spread[-1])
        cameras[key] = Camera(
            width=photo.width,
            height=photo.height,
            readout_s=readout,
            sigma_readout_s=sigma_readout,
            sigmas=sigmas,
            **dict(zip(PARAMETERS, lens, strict=True)),
        )
    camera_of = {}
    for m in setup.members.tolist():
        key = photos[m].camera_key
        camera_of[m] = key + TURNED if setup.turned[m] else key
        if setup.turned[m]:
            cameras.setdefault(camera_of[m], cameras[key].mirrored())
    return cameras, camera_of
