"""What cameras have in common that are one lens behind different digital zooms, or with pictures of
different sizes.

A digital zoom enlarges the middle of the sensor's picture, so the lens stays what it was: its
distortion is the same, the focal length and how far the principal point lies beside the middle grow
with the zoom. The same holds of pictures that were reduced. Calibrated each by itself, a zoom or a
size of one or two photos takes up their tilt.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.enlarged import APART, heights_above_ground
from skyquilt.alignment.problem import InCommon
from skyquilt.model.camera import PARAMETERS
from skyquilt.model.photo import Photo, Zoom
from skyquilt.model.poses import Alignment, Prior
from skyquilt.photos.side_rows import sentence_of

Array = NDArray[np.float64]
ROUNDED = 3e-3
"""Deviation of a factor that files tell, as a share: they tell it with two decimals."""
UNLIKE = 1 + 2 * ROUNDED
"""Focal lengths of one lens, each over its factor, differ by this factor at most."""
MOST_SIZES = 100
"""Sizes of one lens at most: what they have in common takes memory with the square of their number
(8 MB here, 200 MB for five times as many).
"""
OFF_CENTRE = 5e-4
"""Deviation of the middle of what is enlarged, as a share of the picture's longer side."""
DEVIATION = {"k1": 1e-3, "k2": 1e-3, "k3": 1e-3, "p1": 1e-4, "p2": 1e-4, "aspect": 2e-4}
"""Deviations of what does not change with the zoom."""


def same_lens(
    zooms: Sequence[Zoom], K0: Array, size: Array, free: NDArray[np.bool_]
) -> InCommon | None:
    """What the intrinsics of cameras have in common, with their priors (m, 11) and the size (m, 2)
    of their pictures; None where no two of them are one lens. `free` (m, 11): which are estimated;
    those that are not are left as they are.
    """
    rows, zero = list[Array](), list[Array]()
    for lens in dict.fromkeys(zoom.camera for zoom in zooms):
        own = [k for k, zoom in enumerate(zooms) if zoom.camera == lens]
        for column, name in enumerate(PARAMETERS) if len(own) > 1 else ():
            if name not in {"focal", "cx", "cy", *DEVIATION} or not free[own, column].all():
                continue
            if name in {"cx", "cy"} and not all(zooms[k].centred for k in own):
                continue
            value, at_zero, sigma = _of_lens(name, [zooms[k] for k in own], K0[own, 0], size[own])
            weight = sigma**-2 / (sigma**-2).sum()
            apart = (np.eye(len(own)) - weight) / sigma[:, None]  # from their weighted mean
            row = np.zeros((len(own), *free.shape))
            row[:, own, column] = apart * value
            rows.append(row.reshape(len(own), -1))
            zero.append(apart @ at_zero)
    return InCommon(rows=np.concatenate(rows), zero=np.concatenate(zero)) if rows else None


