"""Parts of pictures along their rim that show nothing, so that they are not drawn: black corners of
a circular fisheye or of photos that a program undistorted, frames and bars of one colour, and
see-through pixels.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

LOOKED_AT, FEWEST = 12, 5
"""Photos of a camera whose rims are compared, and fewest that can tell a rim from dark ground."""
LONGEST = 256
"""Longest side in px of the pictures that are compared."""
BLACK = 12
"""Level of 255 up to which a picture shows nothing, in every photo of the camera."""
EMPTY = 4
"""The same level of a see-through photo, whose empty pixels are 0 before contrast is stretched."""
LEAST, MOST = 0.002, 0.7
"""Shares of a picture that may show nothing; less is noise, more is a picture of the night."""
STEP, BESIDE = 25, 4
"""So much lighter the pictures are within so many px beside a black one, and so much they differ
there from each other beside one of another colour, in the median: dark corners of a lens rise
slowly.
"""
EVEN, NEARLY, MOSTLY = 3, 12, 0.8
"""Levels of 255 by which a frame or bar of one colour differs at most, within and between photos,
on this share of it at least; where compression has left something of the picture beside it, it is
so nearly.
"""
WRITTEN = 0.02
"""A part of the picture that such a rim encloses, and that is smaller, is a text in a bar."""
WIDER = 1.5
"""Width in px of the strip beside it that is not drawn either, since it is mixed with black."""
REACH = 16.0
"""Distances from it are told up to so many px."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Blank:
    """Where a photo shows nothing, or a mark."""

    room: NDArray[np.float32]
    """(h, w) distance from there, in the pixels of this raster, as a share of `REACH`; negative
    within.
    """
    size: tuple[int, int]
    """Width and height of the photo in px."""
    written: "Blank | None" = None
    """The part of it that shows no ground at all, such as a text: rather is a place drawn as
    another photo shows it before which something stands.
    """

    def at(self, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float32]:
        """`room` at photo columns and rows of any shape, interpolated linearly."""
        rows, columns = self.room.shape
        x = np.clip((u + 0.5) * (columns / self.size[0]) - 0.5, 0, columns - 1.001)
        y = np.clip((v + 0.5) * (rows / self.size[1]) - 0.5, 0, rows - 1.001)
        i, j = y.astype(np.int64), x.astype(np.int64)
        x, y = x - j, y - i
        above = self.room[i, j] * (1 - x) + self.room[i, j + 1] * x
        below = self.room[i + 1, j] * (1 - x) + self.room[i + 1, j + 1] * x
        return np.asarray(above * (1 - y) + below * y, np.float32)

    def near(self, u: NDArray[Any], v: NDArray[Any], px: float) -> Mask:
        """Whether photo columns and rows of any shape lie within it, or less than `px` beside."""
        side = self.size[0] / self.room.shape[1]
        return np.asarray(self.at(u, v) < min(px / side / REACH, 1.0))


