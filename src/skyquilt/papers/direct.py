"""Direct registration of two images without features: normalised cross-correlation over an image
pyramid, and the search of a maximum that all direct methods share.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from skyquilt.imaging.grey import to_grey8
from skyquilt.model.estimate import NoEstimate, Registration
from skyquilt.papers.picture_similarity import ncc, ncc_of_shifts, summit, warped

Doubles = NDArray[np.float64]
Score = Callable[[NDArray[Any], NDArray[Any], NDArray[np.bool_]], float]


def motion(parameters: Doubles, shape: tuple[int, ...]) -> Doubles:
    """(3, 3) transform from (dx, dy[, rad, log scale]) about the centre of an image of `shape`, in
    its pixels.
    """
    dx, dy, angle, log_scale = (*parameters, 0.0, 0.0)[:4]
    c, s = np.exp(log_scale) * np.cos(angle), np.exp(log_scale) * np.sin(angle)
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    return np.array([[c, -s, x + dx - c * x + s * y], [s, c, y + dy - s * x - c * y], [0, 0, 1]])


def reduced(image: NDArray[Any], factor: int) -> NDArray[np.float32]:
    """Area means of factor x factor pixels (H // factor, W // factor)."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: h * factor, : w * factor].astype(np.float32)
    return np.asarray(cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA), np.float32)


def at_level(H: Doubles, factor: float) -> Doubles:
    """b_H_a for images that are both reduced by `factor` (or enlarged, for its inverse), pixel
    centres at integers.
    """
    D = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    return np.asarray(np.linalg.inv(D) @ H @ D)


def climb(
    score: Score,
    a: NDArray[Any],
    b: NDArray[Any],
    start: Doubles,
    *,
    similarity: bool,
    overlap: float,
    factors: tuple[int, ...],
) -> tuple[Doubles, float, float]:
    """(b_H_a, score, overlap): a local maximum near `start` by the simplex method of Nelder and
    Mead, at each reduction in turn.

    The first simplex has a size of 2 px at each level; for rotation and scale, the change that
    moves a corner by 2 px.
    """
    H, value, share = start, -np.inf, 0.0
    for factor in factors:
        small = [reduced(p, factor) for p in (a, b)]
        base = at_level(H, factor)
        reach = 2 / (0.5 * np.hypot(*small[0].shape))
        steps = np.array([2.0, 2.0, reach, reach][: 4 if similarity else 2])

        def loss(p: Doubles, base: Doubles = base, small: list[NDArray[Any]] = small) -> float:
            seen, inside = warped(small[1], base @ motion(p, small[0].shape), small[0].shape)
            return -score(small[0], seen, inside) if inside.mean() >= overlap else 1.0

        simplex = np.vstack([np.zeros(len(steps)), np.diag(steps)])
        options = {
            "initial_simplex": simplex,
            "xatol": 1e-2 * reach,
            "fatol": 1e-7,
            "maxiter": 60 * len(steps),
        }
        found = minimize(loss, simplex[0], method="Nelder-Mead", options=options)
        H = at_level(base @ motion(found.x, small[0].shape), 1 / factor)
        H, value = H / H[2, 2], -float(found.fun)
    share = float(warped(b, H, a.shape)[1].mean())
    return H, value, share


def levels(shape: tuple[int, ...], *, coarsest: int, finest: int = 1) -> tuple[int, ...]:
    """Reductions from the coarsest, whose longer side is at most `coarsest` px, to `finest`, by
    halves.
    """
    factor = finest
    while max(shape) / factor > coarsest:
        factor *= 2
    return tuple(factor >> k for k in range(factor.bit_length()) if factor >> k >= finest)


_COARSE = 128
"""Longer side in px of the images for the exhaustive search."""


