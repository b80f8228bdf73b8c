"""Marks written into both pictures at the same places: text, scales, cross-hairs, logos.

Screens of cameras and recordings of flights carry them. They are the same in both spectra, so they
fit each other better than anything of the scene does, and at one place: the picture on itself.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Agree
from skyquilt.coregistration.orientation import between, orientation
from skyquilt.coregistration.usable import both_usable, one_band
from skyquilt.geometry.transforms import transfer
from skyquilt.model.registration import (
    Guess,
    Outcome,
    Picture,
    RefusedRegistration,
    Registers,
    Registration,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Marks:
    """Where two pictures carry the same marks; masks (h, w) of both, reduced to one size."""

    certain: NDArray[np.uint8]
    """1 at marks and beside them, else 0."""
    likely: NDArray[np.uint8]
    """1 also at thin strokes that both have, where the pictures differ in size."""
    possible: NDArray[np.uint8]
    """1 also at what may be marks, or alike by chance."""

    def cleared(self, picture: Picture) -> Picture:
        """The picture with its marks painted over from around them."""
        marked = _sized(self.certain, picture.shape)
        return replace(picture, values=cv2.inpaint(picture.values, marked, 3, cv2.INPAINT_TELEA))


@dataclass(frozen=True, kw_only=True)
class FindMarks:
    """Finds what has the same brightness and strong contrast at the same places of two pictures of
    8 bits, provided that much more is so than with one of them shifted.

    Of 34 real pairs, and as many unrelated ones, each as it is and with one picture at 0.6 of its
    size, none had more than 1.2 times as much as shifted; with a thermal camera's text, scale and
    logo in both it was 1.9 to 83 times as much at one size, at two sizes mostly 1.7 and more.
    """

    side: float = 800.0
    """Side in px of the square to whose area pictures are reduced."""
    same: float = 16.0
    """Largest difference of a mark in both, levels of 8 bits."""
    step: float = 48.0
    """Least range of brightness within 5 x 5 px of a mark."""
    window: int = 7
    """Side in px of the square in which the share of such pixels is taken."""
    certain: float = 0.45
    """Share from which a mark is certain."""
    near: float = 0.3
    """Share from which pixels belong to a certain mark that they touch."""
    possible: float = 0.25
    """Share from which they may be marks."""
    part: float = 0.05
    """Least share of certain pixels in a mark."""
    reach: tuple[int, int] = (5, 9)
    """Sides in px of the squares by which marks, certain and possible, are widened."""
    times: float = 1.5
    """How many times as much must be alike as with one picture shifted."""
    least: float = 0.0005
    """Least share of the picture that must be alike besides."""
    most: tuple[float, float] = (0.4, 0.15)
    """Largest share that marks have of all that has contrast in either picture, where that covers
    more than the second share of it; else the pictures themselves are alike. With marks it was 0.1
    at most, for a picture and itself with noise 0.47 at least.
    """
    one_size: float = 0.02
    """Largest difference in size up to which marks have one brightness and one width in both."""
    beside: float = 0.06
    """The shift, as a share of the picture's sides."""

    def __call__(self, a: Picture, b: Picture) -> Marks | None:
        """The marks; None if there are none, or the pictures have other types or other ratios of
        their sides.
        """
        if any(p.values.dtype != np.uint8 for p in (a, b)):
            return None
        if abs(a.shape[1] * b.shape[0] / (a.shape[0] * b.shape[1]) - 1) > 0.01:
            return None
        height, width = min(a.shape, b.shape)
        factor = min(1.0, self.side / float(np.sqrt(height * width)))
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        one, other = (self._reduced(p, size) for p in (a, b))
        alike = self._alike(one, other)
        certain = alike >= self.certain
        dx, dy = (max(1, round(self.beside * side)) for side in size)
        by_chance = max(
            (self._alike(one, np.roll(other, (y, x), (1, 2))) >= self.certain).sum()
            for x, y in ((dx, 0), (0, dy), (dx, dy), (-dx, dy))
        )
        if certain.sum() <= self.times * by_chance + self.least * certain.size:
            return None
        contrast, (share, least) = float(np.maximum(one[1], other[1]).mean()), self.most
        if contrast > least and certain.mean() > share * contrast:
            return None
        marks = self._touching(alike >= self.near, certain)
        strokes = np.zeros(marks.shape, bool)
        if abs(a.shape[1] / b.shape[1] - 1) > self.one_size:
            strokes = self._strokes(one[0], other[0])
        return Marks(
            certain=_widened(marks, self.reach[0]),
            likely=_widened(marks | strokes, self.reach[0]),
            possible=_widened((alike >= self.possible) | strokes, self.reach[1]),
        )

    def _reduced(self, picture: Picture, size: tuple[int, int]) -> NDArray[np.float32]:
        """(2, h, w) brightness, and where its range is that of a mark."""
        grey = cv2.resize(one_band(picture.values), size, interpolation=cv2.INTER_AREA)
        around = np.ones((5, 5), np.uint8)
        steep = cv2.dilate(grey, around) - cv2.erode(grey, around) >= self.step
        return np.stack([grey, steep.astype(np.float32)])

    def _alike(self, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.float32]:
        """(h, w) share of the window that is alike, at pixels that are; else 0."""
        alike = (np.abs(one[0] - other[0]) <= self.same) * one[1] * other[1]
        return np.asarray(alike * cv2.boxFilter(alike, -1, (self.window, self.window)))

    def _strokes(self, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
        """(h, w) thin strokes in both, lighter or darker than both their sides: what is written
        over pictures of different sizes has neither one brightness nor one width.
        """
        thin = np.ones((self.window, self.window), np.uint8)
        found = []
        for way in (cv2.MORPH_TOPHAT, cv2.MORPH_BLACKHAT):
            a, b = (cv2.morphologyEx(p, way, thin) >= self.step for p in (one, other))
            found.append((_widened(a, 3) > 0) & (_widened(b, 3) > 0))
        return np.asarray(found[0] | found[1])

    def _touching(self, near: NDArray[Any], certain: NDArray[Any]) -> NDArray[np.bool_]:
        """Connected pixels of which a part is certain."""
        count, label = cv2.connectedComponents(_widened(near, 3), connectivity=4)
        size = np.bincount(label.ravel(), minlength=count)
        sure = np.bincount(label[certain], minlength=count)
        kept = (sure > 0) & (sure >= self.part * size)
        kept[0] = False
        return np.asarray(kept[label])


@dataclass(frozen=True, kw_only=True)
class WithoutMarks:
    """A method on pictures from which marks that both carry are taken. Where it still finds that
    one picture lies on the other as their marks do, patches must confirm it beside everything that
    may be a mark.
    """

    method: Registers
    """The method."""
    find: FindMarks = field(default_factory=FindMarks)
    """What marks are."""
    agree: Agree = field(default_factory=Agree)
    """The test."""
    side: float = 256.0
    """Side in px of the square to whose area pictures are reduced for the test."""
    least_surprise: float = 5.0
    """Agreement below which it is not confirmed."""
    own: float = 0.05
    """Largest distance of a corner from where the marks have it, as a share of b's longer side, at
    which a registration may be that of the marks.
    """
    version: ClassVar[int] = 2

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a."""
        if (marks := self.find(a, b)) is None:
            return self.method(a, b, guess)
        clear_a, clear_b = marks.cleared(a), marks.cleared(b)
        for hidden in (None, marks.likely, marks.possible):
            found = self.method(_without(clear_a, hidden), _without(clear_b, hidden), guess)
            if isinstance(found, RefusedRegistration) or not self._of_marks(found, a, b):
                return found
            if self._confirmed(found, *(_without(p, marks.possible) for p in (a, b))):
                return found
        return RefusedRegistration(
            reason="text, scales or other marks are written into both pictures at the same places,"
            " and little but these confirms the registration; give pictures without them",
            evidence=found.evidence,
        )

    def _of_marks(self, found: Registration, a: Picture, b: Picture) -> bool:
        """Whether it places the frame of a on that of b."""
        (high, wide), (height, width) = a.shape, b.shape
        corners = np.array([[0.0, 0.0], [wide, 0.0], [0.0, high], [wide, high]])
        off = transfer(found.b_H_a, corners) - corners * [width / wide, height / high]
        return bool(np.hypot(*off.T).max() <= self.own * max(width, height))

    def _confirmed(self, found: Registration, a: Picture, b: Picture) -> bool:
        pair = both_usable(a, b)
        if isinstance(pair, RefusedRegistration):
            return False
        one, other = (orientation(p.grey, p.valid, self.side) for p in pair)
        agreement = self.agree(one, other, between(one, other, found.b_H_a))
        return agreement.surprise >= self.least_surprise


def _without(picture: Picture, marks: NDArray[np.uint8] | None) -> Picture:
    """The picture without measurements at marks, if any are given."""
    if marks is None:
        return picture
    free = _sized(marks, picture.shape) == 0
    return replace(picture, valid=free if picture.valid is None else free & picture.valid)


def _sized(marks: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(marks, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _widened(mask: NDArray[Any], side: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)), np.uint8)
