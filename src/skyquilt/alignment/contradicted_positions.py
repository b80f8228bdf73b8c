"""Whether reported positions contradict the pictures as a whole, so that a map's place, scale and
direction are not reliable: `conflicts` tells of single ones.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.model.poses import Alignment, Prior

FEWEST_POSITIONS = 6
"""Photos with positions that are needed to judge them."""
CONTRADICTED_DEVIATIONS = 5.0
"""Half of the photos lie further from their positions than this times what is stated, and further
"""
CONTRADICTED_SHARE = 0.03
"""than this share of the flight's extent, where positions contradict the pictures."""
MIRRORED = 0.3
"""Positions are mirrored where their mirror image misfits by less than this share of their own
misfit.
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
            " exchanged, west is taken for east, or the pictures were mirrored. The map lies wrong;"
            " correct the positions with a geo.txt, or give control points."
        ]
    return [
        f"The reported positions contradict the pictures: half of the photos lie more than"
        f" {off:.0f} m from where they say, {usual:.2g} m are expected. Place, scale and direction"
        " of the map rest on them and are not reliable; correct the positions with a geo.txt, or"
        " give control points."
    ]


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
