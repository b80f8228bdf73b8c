"""Marks that stay at one place of a camera's pictures and keep their look: a cross, a scale, a
text, parts of the drone. Drawn only where no other photo shows the ground.

What is written into a picture hardly varies from photo to photo, while the ground beside it does.
Marks without features, such as the even bar of a scale, are found so, too
(`matching.fixed_marks` finds those with features). Overlapping photos tell such marks from ground
that is alike in all pictures (a road that the drone follows): they show something else there.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

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
LEAST = 4
"""Fewest pixels of a reduced picture that surely show a mark."""
BESIDE = 3
"""Width in px of a reduced picture of the strip around a mark that is compared with it."""
ASKED, POINTS = 10, 40
"""Photos whose ground is sought in others, and most pixels of a mark, or beside it, in each."""
FINE = 1024
"""Longest side in px of the pictures that are compared where photos show other marks: thumbnails
do not tell the thin lines of a cross-hair or a scale, between features at their ends.
"""
OTHER = 1.5
"""What others show in place of a mark differs from it by so many times more than beside it."""
Mask = NDArray[np.bool_]
Grey = NDArray[np.uint8]


def find_lasting_marks(
    views: Sequence[View],
    names: Sequence[str],
    thumbnails: Mapping[int, NDArray[Any]],
    flat: Surface,
    fixed: Mapping[int, Blank],
    grey: Callable[[int, int], Grey] | None = None,
) -> tuple[dict[str, Blank], tuple[str, ...]]:
    """Where the pictures of each camera show marks, only of cameras with marks, and notes.

    `views` of level ground, `flat`, from places apart, and the name (n) of the camera of each;
    `thumbnails`: (h, w[, bands]) of their photos, of 8 bits; `fixed`: marks of photos known before,
    by index; `grey`: the picture (h, w) of a photo (index), its longer side of so many px.
    """
    found, notes = dict[str, Blank](), list[str]()
    for name in dict.fromkeys(names):
        own = [v for v, n in zip(views, names, strict=True) if n == name]
        if len(own) < FEWEST:
            continue
        some = [own[k] for k in evenly(len(own), LOOKED_AT)]
        small = thumbnails[own[0].photo].shape[:2]
        known = fixed.get(own[0].photo)
        if known is None or grey is None:
            pictures = np.stack([to_grey8(thumbnails[v.photo]) for v in some])
        else:
            pictures = np.stack([grey(v.photo, FINE) for v in some])
        label = _hardly_varying(pictures)
        marks = [k for k in range(1, label.max() + 1) if _is_mark(label, k, some, pictures, flat)]
        mask = np.isin(label, marks)
        size = own[0].camera.width, own[0].camera.height
        if known is not None and (known.at(*_at(mask, size).T) < 0).all():
            continue
        if mask.any():
            found[name] = around(_reduced(mask, small), size)
            notes.append(
                f"Photos of {name} show marks at the same place of every picture, on"
                f" {100 * mask.mean():.1f} % of it, that stay as they are while the ground beside"
                " them changes: a cross, a scale or a text written into them, or a part of the"
                " drone. They are drawn only where no other photo shows the ground."
            )
    return found, tuple(notes)


def _hardly_varying(pictures: Grey) -> NDArray[np.int32]:
    """Connected parts (h, w) of pictures (n, h, w) that hardly vary while their surroundings do,
    numbered from 1; 0 is none. A black rim is none (`imaging.blank` finds it).
    """
    last = len(pictures) - 1
    odd = int(np.ceil(ODD * len(pictures)))
    ordered = np.partition(pictures, (odd, last // 2, last - odd), axis=0)
    varies = ordered[last - odd] - ordered[odd]
    side = round(SURROUNDINGS * max(varies.shape)) | 1
    surroundings = cv2.medianBlur(varies, side).astype(np.float32)
    tells = surroundings >= VARYING
    low = tells & (varies < HARDLY * surroundings)
    _, label = cv2.connectedComponents(low.astype(np.uint8), connectivity=8)
    sure = tells & (varies < SURELY * surroundings)
    kept = np.bincount(label[sure], minlength=label.max() + 1) >= LEAST
    kept[0] = False
    for k in rim_labels(label):
        kept[k] &= float(np.median(ordered[last // 2][label == k])) > BLACK
    return np.where(kept, np.cumsum(kept), 0)[label].astype(np.int32)


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


def _reduced(mask: Mask, shape: tuple[int, ...]) -> Mask:
    """A mask (h, w) as one of another shape, True where any of its pixels is: limits of photos are
    looked at in places as far apart as pixels of thumbnails are, about.
    """
    if mask.shape[0] <= shape[0]:
        return mask
    share = cv2.resize(mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(share > 0)


def _at(mask: Mask, size: tuple[int, int]) -> NDArray[np.float64]:
    """(n, 2) columns and rows in photos of a `size` (width and height in px) of the pixels of a
    mask (h, w) of reduced ones.
    """
    return np.asarray((np.argwhere(mask)[:, ::-1] + 0.5) * size / mask.shape[::-1] - 0.5)
