"""Blending methods: how a map pixel is computed where several photos cover it. There is no removal
of moving objects (ghosts).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
Order = int | NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """One photo orthorectified over a window."""

    photo: int
    """Index of the photo."""
    pixels: NDArray[Any]
    """(h, w, bands)."""
    score: Float
    """(h, w) squared tangent of the angle off the vertical; infinite where the photo does not cover
    the ground.
    """
    centre: tuple[float, float]
    """Camera's plan position in m."""
    height: float
    """Camera above ground in m."""
    slope: float | None = None
    """Where seams are given: change per px, across a seam, of the difference of two scores, which
    are then the share of the place that does not belong to the photo.
    """


class Blend(Protocol):
    """Interface of a blending method."""

    @property
    def margin(self) -> int:
        """Pixels beyond the window that the method needs."""

    @property
    def seam_px(self) -> float | None:
        """Width in px of ramps across seam lines; None for methods that show every place by a rule
        of their own.
        """

    def rank(self, order: Order, score: Float) -> Float:
        """The rank of photos: the photo with the lowest rank is shown. `order`: position in order
        of capture, of one photo or for each score.
        """

    def reach(self, gsd: float) -> float:
        """Largest difference in rank from the leading photo with which a photo still contributes;
        infinite = all photos contribute.
        """

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Pixels (h, w, bands) and the leading photo of each (h, w), -1 = none."""


def leader(layers: Sequence[Layer], ranks: Sequence[Float]) -> NDArray[np.int32]:
    """Position in `layers` of the lowest finite rank per pixel, -1 = none."""
    best, lead = ranks[0], np.isfinite(ranks[0]).astype(np.int32) - 1
    for position, rank in enumerate(ranks[1:], 1):
        np.copyto(lead, np.int32(position), where=rank < best)
        best = np.minimum(best, rank)
    return lead


def _photos(lead: NDArray[np.int32], layers: Sequence[Layer]) -> NDArray[np.int32]:
    table = np.array([*(layer.photo for layer in layers), -1], np.int32)
    return np.asarray(np.take(table, lead))


def _weighted(layers: Sequence[Layer], weights: Sequence[Float]) -> NDArray[Any]:
    """Weighted sum of pixels; weights add up to one (zero where there is no photo)."""
    kind = layers[0].pixels.dtype
    total = np.zeros(layers[0].pixels.shape, np.float32)
    for layer, weight in zip(layers, weights, strict=True):
        part = (
            np.where(weight[..., None] > 0, layer.pixels, 0) if kind.kind == "f" else layer.pixels
        )
        total += part * weight[..., None]
    return (
        np.clip(np.rint(total), 0, np.iinfo(kind).max).astype(kind)
        if kind.kind == "u"
        else total.astype(kind)
    )


@dataclass(frozen=True, kw_only=True)
class Feather:
    """Shows the most vertical view; seams are blended over a few pixels."""

    width_px: float = 6.0
    """Width of the blend in map pixels; 0 = hard seams. Measured values are never mixed."""
    margin: ClassVar[int] = 0
    version: ClassVar[int] = 6

    @property
    def seam_px(self) -> float:
        """The width of the blend."""
        return self.width_px

    def rank(self, order: Order, score: Float) -> Float:
        """The angle off the vertical."""
        return score

    def reach(self, gsd: float) -> float:
        """The rank difference at half the blend's width from the seam of two cameras one flying
        height apart.
        """
        return self.width_px * gsd

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Linear ramps across seams. The distance to a seam follows from the ranks, whose
        difference is linear in the plane.
        """
        lead = leader(layers, [layer.score for layer in layers])
        hard = _picked(layers, lead)
        if self.width_px > 0 and len(layers) > 1 and hard.dtype.kind != "f":
            self._soften(hard, layers, lead, gsd)
        return hard, _photos(lead, layers)

    def _soften(
        self, hard: NDArray[Any], layers: Sequence[Layer], lead: NDArray[np.int32], gsd: float
    ) -> None:
        """Blends, in place, the pixels within half a width of a seam."""
        slopes = _slopes(layers, gsd)
        if layers[0].slope is not None:
            slopes = np.full_like(slopes, layers[0].slope)
        steepest = slopes.max()
        best, second = layers[0].score, np.full_like(layers[0].score, np.inf)
        for layer in layers[1:]:
            second = np.minimum(second, np.maximum(best, layer.score))
            best = np.minimum(best, layer.score)
        near = np.flatnonzero(second < best + np.float32(steepest * self.width_px / 2))
        if not len(near):
            return
        s = np.stack([layer.score.ravel()[near] for layer in layers])
        # no ramp reaches further than half a width from the seam with the leading photo
        within = (s < s.min(0) + slopes[:, s.argmin(0)] * np.float32(self.width_px / 2)).sum(0) > 1
        near, s = near[within], s[:, within]
        ramps = np.empty(s.shape, np.float32)
        with np.errstate(invalid="ignore"):
            for k in range(len(layers)):
                # signed distance in px to the nearest seam: positive where this layer leads
                rows = [(s[j] - s[k]) / slopes[k, j] for j in range(len(layers)) if j != k]
                ramps[k] = np.clip(0.5 + np.min(rows, axis=0) / self.width_px, 0, 1)
        ramps = np.where(np.isfinite(s), np.nan_to_num(ramps), 0)
        total = np.maximum(ramps.sum(0), 1e-6)
        flat = [layer.pixels.reshape(-1, layer.pixels.shape[2])[near] for layer in layers]
        mixed = sum(
            np.nan_to_num(f.astype(np.float32)) * (r / total)[:, None]
            for f, r in zip(flat, ramps, strict=True)
        )
        seen = lead.ravel()[near] >= 0
        if hard.dtype.kind == "u":
            mixed = np.clip(np.rint(mixed), 0, np.iinfo(hard.dtype).max)
        hard.reshape(-1, hard.shape[2])[near[seen]] = mixed[seen].astype(hard.dtype)


