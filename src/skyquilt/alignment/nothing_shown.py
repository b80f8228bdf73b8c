"""Photos without links that show nothing: a lens cap, a failed exposure, the closed shutter of a
thermal camera. Placed by their metadata, they would lie on the map as ground.
"""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import ground_places
from skyquilt.alignment.inputs import GreyPicture
from skyquilt.geometry.camera import shown
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Pose

TONE_PX, BLACK, WHITE = 64, 12, 243
"""Longest side in px of a picture that is asked whether it is black or white all over, and the
levels of 255 below and above which it is.
"""
ONE_TONE = "it is black or white all over"
"""The reason recorded for such a photo."""
NOISE_PX, SMOOTH_PX = 160, 4.0
"""Longest side in px of a thermal picture that is asked whether it shows noise alone, and standard
deviation of the smoothing by whose result it is compared: the shutter need not be evenly warm.
"""
NOISE, GROUND = 0.2, 0.5
"""Correlation of neighbouring pixels up to which a picture shows noise alone, and from which it
shows ground: noise has none, ground seen through a lens 0.6 and more.
"""
NEAREST, FEWEST = 8, 9
"""Nearest connected photos that are asked for what the ground looks like, and fewest of the places
on it that one of them must show.
"""
CLOSED = (
    "it shows next to nothing where other frames show the ground, as a camera does while its"
    " shutter is closed to calibrate it"
)
"""The reason recorded for a frame of a closed shutter."""


def one_tone(photo: Photo, grey: Callable[[int], NDArray[np.uint8]]) -> bool:
    """Whether a photo without links is black or white all over: a lens cap, a failed exposure. It
    would be drawn as a hole in the map. Measured values are none. `grey`: the photo in grey, by its
    longest side; in a small one the noise of the sensor, in which features are found, is gone.
    """
    if photo.dtype != "uint8" or photo.unit:
        return False
    dark, light = np.percentile(grey(TONE_PX), [1, 99])
    return bool(light < BLACK or dark > WHITE)


def shutter_closed(
    photo: Photo, number: int, pose: Pose, alignment: Alignment, grey: GreyPicture
) -> bool:
    """Whether a thermal photo without links shows noise alone where most of the connected ones
    that show the same places show ground. Over water or snow they show noise as well. `pose`: by
    its metadata; `grey` as in `AlignmentInputs`.
    """
    if photo.band != "thermal" or not len(alignment.ties.xyz):
        return False
    if likeness(grey(number, NOISE_PX)) > NOISE or pose.map_C[2] <= alignment.ground_m:
        return False
    places = ground_places(pose, photo.lens, alignment.ground_m)
    away = {
        i: float(np.hypot(*(alignment.poses[i].map_C - pose.map_C)[:2])) for i in alignment.held
    }
    ground = [
        likeness(part) > GROUND
        for i in sorted(away, key=away.__getitem__)[:NEAREST]
        if (part := _part(places, i, alignment, partial(grey, i))) is not None
    ]
    return bool(ground) and float(np.mean(ground)) > 0.5


def likeness(picture: NDArray[np.uint8]) -> float:
    """Correlation of neighbouring pixels of a picture (h, w), without what changes over more of
    them; 0 where all are equal.
    """
    fine = picture.astype(np.float32)
    fine = fine - cv2.GaussianBlur(fine, (0, 0), SMOOTH_PX)
    power = float((fine**2).mean())
    beside = (fine[:, 1:] * fine[:, :-1]).mean() + (fine[1:] * fine[:-1]).mean()
    return float(beside) / 2 / power if power > 0 else 0.0


def _part(
    places: NDArray[np.float64],
    number: int,
    alignment: Alignment,
    grey: Callable[[int], NDArray[np.uint8]],
) -> NDArray[np.uint8] | None:
    """The part of a connected photo (index) that shows places (n, 3); None if it shows too few."""
    camera = alignment.camera(number)
    px, seen = shown(camera, alignment.poses[number].to_camera(places))
    if int(seen.sum()) < FEWEST:
        return None
    picture = grey(NOISE_PX)
    scale = np.array(picture.shape[::-1]) / [camera.width, camera.height]
    low, high = (f(px[seen] * scale, axis=0).astype(int) for f in (np.min, np.max))
    part = picture[low[1] : high[1] + 1, low[0] : high[0] + 1]
    return part if min(part.shape) > SMOOTH_PX else None
