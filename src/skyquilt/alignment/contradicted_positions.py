"""Whether reported positions contradict the pictures as a whole, so that a map's place, scale and
direction are not reliable: `conflicts` tells of single ones. And whether photos of one camera are
enlarged by other factors than their metadata tell.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.enlarged import heights_above_ground
from skyquilt.alignment.false_heights import height_warnings, outvoted
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.alignment.start import ground_of
from skyquilt.model.poses import Alignment, Prior

FEWEST_POSITIONS = 6
"""Photos with positions that are needed to judge them."""
CONTRADICTED_DEVIATIONS = 5.0
"""Half of the photos lie further from their positions than this times what is stated, and further
"""
CONTRADICTED_SHARE = 0.03
"""than this share of the flight's extent, where positions contradict the pictures."""
LOOSE_DEG, LOOSE_SCALE = 3.0, 0.05
"""Direction and scale that rest on positions alone are told where their deviations are larger."""
EVEN = 0.02
"""Height of the take-off point against the ground, where this is level, as a share of that of the
photos.
"""
CHANCE = -1.2816
"""Few positions may fit by chance: they are taken to err by as much as would leave less than is
seen in a tenth of cases, the quantile of the normal distribution at this place.
"""
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


def contradictions(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """All sentences of this module."""
    asked = (position_warnings, height_warnings, loose_warnings, enlargement_warnings)
    return [sentence for warnings in asked for sentence in warnings(priors, alignment)]


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


def loose_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence where positions lie so close to one another, for their errors, that they hardly
    tell the direction of the map, and no photo tells a heading; or hardly its scale, and neither do
    heights above take-off, for want of any or over uneven ground: a hover, a climb, a few photos.

    Positions err as they state, or as they are seen to at most, whichever is less.
    """
    block = max(alignment.blocks, key=len, default=())
    held = [i for i in (block if len(block) > 1 else alignment.poses) if i in alignment.poses]
    told = [i for i in held if np.isfinite(priors[i].map_C[:2]).all()]
    control = any(not c.check for c in alignment.control)
    if alignment.frame.crs is None or not told or control:
        return []
    C = np.array([alignment.poses[i].map_C for i in told])
    off = np.array([priors[i].map_C for i in told]) - C
    sigma = np.array([priors[i].sigma_C for i in told])
    if len(told) >= FEWEST_POSITIONS:
        off -= off.mean(0)
        free = 2 * len(told) - 4
        part = 2 / (9 * free)  # quantile of chi squared over its mean (Wilson and Hilferty 1931)
        chance = (1 - part + CHANCE * np.sqrt(part)) ** -1.5
        seen = chance * np.sqrt((off**2).sum(0) / (len(told) - 2))
        flat = float(np.sqrt((seen[:2] ** 2).mean()))
        sigma = np.fmin(sigma, np.maximum([flat, flat, seen[2]], 1e-3))
    reach = C - np.average(C, axis=0, weights=sigma[:, 0] ** -2)
    tells = np.nan_to_num((reach / sigma) ** 2).sum(0)
    turned = np.degrees(1 / np.sqrt(max(float(tells[:2].sum()), 1e-6)))
    scaled = 1 / np.sqrt(max(float(tells.sum()), 1e-6))
    says = []
    if turned > LOOSE_DEG and not any(np.isfinite(priors[i].yaw_deg) for i in held):
        says.append(f"be turned by {min(2 * turned, 180):.0f} degrees (no photo tells a heading)")
    because = "no height above take-off is known"
    if np.isfinite(ground_of(alignment.frame)):
        uneven, height = _relief(alignment, held)
        scaled = 1 / np.hypot(1 / scaled, height / max(uneven, EVEN * height))
        because = (
            f"the ground is uneven by {uneven:.2g} m, so heights of {height:.2g} m above take-off"
            " hardly tell heights above it"
        )
    if scaled > LOOSE_SCALE:
        says.append(f"be too large or small by {min(200 * scaled, 100):.0f} % ({because})")
    if not says:
        return []
    usual = float(np.sqrt((reach[:, :2] ** 2).sum(1).mean()))
    why = (
        f"positions lie {usual:.2g} m from their middle and err by {np.median(sigma[:, 0]):.2g} m,"
        " so they hardly tell it"
        if len(told) > 1
        else "the position of a single photo does not tell it"
    )
    return [
        f"The map may {' and '.join(says)}: {why}. Give camera angles and heights, or control"
        " points."
    ]


def _relief(alignment: Alignment, photos: Sequence[int]) -> tuple[float, float]:
    """Deviation of the heights of tie points, and the height in m of photos above them; the place
    of take-off may lie as high or low.
    """
    z = alignment.ties.xyz[:, 2]
    if not len(z):
        return 0.0, 1.0
    low, middle, high = np.quantile(z, [0.16, 0.5, 0.84])
    above = np.median([alignment.poses[i].map_C[2] for i in photos]) - middle
    return float(high - low) / 2, max(float(above), 1.0)


def enlargement_warnings(priors: Sequence[Prior], alignment: Alignment) -> list[str]:
    """A sentence for each camera whose photos show the ground at scales that their reported heights
    do not explain: a digital zoom or a crop looks like a lower flight, but relief does not.

    Heights that drift have no gaps, and an offset of all heights is none. Where some heights were
    found to be false and told, they explain it.
    """
    if alignment.frame.crs is None or not len(alignment.ties.xyz) or outvoted(alignment):
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
