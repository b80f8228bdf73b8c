"""`bundle`: similarity graph -> adjustment with self-calibration and priors -> ground points."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import Covariance, adjust, covariance
from skyquilt.alignment.control import Control, hold_to_control, residuals_of_control
from skyquilt.alignment.deviations import believed, observed_noise, point_deviations, robust_scale
from skyquilt.alignment.dominant_plane import levelled
from skyquilt.alignment.least_squares_matching import GreyPicture, LeastSquaresMatching
from skyquilt.alignment.oblique import found_oblique, hung, reported_oblique, tilts_reported
from skyquilt.alignment.problem import READOUT, Problem, State, residuals_px, swept
from skyquilt.alignment.robust import robust_cost
from skyquilt.alignment.setup import Setup, camera_records, pose_records, set_up
from skyquilt.alignment.start import Start, find_start
from skyquilt.alignment.tracks import Tracks, build_tracks, thin
from skyquilt.alignment.triangulate import polish, triangulated
from skyquilt.errors import AlignmentError
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Accuracy, Alignment, MapFrame, Prior, TiePoints

Array = NDArray[np.float64]


ROLLS_PX = 0.3
"""Cameras that move by more than this in px of the photo while a photo is read out turn, too."""
TURN_RAD_S = np.radians(1.5)
"""Deviation of the rates at which they turn, in rad/s; it makes up for errors of velocities too."""
SAMPLED = 400
"""Ground points whose accuracy is predicted, about."""
UNDETERMINED = 0.7
"""A focal length whose deviation stays above this share of its prior's is not determined."""
DOUBTED = 2.5
"""Positions that a block misses by more than this many deviations are not what they claim."""


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """Bundle adjustment of all linked photos at once."""

    distortion: str = "full"
    """What self-calibration may change of the lens: distortion `none`, `2`, `4`, `6` (radial
    order), `6t` (and tangential) or `full` (and the aspect ratio).
    """
    per_photo: int = 400
    """Observations per photo in the adjustment; all other tie points are triangulated
    afterwards.
    """
    repair: bool = True
    """Whether metadata may contain gross errors. False = they are weighted by their stated
    deviations.
    """
    match_observations: LeastSquaresMatching | None = field(default_factory=LeastSquaresMatching)
    """Refinement of observations in larger images; None leaves keypoints unchanged."""
    version: ClassVar[int] = 19

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        links: Sequence[Link],
        control: Sequence[Control] = (),
        grey: GreyPicture | None = None,
    ) -> Alignment:
        """Aligns the photos that are connected by links; `grey` gives images for the refinement of
        observations.

        Raises:
            AlignmentError: no two photos are linked.
        """
        aside = reported_oblique(priors) if self.repair else frozenset[int]()

        def block(aside: frozenset[int]) -> Alignment:
            upright = [k for k in links if k.a not in aside and k.b not in aside]
            return self._block(photos, frame, priors, features, upright, control, grey)

        try:
            found = block(aside)
        except AlignmentError:
            aside, found = frozenset(), block(frozenset())
        if self.repair and (more := found_oblique(found, priors) - aside):
            aside |= more
            found = block(aside)
        return hung(found, photos, priors, features, links, aside)

    def _block(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        links: Sequence[Link],
        control: Sequence[Control],
        grey: GreyPicture | None,
    ) -> Alignment:
        """Adjusts the photos that these links connect."""
        start = find_start(photos, priors, features, links)
        if not start.blocks:
            raise AlignmentError(f"none of {len(photos)} photos could be linked to another one")
        tracks = build_tracks(features, start.links)
        setup = set_up(photos, priors, start, distortion=self.distortion, repair=self.repair)
        sizes = [(p.width, p.height) for p in photos]
        used = setup.sensor_tracks(tracks)
        problem, state = setup.problem(thin(used, sizes, per_photo=self.per_photo))
        problem, state = _rough(problem, state)
        setup = setup.moving_as(photos, state.C)
        problem = replace(problem, velocity=setup.base.velocity)
        if grey is not None and self.match_observations is not None:
            used = _sharpened(used, photos, setup, problem, state, self.match_observations, grey)
            problem, _ = setup.problem(thin(used, sizes, per_photo=self.per_photo))
            state = triangulated(problem, state)
        problem, state = _fine(problem, state)
        setup = setup.moving_as(photos, state.C)
        problem = replace(problem, velocity=setup.base.velocity)
        problem, state = _weighed(problem, state, setup)
        setup = replace(setup, base=replace(setup.base, velocity=problem.velocity))
        if self.repair:
            problem, state = _believe_positions(problem, state, setup)
        problem, state, frame, reports = hold_to_control(problem, state, frame, setup, control)
        done = _outcome(photos, frame, setup, start, used, problem, state, reports)
        held = setup.georeferenced or any(not c.check for c in reports)
        return done if held or tilts_reported(priors) else levelled(done)


