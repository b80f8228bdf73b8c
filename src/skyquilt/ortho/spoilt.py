"""What photos show badly, so that others are drawn in their place: marks, blur, spots, veils, what
is overexposed, and what other photos show much finer.

Dust on a lens or a sensor darkens the same place of every picture. What a photo shows there is
darker than what others show of the same ground, and than what lies beside it in the picture.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import Blank, around, joined
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.imaging.nodes import View, project_all
from skyquilt.imaging.views import make_views, native_gsd, on_ground
from skyquilt.model.poses import Alignment
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import Balance, Samples
from skyquilt.ortho.ground import blanks_of
from skyquilt.ortho.lasting_marks import find_lasting_marks, on_other_ground
from skyquilt.ortho.radiometry import InGrey
from skyquilt.ortho.sharpness import FEWEST_SPOILT, LARGEST_SPOT, find_blurred
from skyquilt.ortho.tie_surface import level
from skyquilt.ortho.veiled import veiled_note, veiled_parts
from skyquilt.photos.side_rows import sentence_of

WHITE = 250
"""Level of 255 from which a band of a reduced picture shows nothing more."""
LEAST_WHITE = 0.02
"""Share of a picture that is that white where it counts as overexposed: roofs and cars are less."""

SPOT_POINTS, SPOT_CELLS = 12_000, 48
"""Ground points that are compared, and cells of a picture along its longer side: so many points
give each cell some 20 values, whatever the number of photos.
"""
DARKER, SURELY = 0.06, 5.0
"""A cell is darkened by a spot where its median lies so far, in log odds, and by so many of its
standard deviations below those around: dust takes 0.2 to 0.5. Chance makes 3 of them.
"""
APART = 0.03
"""Two photos of a camera are compared whose places differ by more than this share of their height,
about.
"""
WITHIN, FEWEST_VALUES = 9, 8
"""Cells along a side of these, and fewest values of a cell."""
RINGS = 12
"""Rings of a picture whose medians are taken away first: corners are dark for another reason."""
FINER = 4
"""Cells of the raster that says where spots are, for each cell, along a side."""
SIGMA_OF_QUARTILES = 0.93
"""Standard deviation of a median of normal values, over the distance of their quartiles, times the
root of their number.
"""
ROUNDS = 3
"""Rounds in which photos' and points' brightness are told apart."""
MUCH_FINER = 1.7
"""A photo yields where others show the same ground by pixels so many times smaller: those of
another camera, or of a flight at half the height.
"""
HIGHEST = 0.99
"""Quantile of the heights of tie points that is the highest ground."""
FINER_CELLS = 24
"""Cells along the longer side of a picture that are compared."""


def spoilt_parts(
    alignment: Alignment,
    details: Callable[[int], NDArray[np.float32]],
    thumbnails: Mapping[int, NDArray[Any]],
    names: Sequence[str],
    fixed: Mapping[int, Blank],
    gsd_cm: float | None = None,
    heat: Collection[int] = (),
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """What yields to other photos, by photo (index), only of photos where something does, and
    notes. `details` as in `find_blurred`, `thumbnails` (h, w[, bands]), `names` of the photos,
    `fixed`: where they show marks, `gsd_cm`: ground size of a map pixel, None: that of the photos.
    `heat`: thermal photos, in which white is warm, and contrast that of a palette: neither tells
    overexposure, smoke or fog.
    """
    flat = level(alignment.ground_m)
    placed = make_views(alignment, flat)
    apart = _apart(alignment, placed, flat)
    blurred, notes = find_blurred(alignment, details, names, {v.photo for v in apart})
    white, of_8_bits = dict[int, Blank](), set[int]()
    blanks, _ = blanks_of(alignment, (), lambda i, px: to_grey8(shrink(thumbnails[i], px)[0]))
    for i in sorted(alignment.poses):
        camera, thumbnail = alignment.camera(i), thumbnails[i]
        if thumbnail.dtype == np.uint8:
            of_8_bits.add(i)
        size = camera.width, camera.height
        if i not in heat and (part := overexposed(thumbnail, size, blanks.get(i))):
            white[i] = part
    if white:
        notes += (overexposed_note([names[i] for i in white]),)
    xyz = alignment.ties.xyz
    views, apart = ([v for v in some if v.photo in of_8_bits] for some in (placed, apart))
    cameras = [alignment.camera_of[v.photo] for v in apart]
    no_ground = with_parts(fixed, blanks)
    written, told = find_lasting_marks(apart, cameras, thumbnails, flat, no_ground)
    marks = {v.photo: written[c] for v in views if (c := alignment.camera_of[v.photo]) in written}
    notes += told
    marked = {**no_ground, **marks}
    spots, told = find_spots(alignment, views, apart, flat, thumbnails, marked)
    notes += told
    # what is overexposed or blurred has little contrast as well, and was told; a drop is not all
    pale = white.keys() | {i for i, part in blurred.items() if (part.room < 0).all()}
    of_light = [v for v in views if v.photo not in heat]
    veiled = veiled_parts(of_light, xyz, thumbnails, no_ground, spoilt=pale) if len(xyz) else {}
    if unnamed := sorted(veiled.keys() - pale):
        notes += (veiled_note([names[i] for i in unnamed]),)
    gsd = gsd_cm / 100 if gsd_cm else native_gsd(placed, flat) if placed else 0.0
    coarse, told = coarser_parts(alignment, placed, names, gsd)
    notes += told
    out: Mapping[int, Blank] = {
        i: replace(b, written=b) for i, b in with_parts(fixed, marks).items()
    }
    for found in (blurred, white, spots, veiled, coarse):
        out = with_parts(out, found)
    return dict(out), notes


def with_parts(some: Mapping[int, Blank], more: Mapping[int, Blank]) -> Mapping[int, Blank]:
    """Parts of photos, by index, that are in either."""
    return {**some, **{i: joined(some[i], b) if i in some else b for i, b in more.items()}}


def coarser_parts(
    alignment: Alignment, views: Sequence[View], names: Sequence[str], gsd: float = 0.0
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """Where photos show ground that others, linked by tie points, show much finer, by photo
    (index), and a note. `names` of the photos. No photo counts as finer than a pixel of the map,
    `gsd` in m: the map does not show what it shows besides.

    Photos are compared at the ground below each, as wide as a pixel is there, and those that show
    it finer by the longer side of a pixel: on a slope, photos farther up are nearer to the ground
    beside them, but look at it flatly.
    """
    high = np.array([v.pose.map_C[2] for v in views])
    focal = np.array([v.camera.focal for v in views])
    z = alignment.ties.xyz[:, 2]
    top = float(np.quantile(z, HIGHEST)) if len(z) else 0.0
    if (
        not views
        or MUCH_FINER * (high.min() - top) * focal.min() >= (high.max() - top) * focal.max()
    ):
        return {}, ()  # as in most surveys: nothing need be sorted by photo
    held = set(alignment.held)
    ground = _ground_below(alignment, [v.photo for v in views])
    low, up = (np.array([f(v.footprint, axis=0) for v in views]) for f in (np.min, np.max))
    linked = np.array([v.photo in held for v in views])
    found, factors = dict[int, Blank](), list[float]()
    for k, view in enumerate(views):
        size = (high[k] - ground[k]) / focal[k]
        above = high - ground[k]
        finer = linked & (above > 0) & (MUCH_FINER * above < size * focal)
        finer &= ((low < up[k]) & (up > low[k])).all(1)
        if not size > MUCH_FINER * gsd or not finer.any():
            continue
        some = np.flatnonzero(finer)
        straight = above[some] / focal[some]
        others = [views[j] for j in some.tolist()]
        mask, factor = finer_shown(view, size, others, straight, ground[k])
        if mask.any():
            found[view.photo] = around(mask, (view.camera.width, view.camera.height))
            factors.append(factor)
    if not found:
        return {}, ()
    they_show = f"{len(found)} photos show" if len(found) > 1 else "One photo shows"
    return found, (
        f"{they_show} ground by pixels {np.median(factors):.1f} times as large as"
        f" others show it ({sentence_of([names[i] for i in found])}): another camera, or a higher"
        " flight. Such pictures are drawn only where no finer photo shows the ground.",
    )


def _ground_below(alignment: Alignment, photos: Sequence[int]) -> NDArray[np.float64]:
    """Heights (n,) in m of the ground that photos show: the median of their tie points, and of all
    where they have none.
    """
    ties = alignment.ties
    usual = alignment.ground_m
    own = ties.of_photos(photos)
    z = (ties.xyz[ties.point[own[i]], 2] for i in photos)
    return np.array([float(np.median(n)) if len(n) else usual for n in z])


def finer_shown(
    view: View, size: float, others: Sequence[View], sizes: NDArray[np.float64], height: float
) -> tuple[NDArray[np.bool_], float]:
    """Cells (h, w) of a photo whose ground, at this height in m, others show much finer than by
    pixels of this size in m; and by what factor, in the median. `sizes` (n,) in m of the others'
    pixels straight below them.
    """
    camera = view.camera
    cell = max(camera.width, camera.height) / FINER_CELLS
    h, w = (max(2, round(n / cell)) for n in (camera.height, camera.width))
    v, u = (np.mgrid[:h, :w] + 0.5) / np.array([h, w])[:, None, None]
    px = np.stack([u * camera.width, v * camera.height], -1).reshape(-1, 2) - 0.5
    x, y, z = on_ground(view, px, level(height)).T.reshape(3, h, w)
    own, *rest = project_all([view, *others], x, y, z)
    finest, beneath = np.full((h, w), np.inf), np.full((h, w), np.inf)
    for straight, nodes in zip(sizes.tolist(), rest, strict=True):
        longer = straight * (1 + nodes.score)
        better = nodes.seen & (longer < finest)
        finest = np.where(better, longer, finest)
        beneath = np.where(better, straight, beneath)
    mask = own.seen & (finest * MUCH_FINER < size)
    return mask, float(np.median(size / beneath[mask])) if mask.any() else 1.0


def overexposed_note(names: Sequence[str]) -> str:
    """A note about overexposed photos of these names, at least one."""
    some = f"{len(names)} photos are" if len(names) > 1 else "One photo is"
    return (
        f"{some} overexposed in part ({sentence_of(names)}): what is white there is drawn only"
        " where no other photo shows the ground."
    )


def overexposed(
    thumbnail: NDArray[Any], size: tuple[int, int], blank: Blank | None = None
) -> Blank | None:
    """Where a photo of a `size` (width and height in px) is overexposed, from its reduced picture
    (h, w[, bands]); None where it is not, or has no 8-bit values. A white frame (`blank`) is not
    overexposed.
    """
    if thumbnail.dtype != np.uint8:
        return None
    lightest = thumbnail if thumbnail.ndim == 2 else thumbnail.max(2)
    white = np.asarray(lightest >= WHITE)
    if blank is not None and white.any():
        v, u = ((np.argwhere(white) + 0.5) * (np.array(size[::-1]) / white.shape) - 0.5).T
        white[white] = blank.at(u, v) >= 0
    if white.mean() <= LEAST_WHITE:
        return None
    return around(white, size)


def find_spots(
    alignment: Alignment,
    views: Sequence[View],
    apart: Sequence[View],
    flat: Surface,
    thumbnails: Mapping[int, NDArray[Any]],
    marked: Mapping[int, Blank],
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """Dark spots at the same place of all pictures of a camera, by photo (index), and notes.
    `views` of level ground, `flat`, and those from places `apart`; `thumbnails`: (h, w[, bands]) of
    their photos, of 8 bits; `marked`: where they show marks, which are no ground, by index.
    """
    if len(apart) < FEWEST_SPOILT:
        return {}, ()
    outline = np.concatenate([v.footprint for v in apart])
    (west, south), (east, north) = outline.min(0), outline.max(0)
    samples = Balance(points=SPOT_POINTS).samples(
        apart, InGrey(thumbnails), flat, (west, south, east, north)
    )
    darker = _darker(samples, len(apart))
    cameras = np.array([alignment.camera_of[v.photo] for v in apart])
    found, notes = dict[int, Blank](), list[str]()
    for name in dict.fromkeys(cameras.tolist()):
        own = cameras == name
        if own.sum() < FEWEST_SPOILT:
            continue
        size = alignment.cameras[name].width, alignment.cameras[name].height
        here = own[samples.row] & np.isfinite(darker)
        if (mark := marked.get(apart[int(np.argmax(own))].photo)) is not None:
            v, u = (_shares(samples.place, size) * size[::-1] - 0.5).T
            here &= mark.at(u, v) >= 0
        if not here.any():  # no ground is shown by three photos
            continue
        spot = _spots(samples.place[here], darker[here], size)
        mine = [v for v, is_own in zip(apart, own, strict=True) if is_own]
        spot = on_other_ground(spot, mine, size, flat)
        if spot.any():
            mark = around(np.kron(spot, np.ones((FINER, FINER))) > 0, size)
            found |= {v.photo: mark for v in views if alignment.camera_of[v.photo] == name}
            notes.append(
                f"Photos of {name} are darkened at the same place of every picture, on"
                f" {100 * spot.mean():.1f} % of it: dust on the lens or the sensor, or the drone's"
                " own shadow. It is drawn only where no other photo shows the ground."
            )
    return found, tuple(notes)


def _apart(alignment: Alignment, views: Sequence[View], flat: Surface) -> list[View]:
    """The views of each camera from places apart: pictures of a hover, or copies, show the same
    ground at the same place of each, as if it were on the lens.
    """
    kept, taken = list[View](), set[tuple[str, int, int]]()
    for view in views:
        x, y, z = view.pose.map_C
        step = APART * max(float(z - flat.at(x, y)), 1e-3)
        name, column, row = alignment.camera_of[view.photo], round(x / step), round(y / step)
        around_it = ((name, column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1))
        if taken.isdisjoint(around_it):
            taken.add((name, column, row))
            kept.append(view)
    return kept


def _darker(samples: Samples, number: int) -> NDArray[np.float64]:
    """(N,) how much lighter each sample is than others of the same ground, in log odds, once each
    of a `number` of photos has one brightness; NaN where fewer than two others show it.
    """
    log = samples.log.mean(1).astype(np.float64)
    shown = np.bincount(samples.point)[samples.point]
    several = shown > 2
    gain = np.zeros(number)
    for _ in range(ROUNDS if several.any() else 0):
        middle = _quartiles(
            samples.row[several], _off(samples, log - gain[samples.row])[several], number
        )[1]
        gain += np.nan_to_num(middle)
    off = _off(samples, log - gain[samples.row]) * shown / np.maximum(shown - 1, 1)
    return np.where(several, off, np.nan)


def _off(samples: Samples, even: NDArray[np.float64]) -> NDArray[np.float64]:
    """Differences (N,) of values from the mean of their point."""
    mean = np.bincount(samples.point, even) / np.bincount(samples.point)
    return np.asarray(even - mean[samples.point])


def _spots(
    place: NDArray[Any], off: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.bool_]:
    """Cells (rows, columns) of a picture of a `size` (width and height in px) that are darkened,
    from how much lighter than others samples (n,) at places (n, 2) in it are, see `image_place`.
    """
    ring = np.minimum((place**2).sum(1) * RINGS, RINGS - 1).astype(int)
    off = off - _quartiles(ring, off, RINGS)[1, ring]
    cell = max(size) / SPOT_CELLS
    shape = tuple(max(1, round(n / cell)) for n in size[::-1])
    row, column = np.clip((_shares(place, size) * shape).astype(int), 0, np.array(shape) - 1).T
    at = row * shape[1] + column
    count = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape)
    low, middle, high = _quartiles(at, off, count.size).reshape(3, *shape)
    # of eight values the quartiles alone may lie close together by chance
    spread = np.fmax(high - low, _median_around(high - low))
    sigma = SIGMA_OF_QUARTILES * spread / np.sqrt(np.maximum(count, 1))
    with np.errstate(invalid="ignore"):
        dark = middle - _median_around(middle) < -np.maximum(DARKER, SURELY * sigma)
    dark &= count >= FEWEST_VALUES
    square = np.ones((3, 3), np.uint8)  # one cell alone may be chance
    together = cv2.filter2D(dark.view(np.uint8), -1, square, borderType=cv2.BORDER_CONSTANT)
    spot = cv2.dilate((dark & (together > 1)).view(np.uint8), square) > 0
    return spot if spot.mean() <= LARGEST_SPOT else np.zeros_like(spot)


def _median_around(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the cells (rows, columns) around each; NaN where all of them are."""
    pad = np.pad(cells, WITHIN // 2, mode="reflect")
    near = np.lib.stride_tricks.sliding_window_view(pad, (WITHIN, WITHIN))
    near = near.reshape(*cells.shape, -1)
    known = np.asarray(np.isfinite(near).any(2))
    found = np.nanmedian(np.where(known[..., None], near, 0.0), 2)
    return np.asarray(np.where(known, found, np.nan))


def _shares(place: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float64]:
    """Rows and columns (n, 2), in shares of its sides, of places (n, 2) in a picture of a `size`
    (width and height in px), see `image_place`.
    """
    return np.asarray(place[:, ::-1] * np.hypot(*size) / 2 / np.array(size[::-1]) + 0.5)


def _quartiles(group: NDArray[Any], value: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    """Quartiles (3, number) of the values (n,) of each group, about; NaN where it has none."""
    order = np.lexsort((value, group))
    count = np.bincount(group, minlength=number)
    first = np.cumsum(count) - count
    at = np.array([[count // 4], [count // 2], [3 * count // 4]])[:, 0] + first
    found = value[order][np.minimum(at, len(value) - 1)]
    return np.where(count > 0, found, np.nan)
