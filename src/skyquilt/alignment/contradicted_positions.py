"""Whether reported positions contradict the pictures as a whole, so that a map's place, scale and
direction are not reliable: `conflicts` tells of single ones. And whether photos of one camera are
enlarged by other factors than their metadata tell.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.enlarged import heights_above_ground
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.model.poses import Alignment, Prior

FEWEST_POSITIONS = 6
"""Photos with positions that are needed to judge them."""
CONTRADICTED_DEVIATIONS = 5.0
"""Half of the photos lie further from their positions than this times what is stated, and further
"""
CONTRADICTED_SHARE = 0.03
"""than this share of the flight's extent, where positions contradict the pictures."""
LOOSE_DEG = 3.0
"""A direction that rests on positions alone is told where its deviation is larger than this."""
MIRRORED = 0.3
"""Positions are mirrored where their mirror image misfits by less than this share of their own
misfit.
"""
ENLARGED = 1.1
"""Photos of one camera are enlarged differently where their heights by image scale, over those that
they report, fall into groups at least this factor apart,
"""
FEWEST_ENLARGED = 3
"""each of at least so many photos: a single false height is told by `conflicts`."""
ALIKE = 0.1
"""Compared are photos that report the same height within this share of it: between others, a false
focal length alone makes such factors.
"""


def position_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence where the positions of photos that are connected by tie points contradict them.

    An offset of all is none: the receiver's own, or one that control points corrected.
    """
    held = [i for i in alignment.held if np.isfinite(priors[i].map_C[:2]).all()]
    if alignment.frame.crs is None or len(held) < FEWEST_POSITIONS:
        return []
    found = _plane([alignment.poses[i].map_C for i in held])
    told = _plane([priors[i].map_C for i in held])
    sigma = np.array([priors[i].sigma_C[0] for i in held])
    off = float(np.median(np.abs(told - found - _middle(told - found))))
    extent = float(2 * np.median(np.abs(told - _middle(told))))
    usual = float(np.median(sigma))
    if off <= max(CONTRADICTED_DEVIATIONS * usual, CONTRADICTED_SHARE * extent):
        return []
    if _mirrored(found, told, sigma):
        return [
            "The reported positions are mirrored against the pictures: latitude and longitude are"
            " exchanged, west is taken for east, their list has another order, or the pictures"
            " were mirrored. The map lies wrong; correct the positions with a geo.txt, or give"
            " control points."
        ]
    return [
        f"The reported positions contradict the pictures: half of the photos lie more than"
        f" {off:.0f} m from where they say, {usual:.2g} m are expected. Place, scale and direction"
        " of the map rest on them and are not reliable; correct the positions with a geo.txt, or"
        " give control points."
    ]


def direction_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence where no photo tells a heading and positions lie so close to one another, for
    their errors, that they hardly tell the direction of the map: a hover, a climb, a few photos.

    Positions err as they state, or as they are seen to, whichever is less.
    """
    held = [i for i in max(alignment.blocks, key=len, default=()) if i in alignment.poses]
    told = [i for i in held if np.isfinite(priors[i].map_C[:2]).all()]
    headed = any(np.isfinite(priors[i].yaw_deg) for i in held)
    control = any(not c.check for c in alignment.control)
    if alignment.frame.crs is None or len(told) < 2 or headed or control:
        return []
    placed, stated = (
        _plane([p.map_C for p in some])
        for some in ([alignment.poses[i] for i in told], [priors[i] for i in told])
    )
    sigma = np.array([priors[i].sigma_C[0] for i in told])
    off = stated - placed - np.mean(stated - placed)
    if len(told) >= FEWEST_POSITIONS:
        seen = float(np.sqrt((np.abs(off) ** 2).sum() / (2 * len(told) - 4)))
        sigma = np.minimum(sigma, max(seen, 1e-3))
    reach = np.abs(placed - np.average(placed, weights=sigma**-2))
    tells = float(((reach / sigma) ** 2).sum())
    deviation = float(np.degrees(1 / np.sqrt(tells))) if tells > 0 else 180.0
    if deviation <= LOOSE_DEG:
        return []
    usual = float(np.sqrt(np.mean(reach**2)))
    return [
        f"The direction of the map is uncertain: it may be turned by {min(2 * deviation, 180):.0f}"
        f" degrees. No photo reports a heading, and positions that lie {usual:.2g} m from their"
        f" middle and err by {np.median(sigma):.2g} m hardly tell it. Give camera angles or control"
        " points."
    ]


def enlargement_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence for each camera whose photos show the ground at scales that their reported heights
    do not explain: a digital zoom or a crop looks like a lower flight, but relief does not.

    Heights that drift have no gaps, and an offset of all heights is none.
    """
    if alignment.frame.crs is None or not len(alignment.ties.xyz):
        return []
    found, told = heights_above_ground(alignment, priors)
    out = list[str]()
    for key in dict.fromkeys(alignment.camera_of[i] for i in told):
        pairs = [(found[i], z) for i, z in told.items() if alignment.camera_of[i] == key]
        usual = float(np.median([r for _, r in pairs]))
        ratio = np.sort([h / r for h, r in pairs if h > 0 and abs(r - usual) < ALIKE * usual])
        near, gap = ratio[FEWEST_ENLARGED - 1 : 1 - FEWEST_ENLARGED], 0.0
        if len(near) > 1:
            steps = near[1:] / near[:-1]
            at, gap = int(np.argmax(steps)), float(steps.max())
        if gap >= ENLARGED:
            first = at + FEWEST_ENLARGED
            factor = float(np.median(ratio[first:]) / np.median(ratio[:first]))
            out.append(
                f"{first} of {len(ratio)} photos of {key} show the ground {factor:.2f} times as"
                " large as the others, and their reported heights do not tell why: a digital zoom"
                " or a crop that their metadata do not state, or heights that are wrong. A zoom"
                " bends the map where the ground is not level; write it into the photos (EXIF"
                " DigitalZoomRatio), or map the photos of each zoom by themselves."
            )
    return out


def _mirrored(
    found: NDArray[np.complex128], told: NDArray[np.complex128], sigma: NDArray[np.float64]
) -> bool:
    """Whether the mirror image of the positions fits far better. Positions in a line are their own
    mirror image.
    """
    straight, turned = (fit_similarity(x, told, sigma)[2] for x in (found, np.conj(found)))
    return turned < MIRRORED * straight


def _plane(places: Sequence[NDArray[np.float64]]) -> NDArray[np.complex128]:
    return np.array([complex(C[0], C[1]) for C in places])


def _middle(places: NDArray[np.complex128]) -> complex:
    return complex(np.median(places.real), np.median(places.imag))