def _slopes(layers: Sequence[Layer], gsd: float) -> Float:
    """(k, k) change of the rank difference per px across the seam of two photos."""
    centre = np.array([layer.centre for layer in layers])
    height = np.array([layer.height for layer in layers])
    apart = np.hypot(*(centre[:, None] - centre).transpose(2, 0, 1))
    return np.asarray(
        (2 * np.maximum(apart, 0.05 * height[:, None]) * gsd / np.outer(height, height)).astype(
            np.float32
        )
    )


def _picked(layers: Sequence[Layer], lead: NDArray[np.int32]) -> NDArray[Any]:
    """Takes each pixel from its leading layer; zero or NaN where there is none."""
    kind = layers[0].pixels.dtype
    out = np.full(layers[0].pixels.shape, np.nan if kind.kind == "f" else 0, kind)
    for position, layer in enumerate(layers):
        cv2.copyTo(
            layer.pixels, (lead == position).view(np.uint8), out
        ) if kind == np.uint8 else np.copyto(out, layer.pixels, where=(lead == position)[..., None])
    return out


@dataclass(frozen=True, kw_only=True)
class First:
    """Shows the photo taken first, with hard seams: earlier photos stay on top, as in the
    thesis.
    """

    margin: ClassVar[int] = 0
    seam_px: ClassVar[None] = None
    version: ClassVar[int] = 3

    def rank(self, order: Order, score: Float) -> Float:
        """Order of capture."""
        return np.where(np.isfinite(score), np.float32(order), np.float32(np.inf))

    def reach(self, gsd: float) -> float:
        """Zero, since only the leading photo contributes."""
        return 0.0

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Takes each pixel from the first layer that covers it; layers are in order of capture."""
        ranks = [self.rank(k, layer.score) for k, layer in enumerate(layers)]
        lead = leader(layers, ranks)
        return _picked(layers, lead), _photos(lead, layers)


@dataclass(frozen=True, kw_only=True)
class Average:
    """The mean of all photos that cover the pixel, as in Arteaga et al. 2019."""

    margin: ClassVar[int] = 0
    seam_px: ClassVar[None] = None
    version: ClassVar[int] = 3

    def rank(self, order: Order, score: Float) -> Float:
        """The angle off the vertical; it determines which photo is recorded as the source."""
        return score

    def reach(self, gsd: float) -> float:
        """Infinite, since all photos contribute."""
        return float(np.inf)

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Averages with equal weights."""
        seen = [np.isfinite(layer.score).astype(np.float32) for layer in layers]
        number = np.maximum(np.sum(seen, axis=0, dtype=np.float32), 1e-6)
        lead = leader(layers, [layer.score for layer in layers])
        merged = _weighted(layers, [np.asarray(s / number, np.float32) for s in seen])
        if merged.dtype.kind == "f":
            merged[lead < 0] = np.nan
        return merged, _photos(lead, layers)


