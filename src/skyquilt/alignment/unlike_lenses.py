"""Photos that files tell to be of one camera, though two took them: drones of one model whose
files have no serial numbers, or photos of which a program took the distortion away.

Taken for one camera's, they share a lens between the two. What is left of each photo's tie points
then grows with the third power of the distance from its middle, outwards for one, inwards for the
other. Places and angles of photos cannot make up for that.
"""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.deviations import CELLS, alike_within
from skyquilt.alignment.enlarged import FEWEST, fits_better, misfit_px
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Photo, evenly
from skyquilt.model.poses import Alignment
from skyquilt.photos.side_rows import sentence_of

Floats = NDArray[np.float64]
LOOKED_AT = 200
"""Photos of a camera that are looked at first; all of them only where these show two lenses."""
FEWEST_TIES = 20
"""Observations of a photo that is looked at."""
GROSS = 6.0
"""Residuals so many times as long as the median count half: what two lenses leave is not gross."""
ROUNDS = 3
"""Rounds in which observations are weighed."""
CLOSE = 0.43
"""Scatter of each group over their distance at most; halves of a normal distribution have 0.44."""
LEAST = 2.5
"""Distance of the groups at least, as a shift in a corner of the picture, over the mean residual:
where photos err by chance it is seldom more than 2.
"""
KEPT = 0.99
"""Share of the observations that an adjustment with two lenses keeps at least."""
BETTER = 0.92
"""Two lenses are taken where the mean residual falls below this share: an error of a lens model
that all photos share lets it fall by less.
"""
ALIKE = 0.18
"""Residuals of neighbours in a photo that correlate so much may be left by other lenses: three real
flights of one lens have 0.17 at most, parts cut 1 to 4 % of the width elsewhere 0.19 and more, five
lenses of a rig under one name 0.45.
"""
MOST_LOOKED = 300
"""Photos of a camera whose residuals are compared, at most."""
MOST_NAMED = 12
"""Groups of names that may stand for a lens each, at most."""
NAMED = "lens"
"""In the name of the second camera."""


def unlike_lenses(
    found: Alignment, cameras: Sequence[str], before: Mapping[int, int]
) -> dict[int, int]:
    """The lens, 0 or 1, of each photo (index) of cameras whose photos show two; of no others.
    `cameras`: names, of each photo; `before`: what they were adjusted with.
    """
    out = dict[int, int]()
    held = [i for i in found.held if not found.camera(i).fisheye]
    for name in dict.fromkeys(cameras[i] for i in held):
        own = [i for i in held if cameras[i] == name]
        if before.keys() & set(own):
            out |= _exchanged(found, own, before)
            continue
        some = [own[k] for k in evenly(len(own), LOOKED_AT)]
        group = _two_groups(*bent(found, some))
        if group and len(own) > len(some):
            group = _two_groups(*bent(found, own))
        out |= group
    return out


def alike_cameras(found: Alignment, cameras: Sequence[str]) -> frozenset[str]:
    """Names of cameras whose photos one lens may not fit, since residuals of neighbours are alike.
    `cameras`: names, of each photo.
    """
    shown = set[str]()
    for name in dict.fromkeys(cameras[i] for i in found.held):
        parts, residuals = [], []
        own = [i for i in found.held if cameras[i] == name]
        own = [own[k] for k in evenly(len(own), MOST_LOOKED)]
        for i, rows in found.ties.of_photos(own).items():
            size = found.camera(i).width, found.camera(i).height
            cell = np.clip(found.ties.px[rows] / size * CELLS, 0, CELLS - 1).astype(np.int64)
            parts.append((i * CELLS + cell[:, 1]) * CELLS + cell[:, 0])
            residuals.append(found.ties.residual_px[rows])
        off = np.concatenate([np.zeros((0, 2)), *residuals])
        if not len(off):
            continue
        length = np.linalg.norm(off, axis=1)
        weight = 1 / (1 + (length / (2 * np.median(length) + 1e-12)) ** 2)
        if alike_within(np.concatenate(parts), off * weight[:, None]) > ALIKE:
            shown.add(name)
    return frozenset(shown)


def named_lenses(
    names: Sequence[str], cameras: Sequence[str], doubtful: Collection[str]
) -> dict[int, int]:
    """The lens, 0 and up, of each photo (index) of doubtful cameras (names) by its folder and by
    what its name has beside numbers, where these make groups: rigs of several cameras of one model.
    """
    out = dict[int, int]()
    for camera in sorted(doubtful):
        kinds = {i: _kind(names[i]) for i, name in enumerate(cameras) if name == camera}
        number = Counter(kinds.values())
        if 2 <= len(number) <= MOST_NAMED and min(number.values()) >= FEWEST:
            order = sorted(number, key=lambda kind: (-number[kind], kind))
            out |= {i: order.index(kind) for i, kind in kinds.items()}
    return out


def _kind(name: str) -> tuple[str, str]:
    """The folder of a file, and its name without numbers."""
    path = PurePosixPath(name)
    return str(path.parent), re.sub(r"[0-9]+", "#", path.stem)


def as_of_lenses(photos: Sequence[Photo], lenses: Mapping[int, int]) -> list[Photo]:
    """The photos, those of a second lens as of a camera of their own."""
    out = list(photos)
    for i, lens in lenses.items():
        if lens:
            name, zoom = f" {NAMED} {lens + 1}", photos[i].zoom
            other = zoom and replace(zoom, camera=zoom.camera + name)
            out[i] = replace(photos[i], camera_key=photos[i].camera_key + name, zoom=other)
    return out


