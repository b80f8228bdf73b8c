"""Marks that lie at the same place of every picture: a burnt-in text, a logo, dirt on the lens.

They match perfectly, as if the camera had not moved, and where the ground has few features they
outvote it. So matches on them are not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import Blank, marked
from skyquilt.model.features import Features
from skyquilt.model.photo import evenly

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class FixedMarks:
    """Where the pictures of each camera show marks."""

    masks: dict[str, Mask] = field(default_factory=dict)
    """By camera, only of cameras with marks: cells of the picture, True on marks."""
    cell_px: dict[str, float] = field(default_factory=dict)
    """By camera: side of a cell in px of the photo."""

    def on_mark(self, camera: str, px: NDArray[np.float64]) -> Mask:
        """(n,) whether places (n, 2) in px of a photo lie on marks."""
        mask = self.masks.get(camera)
        if mask is None:
            return np.zeros(len(px), bool)
        column, row = np.floor(px / self.cell_px[camera]).astype(int).T
        rows, columns = mask.shape
        return np.asarray(mask[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)])

    def shown(self, cameras: Sequence[str]) -> dict[int, Blank]:
        """Where photos show marks, only of photos that do; `cameras`: that of each photo."""
        own = {name: marked(mask, self.cell_px[name]) for name, mask in self.masks.items()}
        return {i: own[name] for i, name in enumerate(cameras) if name in own}

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence for each camera with marks."""
        return tuple(
            f"Photos of {camera} show the same marks at the same place in every picture, on"
            f" {100 * mask.mean():.1f} % of it: a text or logo written into them, a frame, or dirt"
            " on the lens. They are not used to connect photos, and are drawn only where no other"
            " photo shows the ground."
            for camera, mask in self.masks.items()
        )


