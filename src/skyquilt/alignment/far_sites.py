"""Surveys of several places far from one another, which one map spans with nothing between."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.poses import Alignment
from skyquilt.photos.side_rows import sentence_of

SITES_APART_M = 300.0
"""Places are told that lie this far from each other or farther, and farther than the largest block
is long: a line that the pilot flew again does not.
"""
SITES_LISTED = 6
"""So many places are told one by one."""


def with_site_notes(found: Alignment, names: Sequence[str]) -> Alignment:
    """The alignment with these sentences among its notes."""
    notes = site_notes(found, names)
    return replace(found, notes=(*found.notes, *notes)) if notes else found


def site_notes(found: Alignment, names: Sequence[str]) -> tuple[str, ...]:
    """A sentence where photos were taken at several places with nothing between them; `names` of
    all photos.
    """
    if found.frame.crs is None or len(found.blocks) < 2:
        return ()
    blocks = [np.array([i for i in b if i in found.poses], int) for b in found.blocks]
    blocks = [b for b in blocks if len(b)]
    places = [np.array([found.poses[i].map_C[:2] for i in b.tolist()]) for b in blocks]
    far = max([SITES_APART_M, *(float(np.hypot(*np.ptp(xy, axis=0))) for xy in places)])
    sites = _joined(places, far)
    if len(sites) < 2:
        return ()
    members = sorted((np.sort(np.concatenate([blocks[b] for b in s])) for s in sites), key=len)
    xy = [np.mean([found.poses[i].map_C[:2] for i in m.tolist()], axis=0) for m in members]
    apart = max(float(np.hypot(*(a - b))) for a in xy for b in xy)
    told = [
        f"{len(m)} photo{'s' if len(m) > 1 else ''} ({sentence_of([names[i] for i in m])})"
        for m in members[-2::-1]
    ]
    rest = f" and {len(told) - SITES_LISTED} more places" if len(told) > SITES_LISTED else ""
    return (
        f"The photos were taken at {len(members)} places up to {apart / 1000:.1f} km apart, with"
        f" nothing between them: besides the {len(members[-1])} photos of the largest,"
        f" {'; '.join(told[:SITES_LISTED])}{rest}. One map spans them all, and most of it is"
        " empty. Map the photos of each place by themselves.",
    )


def _joined(places: Sequence[NDArray[np.float64]], far: float) -> list[list[int]]:
    """Blocks, by their places (n, 2) in m, in groups that lie less than `far` m from one
    another.
    """
    groups: list[list[int]] = []
    for k, own in enumerate(places):
        near = [g for g in groups if any(nearest(places[b], own, 1)[0].min() < far for b in g)]
        groups = [g for g in groups if g not in near]
        groups.append(sorted([k, *(b for g in near for b in g)]))
    return groups
