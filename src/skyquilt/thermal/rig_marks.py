"""Marks in thermal frames that are placed by the visual photos: a cross, a scale, a text, which
cameras write into pictures in a palette's colours. No seam lines avoid them here, so frames show
nothing there, and what no other frame shows is filled in from them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import REACH, Blank
from skyquilt.imaging.nodes import STEP, View
from skyquilt.model.photo import Photo
from skyquilt.model.raster import Window
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.lasting_marks import find_lasting_marks
from skyquilt.ortho.tie_surface import level

MOST_WIDER = 0.9
"""Distance from a mark up to which it can be widened, as a share of what is told of distances."""


def marks_in(
    photos: Sequence[Photo],
    views: Sequence[View],
    thumbnails: Mapping[int, NDArray[Any]],
    ground: Ground,
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """Where frames (index in `photos`) of 8 bits show marks, and notes. Each is as much wider as
    nodes of the map, at which a photo's limits are looked at, are apart.
    """
    flat = level(float(np.median(ground.surface.z)))
    own = [v for v in views if thumbnails[v.photo].dtype == np.uint8]
    names = [photos[v.photo].camera_key for v in own]
    found, notes = find_lasting_marks(own, names, thumbnails, flat, {})
    marks = {}
    for view, name in zip(own, names, strict=True):
        if (mark := found.get(name)) is not None:
            high = float(view.pose.map_C[2]) - float(np.median(ground.surface.z))
            pixel = view.camera.width / mark.room.shape[1] * high / view.camera.focal
            wider = min(STEP * ground.grid.gsd / max(pixel, 1e-6) / REACH, MOST_WIDER)
            marks[view.photo] = replace(mark, room=mark.room - np.float32(wider))
    return marks, notes


def drawn(
    window: Window, compose: Composer, with_marks: Composer | None
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels (h, w, bands) of a window, and where there are any; what nothing else shows is drawn
    `with_marks`, if there are such frames.
    """
    done = compose(window)
    pixels, shown = done.pixels, done.photo >= 0
    if with_marks is None or shown.all():
        return pixels, shown
    below = with_marks(window)
    return np.where(shown[..., None], pixels, below.pixels), shown | (below.photo >= 0)
