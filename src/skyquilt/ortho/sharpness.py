"""Blurred photos, and blurred parts of all photos of a camera: shown only where no other photo
shows the ground.

A gust or a long exposure blurs single photos, drops and smears on the lens blur the same place of
every picture. How sharp a picture is depends on what it shows: water has no detail. So cells of
pictures are compared where they show the same ground.
"""

from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import rays
from skyquilt.geometry.neighbours import nearest
from skyquilt.imaging.blank import Blank, whole_picture
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import on_ground
from skyquilt.model.poses import Alignment
from skyquilt.ortho.tie_surface import level
from skyquilt.photos.side_rows import sentence_of

Array = NDArray[np.float64]
BLURRED = 1.0
"""A photo is blurred where the logarithm of its detail lies this far below what others show of the
same ground, by more than most photos of its camera do: 4 px of motion take 0.7 to 1.3, 8 px 1.4 to
2.6; sharp photos lie up to 0.8 below.
"""
SPOILT, SPOILT_SHARE = 1.0, 0.6
"""A cell of the picture is spoilt where it lacks so much in so large a share of the photos of a
camera, more than the cells around it: drops take 1.1 to 4.3.
"""
AROUND = 5
"""Cells along a side of these."""
LARGEST_SPOT = 0.3
"""Largest share of a picture that such cells make up: lenses are less sharp towards the rim."""
NEIGHBOURS, FEWEST_NEIGHBOURS = 16, 3
"""Nearest cells that are compared, and fewest."""
WITHIN = 0.75
"""Distance up to which cells show the same ground, in distances of neighbouring cells."""
TIED = 3
"""So many tie points must lie within that distance: waves and glitter have none."""
SHARP_SHARE = 0.75
"""Quantile of what the photos of a place show that counts as sharp: one of four is not blurred."""
FEWEST_CELLS, FEWEST_PHOTOS, FEWEST_SPOILT = 20, 6, 10
"""Fewest cells that tell of a photo, and fewest photos that tell of a camera, and of one cell."""
LEAST_DOWN = 0.9
"""Cosine of the largest angle from the vertical at which cells are compared: slanting views of one
ground differ, by up to 0.9.
"""
FINER = 8
"""Cells of the raster that says where a spot is, for each cell of detail, along a side."""
AT_ONCE = 50_000
"""Cells that are compared at once, to bound memory."""


