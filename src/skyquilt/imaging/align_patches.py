"""Sub-pixel translation of many small patches at once, by Gauss-Newton on brightness."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]


def translate(
    reference: Float, moving: Float, *, margin: int = 3, iterations: int = 4
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shifts of the content of moving patches against reference patches.

    Lucas and Kanade (1981), inverse compositional, gain and offset removed by normalising both
    patches.

    Args:
        reference: (n, s, s).
        moving: (n, s + 2 margin, s + 2 margin), the same ground with a margin around it.
        margin: px; no shift found can exceed it.
        iterations: Gauss-Newton steps.

    Returns:
        Shifts (n, 2) in px, x then y, and the correlation (n,) reached; both NaN where a shift
        exceeded the margin or a patch is uniform.
    """
    n, s, _ = reference.shape
    if not n:
        return np.zeros((0, 2)), np.zeros(0)
    ref = _normalised(reference.reshape(n, -1))
    gy, gx = (np.asarray(g) for g in np.gradient(ref.reshape(n, s, s), axis=(1, 2)))
    J = np.stack([gx.reshape(n, -1), gy.reshape(n, -1)], 1)
    H = J @ np.swapaxes(J, 1, 2) + 1e-6 * np.eye(2, dtype=np.float32)
    J = np.linalg.solve(H, J)
    shift = np.zeros((n, 2))
    for _ in range(iterations):
        current = _normalised(_sampled(moving, shift, margin, s))
        shift -= np.einsum("nki,ni->nk", J, current - ref)
        shift = np.clip(np.nan_to_num(shift), -margin, margin)
    score = np.einsum("ni,ni->n", _normalised(_sampled(moving, shift, margin, s)), ref)
    lost = (np.abs(shift) >= margin - 1e-6).any(1) | ~np.isfinite(score)
    shift[lost], score[lost] = np.nan, np.nan
    return shift, score


def _normalised(flat: Float) -> Float:
    """Rows of zero mean and unit length; NaN where a row is constant."""
    centred = flat - flat.mean(1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 1e-3, centred / length, np.float32(np.nan))


def _sampled(moving: Float, shift: NDArray[np.float64], margin: int, s: int) -> Float:
    """Moving patches (n, s * s) sampled at their shifts, bilinear."""
    n = len(moving)
    whole = np.floor(shift).astype(int)
    part = (shift - whole).astype(np.float32)
    x0 = np.clip(margin + whole[:, 0], 0, 2 * margin - 1)
    y0 = np.clip(margin + whole[:, 1], 0, 2 * margin - 1)
    span = np.arange(s + 1)
    block = moving[
        np.arange(n)[:, None, None],
        (y0[:, None] + span)[:, :, None],
        (x0[:, None] + span)[:, None, :],
    ]
    fx, fy = part[:, 0, None, None], part[:, 1, None, None]
    rows = block[:, :, :-1] * (1 - fx) + block[:, :, 1:] * fx
    return np.asarray(rows[:, :-1] * (1 - fy) + rows[:, 1:] * fy).reshape(n, -1)
