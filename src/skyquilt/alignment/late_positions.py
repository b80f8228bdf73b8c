"""Positions that belong to the photo before or after: a logger that is one photo late, or a list
of positions in which one line is missing or too many.

Along a line such positions look right, and where a drone turns they do not; so they bend and shrink
a map that they hold in place.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.model.poses import Alignment, Prior

FEWEST = 10
"""Photos of a camera with positions that tell whether these are late."""
CLEARER = 0.6
"""Moved by a photo, positions misfit by less than this share of what they misfit by before, ..."""
OFF = 1.5
"""... which is more than this times their deviations."""


def unshifted(found: Alignment, priors: Sequence[Prior], cameras: Sequence[str]) -> Sequence[Prior]:
    """The priors with positions of each camera's photos moved to the photo before or after, in
    order of capture, where they then fit the pictures far better; photos for which none is left
    have none. `cameras`: that of each photo. The very same priors where none is moved.
    """
    out = list(priors)
    for camera in dict.fromkeys(cameras):
        own = [i for i, c in enumerate(cameras) if c == camera]
        now = _misfit(found, priors, own, 0)
        sigma = [priors[i].sigma_C[0] for i in own if np.isfinite(priors[i].map_C[0])]
        if now is None or not now > OFF * float(np.median(sigma)):
            continue
        for late in (1, -1):
            moved = _misfit(found, priors, own, late)
            if moved is not None and moved < CLEARER * now:
                for k, i in enumerate(own):
                    inside = 0 <= k + late < len(own)
                    out[i] = _at(priors[i], priors[own[k + late]] if inside else None)
    return out if any(a is not b for a, b in zip(out, priors, strict=True)) else priors


def moved_note(before: Sequence[Prior], after: Sequence[Prior]) -> str:
    """What is said of priors whose positions were moved."""
    number = sum(a is not b for a, b in zip(after, before, strict=True))
    return (
        f"The positions of {number} photos belong to the photo before or after each: the pictures"
        " show it. They were moved by one photo. Check the list or the logger that they come from."
    )


def _misfit(
    found: Alignment, priors: Sequence[Prior], own: Sequence[int], late: int
) -> float | None:
    """Median distance in m between photos as placed, brought to their positions by a similarity,
    and the positions of the photos `late` places after them; None where too few have both.
    """
    pairs = [
        (i, j)
        for i, j in zip(own[max(0, -late) :], own[max(0, late) :], strict=False)
        if i in found.poses and np.isfinite(priors[j].map_C[:2]).all()
    ]
    if len(pairs) < FEWEST:
        return None
    placed = _plane([found.poses[i].map_C for i, _ in pairs])
    told = _plane([priors[j].map_C for _, j in pairs])
    sigma = np.array([priors[j].sigma_C[0] for _, j in pairs])
    return fit_similarity(placed, told, sigma)[2]


def _at(prior: Prior, other: Prior | None) -> Prior:
    """A prior with the position of another one, or without any."""
    if other is None:
        return replace(prior, map_C=np.full(3, np.nan))
    return replace(prior, map_C=other.map_C, sigma_C=other.sigma_C)


def _plane(places: Sequence[NDArray[np.float64]]) -> NDArray[np.complex128]:
    return np.array([complex(C[0], C[1]) for C in places])
