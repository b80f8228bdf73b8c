"""Photos added to an adjusted block: they are placed on it by their links, and only photos near
them are adjusted again; all others stay where they are.

What moves are the new photos and two rings of photos around them, by links; a third ring is held.
Where that is not enough, as with many new photos or some that join two blocks, the whole has to be
adjusted anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment import enlarged, stabilised
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.determined import weak_photos
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.local_adjustment import LocalAdjustment, NotAdjusted
from skyquilt.alignment.near_new import Block, adjusted_near, ground_near, window_of
from skyquilt.alignment.oblique import OBLIQUE_DEG, hung, reported_oblique, tilt_deg
from skyquilt.model.features import Link
from skyquilt.model.poses import Alignment, Pose, Prior, TiePoints

Array = NDArray[np.float64]
RINGS = 2
"""Rings of photos around the new ones that are adjusted with them."""
MOST = 0.5
"""With a larger share of photos to adjust than this, the whole is adjusted anew."""
NEIGHBOURS = 10
"""Placed photos that a new one is first placed by, at most."""


def added(inputs: AlignmentInputs, bundle: Bundle) -> Alignment | None:
    """The earlier alignment of `inputs`, with the photos that it lacks placed on it; None where the
    whole has to be adjusted.

    Raises:
        ValueError: there is no earlier alignment.
    """
    former = inputs.former
    if former is None:
        raise ValueError("no earlier alignment is given")
    marks = enlarged.NAMED, stabilised.NAMED
    if any(mark in name for name in former.camera_of.values() for mark in marks):
        return None  # whether new photos are so, too, the whole tells
    aside = {i for i, p in former.poses.items() if tilt_deg(p.cam_R_map) > OBLIQUE_DEG}
    oblique = frozenset(reported_oblique(inputs.priors) - former.poses.keys())
    links = _of_photos(
        [k for k in inputs.links if not {k.a, k.b} & (aside | oblique)], len(inputs.photos)
    )
    fixed = set(former.held) - aside
    new = {i for i in range(len(inputs.photos)) if i not in former.poses and i not in oblique}
    loose = set(former.poses) - set(former.held)
    waiting = {i for i in new if links[i]}
    waiting |= {i for i in loose if any(k.other(i) in new for k in links[i])}
    if len(waiting) > MOST * max(len(fixed), 1):
        return None
    offset = median_offset(former, inputs.priors)
    priors = [replace(p, map_C=p.map_C + offset) for p in inputs.priors]
    block = Block(
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
        found = adjusted_near(inputs, priors, block, links, base, placed, moving, bundle)
        if found is None:
            return None
        base = found
    if oblique:
        weak, away = weak_photos(base, priors), frozenset(oblique)
        base = hung(base, weak, inputs.photos, priors, inputs.features, inputs.links, away)
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


def _joined(
    inputs: AlignmentInputs,
    priors: Sequence[Prior],
    block: Block,
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
            i: sum(len(k.index_a) for k in links[i] if k.other(i) in block.poses)
            for i in sorted(left)
        }
        best = max(counted, key=lambda i: counted[i])
        if not counted[best]:
            lonely = [i for i in left if not any(k.other(i) in left for k in links[i])]
            return failed if len(lonely) == len(left) else None
        left.remove(best)
        near = sorted(
            (k for k in links[best] if k.other(best) in block.poses), key=lambda k: -len(k.index_a)
        )[:NEIGHBOURS]
        members = sorted({best, *(k.other(best) for k in near)})
        window = window_of(inputs, priors, block, links, members, frozenset(members) - {best})
        at, ground = members.index(best), ground_near(ties, members)
        done = place(replace(window, new=at, ground=ground))
        if isinstance(done, NotAdjusted):
            failed[best] = done.reason
            continue
        block.poses[best], block.camera_of[best] = done.poses[at], done.camera
        _know(block, inputs, best)
        again = {i for i in failed if any(k.other(i) == best for k in links[i])}
        left |= again
        failed = {i: r for i, r in failed.items() if i not in again}
    return failed


def _know(block: Block, inputs: AlignmentInputs, photo: int) -> None:
    """Enters the calibration of a photo just placed where it is new."""
    name, key = block.camera_of[photo], inputs.photos[photo].camera_key
    if name not in block.cameras:
        own = block.cameras.get(key) or inputs.photos[photo].lens
        block.cameras[name] = own if name == key else own.mirrored()


def _on_one_block(former: Alignment, placed: set[int], links: Sequence[Sequence[Link]]) -> bool:
    """Whether the new photos touch one block only: those that join two change where these lie."""
    number = {i: n for n, b in enumerate(former.blocks) if len(b) > 1 for i in b}
    touched = {number[o] for i in placed for k in links[i] if (o := k.other(i)) in number}
    return len(touched) <= 1


def _rings(
    placed: set[int], links: Sequence[Sequence[Link]], known: Mapping[int, Pose]
) -> set[int]:
    """These photos and rings of linked ones around them."""
    found = set(placed)
    for _ in range(RINGS):
        found |= {o for i in found for k in links[i] if (o := k.other(i)) in known}
    return found
