"""Verification of a pair: first a similarity with a wide tolerance, then epipolar geometry with a
narrow one.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.matching.lens_kind import TOLERANCE_PX, straight, unit_rays
from skyquilt.matching.sphere_epipolar import agreeing
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches, RejectedLink, numbers

FURTHER = 4.0
"""Factor on the tolerance of the similarity for fisheyes: relief and tilt move what a pinhole shows
at 60 degrees from the axis four times as far as what it shows in the middle.
"""
EPIPOLAR = {"magsac": cv2.USAC_MAGSAC, "ransac": cv2.FM_RANSAC, "lmeds": cv2.FM_LMEDS}
"""OpenCV's estimators of a fundamental matrix, by name."""
BESIDE = 3
"""Matches beside one whose displacements are compared with its own."""


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Near-vertical photos of the same ground differ by a similarity, except for relief and tilt;
    displacements by relief fulfil the epipolar geometry.
    """

    similarity_share: float = 0.03
    """Tolerance of the similarity as a share of the image width: it allows for relief and tilt."""
    epipolar: str = "magsac"
    """One of `EPIPOLAR`: the estimator of the epipolar geometry."""
    epipolar_px: float = 1.0
    """Its threshold in px of the image that the features were found in (lmeds needs none)."""
    minimum: int = 15
    """Fewest inliers of a link."""
    scale: float = 1.7
    """Largest factor between the scales of two photos, as they were searched for features: between
    their flying heights where their lenses see the same angle.
    """
    sure: int = 20
    """Inliers from which `most_scale` holds instead."""
    most_scale: float = 4.0
    """The same for photos that evidently show the same ground: two flying heights, or a wide lens
    and a long one.
    """
    elsewhere: float = 0.2
    """Larger than this share of a link's inliers, and `fewest_elsewhere`, are those of the third
    best similarity of matches apart, where ground looks alike elsewhere: rows of panels or cars.
    (The second best may be that of roofs.) Links of 18 photos of forest and 75 of houses have 5 at
    most.
    """
    fewest_elsewhere: int = 6
    """Fewest inliers of such a similarity."""
    by_chance: float = 0.065
    """Share of the keypoints of the photo with fewer from which a link is none of chance: false
    ones have up to 64 of 1200.
    """
    flat_share: float = 0.007
    """Such a link shows the same ground where most inliers agree with one homography within this
    share of the image width: what agrees by chance is off by a panel or a car here and there.
    """
    flat: float = 0.85
    """Least share of these. Of 115 false links of a solar farm and a car park 4 have more, of 77
    true ones 75.
    """
    one_view: float = 0.7
    """Over steep ground, and where photos look aslant, true links are not flat either: then at
    least this share of the matches with the second and the third best similarity agree with one
    epipolar geometry of them all,
    """
    smooth: float = 0.62
    """and what an affine transformation of the link leaves of the displacements differs between
    matches beside one another by so much less than between any two, as a share. False links with
    one epipolar geometry, as rows along the line of flight have, reach 0.62 (95 %), true ones 0.79
    to 0.88 (median).
    """
    version: ClassVar[int] = 5

    def __call__(
        self,
        a: int,
        b: int,
        features_a: Features,
        features_b: Features,
        matches: Matches,
        width: int,
        lenses: tuple[Camera, Camera] | None = None,
    ) -> Link | RejectedLink:
        """The link of photos a and b (indices), or the reason why there is none. `width`: image
        width of a in px; `lenses` of the two photos where one is a fisheye.
        """
        if len(matches) < self.minimum:
            return RejectedLink(
                a=a, b=b, reason=f"too few matches ({len(matches)} of {self.minimum})"
            )
        pa = features_a.px[matches.index_a]
        pb = features_b.px[matches.index_b]
        # photos may have different numbers of pixels; distances are those in b
        finer = features_a.scale / features_b.scale
        tolerance = self.similarity_share * width / finer
        rays = None
        if lenses is not None:
            rays = unit_rays(lenses[0], pa), unit_rays(lenses[1], pb)
            pa, pb = (straight(lens, px) for lens, px in zip(lenses, (pa, pb), strict=True))
            tolerance *= FURTHER
        model, inliers = _similarity(pa, pb, tolerance)
        if model is None:
            return RejectedLink(a=a, b=b, reason="no common similarity")
        keep = np.flatnonzero(inliers)
        scale = float(np.hypot(model[0, 0], model[1, 0])) * finer
        if len(keep) < self.minimum:
            return RejectedLink(
                a=a, b=b, reason=f"weak inliers ({len(keep)} of {len(matches)} matches)"
            )
        plenty = self.by_chance * min(len(features_a), len(features_b))
        coarser = max(features_a.scale, features_b.scale)
        if len(keep) < plenty and (others := self._elsewhere(pa, pb, inliers, tolerance, coarser)):
            reason = f"ground that looks alike elsewhere ({others} beside {len(keep)} inliers)"
            return RejectedLink(a=a, b=b, reason=reason)
        limit = self.most_scale if len(keep) >= self.sure else self.scale
        if not 1 / limit < scale < limit:
            return RejectedLink(a=a, b=b, reason=f"implausible scale ({scale:.2f})")
        if lenses is None or rays is None:
            keep = self._epipolar(pa, pb, keep, coarser)
        else:
            angle = TOLERANCE_PX * coarser / min(lens.focal for lens in lenses)
            keep = keep[agreeing(rays[0][keep], rays[1][keep], angle)]
        if len(keep) < self.minimum:
            return RejectedLink(a=a, b=b, reason=f"weak inliers after epipolar check ({len(keep)})")
        # image y points down: conjugate to get the similarity with y up
        return Link(
            a=a,
            b=b,
            index_a=numbers(matches.index_a[keep]),
            index_b=numbers(matches.index_b[keep]),
            b_S_a=complex(model[0, 0], -model[1, 0]),
        )

    def _elsewhere(
        self,
        pa: np.ndarray,
        pb: np.ndarray,
        inliers: NDArray[np.bool_],
        tolerance: float,
        scale: float,
    ) -> int:
        """How many matches (of n, 2) agree with another similarity than those (n,) of a link that
        may be one of chance; 0 where it is none.
        """
        least = max(self.fewest_elsewhere - 1.0, self.elsewhere * int(inliers.sum()))
        groups = _groups(pa, pb, inliers, tolerance, least)
        near = tolerance * self.flat_share / self.similarity_share
        if len(groups) < 3 or _flat(pa[inliers], pb[inliers], near) >= self.flat:
            return 0
        return 0 if self._uneven(pa, pb, groups, scale) else len(groups[2])

    def _uneven(
        self, pa: np.ndarray, pb: np.ndarray, groups: Sequence[NDArray[np.intp]], scale: float
    ) -> bool:
        """Whether the matches of three similarities are of one uneven ground, not of one that
        repeats.
        """
        every, others = np.concatenate(groups), np.concatenate(groups[1:])
        seen = self._epipolar(pa, pb, every, scale)
        if np.isin(others, seen).mean() < self.one_view:
            return False
        by = fit("affine", pa[groups[0]], pb[groups[0]])
        return by is not None and (
            _smooth(pa[every], pb[every] - transfer(by, pa[every])) > self.smooth
        )

    def _epipolar(
        self, pa: np.ndarray, pb: np.ndarray, keep: np.ndarray, scale: float
    ) -> np.ndarray:
        """Indices of the matches in `keep` that agree with one epipolar geometry."""
        kind, limit = EPIPOLAR[self.epipolar], self.epipolar_px * scale
        for order in (keep, keep[::-1]):
            # an assertion of OpenCV fails where a sample has no model (5.0.0, one call of some
            # thousands); in another order, the samples are others
            with suppress(cv2.error):
                _, inliers = cv2.findFundamentalMat(pa[order], pb[order], kind, limit, 0.999, 1000)
                return order[:0] if inliers is None else np.sort(order[inliers.ravel() > 0])
        return keep[:0]


def _similarity(
    pa: NDArray[np.float64], pb: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_]]:
    """The similarity (2, 3) from pa to pb (n, 2) that most pairs agree with within a tolerance in
    px, None where there is none; and which do (n,).
    """
    model, inliers = cv2.estimateAffinePartial2D(
        pa, pb, ransacReprojThreshold=tolerance, maxIters=2000, confidence=0.999, refineIters=5
    )
    if model is None:
        return None, np.zeros(len(pa), np.bool_)
    return np.asarray(model, np.float64), inliers.ravel() > 0


def _groups(
    pa: NDArray[np.float64],
    pb: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    tolerance: float,
    least: float,
) -> list[NDArray[np.intp]]:
    """The pairs (of n, 2) that agree with the best similarity, and of the others those with the
    second and the third best, as long as these are more than `least`.
    """
    found, left = [np.flatnonzero(inliers)], np.flatnonzero(~inliers)
    for rank in (2, 1):
        if len(left) <= rank * least:
            break
        _, own = _similarity(pa[left], pb[left], tolerance)
        if own.sum() <= least:
            break
        found.append(left[own])
        left = left[~own]
    return found


def _smooth(px: NDArray[np.float64], moved: NDArray[np.float64]) -> float:
    """By how much less displacements (n, 2) of places (n, 2) beside one another differ than those
    of any two: 1 where they change slowly over the picture, about 0 where they lie among one
    another.
    """
    beside = nearest(px, px, 1 + BESIDE)[1][:, 1:]
    apart = np.linalg.norm(moved[:, None] - moved[None], axis=2)
    usual = apart.sum() / (len(px) * (len(px) - 1))
    return 1 - float(apart[np.arange(len(px))[:, None], beside].mean() / max(usual, 1e-9))


def _flat(pa: NDArray[np.float64], pb: NDArray[np.float64], tolerance: float) -> float:
    """The share of pairs (n, 2) that agree with one homography within a tolerance in px."""
    _, inliers = cv2.findHomography(pa, pb, cv2.RANSAC, tolerance)
    return 0.0 if inliers is None else float(inliers.mean())