def _of_lens(
    name: str, zooms: Sequence[Zoom], focal: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Factors (n,) and what is taken off (n,) that make an intrinsic of each camera that of their
    lens, and its deviations (n,).
    """
    n, factor = len(zooms), np.array([zoom.factor for zoom in zooms])
    if name in DEVIATION:
        return np.ones(n), np.zeros(n), np.full(n, DEVIATION[name])
    if name == "focal":
        share = np.hypot(ROUNDED, [zoom.sigma for zoom in zooms])
        return 1 / factor, np.zeros(n), focal / factor * share
    middle = (size[:, 0 if name == "cx" else 1] - 1) / 2
    return 1 / factor, middle / factor, OFF_CENTRE * size.max(1)


def lenses_of_sizes(photos: Sequence[Photo], *, cut: bool = False) -> dict[str, Zoom]:
    """Cameras (names) whose pictures differ from others by their size alone, as zooms of what may
    be one lens: the size that most photos have counts as 1, others as all of it on more or fewer
    px; or, with `cut`, as parts of it that were cut out. Of wide and upright pictures each are
    their own lens: one of them was turned.
    """
    first = {p.camera_key: p for p in reversed(photos)}
    number = Counter(p.camera_key for p in photos)
    lenses: dict[tuple[str, bool], list[str]] = {}
    for key, photo in first.items():
        lenses.setdefault((_sizeless(photo), photo.width > photo.height), []).append(key)
    out: dict[str, Zoom] = {}
    for (lens, _), keys in lenses.items():
        widths = {k: first[k].width for k in keys}
        sizes = {(first[k].width, first[k].height) for k in keys}
        usual = widths[max(keys, key=lambda k: number[k])]
        for key in keys if 1 < len(sizes) <= MOST_SIZES else ():
            own = first[key].zoom or Zoom(camera=lens, factor=1.0)
            factor = own.factor if cut else own.factor * widths[key] / usual
            out[key] = replace(own, camera=lens, factor=factor, centred=not cut)
    return out


def _sizeless(photo: Photo) -> str:
    """The name of a photo's camera without its zoom and size."""
    name = photo.zoom.camera if photo.zoom else photo.camera_key
    return " ".join(part for part in name.split() if part != f"{photo.width}x{photo.height}")


def as_of_sizes(photos: Sequence[Photo], zooms: Mapping[str, Zoom]) -> list[Photo]:
    """The photos, those of several sizes as of their lens: what files tell of the most frequent
    size (of what is not zoomed; of parts, the largest) is believed of all, once. Programs that
    reduce pictures leave metadata that count in px of the larger ones, and those that cut leave
    some that count for the whole.
    """
    told: dict[str, Photo] = {}
    for photo in sorted(photos, key=lambda p: -p.width * p.height):
        zoom = zooms.get(photo.camera_key)
        if zoom is not None and zoom.factor == 1:
            told.setdefault(zoom.camera, photo)
    shared = Counter(zoom.camera for zoom in zooms.values())
    out = list(photos)
    for i, photo in enumerate(photos):
        zoom = zooms.get(photo.camera_key)
        if zoom is not None:
            usual = told.get(zoom.camera, photo)
            out[i] = _told_by(usual, photo, zoom, np.sqrt(shared[zoom.camera]))
    return out


def _told_by(usual: Photo, photo: Photo, zoom: Zoom, wider: float) -> Photo:
    """A photo with the lens that one of the usual size tells, its focal length with a deviation
    that is `wider` by this factor: each camera of the lens counts.
    """
    factor = 1.0 if usual is photo else zoom.factor
    px, sigma = usual.focal.px * factor, usual.focal.sigma_px * factor * wider
    focal = replace(usual.focal, px=px, sigma_px=sigma)
    if factor == 1:
        return replace(photo, zoom=zoom, focal=focal)
    size = photo.width, photo.height
    whole = size == (round(usual.width * factor), round(usual.height * factor))
    calibration, shown = (
        lens.rescaled(*size) if lens is not None and whole else None
        for lens in (usual.calibration, usual.shown_lens)
    )
    return replace(photo, zoom=zoom, focal=focal, calibration=calibration, shown_lens=shown)


def unlike(
    found: Alignment, cameras: Sequence[str], zooms: Mapping[str, Zoom], priors: Sequence[Prior]
) -> bool:
    """Whether an adjustment as one lens contradicts that it is one: focal lengths of sizes differ
    by more than `UNLIKE` from what these make of them, or photos of a size lie lower over the
    ground, or higher, by a factor of `APART` than the others, by what they tell. `cameras`: names,
    of each photo.
    """
    height, told = heights_above_ground(found, priors) if len(found.ties.xyz) else ({}, {})
    focals: dict[str, list[float]] = {}
    ratios: dict[str, list[float]] = {}
    for camera, zoom in zooms.items():
        own = [i for i in found.held if cameras[i] == camera]
        if own:
            focals.setdefault(zoom.camera, []).append(found.camera(own[0]).focal / zoom.factor)
        over = [height[i] / told[i] for i in own if i in told and min(height[i], told[i]) > 0]
        if over:
            ratios.setdefault(zoom.camera, []).append(float(np.median(over)))
    limits = ((UNLIKE, focals.values()), (APART, ratios.values()))
    return any(max(each) > limit * min(each) for limit, lenses in limits for each in lenses)


def sizes_note(zooms: Mapping[str, Zoom]) -> str:
    """What the user is told."""
    cut = not all(zoom.centred for zoom in zooms.values())
    how = "show parts of what the same lens took" if cut else "show the same lens"
    return (
        f"Photos that differ from others of their camera by their size {how}, so they are"
        f" calibrated together: {sentence_of(sorted(zooms))}."
    )