def find_blurred(
    alignment: Alignment,
    details: Callable[[int], NDArray[np.float32]],
    names: Sequence[str],
    apart: Collection[int],
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """What is blurred, by photo, only of photos where something is, and notes. `details`: detail
    (rows, columns, 3) in the cells of a photo (index); `names` of the photos; `apart`: photos
    (indices) taken at places apart, which tell spots of the lens.
    """
    photos = sorted(alignment.poses)
    if len(photos) < FEWEST_PHOTOS:
        return {}, ()
    shown = np.array([details(i) for i in photos], np.float64)
    places, reach = _places(alignment, photos, shown.shape[1:3])
    places[~_tied(alignment, places, reach)] = np.nan
    cameras = np.array([alignment.camera_of[i] for i in photos])
    off = np.full(shown.shape, np.nan)
    for name in dict.fromkeys(cameras.tolist()):  # lenses and ground sizes differ
        own = cameras == name
        off[own] = shown[own] - _sharp(shown[own], places[own], reach[own])
    told = np.isfinite(off[..., 0]).sum((1, 2)) >= FEWEST_CELLS
    with np.errstate(all="ignore"):
        each = np.full((len(photos), 3), np.nan)
        each[told] = np.nanmedian(off[told].reshape(-1, off[0, ..., 0].size, 3), 1)
    found, notes = dict[int, Blank](), list[str]()
    for name in dict.fromkeys(cameras.tolist()):
        own = np.flatnonzero((cameras == name) & told)
        if len(own) < FEWEST_PHOTOS:
            continue
        camera = alignment.cameras[name]
        size = camera.width, camera.height
        below = (each[own] - np.median(each[own], 0))[:, :2].min(1)
        blurred = own[below < -BLURRED]
        found |= {photos[k]: whole_picture(size) for k in blurred}
        if len(blurred):
            notes.append(blurred_note([names[photos[k]] for k in blurred]))
        told_by = np.array([k for k in np.setdiff1d(own, blurred) if photos[k] in apart], np.int64)
        spot = _spot(off[told_by, ..., 2] - each[told_by, None, None, 2])
        if spot.any():
            room = np.kron(np.where(spot, -1, 1), np.ones((FINER, FINER))).astype(np.float32)
            mark = Blank(room=room, size=size)
            found |= {photos[k]: found.get(photos[k], mark) for k in own}
            notes.append(
                f"Photos of {name} are blurred at the same place of every picture, on"
                f" {100 * spot.mean():.0f} % of it: drops, dirt or a fingerprint on the lens. It is"
                " drawn only where no other photo shows the ground."
            )
    return found, tuple(notes)


def blurred_note(names: Sequence[str]) -> str:
    """A note about blurred photos of these names, at least one."""
    some = f"{len(names)} photos are" if len(names) > 1 else "One photo is"
    return (
        f"{some} blurred against others of the same ground ({sentence_of(names)}): gusts, a long"
        " exposure or a drone that flew too fast for it. They are drawn only where no other photo"
        " shows the ground."
    )


def _places(
    alignment: Alignment, photos: Sequence[int], cells: tuple[int, int]
) -> tuple[Array, Array]:
    """Places (n, rows, columns, 2) in m that the cells of photos show, NaN where they look flatly,
    and the distance in m (n,) of neighbouring cells.
    """
    rows, columns = cells
    v, u = np.mgrid[:rows, :columns].reshape(2, -1) + 0.5
    out, apart = np.full((len(photos), rows * columns, 2), np.nan), np.zeros(len(photos))
    ground = level(alignment.ground_m)
    for k, i in enumerate(photos):
        pose, camera = alignment.poses[i], alignment.camera(i)
        px = np.column_stack([u / columns * camera.width, v / rows * camera.height]) - 0.5
        down = np.ones(len(px), np.bool_)
        if pose.cam_H_map is None:
            ray = rays(camera, px)
            down = -(ray @ pose.cam_R_map)[:, 2] > LEAST_DOWN * np.linalg.norm(ray, axis=1)
        view = View(photo=i, camera=camera, pose=pose, footprint=np.zeros((0, 2)))
        out[k, down] = on_ground(view, px[down], ground)[:, :2]
        steps = np.diff(out[k].reshape(rows, columns, 2), axis=1)
        finite = np.isfinite(steps[..., 0])
        apart[k] = np.median(np.hypot(*steps[finite].T)) if finite.any() else 0.0
    return out.reshape(len(photos), rows, columns, 2), apart


def _tied(alignment: Alignment, places: Array, reach: Array) -> NDArray[np.bool_]:
    """(n, rows, columns) whether enough tie points lie near the places of cells."""
    out = np.isfinite(places[..., 0])
    xyz = alignment.ties.xyz
    if len(xyz) < TIED or not out.any():
        return np.zeros(out.shape, np.bool_)
    far = WITHIN * np.broadcast_to(reach[:, None, None], out.shape)[out]
    out[out] = nearest(xyz[:, :2], places[out], TIED)[0][:, -1] <= far
    return out


def _sharp(shown: Array, places: Array, reach: Array) -> Array:
    """Detail (n, rows, columns, 3) that sharp photos show of the ground of each cell, NaN where too
    few photos show it.
    """
    known = np.isfinite(places[..., 0]) & np.isfinite(shown[..., 0])
    out = np.full(shown.shape, np.nan)
    if known.sum() < FEWEST_NEIGHBOURS:
        return out
    at, detail = places[known], shown[known]
    far = WITHIN * np.broadcast_to(reach[:, None, None], known.shape)[known]
    distance, near = nearest(at, at, min(NEIGHBOURS, len(at)))
    told = np.full(detail.shape, np.nan)
    for low in range(0, len(at), AT_ONCE):
        some = slice(low, low + AT_ONCE)
        same = distance[some] <= far[some, None]
        count = same.sum(1)
        ordered = np.sort(np.where(same[..., None], detail[near[some]], np.inf), axis=1)
        rank = np.rint(SHARP_SHARE * (count - 1)).astype(np.int64)
        sharp = np.take_along_axis(ordered, rank[:, None, None], 1)[:, 0]
        told[some] = np.where(count[:, None] >= FEWEST_NEIGHBOURS, sharp, np.nan)
    out[known] = told
    return out


def _spot(off: Array) -> NDArray[np.bool_]:
    """Cells (rows, columns) that lack detail in most photos; `off`: logarithm of their fine detail
    over that of others of the same ground, less what is usual in the photo, (n, rows, columns), NaN
    where it is not known.
    """
    count = np.isfinite(off).sum(0)
    if not len(off) or not (known := count >= FEWEST_SPOILT).any():
        return np.zeros(off.shape[1:], np.bool_)
    usual = np.full(count.shape, np.nan)
    usual[known] = np.nanmedian(off[:, known], 0)
    half = AROUND // 2
    around = np.pad(usual, half, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(around, (AROUND, AROUND))
    spoilt = np.zeros(count.shape, np.bool_)
    beside = np.nanmedian(around[known].reshape(-1, AROUND**2), 1)
    lacks = (off[:, known] - beside < -SPOILT).sum(0)
    spoilt[known] = lacks >= SPOILT_SHARE * count[known]
    return spoilt if spoilt.mean() <= LARGEST_SPOT else np.zeros_like(spoilt)
