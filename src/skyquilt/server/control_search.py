"""Where photos show a control point: predicted by the poses, refined by correlation with a photo in
which it is marked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.server.projection import Projection, Xyz

HALF, REACH = 20, 40
"""Half the side of the compared patch, and the farthest distance searched, in cells."""
ACCEPTED = 0.7
"""Least correlation of a proposal."""
ITERATIONS = 8
Picture = Callable[[str], NDArray[np.uint8]]
"""Decodes a photo by its name."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A pixel at which a photo seems to show a point."""

    x: float
    """Column, centres at integers."""
    y: float
    """Row."""
    score: float
    """Correlation with the marked photo, up to 1."""


def place_of_mark(
    projection: Projection, photo: str, px: tuple[float, float], near: Xyz
) -> Xyz | None:
    """The place at the height of `near` that a photo shows at a pixel, by Newton's method; None
    where it does not converge.
    """
    x, y, z = near
    step = 0.05
    for _ in range(ITERATIONS):
        at = projection.pixel(photo, (x, y, z), beyond=True)
        east = projection.pixel(photo, (x + step, y, z), beyond=True)
        north = projection.pixel(photo, (x, y + step, z), beyond=True)
        if at is None or east is None or north is None:
            return None
        slope = np.array([np.subtract(east, at), np.subtract(north, at)]).T / step
        if abs(np.linalg.det(slope)) < 1e-9:
            return None
        dx, dy = np.linalg.solve(slope, np.subtract(px, at))
        x, y = x + float(dx), y + float(dy)
        if abs(dx) + abs(dy) < 1e-4:
            return x, y, z
    return None


def cell_of(projection: Projection, photo: str, place: Xyz) -> float | None:
    """Size in m of a pixel of a photo at a place."""
    x, y, z = place
    ends = [projection.pixel(photo, (x + d, y, z), beyond=True) for d in (0.0, 0.5)]
    if ends[0] is None or ends[1] is None:
        return None
    length = float(np.hypot(*np.subtract(ends[1], ends[0])))
    return 0.5 / length if length > 0 else None


def propose(
    projection: Projection, picture: Picture, marked: str, place: Xyz, other: str
) -> Proposal | None:
    """The pixel of another photo that looks like a place in the marked one; None where nothing is
    alike enough.

    Both photos are drawn on the horizontal plane through the place, so that turned and tilted ones
    can be compared.
    """
    cells = [cell_of(projection, name, place) for name in (marked, other)]
    if cells[0] is None or cells[1] is None:
        return None
    cell = max(cells[0], cells[1])
    a = _drawn(projection, picture, marked, place, cell, HALF)
    b = _drawn(projection, picture, other, place, cell, HALF + REACH)
    if a is None or b is None or a.std() < 2:
        return None
    scores = cv2.matchTemplate(b, a, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    score = float(scores[row, column])
    if score < ACCEPTED or not (0 < row < 2 * REACH and 0 < column < 2 * REACH):
        return None
    dy = _summit(scores[row - 1 : row + 2, column])
    dx = _summit(scores[row, column - 1 : column + 2])
    x, y, z = place
    found = projection.pixel(
        other, (x + (column + dx - REACH) * cell, y - (row + dy - REACH) * cell, z)
    )
    return None if found is None else Proposal(x=found[0], y=found[1], score=score)


def _summit(values: NDArray[Any]) -> float:
    """Place of the top of a parabola through three values, from -0.5 to 0.5."""
    low, top, high = (float(v) for v in values)
    bend = low - 2 * top + high
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (low - high) / bend, -0.5, 0.5))


def _drawn(
    projection: Projection, picture: Picture, photo: str, place: Xyz, cell: float, half: int
) -> NDArray[np.float32] | None:
    """A photo drawn on the plane, (2 half + 1) cells a side, grey; None where it does not show all
    of it.
    """
    x, y, z = place
    size = 2 * half
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    seen = [projection.pixel(photo, (x + c * cell, y - r * cell, z)) for c, r in corners]
    if any(p is None for p in seen):
        return None
    at = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float32)
    matrix = cv2.getPerspectiveTransform(at, np.array(seen, np.float32))
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    rgb = cv2.warpPerspective(picture(photo), matrix, (size + 1, size + 1), flags=how)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7))
