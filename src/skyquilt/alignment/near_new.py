"""The adjustment of photos near new ones, all photos around them held."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import Covariance, adjust, covariance
from skyquilt.alignment.bundle import ROUGHLY, Bundle, sharpened
from skyquilt.alignment.control import (
    Control,
    control_in_frame,
    placed_in,
    residuals_of_control,
    with_points,
)
from skyquilt.alignment.inputs import AlignmentInputs, GreyPicture
from skyquilt.alignment.local_adjustment import Window, held_setup, similarity_of, useful
from skyquilt.alignment.outcome import accuracy, ground_points
from skyquilt.alignment.problem import Problem, State
from skyquilt.alignment.setup import Setup, camera_records, pose_records
from skyquilt.alignment.stages import fine, prune, weighed
from skyquilt.alignment.tracks import Tracks, build_tracks, thin
from skyquilt.alignment.triangulate import triangulated
from skyquilt.geometry.neighbours import nearest
from skyquilt.model.camera import Camera
from skyquilt.model.features import Link
from skyquilt.model.poses import Accuracy, Alignment, ControlResidual, Pose, Prior, TiePoints

Array = NDArray[np.float64]
STAYS_PX = 0.1
"""A photo whose pixels would move by less than this stays where it is."""
WORSE, WORSE_PX = 2.0, 0.3
"""New photos whose residuals exceed those of the block by this factor and this many px do not fit
on it as it is.
"""
KEPT = 0.6
"""Nor do those that keep less than this share of the observations that photos around them keep."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """The block while photos are placed on it."""

    poses: dict[int, Pose]
    """Photos that stand on tie points."""
    cameras: dict[str, Camera]
    """Calibrations by name."""
    camera_of: dict[int, str]
    """Name of the calibration of each of these photos."""
    sigma_xy: float
    """Scatter of reported positions about the adjusted ones in m."""


def ground_near(ties: TiePoints, members: Sequence[int]) -> float:
    """Median height in m of the tie points that these photos show; of all where they show none."""
    mine = np.isin(ties.photo, members)
    z = ties.xyz[ties.point[mine], 2] if mine.any() else ties.xyz[:, 2]
    return float(np.median(z))


def window_of(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: Block,
    links: Sequence[Sequence[Link]],
    members: Sequence[int],
    held: frozenset[int],
) -> Window:
    """Photos with the links among them, numbered in this order."""
    where = {i: k for k, i in enumerate(members)}
    own = {(k.a, k.b): k for i in members for k in links[i] if k.a in where and k.b in where}
    placed = [i for i in members if i in block.poses]
    names = {block.camera_of[i] for i in placed}
    return Window(
        photos=[inputs.photos[i] for i in members],
        priors=[priors[i] for i in members],
        features=[inputs.features[i] for i in members],
        links=[replace(k, a=where[k.a], b=where[k.b]) for k in own.values()],
        poses={where[i]: block.poses[i] for i in placed},
        cameras={n: c for n, c in block.cameras.items() if n in names or n.split("/")[0] in names},
        camera_of={where[i]: block.camera_of[i] for i in placed},
        new=0,
        held=frozenset(where[i] for i in held),
        ground=0.0,
        sigma_xy=block.sigma_xy,
    )


def adjusted_near(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: Block,
    links: Sequence[Sequence[Link]],
    base: Alignment,
    placed: set[int],
    moving: set[int],
    bundle: Bundle,
) -> Alignment | None:
    """The earlier alignment with the moving photos adjusted, all around them held; None where the
    new ones do not fit on it.
    """
    around = {o for i in moving for k in links[i] if (o := k.other(i)) in block.poses}
    held = around - moving
    if not held:
        return None  # nothing would hold the block in place
    members = sorted(moving | held)
    window = window_of(inputs, priors, block, links, members, frozenset(held))
    known = {n: c for n, c in window.cameras.items() if n in base.cameras}
    window = replace(window, ground=ground_near(base.ties, sorted(held)), cameras=known)
    control = control_in_frame(inputs.control, window.photos, base.frame)
    setup, problem, state, tracks = _solved(inputs, window, control, members, bundle)
    full = covariance(problem, state)
    found = ground_points(tracks, setup, state)
    numbers = np.array(members)
    found = replace(found, photo=numbers[found.photo])
    if _misfit(found, base.ties, numbers[tracks.photo], placed):
        return None
    keys = None if full is None else full.camera_sigmas
    own = None if full is None else accuracy(setup, problem, state, full)
    cameras, camera_of = camera_records(window.photos, setup, state, keys)
    poses = pose_records(setup, state, _sigmas(full, base, held))
    kept = {members[k]: p for k, p in poses.items() if members[k] in moving}
    kept = {
        i: base.poses[i] if i in base.poses and _stays(base, i, p, found) else p
        for i, p in kept.items()
    }
    names = {members[k]: n for k, n in camera_of.items() if members[k] in moving}
    fresh = {n: c for n, c in cameras.items() if n in names.values() and n not in base.cameras}
    grown = [sorted({*b, *placed}) if held & set(b) else b for b in base.blocks]
    return replace(
        base,
        poses=base.poses | kept,
        cameras=base.cameras | fresh,
        camera_of=base.camera_of | names,
        blocks=tuple(tuple(b) for b in grown),
        ties=_merged(base.ties, found, moving),
        control=_checked(base, control, setup, problem, state, full),
        accuracy=_accuracy(base, own, found, moving),
    )


def _solved(
    inputs: AlignmentInputs,
    window: Window,
    control: Sequence[Control],
    members: Sequence[int],
    bundle: Bundle,
) -> tuple[Setup, Problem, State, Tracks]:
    """The adjustment of a window, and its tracks: the steps of `Bundle` from a start that is nearly
    right.
    """
    plane = {i: similarity_of(window, i) for i in window.poses}
    setup = held_setup(window, plane, window.links, distortion=bundle.distortion)
    if all(p.motion is None for p in window.poses.values()):
        setup = replace(setup, base=replace(setup.base, velocity=setup.base.velocity * 0.0))
    sizes = [(p.width, p.height) for p in window.photos]
    tracks = useful(setup.sensor_tracks(build_tracks(window.features, window.links)), window)
    each, least = bundle.per_photo, 0
    if len(inputs.photos) > bundle.many:
        each, least = bundle.per_photo // 3, ROUGHLY
        tracks = thin(tracks, sizes, per_photo=bundle.ties, least=bundle.ties // 2)
    problem, state = setup.problem(thin(tracks, sizes, per_photo=each, least=least))
    state = triangulated(problem, state)
    wide = problem.with_loss(6.0)
    state = adjust(wide, state, iterations=10, tolerance=3e-3, damping=1e-5).state
    problem, state = prune(problem, state, 12.0)
    if (method := bundle.match_observations) is not None:
        grey, keep = _Renumbered(inputs.grey, tuple(members)), inputs.keep.within("added")
        tracks = sharpened(tracks, window.photos, setup, problem, state, method, grey, keep)
        problem, _ = setup.problem(thin(tracks, sizes, per_photo=each, least=least))
        state = triangulated(problem, state)
    problem, state = weighed(*fine(problem, state), setup)
    setup = replace(setup, base=replace(setup.base, velocity=problem.velocity))
    fit = [c for c in control if not c.check and len(placed_in(c, setup)[0]) >= 2]
    if fit:
        problem, state = with_points(problem, state, setup, fit)
        state = adjust(problem, state, iterations=15, tolerance=1e-4).state
    return setup, problem, state, tracks


@dataclass(frozen=True)
class _Renumbered:
    """Grey images by the number of a photo in a window."""

    grey: GreyPicture
    members: tuple[int, ...]

    def __call__(self, photo: int, longest: int) -> NDArray[np.uint8]:
        return self.grey(self.members[photo], longest)


def _misfit(
    found: TiePoints, former: TiePoints, tracked: NDArray[np.int64], placed: set[int]
) -> bool:
    """Whether the new photos do not fit on the block as it is (another focus, or a block that is
    bent): by residuals, and by the share of their observations that were removed. `tracked`: the
    photo of each observation before.
    """
    new = np.linalg.norm(found.residual_px[np.isin(found.photo, list(placed))], axis=1)
    usual = np.linalg.norm(former.residual_px, axis=1)
    if not len(new) or not len(usual):
        return True
    count = max(int(tracked.max()), *placed) + 1
    kept = np.bincount(found.photo, minlength=count) / np.maximum(
        np.bincount(tracked, minlength=count), 1
    )
    mine = np.zeros(count, np.bool_)
    mine[list(placed)] = True
    others = np.unique(tracked[~mine[tracked]])
    lost = np.median(kept[list(placed)]) < KEPT * np.median(kept[others])
    return bool(lost or np.median(new) > WORSE * np.median(usual) + WORSE_PX)


def _sigmas(full: Covariance | None, base: Alignment, held: set[int]) -> Array | None:
    """Deviations (n, 3) of the centres in m: those against the held photos, and that of these."""
    stated = [s for i in held if (s := base.poses[i].sigma_m) is not None]
    if full is None or not stated:
        return None
    return np.asarray(np.hypot(full.photo_sigmas, np.median(stated, axis=0)))


def _stays(base: Alignment, photo: int, pose: Pose, ties: TiePoints) -> bool:
    """Whether a photo would move by so little that nobody could see it."""
    xyz = ties.xyz[ties.point[ties.photo == photo]]
    if not len(xyz):
        return True
    camera = base.camera(photo)
    before, now = (
        p.to_camera(xyz)[:, :2] / p.to_camera(xyz)[:, 2:] for p in (base.poses[photo], pose)
    )
    return float(np.abs(now - before).max()) * camera.focal < STAYS_PX


def _merged(former: TiePoints, found: TiePoints, moving: set[int]) -> TiePoints:
    """The points that no moving photo shows, and those found by the adjustment."""
    keep = ~_shown(former, moving)[former.point]
    points, renumbered = np.unique(former.point[keep], return_inverse=True)
    return TiePoints(
        xyz=np.concatenate([former.xyz[points], found.xyz]),
        point=np.concatenate([renumbered.astype(np.int64), len(points) + found.point]),
        photo=np.concatenate([former.photo[keep], found.photo]),
        px=np.concatenate([former.px[keep], found.px]),
        residual_px=np.concatenate([former.residual_px[keep], found.residual_px]),
    )


def _shown(ties: TiePoints, photos: set[int]) -> NDArray[np.bool_]:
    """(P,) whether any of these photos shows a point."""
    shown = np.zeros(len(ties.xyz), np.bool_)
    shown[ties.point[np.isin(ties.photo, list(photos))]] = True
    return shown


def _checked(
    base: Alignment,
    control: Sequence[Control],
    setup: Setup,
    problem: Problem,
    state: State,
    full: Covariance | None,
) -> tuple[ControlResidual, ...]:
    """Residuals of all control points: those in the window as it was adjusted."""
    usable = [c for c in control if len(placed_in(c, setup)[0]) >= 2]
    now = {r.name: r for r in residuals_of_control(usable, base.frame, setup, problem, state, full)}
    before = {r.name: r for r in base.control}
    seen = {
        n: now[n] if n in now and now[n].observations >= before[n].observations else before[n]
        for n in before
    }
    return tuple((seen | {n: r for n, r in now.items() if n not in seen}).values())


def _accuracy(
    base: Alignment, own: Accuracy | None, found: TiePoints, moving: set[int]
) -> Accuracy | None:
    """The predicted accuracy with that of the window's ground points (`own`), which hang on the
    block as it is there: they take the place of those that moving photos show, as many of them as
    elsewhere.
    """
    told = base.accuracy
    if told is None or own is None or not len(told.xyz):
        return told
    wanted = len(found.xyz) * len(told.xyz) / len(base.ties.xyz)
    each = max(1, round(len(own.xyz) / max(wanted, 1.0)))
    xyz = own.xyz[::each]
    _, near = nearest(told.xyz[:, :2], xyz[:, :2], min(20, len(told.xyz)))
    sigma = np.hypot(own.sigma_m[::each], np.median(told.sigma_m[near], axis=1))
    _, at = nearest(base.ties.xyz, told.xyz, 1)
    stays = ~_shown(base.ties, moving)[at[:, 0]]
    return replace(
        told,
        xyz=np.concatenate([told.xyz[stays], xyz]),
        sigma_m=np.concatenate([told.sigma_m[stays], sigma]),
    )
