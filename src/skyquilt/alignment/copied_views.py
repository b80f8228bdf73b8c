"""Pictures without metadata that repeat the view of a photo that has them: copies from a chat,
screenshots, photographs of a screen.

They link as well as the photo does, and what is around the photo in them would be drawn, too.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.oblique import without_photos
from skyquilt.geometry.camera import shown
from skyquilt.model.poses import Alignment

SAME_PLACE = 0.03
"""Share of the flying height within which two pictures were taken from one place."""
CELLS, FEWEST = 6, 6
"""A picture is divided into so many cells each way, and judged by those into which at least so many
tie points fall.
"""
ELSE = 0.3
"""A picture without metadata shows something else if in more than this share of its cells it shows
none of the points that photos show there.
"""


def without_copied_views(
    found: Alignment, names: Sequence[str], told: Collection[int], bare: Collection[int]
) -> Alignment:
    """The alignment without pictures of that kind, each with its reason. `told`: photos that report
    their position; `bare`: pictures without any metadata.
    """
    told = [i for i in found.held if i in told]
    bare = [i for i in found.held if i in bare]
    if not told or not bare or not len(found.ties.xyz):
        return found
    reasons = {i: _copied(found, i, told, names) or _else(found, i) for i in bare}
    return without_photos(found, {i: why for i, why in reasons.items() if why})


def _copied(found: Alignment, i: int, told: Sequence[int], names: Sequence[str]) -> str:
    """Why a picture is a copy of one of the photos `told`; empty if it is none."""
    places = np.array([found.poses[j].map_C for j in told])
    height = float(np.median(places[:, 2]) - np.median(found.ties.xyz[:, 2]))
    away = np.linalg.norm(places[:, :2] - found.poses[i].map_C[:2], axis=1)
    nearest = int(np.argmin(away))
    if not away[nearest] < SAME_PLACE * height:
        return ""
    return (
        f"it has no metadata and shows the view of {names[told[nearest]]}: it is a copy, or a"
        " picture of a screen"
    )


def _else(found: Alignment, i: int) -> str:
    """Why a picture shows something else than the ground in large parts; empty if it does not."""
    camera, ties = found.camera(i), found.ties
    px, inside = shown(camera, found.poses[i].to_camera(ties.xyz))
    size = np.array([camera.width, camera.height])
    there = np.bincount(_cells(px[inside], size), minlength=CELLS**2)
    own = np.bincount(_cells(ties.px[ties.photo == i], size), minlength=CELLS**2)
    judged = there >= FEWEST
    share = float((own[judged] == 0).mean()) if judged.any() else 0.0
    if share <= ELSE:
        return ""
    return (
        f"it has no metadata, and {100 * share:.0f} % of it shows something else than the photos of"
        " that place: it is a screenshot, or a picture of a screen"
    )


def _cells(px: NDArray[np.floating[Any]], size: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers (n,) of the cells in which pixels (n, 2) lie."""
    column, row = np.clip(px * CELLS // size, 0, CELLS - 1).astype(np.int64).T
    return np.asarray(row * CELLS + column)