def _sharpened(
    tracks: Tracks,
    photos: Sequence[Photo],
    setup: Setup,
    problem: Problem,
    state: State,
    match_observations: LeastSquaresMatching,
    grey: GreyPicture,
) -> Tracks:
    """Tracks (sensor pixels) with observations refined in larger images."""
    everything, _ = setup.problem(tracks)
    xyz = triangulated(everything, state).X
    cameras, camera_of = camera_records(photos, setup, state, None)
    poses = pose_records(setup, state)
    filed = replace(tracks, px=setup.file_px(tracks.photo, tracks.px))
    sharp = match_observations(
        filed, xyz, poses, {i: cameras[k] for i, k in camera_of.items()}, grey
    )
    return replace(sharp, px=setup.file_px(sharp.photo, sharp.px))


def _rough(problem: Problem, state: State) -> tuple[Problem, State]:
    """First stage: intrinsics fixed under a wide loss, then all free under a narrower one; outliers
    are removed in between.
    """
    fixed = replace(problem, free=np.zeros_like(problem.free), loss_px=20.0)
    state = adjust(fixed, state, iterations=10, tolerance=3e-2).state
    problem, state = prune(problem, state, 40.0)
    state = adjust(problem.with_loss(6.0), state, iterations=20, tolerance=3e-3, damping=1e-5).state
    return prune(problem, state, 12.0)


def _fine(problem: Problem, state: State) -> tuple[Problem, State]:
    """Second stage: all unknowns free under ever narrower losses; outliers are removed in
    between.
    """
    problem, state = prune(problem, state, 20.0)
    state = adjust(problem.with_loss(2.5), state, iterations=20, tolerance=2e-3, damping=1e-6).state
    problem, state = prune(problem, state, 5.0)
    return problem, adjust(
        problem.with_loss(2.0), state, iterations=15, tolerance=3e-4, damping=1e-6
    ).state


def _weighed(problem: Problem, state: State, setup: Setup) -> tuple[Problem, State]:
    """The adjustment repeated with observations as sharp as their residuals show them to be, and
    with the weight that those are worth; with turns of the cameras where rows were exposed one
    after the other.
    """
    reach = np.linalg.norm(swept(problem, state), axis=1) / _heights(state)
    rolls = bool((reach * state.K[problem.camera, 0] > ROLLS_PX).any())
    if rolls:
        readout = np.abs(state.K[problem.camera, READOUT])
        problem = replace(problem, sigma_turn=np.maximum(TURN_RAD_S * readout, 1e-9))
        state = adjust(problem, state, iterations=15, tolerance=1e-3, damping=1e-6).state
    for _ in range(2):
        scale = robust_scale(problem, state)
        problem = replace(problem, sigma_px=problem.sigma_px * scale)
        noise = observed_noise(problem.with_loss(2.0), state, setup.size[setup.members])
        problem = believed(problem.with_loss(2.0), noise)
        state = adjust(problem, state, iterations=15, tolerance=3e-4, damping=1e-6).state
    return _standing(problem, state) if rolls else (problem, state)


def _standing(problem: Problem, state: State) -> tuple[Problem, State]:
    """The adjustment as if cameras stood still while they expose, where that explains the photos
    better: drones that stop for each photo have positions and times as if they flew on.
    """
    still = problem.velocity * 0.0
    free = problem.free.copy()
    free[:, READOUT] = False
    other = replace(problem, velocity=still, free=free)
    K = state.K.copy()
    K[:, READOUT] = problem.K0[:, READOUT]
    begin = replace(state, K=K, turn=np.zeros_like(state.turn))
    stood = adjust(other, begin, iterations=10, tolerance=1e-3, damping=1e-6)
    if stood.cost < robust_cost(problem, state):
        return other, stood.state
    return problem, state


