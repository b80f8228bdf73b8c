"""Marks that stay at one place of a camera's pictures and keep their look: a cross, a scale, a
text, parts of the drone. Drawn only where no other photo shows the ground.

What is written into a picture hardly varies from photo to photo, while the ground beside it does.
Marks without features, such as the even bar of a scale, are found so, too
(`matching.fixed_marks` finds those with features). What the ground shines through (a watermark, a
scratch or a hair on the lens) varies like the ground, but is lighter or darker than what lies
beside it in all pictures alike. Overlapping photos tell such marks from ground that is alike in all
pictures (a road that the drone follows): they show something else there.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.oblique_start import reach_of
from skyquilt.imaging.blank import BLACK, Blank, around, rim_labels
from skyquilt.imaging.grey import to_grey8
from skyquilt.imaging.nodes import View, project_all
from skyquilt.imaging.views import on_ground
from skyquilt.model.photo import evenly
from skyquilt.model.surface import Surface

LOOKED_AT, FEWEST = 30, 10
"""Photos of a camera that are compared, spread evenly over the survey, and fewest that tell."""
ODD = 0.1
"""Share of these photos left out at either end of the values of a pixel."""
VARYING = 12
"""Levels of 255 by which the surroundings vary at least where something can be told."""
HARDLY, SURELY = 0.5, 0.25
"""A mark varies by less than this share of what its surroundings do, and by less than the other in
its surest pixels: 0.3 is reached by single pixels of ordinary ground.
"""
SURROUNDINGS = 0.08
"""Side of a pixel's surroundings, in longer sides of the picture: marks that are not drawn as lines
are half as wide at most.
"""
STILL = 6
"""Levels of 255 by which what is written into pictures varies at most: a part that does so is
compared with the whole picture, too, since a logo may be wider than its surroundings.
"""
THROUGH, CLEARLY, LESS_CLEARLY = 8, 6.0, 4.0
"""What the ground shines through differs by more than so many levels of 255 from what lies beside
it, in the median of pictures, and by so many of its standard deviations in its surest pixels; by
the other number in all.
"""
SIGMA_OF_ABSOLUTE = 1.86
"""Standard deviation of a median of normal values, over the median of how far they are from it,
times the root of their number.
"""
LEAST = 4
"""Fewest pixels of a reduced picture that surely show a mark."""
BESIDE = 3
"""Width in px of a reduced picture of the strip around a mark that is compared with it."""
MOSTLY = 0.7
"""A part of which a larger share lies within marks that are known is one of these, with its rim."""
ASKED, POINTS = 10, 40
"""Photos whose ground is sought in others, and most pixels of a mark, or beside it, in each."""
OTHER = 1.5
"""What others show in place of a mark differs from it by so many times more than beside it."""
MOVES = 0.7
"""The ground behind a spot on the lens extends over at least this share of the extent of the
places that photos were taken from; that behind a house that they circle around hardly moves.
"""
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]


def find_lasting_marks(
    views: Sequence[View],
    names: Sequence[str],
    thumbnails: Mapping[int, NDArray[Any]],
    flat: Surface,
    fixed: Mapping[int, Blank],
) -> tuple[dict[str, Blank], tuple[str, ...]]:
    """Where the pictures of each camera show marks, only of cameras with marks, and notes.

    `views` of level ground, `flat`, from places apart, and the name (n) of the camera of each;
    `thumbnails`: (h, w[, bands]) of their photos, of 8 bits; `fixed`: marks and frames of photos
    that are known before, by index.
    """
    found, notes = dict[str, Blank](), list[str]()
    for name in dict.fromkeys(names):
        own = [v for v, n in zip(views, names, strict=True) if n == name]
        if len(own) < FEWEST:
            continue
        some = [own[k] for k in evenly(len(own), LOOKED_AT)]
        pictures = np.stack([to_grey8(thumbnails[v.photo]) for v in some])
        label = _hardly_varying(pictures)
        size = own[0].camera.width, own[0].camera.height
        known = fixed.get(own[0].photo)
        marks = [
            k
            for k in range(1, label.max() + 1)
            if not _is_known(label == k, known, size) and _is_mark(label, k, some, pictures, flat)
        ]
        mask = on_other_ground(np.isin(label, marks), some, size, flat)
        if mask.any():
            found[name] = around(mask, size)
            notes.append(
                f"Photos of {name} show marks at the same place of every picture, on"
                f" {100 * mask.mean():.1f} % of it, that stay as they are while the ground beside"
                " them changes: a cross, a scale or a text written into them, or a part of the"
                " drone. They are drawn only where no other photo shows the ground."
            )
    return found, tuple(notes)


def _hardly_varying(pictures: Grey) -> NDArray[np.int32]:
    """Connected parts (h, w) of pictures (n, h, w) that hardly vary while their surroundings do, or
    differ from these alike in all, numbered from 1; 0 is none. A black rim is none
    (`imaging.blank` finds it).
    """
    last = len(pictures) - 1
    odd = int(np.ceil(ODD * len(pictures)))
    ordered = np.partition(pictures, (odd, last // 2, last - odd), axis=0)
    varies = ordered[last - odd] - ordered[odd]
    side = round(SURROUNDINGS * max(varies.shape)) | 1
    surroundings = cv2.medianBlur(varies, side).astype(np.float32)
    surroundings[varies <= STILL] = np.maximum(surroundings, np.median(varies))[varies <= STILL]
    tells = surroundings >= VARYING
    differs = _differing(pictures, side)
    low = tells & (varies < HARDLY * surroundings) | (differs > LESS_CLEARLY)
    _, label = cv2.connectedComponents(low.astype(np.uint8), connectivity=8)
    sure = tells & (varies < SURELY * surroundings) | (differs > CLEARLY)
    kept = np.bincount(label[sure], minlength=label.max() + 1) >= LEAST
    kept[0] = False
    for k in rim_labels(label):
        kept[k] &= float(np.median(ordered[last // 2][label == k])) > BLACK
    return np.where(kept, np.cumsum(kept), 0)[label].astype(np.int32)


def _is_known(part: Mask, known: Blank | None, size: tuple[int, int]) -> bool:
    """Whether most of a part (h, w) of photos of a `size` (width and height in px) lies within
    marks and frames that are known.
    """
    return known is not None and bool((known.at(*_at(part, size).T) < 0).mean() > MOSTLY)


def _differing(pictures: Grey, side: int) -> NDArray[np.float64]:
    """By how many standard deviations (h, w) pictures (n, h, w) are lighter or darker than what
    lies beside it in a square of a `side` in px, alike in all.
    """
    off = np.stack([p - cv2.medianBlur(p, side).astype(np.float32) for p in pictures])
    middle = np.median(off, axis=0)
    sigma = SIGMA_OF_ABSOLUTE * np.median(np.abs(off - middle), axis=0) / np.sqrt(len(off))
    clear = np.abs(middle) / np.maximum(sigma, THROUGH / CLEARLY)
    return np.where(np.abs(middle) > THROUGH, clear, 0.0)


def _is_mark(
    label: NDArray[np.int32], k: int, views: Sequence[View], pictures: Grey, flat: Surface
) -> bool:
    """Whether other photos show something else at the ground under a part (number) of pictures
    (n, h, w) of some views, more so than beside it.
    """
    part = label == k
    wide = cv2.dilate(part.astype(np.uint8), np.ones((2 * BESIDE + 1,) * 2, np.uint8))
    beside = (wide > 0) & (label == 0)
    differs = [_differs(m, label > 0, views, pictures, flat) for m in (part, beside)]
    return min(map(len, differs)) > 0 and bool(
        np.median(differs[0]) > OTHER * np.median(differs[1])
    )


def _differs(
    mask: Mask, marked: Mask, views: Sequence[View], pictures: Grey, flat: Surface
) -> NDArray[np.float64]:
    """(n,) by how many levels other photos differ from some at the ground under a mask (h, w) of
    these, where they do not show what is `marked` (h, w).
    """
    camera = views[0].camera
    places = np.argwhere(mask)[evenly(int(mask.sum()), POINTS)]
    shape, size = np.array(mask.shape), np.array([camera.height, camera.width])
    px = _at(mask, (camera.width, camera.height))[evenly(int(mask.sum()), POINTS)]
    found = [np.zeros(0)]
    for a in evenly(len(views), ASKED):
        x, y, z = on_ground(views[a], px, flat).T[:, None]
        own = pictures[a][tuple(places.T)].astype(float)
        for b, nodes in enumerate(project_all(views, x, y, z)):
            seen = nodes.seen[0] & (b != a)
            there = np.stack([nodes.v[0, seen], nodes.u[0, seen]], 1)
            row, column = (((there + 0.5) * shape / size).astype(int).clip(0, shape - 1)).T
            free = ~marked[row, column]
            found.append(np.abs(pictures[b][row, column][free] - own[seen][free]))
    return np.concatenate(found)


def on_other_ground(
    spot: NDArray[np.bool_], views: Sequence[View], size: tuple[int, int], flat: Surface
) -> NDArray[np.bool_]:
    """The parts of a mark or spot (rows, columns) that lie on other ground from view to view: what
    photos circle around lies at the same place of each, too.
    """
    number, part = cv2.connectedComponents(spot.view(np.uint8))
    centres = np.array([v.pose.map_C[:2] for v in views])
    kept = np.zeros_like(spot)
    for k in range(1, number):
        rows, columns = np.nonzero(part == k)
        box = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
        px = box * np.array(size) / spot.shape[::-1] - 0.5
        ground = np.array([on_ground(v, px, flat)[:, :2].mean(0) for v in views])
        seen = np.isfinite(ground).all(1)  # not the sky
        if reach_of(ground) >= MOVES * reach_of(centres[seen]):
            kept |= part == k
    return kept


def _at(mask: Mask, size: tuple[int, int]) -> NDArray[np.float64]:
    """(n, 2) columns and rows in photos of a `size` (width and height in px) of the pixels of a
    mask (h, w) of reduced ones.
    """
    return np.asarray((np.argwhere(mask)[:, ::-1] + 0.5) * size / mask.shape[::-1] - 0.5)