@dataclass(frozen=True, kw_only=True)
class FindFixedMarks:
    """Looks for marks in some photos of each camera."""

    looked_at: int = 8
    """Photos of a camera in which marks are looked for, spread evenly over the survey."""
    fewest: int = 6
    """Fewest photos of a camera that can tell marks from ground."""
    agreeing: int = 3
    """So many of the other photos looked at must show a mark."""
    alike: float = 0.85
    """Least similarity of two descriptors of one mark."""
    standing: float = 0.4
    """With a larger share than this of a photo's keypoints at the same place in others, the camera
    stood still.
    """
    spread: float = 0.2
    """It also did between two photos that share keypoints at the same place in more than this share
    of the parts of the picture inside its rim, and in more than half of this share in each quarter
    and in the middle: marks lie together, or along the rim.
    """
    parts: int = 10
    """Parts along a side."""
    least: int = 3
    """Fewest places of a photo with keypoints on marks; one place may have several keypoints."""
    chance: float = 3.0
    """And so many times as many as others show where the picture is shifted: rows of plants or
    panels look alike wherever one lies on another.
    """
    shifts: tuple[tuple[int, int], ...] = ((23, 0), (0, 19), (-17, 14), (13, -29))
    """Shifts (x, y) in px of the image that was searched, at which only chance makes pictures
    alike.
    """
    cell_px: int = 4
    """Side of a cell of a mask, in px of the image that was searched for features."""

    def __call__(
        self, features: Sequence[Features], cameras: Sequence[str], sizes: Sequence[tuple[int, int]]
    ) -> FixedMarks:
        """The marks of each camera (its name for each photo); `sizes`: width and height of the
        photos in px.
        """
        masks, cells = dict[str, Mask](), dict[str, float]()
        for camera in dict.fromkeys(cameras):
            own = [i for i, c in enumerate(cameras) if c == camera]
            if len(own) < self.fewest:
                continue
            some = [features[own[k]] for k in evenly(len(own), self.looked_at)]
            side = self.cell_px * some[0].scale
            width, height = sizes[own[0]]
            mask = np.zeros((int(height / side) + 1, int(width / side) + 1), bool)
            for one, fixed in zip(some, self._fixed(some, sizes[own[0]]), strict=True):
                column, row = np.floor(one.px[fixed] / side).astype(int).T
                inside = np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)
                mask[inside] = True
            if mask.any():
                # with the cells around each
                wide = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
                masks[camera], cells[camera] = wide > 0, float(side)
        return FixedMarks(masks=masks, cell_px=cells)

    def _fixed(self, photos: Sequence[Features], size: tuple[int, int]) -> list[Mask]:
        """Which keypoints of each photo others show at the same place. Of photos between which the
        camera stood still, one tells. `size`: width and height in px.
        """
        alike = self._alike(photos)
        apart = list[int]()
        for a, one in enumerate(photos):
            if not any(self._stood_still(one, alike[a][b], size) for b in apart):
                apart.append(a)
        fixed = self._agreed(photos, alike, apart)
        if not fixed:
            return [np.zeros(len(one), bool) for one in photos]
        shifted = [self._agreed(photos, self._alike(photos, by), apart) for by in self.shifts]
        places = [
            sum(_places(photos[a], mask, self.cell_px) for a, mask in some.items())
            for some in (fixed, *shifted)
        ]
        if places[0] <= self.chance * np.mean(places[1:]):
            return [np.zeros(len(one), bool) for one in photos]
        return [fixed.get(a, np.zeros(len(one), bool)) for a, one in enumerate(photos)]

    def _agreed(
        self, photos: Sequence[Features], alike: list[list[Mask]], apart: Sequence[int]
    ) -> dict[int, Mask]:
        """By photo, the keypoints that enough others share; only of photos with enough of them, and
        none if there are not as many such photos: those that share a mark all show it.
        """
        found = {}
        for a in apart:
            fixed = np.sum([alike[a][b] for b in apart], axis=0) >= self.agreeing
            enough = _places(photos[a], fixed, self.cell_px) >= self.least
            if enough and fixed.sum() <= self.standing * len(photos[a]):
                found[a] = fixed
        return found if len(found) > self.agreeing else {}

    def _alike(
        self, photos: Sequence[Features], shift: tuple[int, int] = (0, 0)
    ) -> list[list[Mask]]:
        """Which keypoints of each photo each of the others shows at the same place, or shifted by
        so many px (x, y) of the image that was searched.
        """
        rasters, described = [_raster(f) for f in photos], [f.unit for f in photos]
        found = []
        for a, one in enumerate(photos):
            place = np.maximum(_cells(one) + shift, 0)
            own = [np.zeros(len(one), bool) for _ in photos]
            for b, raster in enumerate(rasters):
                if a == b:
                    continue
                inside = (place < raster.shape[::-1]).all(1)
                other = np.full(len(one), -1)
                other[inside] = raster[place[inside, 1], place[inside, 0]]
                near = np.flatnonzero(other >= 0)
                likeness = (described[a][near] * described[b][other[near]]).sum(1)
                own[b][near[likeness > self.alike]] = True
            found.append(own)
        return found

    def _stood_still(self, one: Features, shared: Mask, size: tuple[int, int]) -> bool:
        """Whether a photo shares keypoints (n,) with another all over the picture."""
        column, row = (one.px / size * self.parts).astype(int).clip(0, self.parts - 1).T
        cells = np.zeros((2, self.parts, self.parts), bool)
        cells[0, row, column] = True
        cells[1, row[shared], column[shared]] = True
        rim, half = slice(1, -1), self.parts // 2
        low, high, middle = slice(1, half), slice(half, -1), slice(half // 2 + 1, -half // 2)
        places = [(a, b) for a in (low, high) for b in (low, high)]
        return _shares(cells[:, rim, rim], self.spread) and all(
            _shares(cells[:, a, b], self.spread / 2) for a, b in (*places, (middle, middle))
        )


def _shares(cells: Mask, share: float) -> bool:
    """Whether of some parts of a picture that show keypoints (first) more than a share have some in
    common with another (second); cells (2, rows, columns).
    """
    shown, common = cells.sum((1, 2))
    return bool(common > share * shown)


def _places(photo: Features, some: Mask, cell_px: int) -> int:
    """How many cells of the picture some keypoints (n,) of a photo lie in."""
    return len(np.unique(_cells(photo)[some] // cell_px, axis=0))


def _cells(features: Features) -> NDArray[np.int64]:
    """(n, 2) px of the image that was searched in which the keypoints lie."""
    return np.maximum(np.round(features.px / features.scale).astype(np.int64), 0)


def _raster(features: Features) -> NDArray[np.int32]:
    """The number of the keypoint at or beside each px of the image that was searched; -1 = none."""
    place = _cells(features)
    size = place.max(0) + 2 if len(place) else np.array([1, 1])
    raster = np.full((size[1], size[0]), -1, np.int32)
    beside = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    for x, y in sorted(beside, key=lambda b: -abs(b[0]) - abs(b[1])):  # its own px last
        raster[np.maximum(place[:, 1] + y, 0), np.maximum(place[:, 0] + x, 0)] = range(len(place))
    return raster