class Direct(Protocol):
    """Interface of direct registration: `Ncc`, `PhaseCorrelation`, `Ecc`, `MutualInformation`.
    `start`: (3, 3) b_H_a or None.
    """

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a with its score, or the reason why there is none."""
        ...


@dataclass(frozen=True, kw_only=True)
class Ncc:
    """Searches all shifts (and the requested rotations and scales) in small images, then refines
    the best in larger ones.
    """

    turn: float = 0.0
    """Largest rotation tried, in degrees in both directions from the start; 0 searches for a
    translation, unless `zoom` is given.
    """
    zoom: float = 1.0
    """Largest scale factor tried, in both directions."""
    minimum: float = 0.3
    """Least accepted correlation."""
    clear: float = 0.95
    """Largest correlation of a second place, as a share of that of the best (at the coarsest
    level).
    """
    overlap: float = 0.2
    """Least share of a's pixels that overlap b."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two images (H, W[, C]), with shifts of any size from `start`; or the reason why
        there is none.
        """
        a, b = to_grey8(a), to_grey8(b)
        first = np.eye(3) if start is None else start
        factors = levels((*a.shape, *b.shape), coarsest=_COARSE)
        found = self._everything(
            reduced(a, factors[0]), reduced(b, factors[0]), at_level(first, factors[0])
        )
        if isinstance(found, NoEstimate):
            return found
        similarity = self.turn > 0 or self.zoom > 1
        H, score, share = climb(
            ncc,
            a,
            b,
            at_level(found, 1 / factors[0]),
            similarity=similarity,
            overlap=self.overlap,
            factors=factors,
        )
        if score < self.minimum:
            return NoEstimate(reason=f"weak peak ({score:.2f} of {self.minimum:g})")
        model = "similarity" if similarity else "translation"
        return Registration(model=model, b_H_a=H, score=score, overlap=share, method="NCC")

    def _everything(self, a: NDArray[Any], b: NDArray[Any], start: Doubles) -> Doubles | NoEstimate:
        """The best of all shifts, rotations and scales of small images, close enough for local
        maximisation.
        """
        best: tuple[float, float, Doubles] = (-1.0, -1.0, start)
        size = (int(2 * max(b.shape)),) * 2
        middle = np.array(
            [[1, 0, (b.shape[1] - size[1]) / 2], [0, 1, (b.shape[0] - size[0]) / 2], [0, 0, 1.0]]
        )
        centre = np.array([(a.shape[1] - 1) / 2, (a.shape[0] - 1) / 2, 1.0])
        for angle, scale in self._tried(max(a.shape)):
            H = start @ motion(np.array([0, 0, np.radians(angle), np.log(scale)]), a.shape)
            H[:2, 2] += np.array([(b.shape[1] - 1) / 2, (b.shape[0] - 1) / 2]) - (H @ centre)[:2]
            # a rotated to b's orientation on a canvas around b
            turned, inside = warped(a, np.linalg.inv(H) @ middle, size)
            field, zero = ncc_of_shifts(turned, b, inside, overlap=self.overlap)
            row, column, value, second = summit(field)
            if value > best[0]:
                shift = np.array([[1, 0, column - zero[1]], [0, 1, row - zero[0]], [0, 0, 1.0]])
                best = (value, second, shift @ np.linalg.inv(middle) @ H)
        if best[0] < self.minimum:
            return NoEstimate(reason=f"weak peak ({best[0]:.2f} of {self.minimum:g})")
        if best[1] > self.clear * best[0]:
            return NoEstimate(
                reason=f"ambiguous (correlations of {best[0]:.2f} and {best[1]:.2f} apart)"
            )
        return best[2]

    def _tried(self, longest: int) -> list[tuple[float, float]]:
        """(degrees, scale) in steps at which a corner moves by at most 3 px."""
        step = 6 / longest
        turns = int(np.ceil(np.radians(self.turn) / step))
        zooms = int(np.ceil(np.log(self.zoom) / step)) if self.zoom > 1 else 0
        angles = np.linspace(-self.turn, self.turn, 2 * turns + 1)
        scales = self.zoom ** np.linspace(-1, 1, 2 * zooms + 1) if zooms else np.ones(1)
        return [(float(angle), float(scale)) for scale in scales for angle in angles]


def by_ncc(model: str) -> Ncc:
    """Cross-correlation for photos of any heading: a `translation`, or a `similarity`."""
    return Ncc() if model == "translation" else Ncc(turn=180.0)