def fits_lenses(other: Alignment, found: Alignment, before: Mapping[int, int]) -> bool:
    """Whether an alignment with two lenses fits the pictures much better than one with one, or
    clearly better than one with two that some photos were given otherwise (`before`).
    """
    if before:
        return fits_better(other, found, kept=KEPT)
    return fits_better(other, found, kept=KEPT, share=BETTER)


def lenses_note(lenses: Mapping[int, int], cameras: Sequence[str], names: Sequence[str]) -> str:
    """What the user is told."""
    said = []
    for camera in sorted({cameras[i] for i in lenses}):
        own = [i for i in sorted(lenses) if cameras[i] == camera]
        second = [names[i] for i in own if lenses[i]]
        said.append(f"{len(second)} of {len(own)} of {camera} ({sentence_of(second)})")
    return (
        "Some photos were taken through another lens than others of their camera, as their"
        " overlaps show (drones or cameras of one model, or a program that corrected the"
        " distortion):"
        f" {'; '.join(said)}. They are calibrated by themselves."
    )


@dataclass(frozen=True, kw_only=True)
class Bent:
    """By how much a photo is bent against its camera's lens."""

    k1: float
    """Error of k1, negative where the photo's own is larger."""
    ties: int
    """Observations that tell it."""


def bent(found: Alignment, photos: Sequence[int]) -> tuple[dict[int, Bent], float]:
    """By how much each of some photos (index) is bent, where its tie points tell that; and by how
    much two lenses differ at least.
    """
    out, corner = dict[int, Bent](), 1.0
    for i, rows in found.ties.of_photos(photos).items():
        if len(rows) < FEWEST_TIES:
            continue
        camera = found.camera(i)
        out[i] = _bent(camera, found.ties.px[rows], found.ties.residual_px[rows])
        reach = np.hypot(camera.width, camera.height) / 2 / camera.focal
        corner = max(corner, float(camera.focal * reach**3))
    return out, LEAST * misfit_px(found) / corner


def _bent(camera: Camera, px: NDArray[np.floating], off_px: NDArray[np.floating]) -> Bent:
    """The error of k1 from residuals (n, 2) at pixels (n, 2), beside shifts, a turn and a scale."""
    x, y = ((px - [camera.cx, camera.cy]) / camera.focal).T.astype(np.float64)
    off = off_px.T.astype(np.float64) / camera.focal
    one, zero, square = np.ones_like(x), np.zeros_like(x), x**2 + y**2
    across = np.stack([one, zero, x, -y, square * x])
    down = np.stack([zero, one, y, x, square * y])
    weight = one
    for _ in range(ROUNDS):
        normal = (across * weight) @ across.T + (down * weight) @ down.T
        solved = np.linalg.pinv(normal) @ ((across * weight) @ off[0] + (down * weight) @ off[1])
        length = np.hypot(*(off - np.stack([solved @ across, solved @ down])))
        weight = 1 / (1 + (length / (GROSS * np.median(length) + 1e-12)) ** 2)
    return Bent(k1=float(solved[-1]), ties=len(x))


def _two_groups(values: Mapping[int, Bent], least: float) -> dict[int, int]:
    """The group, 0 or 1, of each photo where these form two that are so far apart; nothing
    otherwise.
    """
    photos = sorted(values, key=lambda i: values[i].k1)
    if len(photos) < 2 * FEWEST:
        return {}
    k1 = np.array([values[i].k1 for i in photos])
    votes = np.array([values[i].ties for i in photos])
    cuts = range(FEWEST, len(photos) - FEWEST + 1)
    cut = min(cuts, key=lambda k: _off_middle(k1[:k], votes[:k]) + _off_middle(k1[k:], votes[k:]))
    (low, scatter), (high, other) = _middle(k1[:cut], votes[:cut]), _middle(k1[cut:], votes[cut:])
    apart = high - low
    if apart < least or max(scatter, other) > CLOSE * apart:
        return {}
    return {i: int(k >= cut) for k, i in enumerate(photos)}


def _off_middle(values: Floats, votes: NDArray[np.int64]) -> float:
    """Sum of how far some values lie from their median, each counted as often as it has votes."""
    return float(votes @ np.abs(values - _median(values, votes)))


def _middle(values: Floats, votes: NDArray[np.int64]) -> tuple[float, float]:
    """The median of some values by votes, and their scatter around it as a standard deviation."""
    middle = _median(values, votes)
    return middle, 1.4826 * _median(np.abs(values - middle), votes)


def _median(values: Floats, votes: NDArray[np.int64]) -> float:
    return float(np.quantile(values, 0.5, weights=votes, method="inverted_cdf"))


def _exchanged(
    found: Alignment, photos: Sequence[int], before: Mapping[int, int]
) -> dict[int, int]:
    """The lenses of photos, those given the other one that are bent towards it unlike others of
    theirs. The first has the larger k1.
    """
    out = {i: before.get(i, 0) for i in photos}
    for lens in (0, 1):
        group = _two_groups(*bent(found, [i for i in photos if before.get(i, 0) == lens]))
        out |= {i: 1 - lens for i, towards in group.items() if towards != lens}
    return out
