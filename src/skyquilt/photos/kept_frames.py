"""Decoded frames of clips, as they are kept in a store."""

import numpy as np
import simplejpeg
from numpy.typing import NDArray

KEPT_QUALITY = 97
"""Some 45 dB from what the clip gave."""


def kept_frame(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A decoded frame (height, width, 3) RGB as the bytes (n,) of a JPEG without metadata. As in
    the clip, colours have half the resolution.
    """
    data = simplejpeg.encode_jpeg(
        np.ascontiguousarray(pixels), quality=KEPT_QUALITY, colorspace="RGB", colorsubsampling="420"
    )
    return np.frombuffer(data, np.uint8)
