"""The parts that two images share according to a guess.

Resolutions are chosen by image area. Without this step, a thermal image of the middle of a visible
photo, or two maps of different extent, would be compared at different ground resolutions.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.registration import Guess, Matrix, Picture, RefusedRegistration, Registration

_WHOLE = 0.7
"""If the shared part is more than this share of an image, the whole image is used."""
LEAST_PX = 96
"""If the shorter side of a part has fewer px, the whole images are used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CommonPart:
    """Parts of both images, and their positions."""

    a: Picture
    """Part of a."""
    b: Picture
    """Part of b."""
    guess: Guess
    """The guess in px of the parts."""
    shift_a: NDArray[np.float64]
    """(2,) column and row of the part's first pixel in a."""
    shift_b: NDArray[np.float64]
    """(2,) the same in b."""

    def whole(
        self, outcome: Registration | RefusedRegistration
    ) -> Registration | RefusedRegistration:
        """Converts a registration of the parts to one of the whole images."""
        if isinstance(outcome, RefusedRegistration):
            return outcome
        matrix = _moved(self.shift_b) @ outcome.b_H_a @ _moved(-self.shift_a)
        return replace(
            outcome,
            b_H_a=matrix / matrix[2, 2],
            px_a=outcome.px_a + self.shift_a,
            px_b=outcome.px_b + self.shift_b,
            error=outcome.error and outcome.error.moved(1.0, self.shift_b),
            lens_error=outcome.lens_error and outcome.lens_error.moved(1.0, self.shift_b),
        )


def common_part(a: Picture, b: Picture, guess: Guess) -> CommonPart:
    """The parts shared by both images if the guess is right within its stated uncertainty."""
    margin = guess.reach * max(b.shape)
    scale = float(np.sqrt(abs(np.linalg.det(guess.b_H_a[:2, :2])))) or 1.0
    in_a = _window(np.linalg.inv(guess.b_H_a), b.shape, margin / scale, a.shape)
    in_b = _window(guess.b_H_a, a.shape, margin, b.shape)
    shift_a, shift_b = (np.array([w[1].start, w[0].start], float) for w in (in_a, in_b))
    matrix = _moved(-shift_b) @ guess.b_H_a @ _moved(shift_a)
    part_b = _part(b, in_b)
    return CommonPart(
        a=_part(a, in_a),
        b=part_b,
        shift_a=shift_a,
        shift_b=shift_b,
        guess=replace(guess, b_H_a=matrix / matrix[2, 2], reach=margin / max(part_b.shape)),
    )


def _window(
    to_H_from: NDArray[Any], source: tuple[int, int], margin: float, target: tuple[int, int]
) -> tuple[slice, slice]:
    """Rows and columns of `target` that the image `source` covers, widened by a margin; all of them
    if that is most of the image.
    """
    height, width = source
    ends = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1.0]]) @ to_H_from.T
    everything = (slice(0, target[0]), slice(0, target[1]))
    if (ends[:, 2] <= 0).any():
        return everything
    px = ends[:, :2] / ends[:, 2:]
    low = np.clip(np.floor(px.min(0) - margin), 0, [target[1], target[0]]).astype(int)
    high = np.clip(np.ceil(px.max(0) + margin), 0, [target[1], target[0]]).astype(int)
    size = high - low
    if size.min() < LEAST_PX or size.prod() > _WHOLE * target[0] * target[1]:
        return everything
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _part(picture: Picture, window: tuple[slice, slice]) -> Picture:
    valid = None if picture.valid is None else picture.valid[window]
    return Picture(values=np.ascontiguousarray(picture.values[window]), valid=valid)


def _moved(shift: NDArray[np.float64]) -> Matrix:
    return np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]])