def find_blanks(
    cameras: Mapping[int, tuple[str, tuple[int, int]]],
    see_through: Collection[int],
    grey: Callable[[int, int], NDArray[np.uint8]],
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """What shows nothing, by photo (only of photos where something does), and a note for each
    camera. `cameras`: name, and width and height in px, of each photo; `see_through`: photos with
    an alpha channel, of which each tells for itself; `grey` as in `workflows.photo_features`.
    """
    found, notes = dict[int, Blank](), list[str]()
    for name, size in dict.fromkeys(cameras.values()):
        own = [i for i, camera in cameras.items() if camera == (name, size)]
        alike = [i for i in own if i not in see_through]
        some = np.unique(np.linspace(0, len(alike) - 1, LOOKED_AT).astype(int)).tolist()
        shared = None
        if len(alike) >= FEWEST:
            shared = blank_rim([grey(alike[k], LONGEST) for k in some])
        masks = dict.fromkeys(alike, shared) if shared is not None else {}
        for i in own:
            if i in see_through and (rim := _rim(grey(i, LONGEST) <= EMPTY)).mean() > LEAST:
                masks[i] = rim
        made = dict[bytes, Blank]()  # programs that undistort photos leave all alike
        for i, mask in masks.items():
            key = mask.tobytes()
            made[key] = found[i] = made.get(key) or Blank(room=_room(mask), size=size)
        if masks:
            share = 100 * float(np.median([m.mean() for m in masks.values()]))
            notes.append(
                f"{len(masks)} photos of {name} show nothing on {share:.1f} % of the picture, along"
                " its rim (black corners, a frame or bars of one colour, or see-through pixels):"
                " that is not drawn."
            )
    return found, tuple(notes)


def marked(mask: Mask, cell_px: float) -> Blank:
    """Where photos show marks, from cells (h, w) of so many px on which features were found."""
    around = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    rows, columns = mask.shape
    size = round(columns * cell_px), round(rows * cell_px)
    return Blank(room=_room(around > 0), size=size)


def around(mask: Mask, size: tuple[int, int]) -> Blank:
    """The parts of a photo under a mask (h, w) of its reduced picture; `size`: width and height of
    the photo in px.
    """
    return Blank(room=_room(mask), size=size)


def whole_picture(size: tuple[int, int]) -> Blank:
    """All of a photo of a `size`, width and height in px."""
    return Blank(room=np.full((2, 2), -1, np.float32), size=size)


def joined(a: Blank, b: Blank) -> Blank:
    """Parts of a photo that are in either."""
    if a.room.size < b.room.size:
        a, b = b, a
    other = cv2.resize(b.room, a.room.shape[::-1], interpolation=cv2.INTER_LINEAR)
    written = a.written or b.written
    if a.written and b.written:
        written = joined(a.written, b.written)
    room = np.minimum(a.room, np.asarray(other, np.float32))
    return Blank(room=room, size=a.size, written=written)


def blank_rim(pictures: Sequence[NDArray[np.uint8]]) -> Mask | None:
    """Where none of some pictures (h, w) of one camera shows anything; None where all do."""
    lightest, darkest = np.max(pictures, axis=0), np.min(pictures, axis=0)
    rim = np.zeros(lightest.shape, bool)
    for mask in (lightest <= BLACK, *_of_one_colour(lightest, darkest)):
        mask = _rim(mask)
        if not LEAST < mask.mean() < MOST:
            continue
        away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        beside = (away > WIDER) & (away <= BESIDE) & ~rim
        level = np.median(darkest[mask])
        if level > BLACK:  # ground beside a frame may have its colour, but not in all photos
            steps = (lightest - darkest)[beside]
        else:
            steps = np.array([np.median(p[beside]) - np.median(p[mask]) for p in pictures])
        if steps.size and np.median(steps) >= STEP:
            rim |= mask
    return _without_writing(rim) if rim.any() else None


def _of_one_colour(lightest: NDArray[np.uint8], darkest: NDArray[np.uint8]) -> list[Mask]:
    """Where pictures are of one colour that is not black, from their `lightest` and `darkest`
    values (h, w): a mask for each colour that their rim mostly has. Ground that is even at one
    place of every picture (a canal beside the line of flight) differs by more.
    """
    rim = np.ones(lightest.shape, bool)
    rim[1:-1, 1:-1] = False
    counts = np.bincount(
        darkest[(lightest - darkest <= EVEN) & (darkest > BLACK) & rim], minlength=256
    )
    light, dark = lightest.astype(int), darkest.astype(int)
    found = list[Mask]()
    while counts.max() > 0:
        level = int(counts.argmax())
        counts[max(level - NEARLY, 0) : level + NEARLY + 1] = 0
        even, nearly = (
            (light <= level + by) & (dark >= max(level - by, BLACK + 1)) for by in (EVEN, NEARLY)
        )
        _, label = cv2.connectedComponents(nearly.astype(np.uint8), connectivity=4)
        size = np.maximum(np.bincount(label.ravel()), 1)  # perhaps of no pixel of another colour
        share = np.bincount(label[even], minlength=len(size)) / size
        found.append(np.asarray((share >= MOSTLY)[label] & nearly))
    return found


def _without_writing(rim: Mask) -> Mask:
    """A rim (h, w) with the small parts of the picture that it encloses."""
    _, label = cv2.connectedComponents((~rim).astype(np.uint8), connectivity=4)
    return np.asarray(rim | (np.bincount(label.ravel()) < WRITTEN * rim.size)[label])


def rim_labels(label: NDArray[Any]) -> NDArray[Any]:
    """The labels (h, w) of connected parts that reach the rim of a picture; 0 is none."""
    at_rim = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    return np.asarray(at_rim[at_rim > 0])


def _rim(dark: Mask) -> Mask:
    """The parts of a mask (h, w) that reach the rim of the picture."""
    _, label = cv2.connectedComponents(dark.astype(np.uint8), connectivity=4)
    return np.asarray(np.isin(label, rim_labels(label)))


def _room(mask: Mask) -> NDArray[np.float32]:
    """`Blank.room` of a mask (h, w)."""
    inside, outside = (
        cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        for m in (mask, ~mask)
    )
    signed = np.where(mask, 0.5 - inside, outside - 0.5) - WIDER
    return np.asarray(np.clip(signed / REACH, -1, 1), np.float32)
