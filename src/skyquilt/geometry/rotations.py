"""Rotations between bundles of directions, and the one that many agree on."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def turning(a: Array, b: Array) -> Array:
    """b_R_a (3, 3) that takes directions a (n, 3) best to b (n, 3): Wahba's problem (Markley
    1988).
    """
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    return nearest_rotation(b.T @ a)


def nearest_rotation(m: Array) -> Array:
    """The rotation next to a matrix (3, 3)."""
    u, _, vt = np.linalg.svd(m)
    return np.asarray(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)


def angle_deg(a: Array, b: Array) -> float:
    """Degrees between two rotations (3, 3)."""
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))))


def median_rotation(rotations: Sequence[Array], *, rounds: int = 50) -> Array:
    """The chordal L1 mean (Hartley et al. 2013) by Weiszfeld's reweighting: up to half of them may
    be wrong.
    """
    stack = np.stack(rotations)
    mean = nearest_rotation(np.median(stack, axis=0))
    for _ in range(rounds):
        off = np.linalg.norm(stack - mean, axis=(1, 2))
        mean = nearest_rotation((stack / np.maximum(off, 1e-6)[:, None, None]).sum(0))
    return mean