def _heights(state: State) -> Array:
    """Heights (n,) in m of the cameras above the points."""
    return np.maximum(state.C[:, 2] - np.median(state.X[:, 2]), 1.0)


def prune(problem: Problem, state: State, limit: float) -> tuple[Problem, State]:
    """Removes observations with residuals above `limit` deviations and points left with one
    observation; control points are kept.
    """
    error = np.linalg.norm(residuals_px(problem, state), axis=1) / problem.sigma_px
    pinned = np.asarray(np.isfinite(problem.X0).any(1))
    good = (error < limit) | pinned[problem.point]
    enough = np.bincount(problem.point[good], minlength=len(state.X)) >= 2
    good &= enough[problem.point] | pinned[problem.point]
    thinner, points = problem.only(good)
    return thinner, replace(state, X=state.X[points])


def _believe_positions(problem: Problem, state: State, setup: Setup) -> tuple[Problem, State]:
    """Positions believed as far as the photos confirm them.

    The start gave them deviations as wide as their scatter about it, which is coarse. Here they get
    those that they state, or their scatter between neighbours where that is larger. Only
    differences from photo to photo count: a smooth misfit may be a deformation of the block, and
    positions with less weight would permit it. Where a block then still misses its positions by
    more than these deviations allow, they are not what they claim (a drifting barometer, a plain
    GPS that states centimetres), and what the start gave stays.
    """
    started = problem.sigma_C
    doubted = np.zeros(started.shape, bool)
    for _ in range(3):
        error = state.C - problem.C0
        sigma = started.copy()
        for block in setup.block_rows:
            for axes in (slice(0, 2), slice(2, 3)):
                stated = setup.stated_sigma_C[block][:, axes]
                wanted = np.maximum(stated, position_noise(error[block][:, axes]))
                trusted = ~doubted[block][:, axes]
                sigma[block, axes] = np.where(trusted, wanted, sigma[block, axes])
        if np.allclose(sigma, problem.sigma_C, rtol=0.15, equal_nan=True):
            break
        problem = replace(problem, sigma_C=sigma)
        state = adjust(problem.with_loss(2.0), state, iterations=10, tolerance=1e-4).state
        misfit = np.abs(state.C - problem.C0) / problem.sigma_C
        for block in setup.block_rows:
            for axes in (slice(0, 2), slice(2, 3)):
                known = misfit[block][:, axes][np.isfinite(misfit[block][:, axes])]
                if len(known) and 1.48 * np.median(known) > DOUBTED:
                    doubted[block, axes] = True
    return problem, state


def position_noise(error: Array) -> float:
    """Robust deviation in m of each axis of position errors (n, 2), in order of capture, from
    their neighbours' mean.
    """
    known = error[np.isfinite(error).all(1)]
    if len(known) < 6:
        return 0.0
    local = known[1:-1] - (known[:-2] + known[2:]) / 2
    return float(1.48 * np.median(np.abs(local)) / np.sqrt(1.5))


def leave_one_out(
    problem: Problem, state: State, covariance: Covariance | None
) -> tuple[float, float, float] | None:
    """RMS per axis in m of the difference between each measured position and its prediction from
    all other observations.

    Computed from the covariance of the full solution (the usual identity of linear least squares)
    instead of n adjustments.
    """
    known = np.flatnonzero(np.isfinite(problem.C0[:, :2]).all(1))
    if covariance is None or len(known) < 3:
        return None
    out = []
    for i in known:
        axes = np.isfinite(problem.C0[i])
        e = (state.C[i] - problem.C0[i])[axes]
        white = e / problem.sigma_C[i][axes]
        precision = np.diag(1 / problem.sigma_C[i][axes] ** 2) / np.sqrt(
            1 + (white @ white) / problem.loss_C**2
        )
        own = covariance.photos[i, 3:6, 3:6][np.ix_(axes, axes)]
        full = np.full(3, np.nan)
        full[axes] = np.linalg.solve(np.eye(len(e)) - own @ precision, e)
        out.append(full)
    rms = np.sqrt(np.nanmean(np.array(out) ** 2, axis=0)) if out else np.full(3, np.nan)
    return float(rms[0]), float(rms[1]), float(rms[2])


