"""What photos show badly, so that others are drawn in their place: marks, blur, and what is
overexposed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import Blank, around, joined
from skyquilt.model.poses import Alignment
from skyquilt.ortho.sharpness import find_blurred
from skyquilt.photos.side_rows import sentence_of

WHITE = 250
"""Level of 255 from which a band of a reduced picture shows nothing more."""
LEAST_WHITE = 0.02
"""Share of a picture that is that white where it counts as overexposed: roofs and cars are less."""


def spoilt_parts(
    alignment: Alignment,
    details: Callable[[int], NDArray[np.float32]],
    thumbnails: Mapping[int, NDArray[Any]],
    names: Sequence[str],
    fixed: Mapping[int, Blank],
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """What yields to other photos, by photo (index), only of photos where something does, and
    notes. `details` as in `find_blurred`, `thumbnails` (h, w[, bands]), `names` of the photos,
    `fixed`: where they show marks.
    """
    blurred, notes = find_blurred(alignment, details, names)
    white = dict[int, Blank]()
    for i in sorted(alignment.poses):
        camera = alignment.camera(i)
        if part := overexposed(thumbnails[i], (camera.width, camera.height)):
            white[i] = part
    if white:
        notes += (overexposed_note([names[i] for i in white]),)
    out = dict(fixed)
    for found in (blurred, white):
        out |= {i: joined(out[i], b) if i in out else b for i, b in found.items()}
    return out, notes


def overexposed_note(names: Sequence[str]) -> str:
    """A note about overexposed photos of these names, at least one."""
    some = f"{len(names)} photos are" if len(names) > 1 else "One photo is"
    return (
        f"{some} overexposed in part ({sentence_of(names)}): what is white there is drawn only"
        " where no other photo shows the ground."
    )


def overexposed(thumbnail: NDArray[Any], size: tuple[int, int]) -> Blank | None:
    """Where a photo of a `size` (width and height in px) is overexposed, from its reduced picture
    (h, w[, bands]); None where it is not, or has no 8-bit values.
    """
    if thumbnail.dtype != np.uint8:
        return None
    lightest = thumbnail if thumbnail.ndim == 2 else thumbnail.max(2)
    white = np.asarray(lightest >= WHITE)
    if white.mean() <= LEAST_WHITE:
        return None
    return around(white, size)
