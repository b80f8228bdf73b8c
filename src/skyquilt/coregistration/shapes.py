"""Matches of areas and objects: lakes, roofs, fields, roads as shapes, whatever their brightness.

The thesis names them as the interspectral features of the future [Yahyanejad 2013, chapter 7]. An
area is a maximally stable region (Matas et al. 2002), brighter or darker than what surrounds it: in
another spectrum it may be the other, its outline is the same. Outlines are described by the lengths
of their Fourier coefficients relative to the first (Zahn and Roskies 1972), which neither position,
size, rotation nor the starting point change. One pair of areas already gives a similarity; the one
that brings most other areas onto areas of the same size and shape is proposed.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skyquilt.coregistration.candidates import similarity
from skyquilt.coregistration.orientation import shrunken
from skyquilt.coregistration.structure import Proposal
from skyquilt.coregistration.usable import Usable
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.model.registration import Matrix

_HARMONICS = 5
_DELTA, _VARIATION = 2, 0.6
"""Steps of brightness over which an area is stable, and its largest relative change over them."""
_BLURS = (1.0, 2.5)
"""Standard deviations in px of the smoothing before areas are searched."""
_POINTS = 64
"""Points along an outline."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shapes:
    """The areas of one image."""

    px: NDArray[np.float64]
    """(n, 2) centroids, px."""
    size: NDArray[np.float64]
    """(n,) square root of the area, px."""
    angle: NDArray[np.float64]
    """(n,) direction of the long axis, radians, modulo pi."""
    outline: NDArray[np.float64]
    """(n, d) lengths of Fourier coefficients."""

    def first(self, count: int) -> "Shapes":
        """The first areas, at most so many."""
        return Shapes(
            px=self.px[:count],
            size=self.size[:count],
            angle=self.angle[:count],
            outline=self.outline[:count],
        )


