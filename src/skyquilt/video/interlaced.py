"""Frames of interlaced recordings (analog cameras, DV, HDV): every second line was taken half a
frame later, so what moves has a comb for an edge. Nothing in many files tells it but the picture.
"""

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]
HEIGHTS = (480, 486, 576, 1080, 1088)
"""Lines of the standards that interlace."""
COMBED = 1.0
"""A frame is combed where neighbouring lines differ by so much more than lines two apart: those of
whole frames differ by a third.
"""
EACH = 8
"""One of so many columns is looked at."""


def first_field(pixels: Frame) -> Frame:
    """A frame (height, width[, 3]) as its even lines alone show it, if it is combed; the same frame
    otherwise. The lines keep their places, so poses and lens do.
    """
    if len(pixels) not in HEIGHTS or not _combed(pixels):
        return pixels
    out = pixels.copy()
    above, below = pixels[:-2:2].astype(np.uint16), pixels[2::2]
    out[1 : 1 + 2 * len(below) : 2] = (above + below + 1) // 2
    out[-1] = out[-2]
    return out


def _combed(pixels: Frame) -> bool:
    some = pixels[:, ::EACH].reshape(len(pixels), -1).astype(np.float32)
    next_to, two_apart = (float(((some[by:] - some[:-by]) ** 2).mean()) for by in (1, 2))
    return next_to > COMBED * two_apart
