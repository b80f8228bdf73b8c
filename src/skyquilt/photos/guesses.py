"""What is assumed of a camera of which its files tell nothing."""

from dataclasses import replace

from skyquilt.model.photo import Focal, Photo

_GUESSED, _GUESSED_THERMAL = (0.75, 0.25), (1.15, 0.30)
"""Focal length of an unknown camera as a multiple of the long side (thermal: of the width), and its
relative deviation: half of the table's visible cameras lie below 0.71, nine in ten from 0.58 to
1.14.
"""


def guessed_focal(width: float, height: float, *, thermal: bool) -> Focal:
    """The focal length of an unknown camera whose pictures have `width` x `height` px."""
    multiple, share = _GUESSED_THERMAL if thermal else _GUESSED
    px = multiple * (width if thermal else max(width, height))
    return Focal(px=px, sigma_px=share * px, source="guess")


def as_thermal(photo: Photo) -> Photo:
    """A photo whose file does not say that it is of a thermal camera, as one of such a camera."""
    focal = photo.focal
    if focal.source == "guess":
        focal = guessed_focal(photo.width, photo.height, thermal=True)
    return replace(photo, band="thermal", focal=focal)