def ground_points(tracks: Tracks, setup: Setup, problem: Problem, state: State) -> TiePoints:
    """All tracks triangulated with the final poses; outliers and unstable points are removed."""
    everything, _ = setup.problem(tracks)
    everything = replace(everything, loss_px=2.0)
    whole = triangulated(everything, state)
    whole, _ = polish(everything, whole, iterations=3)
    everything, whole = prune(everything, whole, 5.0)
    whole, sigma_z = polish(everything, whole, iterations=2)
    height = float(np.median(state.C[:, 2]) - np.median(whole.X[:, 2]))
    keep = (sigma_z < 0.05 * abs(height))[everything.point]
    points, renumbered = np.unique(everything.point[keep], return_inverse=True)
    photo = setup.members[everything.photo[keep]]
    return TiePoints(
        xyz=whole.X[points],
        point=renumbered.astype(np.int64),
        photo=photo,
        px=setup.file_px(photo, everything.px[keep]),
        residual_px=residuals_px(everything, whole)[keep] * setup.file_sign(photo),
    )


def _outcome(
    photos: Sequence[Photo],
    frame: MapFrame,
    setup: Setup,
    start: Start,
    tracks: Tracks,
    problem: Problem,
    state: State,
    control: Sequence[Control],
) -> Alignment:
    ties = ground_points(tracks, setup, problem, state)
    seen = np.bincount(ties.photo, minlength=len(photos))
    weak = {int(i): f"it has only {seen[i]} tie points" for i in setup.members if seen[i] < 8}
    full = covariance(problem, state)
    cameras, camera_of = camera_records(
        photos, setup, state, None if full is None else full.camera_sigmas
    )
    placed = pose_records(setup, state, None if full is None else full.photo_sigmas)
    poses = {i: p for i, p in placed.items() if i not in weak}
    blocks = tuple(tuple(i for i in b if i not in weak) for b in start.blocks)
    metric = frame.metric and (start.metric or any(not c.check for c in control))
    return Alignment(
        method="bundle",
        why="",
        frame=replace(frame, metric=metric),
        poses=poses,
        cameras=cameras,
        camera_of=camera_of,
        blocks=tuple(b for b in blocks if b),
        ties=ties,
        rejected=weak,
        control=residuals_of_control(control, frame, setup, problem, state, full),
        accuracy=None if full is None else _accuracy(setup, problem, state, full),
        notes=_undetermined(setup, problem, state, full),
        loo_rms_m=leave_one_out(problem, state, full) if setup.georeferenced else None,
    )


def _accuracy(setup: Setup, problem: Problem, state: State, covariance: Covariance) -> Accuracy:
    """Predicted deviations of a sample of ground points."""
    seen = np.flatnonzero(np.bincount(problem.point, minlength=len(state.X)) >= 2)
    sample = seen[:: max(1, len(seen) // SAMPLED)]
    tied = bool(np.isfinite(problem.X0).any())
    stated = np.median(setup.stated_sigma_C, axis=0)
    return Accuracy(
        xyz=state.X[sample],
        sigma_m=point_deviations(problem, state, covariance, sample),
        shared_m=(0.0, 0.0) if tied else (float(stated[0]), float(stated[2])),
        focal_share=_focal_share(problem, covariance),
        design_effect=problem.design_effect,
    )


def _focal_share(problem: Problem, covariance: Covariance) -> float:
    """Largest ratio of a focal length's deviation after the adjustment to that before."""
    after = covariance.camera_sigmas[:, 0]
    return float(np.max(np.where(problem.free[:, 0], after / problem.sigma_K[:, 0], 0.0)))


def _undetermined(
    setup: Setup, problem: Problem, state: State, covariance: Covariance | None
) -> tuple[str, ...]:
    """Sentences about what the flight does not determine."""
    if covariance is None:
        return ()
    notes = []
    height = float(np.median(_heights(state)))
    after = covariance.camera_sigmas[:, 0]
    for row, key in enumerate(setup.camera_keys):
        share = float(after[row] / state.K[row, 0])
        told = float(problem.sigma_K[row, 0] / state.K[row, 0])
        if problem.free[row, 0] and share > UNDETERMINED * told and share * height > 0.01:
            notes.append(
                f"This flight does not determine the focal length of {key}: it stays as uncertain"
                f" as its metadata ({100 * share:.1f} %), and heights of the ground with it"
                f" ({share * height:.2g} m, one standard deviation); control points, oblique photos"
                " or lines at two heights would."
            )
    return tuple(notes)
