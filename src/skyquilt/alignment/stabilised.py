"""Photos that electronic stabilisation cut out of larger pictures, each elsewhere, so that the
optical axis meets each of them at another place.

Over level ground that looks as if each photo was taken from beside where it was. Relief, and
distortion around another middle than is taken for it, leave residuals of neighbours that are alike.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from skyquilt.alignment.enlarged import fits_better
from skyquilt.alignment.same_lens import MOST_SIZES
from skyquilt.alignment.setup import Setup
from skyquilt.alignment.unfit_cameras import CX, CY
from skyquilt.alignment.unlike_lenses import alike_cameras
from skyquilt.model.photo import Photo, Zoom
from skyquilt.model.poses import Alignment

FEWEST = 6
"""Photos of a camera at least: of fewer, places of axes take up too much else."""
BETTER = 0.92
"""Places of their own are taken where the mean residual falls below this share: 0.54 to 0.90 where
parts lie 1 to 4 % of the width elsewhere, 0.97 and more on real flights without any.
"""
KEPT = 0.99
"""Share of the observations that are kept at least."""
WANDERS = 0.05
"""Deviation of where the axis meets a photo from its middle, as a share of the longer side:
stabilisation has margins of a tenth, about.
"""
NAMED = "stabilised"
"""In the name of the camera of each photo."""


def stabilised_cameras(found: Alignment, cameras: Sequence[str]) -> frozenset[str]:
    """Names of cameras each of whose photos may be another part of what the lens shows, as
    residuals of neighbours tell. `cameras`: names, of each photo.
    """
    number = Counter(cameras[i] for i in found.held)
    return frozenset(
        name for name in alike_cameras(found, cameras) if FEWEST <= number[name] <= MOST_SIZES
    )


def as_stabilised(photos: Sequence[Photo], cameras: Collection[str]) -> list[Photo]:
    """The photos, each of some cameras (names) as of a camera of its own: a part, anywhere, of what
    the same lens shows. Each counts what files tell of the focal length, so it counts for less.
    """
    number = Counter(p.camera_key for p in photos)
    out = list(photos)
    for i, photo in enumerate(photos):
        if photo.camera_key in cameras:
            lens = photo.zoom or Zoom(camera=photo.camera_key, factor=1.0)
            sigma = photo.focal.sigma_px * float(np.sqrt(number[photo.camera_key]))
            out[i] = replace(
                photo,
                camera_key=f"{photo.camera_key} {NAMED} {i + 1}",
                zoom=replace(lens, centred=False),
                focal=replace(photo.focal, sigma_px=sigma),
            )
    return out


def wandering(setup: Setup) -> Setup:
    """The same for an adjustment in which the axis meets each photo of a stabilised camera anywhere
    around its middle.
    """
    mine = np.array([f" {NAMED} " in key for key in setup.camera_keys])
    if not mine.any():
        return setup
    sigma = setup.base.sigma_K.copy()
    for row in np.flatnonzero(mine):
        longer = float(setup.size[setup.members[setup.camera == row]].max())
        sigma[row, [CX, CY]] = WANDERS * longer
    return replace(setup, base=replace(setup.base, sigma_K=sigma))


def fits_stabilised(other: Alignment, found: Alignment, cameras: Sequence[str]) -> bool:
    """Whether an alignment with an axis of its own for each photo fits the pictures much better,
    and leaves no residuals that are alike: several lenses under one name still do. `cameras`:
    names, of each photo, without stabilisation.
    """
    better = fits_better(other, found, kept=KEPT, share=BETTER)
    return better and not stabilised_cameras(other, cameras)


def stabilised_note(found: Alignment, cameras: Sequence[str], stabilised: Collection[str]) -> str:
    """What the user is told. `cameras`: names, of each photo."""
    said = []
    for name in sorted(stabilised):
        own = [found.camera(i) for i in found.held if cameras[i] == name]
        middle = np.array([(c.cx, c.cy) for c in own])
        off = float(np.linalg.norm(middle - np.median(middle, axis=0), axis=1).max())
        said.append(f"{name} (by up to {off:.0f} px)")
    return (
        "The optical axis meets each photo at another place, as they show where they overlap:"
        f" {'; '.join(said)}. Electronic stabilisation cuts pictures so. The map is made so; photos"
        " without it are better."
    )
