"""What is stated about the error of a registration over the whole picture, and whether it is
tolerated.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.error_field import overlap_corners
from skyquilt.geometry.transforms import transfer
from skyquilt.model.registration import RefusedRegistration, Registration

TOLERANCE = 0.02
"""Largest tolerated error if none is given, as a share of b's diagonal."""
LEAST_SHARE = 0.5
"""Least share of what both show within the tolerance where a lens bends the rest."""
_ACROSS = 96
"""Points along a's longer side at which the error is computed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StatedError:
    """The error of a registration over the part of a that b covers, in px of b."""

    error_px: float
    """Largest of the bounds at the corners of that part: 95 % of registrations are within it."""
    tolerance_px: float
    """Largest tolerated error."""
    corners_a: NDArray[np.float64]
    """(n, 2) the corners, px of a."""
    corners_px: NDArray[np.float64]
    """(n,) the bounds there."""
    valid_share: float
    """Share of that part in which the bound is tolerated."""
    valid_a: NDArray[np.float64]
    """(m, 2) outline of the part with tolerated bounds, px of a; (0, 2) if there is none."""


def state_error(
    outcome: Registration,
    shape_a: tuple[int, int],
    shape_b: tuple[int, int],
    tolerance_px: float | None,
) -> StatedError | None:
    """What a registration's own error says about pictures of these shapes (H, W); None if its
    method does not measure it. A tolerance of None is the default one.
    """
    if outcome.error is None:
        return None
    tolerance = tolerance_px or TOLERANCE * float(np.hypot(*shape_b))
    ends = overlap_corners(outcome.b_H_a, shape_a, shape_b)
    a_H_b = np.asarray(np.linalg.inv(outcome.b_H_a), np.float64)
    bounds, corners = outcome.error.bound_px(ends), transfer(a_H_b, ends)
    step = max(shape_a) / _ACROSS
    bound = error_map(outcome, shape_a, shape_b, step)
    inside, valid = np.isfinite(bound), bound <= tolerance
    outline = corners if bounds.max() <= tolerance else _outline(valid, step)
    return StatedError(
        error_px=float(bounds.max()),
        tolerance_px=tolerance,
        corners_a=corners,
        corners_px=bounds,
        valid_share=float(valid.sum() / max(inside.sum(), 1)),
        valid_a=outline,
    )


def tolerated(
    outcome: Registration, stated: StatedError | None, *, bent: bool = False
) -> Registration | RefusedRegistration:
    """The registration, or its refusal if its stated error is larger than tolerated; `bent`: a lens
    bends the rim of a picture, so that a note tells it where the rest is within the tolerance.
    """
    if stated is None or stated.error_px <= stated.tolerance_px:
        return outcome
    if bent and stated.valid_share >= LEAST_SHARE:
        note = (
            "Lenses and tilts bend photos, and no transform follows that:"
            f" {stated.valid_share:.0%} of the picture are within {stated.tolerance_px:.1f} px of"
            f" B, a corner may be {stated.error_px:.0f} px off; --tolerance refuses that."
        )
        return replace(outcome, note=outcome.note or note)
    return RefusedRegistration(
        reason=f"the error may reach {stated.error_px:.1f} px in a corner of the picture, and"
        f" {stated.tolerance_px:.1f} px are tolerated: patches confirm the registration in a part"
        f" of it only ({stated.valid_share:.0%} are within the tolerance);"
        " --tolerance sets another",
        inliers=len(outcome.px_a),
        evidence=outcome.evidence,
    )


def error_map(
    outcome: Registration, shape_a: tuple[int, int], shape_b: tuple[int, int], step: float
) -> NDArray[np.float32]:
    """(h, w) bounds in px of b at the middles of a's squares of `step` px; NaN where b has no
    pixels.
    """
    assert outcome.error is not None
    height, width = (max(1, round(side / step)) for side in shape_a)
    x, y = np.meshgrid(_middles(width, step), _middles(height, step))
    px_b = transfer(outcome.b_H_a, np.c_[x.ravel(), y.ravel()])
    seen = ((px_b >= -0.5) & (px_b <= np.array([shape_b[1], shape_b[0]]) - 0.5)).all(1)
    bounds = np.full(len(px_b), np.nan, np.float32)
    bounds[seen] = outcome.error.bound_px(px_b[seen])
    return bounds.reshape(height, width)


def _middles(count: int, step: float) -> NDArray[np.float64]:
    return np.asarray((np.arange(count) + 0.5) * step - 0.5, np.float64)


def _outline(valid: NDArray[np.bool_], step: float) -> NDArray[np.float64]:
    """(m, 2) px of a: the outline of the largest part of a mask of squares of `step` px."""
    contours, _ = cv2.findContours(
        valid.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    if not contours:
        return np.zeros((0, 2))
    largest = max(contours, key=cv2.contourArea).reshape(-1, 2).astype(np.float64)
    return np.asarray((largest + 0.5) * step - 0.5, np.float64)
