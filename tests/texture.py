"""Ground of known truth: random texture drawn four times finer than the pixels that see it."""

from functools import lru_cache

import cv2
import numpy as np

FINE = 4


@lru_cache(maxsize=4)
def texture(height, width, seed=0, roughness=1.0):
    """Grey values (height, width), mean 120, detail at every scale (amplitude ~ frequency **
    -roughness).

    Not to be written to: who asks again gets the same.
    """
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    amplitude = 1 / np.maximum(np.hypot(fy, fx), 1 / max(height, width)) ** roughness
    phase = np.exp(2j * np.pi * rng.random((height, width // 2 + 1)))
    image = np.fft.irfft2(amplitude * phase, s=(height, width))
    grey = (120 + 35 * image / image.std()).astype(np.float32)
    grey.setflags(write=False)
    return grey


def seen(fine, row, column, size=64):
    """What a sensor of pixels FINE times as large sees of a fine texture from (row, column) on."""
    cut = fine[row : row + size * FINE, column : column + size * FINE]
    return cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA)
