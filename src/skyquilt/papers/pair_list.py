"""Lists of image pairs with known registration (pairs.csv), and the error of a registration over
their overlap.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import SideFileError
from skyquilt.model.registration import Matrix
from skyquilt.outside import real
from skyquilt.photos.side_rows import read_lines, read_table

_ACROSS = 64
"""Number of points along the longer side of the reference at which both are compared."""


def overlap_error(
    b_H_a: NDArray[Any], truth: NDArray[Any], shape_a: tuple[int, int], shape_b: tuple[int, int]
) -> float:
    """RMS distance in px of b between the positions by two transforms (3, 3), over the points of a
    (H, W) that are truly inside b (H, W). Infinite if there are none, or if the transform maps one
    to infinity.
    """
    step = max(max(shape_a) / _ACROSS, 1.0)
    y, x = np.mgrid[0 : shape_a[0] - 1 : step, 0 : shape_a[1] - 1 : step]
    px = np.c_[x.ravel(), y.ravel(), np.ones(x.size)]
    there = _projected(px @ truth.T)
    inside = ((there >= -0.5) & (there <= np.array([shape_b[1], shape_b[0]]) - 0.5)).all(1)
    if not inside.any():
        return float("inf")
    distance = ((_projected(px[inside] @ b_H_a.T) - there[inside]) ** 2).sum(1)
    return float(np.sqrt(distance.mean())) if np.isfinite(distance).all() else float("inf")


def _projected(points: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(all="ignore"):
        return np.asarray(points[:, :2] / points[:, 2:], np.float64)


COLUMNS = (
    "class",
    "source",
    "a",
    "b",
    "tolerance_px",
    *(f"h{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
)
"""Required columns, in any order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two images with known registration."""

    kind: str
    """Class of the pair."""
    source: str
    """Its source, as text."""
    a: Path
    """The reference."""
    b: Path
    """The other image."""
    tolerance_px: float
    """RMS error in px of b below which a registration is right."""
    b_H_a: Matrix
    """(3, 3) the true transform."""


def read_pairs(path: Path) -> tuple[Pair, ...]:
    """The pairs of a CSV file; paths of images are relative to its folder.

    Raises:
        SideFileError: it cannot be read, lacks columns, or contains an invalid number.
    """
    table = read_table([line for _, line in read_lines(path)], file=path.name)
    header = [cell.strip() for cell in table[0]] if table else []
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise SideFileError(
            f"{path.name} lacks the columns {', '.join(missing)}; see docs/methods.md"
        )
    rows = (dict(zip(header, [*row, *[""] * len(header)], strict=False)) for row in table[1:])
    pairs = tuple(_pair(row, number, path) for number, row in enumerate(rows, 2))
    if not pairs:
        raise SideFileError(f"{path.name} names no pairs; one line each is expected below the head")
    return pairs


def _pair(row: dict[str, str], number: int, path: Path) -> Pair:
    names = [f"h{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    numbers = [real(row[name], -1e12, 1e12) for name in (*names, "tolerance_px")]
    if None in numbers or not row["a"].strip() or not row["b"].strip():
        raise SideFileError(
            f"{path.name}, line {number}: a number is expected in each of {len(numbers)} cells,"
            " and two images"
        )
    matrix, tolerance = np.array(numbers[:9], np.float64).reshape(3, 3), numbers[9] or 0.0
    if not (abs(np.linalg.det(matrix)) > 1e-12 and tolerance > 0):
        raise SideFileError(
            f"{path.name}, line {number}: h11 to h33 are no transform, or the tolerance is not > 0"
        )
    return Pair(
        kind=row["class"],
        source=row["source"],
        a=path.parent / row["a"],
        b=path.parent / row["b"],
        tolerance_px=tolerance,
        b_H_a=matrix,
    )
