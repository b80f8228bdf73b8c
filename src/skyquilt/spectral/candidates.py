"""Places where two pictures may fit, best first."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.registration import Matrix

_SUPPRESS = 4
"""Px about a peak in which no other is looked for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A transform and what speaks for it."""

    b_H_a: Matrix
    """(3, 3) in px of the resolution it was found in."""
    score: float
    """The higher the better; comparable among candidates of one search only."""


def distinct(
    candidates: Sequence[Candidate], shape: tuple[int, int], apart: float, most: int
) -> list[Candidate]:
    """The best ones, no two of which carry a's corners to within `apart` px (RMS) of each other.

    `shape` is a's height and width; candidates need not be in order.
    """
    order = sorted(candidates, key=lambda c: -c.score)
    kept: list[Candidate] = []
    places = np.zeros((0, 4, 2))
    for candidate in order:
        place = corners(candidate.b_H_a, shape)
        if (((places - place) ** 2).sum(2).mean(1) <= apart**2).any():
            continue
        kept.append(candidate)
        places = np.concatenate([places, place[None]])
        if len(kept) == most:
            break
    return kept


def corners(b_H_a: Matrix, shape: tuple[int, int]) -> np.ndarray:
    """Where a transform carries the corners of a picture of `shape`: (4, 2) in px of b."""
    height, width = shape
    ends = np.array(
        [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1.0]]
    )
    moved = ends @ b_H_a.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def similarity(scale: float, angle: float, from_px: np.ndarray, to_px: np.ndarray) -> Matrix:
    """Scales and turns (radians, x towards y) so that one point falls on another."""
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    shift = np.asarray(to_px) - turn @ np.asarray(from_px)
    return np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1.0]])


def middle(shape: tuple[int, int]) -> np.ndarray:
    """The middle pixel (2,): x, y."""
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])


def peaks(z: NDArray[np.float32], most: int) -> Iterator[tuple[float, int, int]]:
    """The highest places (score, x, y) of a field that wraps around; the field is spoilt."""
    height, width = z.shape
    near = np.arange(-_SUPPRESS, _SUPPRESS + 1)
    for _ in range(most):
        y, x = divmod(int(z.argmax()), width)
        if z[y, x] <= 0:
            return
        yield float(z[y, x]), x, y
        z[np.ix_((y + near) % height, (x + near) % width)] = -1