@dataclass(frozen=True, kw_only=True)
class ShapeMatches:
    """Proposes the similarity on which most areas of two images agree."""

    side: float = 320.0
    """Side in px of the square to whose area the images are reduced."""
    smallest: float = 0.0006
    """Least area, as a share of the image."""
    largest: float = 0.25
    """Largest area."""
    count: int = 200
    """Most areas of an image; the largest are kept."""
    tried: int = 6
    """Areas of the other image, the most similar ones, with which each area is paired."""
    near: float = 0.02
    """Largest distance of agreeing centroids, as a share of the side."""
    alike: float = 0.35
    """Largest difference of agreeing sizes (log) and outlines."""
    minimum: int = 4
    """Fewest areas that agree."""
    scales: tuple[float, float] = (0.6, 1.7)
    """Smallest and largest scale between both images relative to equal areas."""
    version: ClassVar[int] = 1

    def __call__(self, a: Usable, b: Usable) -> Proposal:
        """The transform on which most areas agree."""
        (fa, full_a), (fb, full_b) = self._shapes(a), self._shapes(b)
        if min(len(fa.px), len(fb.px)) < self.minimum:
            return Proposal(
                b_H_a=None,
                matches=min(len(fa.px), len(fb.px)),
                reason=f"{len(fa.px)} and {len(fb.px)} areas were found,"
                f" {self.minimum} are needed in each",
            )
        small, agreeing = self._voted(fa, fb)
        if small is None:
            return Proposal(
                b_H_a=None,
                matches=agreeing,
                reason=f"{agreeing} areas agree on a similarity, {self.minimum} are needed",
            )
        full = np.linalg.inv(full_b) @ small @ full_a
        return Proposal(b_H_a=full / full[2, 2], matches=agreeing)

    def _shapes(self, picture: Usable) -> tuple[Shapes, Matrix]:
        grey, valid, small_S_full = shrunken(picture.grey, picture.valid, self.side)
        filled = np.where(valid, grey, grey[valid].mean() if valid.any() else 0)
        low, high = np.percentile(filled[valid], [1, 99]) if valid.any() else (0.0, 1.0)
        levels = np.clip((filled - low) / max(float(high - low), 1e-6) * 255, 0, 255)
        even = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(4, 4)).apply(levels.astype(np.uint8))
        found = found_shapes(np.asarray(even), valid, self.smallest, self.largest)
        return found.first(self.count), small_S_full

    def _voted(self, a: Shapes, b: Shapes) -> tuple[Matrix | None, int]:
        """The similarity with most agreeing areas, fitted to their centroids, and their number."""
        pairs = self._pairs(a, b)
        tree, best, most = cKDTree(b.px), None, 0.0
        for i, j in pairs:
            scale = b.size[j] / a.size[i]
            for turn in (0.0, np.pi):
                angle = float(b.angle[j] - a.angle[i] + turn)
                guess = similarity(float(scale), angle, a.px[i], b.px[j])
                votes = self._agreeing(guess, a, b, tree)
                score = float(a.size[votes[0]].sum()) if len(votes[0]) else 0.0
                if score > most:
                    best, most = guess, score
        if best is None:
            return None, 0
        for _ in range(4):
            ours, theirs = self._agreeing(best, a, b, tree)
            if len(ours) < self.minimum:
                return None, len(ours)
            better = fit("similarity", a.px[ours], b.px[theirs], a.size[ours])
            if better is None:
                return None, len(ours)
            best = better
        return best, len(ours)

    def _pairs(self, a: Shapes, b: Shapes) -> NDArray[np.int64]:
        """(m, 2) indices of areas that may be the same."""
        count = min(self.tried, len(b.px))
        _, near = cKDTree(b.outline).query(a.outline, k=count)
        near = np.asarray(near).reshape(len(a.px), count)
        pairs = np.stack([np.arange(len(a.px)).repeat(count), near.ravel()], 1)
        scale = b.size[pairs[:, 1]] / a.size[pairs[:, 0]]
        apart = np.linalg.norm(a.outline[pairs[:, 0]] - b.outline[pairs[:, 1]], axis=1)
        kept = (scale > self.scales[0]) & (scale < self.scales[1]) & (apart < self.alike)
        return np.asarray(pairs[kept], np.int64)

    def _agreeing(
        self, b_H_a: Matrix, a: Shapes, b: Shapes, tree: Any
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices of the areas of a and b that a transform brings together, each used once."""
        there = transfer(b_H_a, a.px)
        scale = float(np.sqrt(abs(np.linalg.det(b_H_a[:2, :2]))))
        distance, other = tree.query(there, distance_upper_bound=self.near * self.side)
        ours = np.flatnonzero(np.isfinite(distance))
        theirs = np.asarray(other)[ours]
        same = (np.abs(np.log(b.size[theirs] / (scale * a.size[ours]))) < self.alike) & (
            np.linalg.norm(a.outline[ours] - b.outline[theirs], axis=1) < self.alike
        )
        ours, theirs = ours[same], theirs[same]
        _, first = np.unique(theirs, return_index=True)
        return ours[first], theirs[first]


def found_shapes(
    grey: NDArray[np.uint8], valid: NDArray[np.bool_], smallest: float, largest: float
) -> Shapes:
    """The stable regions of an 8-bit image (h, w) between two shares of its area; those that touch
    what is not valid are left out, since their outlines are cut.
    """
    detector = cv2.MSER.create(
        delta=_DELTA,
        min_area=int(smallest * grey.size),
        max_area=int(largest * grey.size),
        max_variation=_VARIATION,
        min_diversity=0.1,
    )
    regions = [r for sigma in _BLURS for r in detector.detectRegions(_blurred(grey, sigma))[0]]
    inner = cv2.erode(
        valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT
    )
    rows = []
    for points in regions:
        region = np.asarray(points, np.int32)
        if not inner[region[:, 1], region[:, 0]].all():
            continue
        row = _described(region)
        if row is not None:
            rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 4 + 2 * _HARMONICS - 1)
    table = _apart(table)
    return Shapes(px=table[:, :2], size=table[:, 2], angle=table[:, 3], outline=table[:, 4:])


def _blurred(grey: NDArray[np.uint8], sigma: float) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma), np.uint8)


def _described(region: NDArray[np.int32]) -> NDArray[np.float64] | None:
    """Centroid, size, angle and Fourier lengths of a region's outline."""
    low = region.min(0) - 1
    mask = np.zeros(tuple((region.max(0) - low + 2)[::-1]), np.uint8)
    mask[region[:, 1] - low[1], region[:, 0] - low[0]] = 1
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=len).reshape(-1, 2).astype(np.float64)
    if len(outline) < 12:
        return None
    z = outline[:, 0] + 1j * outline[:, 1]
    step = np.abs(np.diff(np.r_[z, z[0]]))
    along = np.r_[0, np.cumsum(step)]
    at = np.linspace(0, along[-1], _POINTS, endpoint=False)
    closed = np.r_[z, z[0]]
    even = np.interp(at, along, closed.real) + 1j * np.interp(at, along, closed.imag)
    c = np.fft.fft(even) / _POINTS
    if abs(c[-1]) > abs(c[1]):  # the other way round
        c = np.r_[c[0], c[:0:-1]]
    first = max(abs(c[1]), 1e-9)
    order = [-1, *(s * k for k in range(2, _HARMONICS + 1) for s in (1, -1))]
    angle = float(np.angle(c[1] * c[-1])) / 2
    lengths = np.array([abs(c[k]) / first for k in order])
    return np.concatenate([region.mean(0), [np.sqrt(len(region)), angle], lengths])


def _apart(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows without those that repeat another one, hardly larger or smaller; largest first."""
    kept: list[int] = []
    for k in np.argsort(-table[:, 2]):
        others = table[kept]
        same = (np.abs(np.log(others[:, 2] / table[k, 2])) < 0.1) & (
            np.hypot(*(others[:, :2] - table[k, :2]).T) < 0.15 * table[k, 2]
        )
        if not same.any():
            kept.append(int(k))
    return table[kept]