@dataclass(frozen=True, kw_only=True)
class Multiband:
    """Shows the most vertical view; each spatial frequency band is blended over its own width (Burt
    and Adelson 1983).
    """

    levels: int = 5
    """Levels of the Laplacian pyramid; the widest blend is about 2 ** levels px."""
    seam_px: ClassVar[float] = 0.0
    version: ClassVar[int] = 4

    @property
    def margin(self) -> int:
        """Neighbouring tiles overlap by the widest blend, so that there is no step between them."""
        return int(4 * 2**self.levels)

    def rank(self, order: Order, score: Float) -> Float:
        """The angle off the vertical."""
        return score

    def reach(self, gsd: float) -> float:
        """The rank difference over the width of the coarsest blend."""
        return 4.0 * self.margin * gsd

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Sums the Laplacian pyramids of the layers, weighted by Gaussian pyramids of the masks
        where each layer leads.
        """
        lead = leader(layers, [layer.score for layer in layers])
        hard = _picked(layers, lead)
        if len(layers) == 1 or hard.dtype.kind == "f":  # measured values are cut, not mixed
            return hard, _photos(lead, layers)
        total: list[NDArray[Any]] = []
        mass: list[NDArray[Any]] = []
        for position, layer in enumerate(layers):
            bands = _laplacian(_filled(layer, hard), self.levels)
            weights = _gaussian((lead == position).astype(np.float32), self.levels)
            for level, (band, weight) in enumerate(zip(bands, weights, strict=True)):
                if position == 0:
                    total.append(np.zeros_like(band))
                    mass.append(np.zeros_like(weight))
                total[level] += band * weight[..., None]
                mass[level] += weight
        out = _collapse(
            [t / np.maximum(m, 1e-6)[..., None] for t, m in zip(total, mass, strict=True)]
        )
        kind = layers[0].pixels.dtype
        if kind.kind == "u":
            out = np.clip(np.rint(out), 0, np.iinfo(kind).max)
        blended = out.astype(kind)
        blended[lead < 0] = hard[lead < 0]
        return blended, _photos(lead, layers)


def _filled(layer: Layer, hard: NDArray[Any]) -> Float:
    """The layer, filled with the unblended mosaic where it has no pixels, so that black does not
    bleed in.
    """
    seen = np.isfinite(layer.score)[..., None]
    return np.nan_to_num(np.where(seen, layer.pixels, hard).astype(np.float32))


def _gaussian(image: Float, levels: int) -> list[Float]:
    out = [image]
    for _ in range(levels):
        out.append(np.asarray(cv2.pyrDown(out[-1]), np.float32))
    return out


def _laplacian(image: Float, levels: int) -> list[Float]:
    gaussian = _gaussian(image, levels)
    gaussian = [g[..., None] if g.ndim == 2 else g for g in gaussian]
    return [a - _up(b, a) for a, b in pairwise(gaussian)] + [gaussian[-1]]


def _up(small: Float, like: Float) -> Float:
    return np.asarray(cv2.pyrUp(small, dstsize=(like.shape[1], like.shape[0])), np.float32).reshape(
        like.shape
    )


def _collapse(bands: list[Float]) -> Float:
    image = bands[-1]
    for band in reversed(bands[:-1]):
        image = band + _up(image, band)
    return image
