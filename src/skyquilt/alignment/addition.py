"""Photos added to an adjusted block: they are placed on it by their links, and only photos near
them are adjusted again; all others stay where they are.

What moves are the new photos and two rings of photos around them, by links; a third ring is held.
Where that is not enough, as with many new photos or some that join two blocks, the whole has to be
adjusted anew.
"""

from collections.abc import Mapping, Sequence
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
from skyquilt.alignment.local_adjustment import (
    LocalAdjustment,
    NotAdjusted,
    Window,
    held_setup,
    similarity_of,
    useful,
)
from skyquilt.alignment.oblique import OBLIQUE_DEG, hung, reported_oblique, tilt_deg
from skyquilt.alignment.outcome import accuracy, ground_points
from skyquilt.alignment.pose import reported_camera
from skyquilt.alignment.problem import Problem, State
from skyquilt.alignment.setup import Setup, camera_records, pose_records
from skyquilt.alignment.stages import fine, prune, weighed
from skyquilt.alignment.tracks import Tracks, build_tracks, thin
from skyquilt.alignment.triangulate import triangulated
from skyquilt.model.camera import Camera
from skyquilt.model.features import Link
from skyquilt.model.poses import Accuracy, Alignment, ControlResidual, Pose, Prior, TiePoints

Array = NDArray[np.float64]
RINGS = 2
"""Rings of photos around the new ones that are adjusted with them."""
MOST = 0.5
"""With a larger share of photos to adjust than this, the whole is adjusted anew."""
STAYS_PX = 0.1
"""A photo whose pixels would move by less than this stays where it is."""
NEIGHBOURS = 10
"""Placed photos that a new one is first placed by, at most."""
WORSE, WORSE_PX = 2.0, 0.3
"""New photos whose residuals exceed those of the block by this factor and this many px do not fit
on it as it is.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    """The block while photos are placed on it."""

    poses: dict[int, Pose]
    """Photos that stand on tie points."""
    cameras: dict[str, Camera]
    """Calibrations by name."""
    camera_of: dict[int, str]
    """Name of the calibration of each of these photos."""
    sigma_xy: float
    """Scatter of reported positions about the adjusted ones in m."""


def added(inputs: AlignmentInputs, bundle: Bundle) -> Alignment | None:
    """The earlier alignment of `inputs`, with the photos that it lacks placed on it; None where the
    whole has to be adjusted.

    Raises:
        ValueError: there is no earlier alignment.
    """
    former = inputs.former
    if former is None:
        raise ValueError("no earlier alignment is given")
    aside = {i for i, p in former.poses.items() if tilt_deg(p.cam_R_map) > OBLIQUE_DEG}
    oblique = frozenset(reported_oblique(inputs.priors) - former.poses.keys())
    links = _of_photos(
        [k for k in inputs.links if not {k.a, k.b} & (aside | oblique)], len(inputs.photos)
    )
    fixed = set(former.held) - aside
    new = {i for i in range(len(inputs.photos)) if i not in former.poses and i not in oblique}
    loose = set(former.poses) - set(former.held)
    waiting = {i for i in new if links[i]}
    waiting |= {i for i in loose if any(_other(k, i) in new for k in links[i])}
    if len(waiting) > MOST * max(len(fixed), 1):
        return None
    offset = median_offset(former, inputs.priors)
    priors = [replace(p, map_C=p.map_C + offset) for p in inputs.priors]
    block = _Block(
        poses={i: former.poses[i] for i in sorted(fixed)},
        cameras=dict(former.cameras),
        camera_of={i: former.camera_of[i] for i in sorted(fixed)},
        sigma_xy=_scatter(former, priors),
    )
    failed = _joined(inputs, priors, block, former.ties, links, waiting)
    placed = waiting & block.poses.keys()
    if failed is None or not _on_one_block(former, placed, links):
        return None
    base = replace(
        former,
        poses={i: p for i, p in former.poses.items() if i not in waiting},
        rejected={i: r for i, r in former.rejected.items() if i not in new} | failed,
        blocks=tuple(b for b in former.blocks if len(b) > 1 or b[0] not in waiting),
        notes=tuple(
            n for n in former.notes if not any(n.startswith(inputs.photos[i].name) for i in waiting)
        ),
    )
    if placed:
        moving = _rings(placed, links, block.poses)
        if len(moving) > MOST * len(block.poses):
            return None
        found = _adjusted(inputs, priors, block, links, base, placed, moving, bundle)
        if found is None:
            return None
        base = found
    if oblique:
        base = hung(base, inputs.photos, priors, inputs.features, inputs.links, frozenset(oblique))
    return base


def median_offset(alignment: Alignment, priors: Sequence[Prior]) -> Array:
    """(3,) offset in m from reported to adjusted positions; 0 where it is unknown."""
    apart = np.array([p.map_C - priors[i].map_C for i, p in alignment.poses.items()])
    columns = apart.reshape(-1, 3).T
    known = [c[np.isfinite(c)] for c in columns]
    return np.array([np.median(c) if len(c) else 0.0 for c in known])


def _scatter(former: Alignment, priors: Sequence[Prior]) -> float:
    """Scatter in m of reported positions about the adjusted ones, per horizontal axis."""
    apart = np.array([(former.poses[i].map_C - priors[i].map_C)[:2] for i in former.held])
    known = np.abs(apart[np.isfinite(apart).all(1)]) if len(apart) else apart
    return 1.48 * float(np.median(known)) if known.size else 0.0


def _of_photos(links: Sequence[Link], count: int) -> list[list[Link]]:
    """The links of each photo."""
    found: list[list[Link]] = [[] for _ in range(count)]
    for link in links:
        found[link.a].append(link)
        found[link.b].append(link)
    return found


def _other(link: Link, photo: int) -> int:
    return link.b if link.a == photo else link.a


def _joined(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: _Block,
    ties: TiePoints,
    links: Sequence[Sequence[Link]],
    waiting: set[int],
) -> dict[int, str] | None:
    """Places the waiting photos on the block, the best linked first. Returns those that cannot be,
    with reasons; None where some are linked with one another only, and so are a block of their own.
    """
    left, failed = set(waiting), dict[int, str]()
    place = LocalAdjustment()
    while left:
        counted = {
            i: sum(len(k.index_a) for k in links[i] if _other(k, i) in block.poses)
            for i in sorted(left)
        }
        best = max(counted, key=lambda i: counted[i])
        if not counted[best]:
            lonely = [i for i in left if not any(_other(k, i) in left for k in links[i])]
            return failed if len(lonely) == len(left) else None
        left.remove(best)
        near = sorted(
            (k for k in links[best] if _other(k, best) in block.poses),
            key=lambda k: -len(k.index_a),
        )[:NEIGHBOURS]
        members = sorted({best, *(_other(k, best) for k in near)})
        window = _window(inputs, priors, block, links, members, frozenset(members) - {best})
        at, ground = members.index(best), _ground_near(ties, members)
        done = place(replace(window, new=at, ground=ground))
        if isinstance(done, NotAdjusted):
            failed[best] = done.reason
            continue
        block.poses[best], block.camera_of[best] = done.poses[at], done.camera
        _know(block, inputs, best)
        again = {i for i in failed if any(_other(k, i) == best for k in links[i])}
        left |= again
        failed = {i: r for i, r in failed.items() if i not in again}
    return failed


def _know(block: _Block, inputs: AlignmentInputs, photo: int) -> None:
    """Enters the calibration of a photo just placed where it is new."""
    name, key = block.camera_of[photo], inputs.photos[photo].camera_key
    if name not in block.cameras:
        own = block.cameras.get(key) or reported_camera(inputs.photos[photo])
        block.cameras[name] = own if name == key else own.mirrored()


def _ground_near(ties: TiePoints, members: Sequence[int]) -> float:
    """Median height in m of the tie points that these photos show; of all where they show none."""
    mine = np.isin(ties.photo, members)
    z = ties.xyz[ties.point[mine], 2] if mine.any() else ties.xyz[:, 2]
    return float(np.median(z))


def _window(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: _Block,
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


def _on_one_block(former: Alignment, placed: set[int], links: Sequence[Sequence[Link]]) -> bool:
    """Whether the new photos touch one block only: those that join two change where these lie."""
    number = {i: n for n, b in enumerate(former.blocks) if len(b) > 1 for i in b}
    touched = {number[o] for i in placed for k in links[i] if (o := _other(k, i)) in number}
    return len(touched) <= 1


def _rings(
    placed: set[int], links: Sequence[Sequence[Link]], known: Mapping[int, Pose]
) -> set[int]:
    """These photos and rings of linked ones around them."""
    found = set(placed)
    for _ in range(RINGS):
        found |= {o for i in found for k in links[i] if (o := _other(k, i)) in known}
    return found


def _adjusted(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: _Block,
    links: Sequence[Sequence[Link]],
    base: Alignment,
    placed: set[int],
    moving: set[int],
    bundle: Bundle,
) -> Alignment | None:
    """The earlier alignment with the moving photos adjusted, all around them held; None where the
    new ones do not fit on it.
    """
    around = {o for i in moving for k in links[i] if (o := _other(k, i)) in block.poses}
    held = around - moving
    if not held:
        return None  # nothing would hold the block in place
    members = sorted(moving | held)
    window = _window(inputs, priors, block, links, members, frozenset(held))
    known = {n: c for n, c in window.cameras.items() if n in base.cameras}
    window = replace(window, ground=_ground_near(base.ties, sorted(held)), cameras=known)
    control = control_in_frame(inputs.control, window.photos, base.frame)
    setup, problem, state, tracks = _solved(inputs, window, control, members, bundle)
    full = covariance(problem, state)
    found = ground_points(tracks, setup, problem, state)
    found = replace(found, photo=np.array(members)[found.photo])
    if _misfit(found, base.ties, placed):
        return None
    keys = None if full is None else full.camera_sigmas
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
        accuracy=_accuracy(base, setup, problem, state, full, held),
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


def _misfit(found: TiePoints, former: TiePoints, placed: set[int]) -> bool:
    """Whether the new photos' residuals show that the block has to change: another focus, or a
    block that is bent.
    """
    new = np.linalg.norm(found.residual_px[np.isin(found.photo, list(placed))], axis=1)
    usual = np.linalg.norm(former.residual_px, axis=1)
    if not len(new) or not len(usual):
        return True
    return bool(np.median(new) > WORSE * np.median(usual) + WORSE_PX)


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
    touched = np.zeros(len(former.xyz), np.bool_)
    touched[former.point[np.isin(former.photo, list(moving))]] = True
    keep = ~touched[former.point]
    points, renumbered = np.unique(former.point[keep], return_inverse=True)
    return TiePoints(
        xyz=np.concatenate([former.xyz[points], found.xyz]),
        point=np.concatenate([renumbered.astype(np.int64), len(points) + found.point]),
        photo=np.concatenate([former.photo[keep], found.photo]),
        px=np.concatenate([former.px[keep], found.px]),
        residual_px=np.concatenate([former.residual_px[keep], found.residual_px]),
    )


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
    base: Alignment,
    setup: Setup,
    problem: Problem,
    state: State,
    full: Covariance | None,
    held: set[int],
) -> Accuracy | None:
    """The predicted accuracy with that of the window's ground points, which hang on the others."""
    if base.accuracy is None or full is None:
        return base.accuracy
    own = accuracy(setup, problem, state, full)
    centre = np.array([base.poses[i].map_C[:2] for i in sorted(held)]).mean(0)
    near = np.argsort(np.hypot(*(base.accuracy.xyz[:, :2] - centre).T))[:20]
    there = np.median(base.accuracy.sigma_m[near], axis=0)
    return replace(
        base.accuracy,
        xyz=np.concatenate([base.accuracy.xyz, own.xyz]),
        sigma_m=np.concatenate([base.accuracy.sigma_m, np.hypot(own.sigma_m, there)]),
    )
