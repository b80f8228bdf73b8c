"""Photos in: what they say, their features, and a thumbnail each, each photo decoded once."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.config import Methods
from skyquilt.errors import NoPhotosError, UnreadablePhotoError
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.run.clock import Steps
from skyquilt.run.executor import in_order
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store, digest

PICTURE = 500
"""Longest side in px of the grey pictures kept for the search of heights."""
THUMBNAIL = 256
"""Longest side in px of the thumbnails kept for exposure and the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Looked:
    """What one look at a photo's pixels gives."""

    features: Features
    """Keypoints."""
    thumbnail: NDArray
    """(h, w[, bands])."""
    picture: NDArray[np.uint8]
    """(h, w) grey, longest side PICTURE px, for the search of heights."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Intake:
    """Photos that could be read, and what was seen in them."""

    photos: tuple[Photo, ...]
    """In order of capture."""
    looked: tuple[Looked, ...]
    """One per photo."""
    rejected: tuple[RejectedPhoto, ...]
    """Photos whose pixels could not be read."""

    @property
    def features(self) -> list[Features]:
        """Features per photo."""
        return [k.features for k in self.looked]

    def grey(self, photo: int, longest: int) -> NDArray[np.uint8]:
        """Grey picture of a photo, its longest side at most `longest` px."""
        return shrink(self.looked[photo].picture, longest)[0]


def look(photo: Photo, index: int, cache: PixelCache, methods: Methods) -> Looked:
    """Features and thumbnail of a photo.

    Raises:
        UnreadablePhotoError: its pixels cannot be decoded.
    """
    pixels = cache(index)
    small, _ = shrink(pixels, methods.sift.longest)
    thumbnail, _ = shrink(small, THUMBNAIL)
    return Looked(
        features=methods.sift.of_shrunken(small, pixels.shape[:2]), thumbnail=np.ascontiguousarray(thumbnail),
        picture=to_grey8(shrink(small, PICTURE)[0]),
    )  # fmt: skip


def take_in(photos: Sequence[Photo], cache: PixelCache, methods: Methods, store: Store, jobs: int) -> Steps[Intake]:
    """Looks at every photo, or finds in the store what an earlier look gave.

    Raises:
        NoPhotosError: not one photo's pixels could be read.
    """
    cv2.setNumThreads(1)  # parallel over photos instead

    def one(index: int) -> Looked | RejectedPhoto:
        photo = photos[index]
        try:
            key = digest(photo.digest, methods.sift, THUMBNAIL, PICTURE)
            return store.get_or("features", key, lambda: look(photo, index, cache, methods))
        except UnreadablePhotoError as error:
            return RejectedPhoto(name=photo.name, reason=str(error))

    results = []
    for result in in_order(one, range(len(photos)), jobs=jobs):
        results.append(result)
        yield len(results), len(photos)
    good = [(p, r) for p, r in zip(photos, results, strict=True) if isinstance(r, Looked)]
    bad = tuple(r for r in results if isinstance(r, RejectedPhoto))
    if not good:
        raise NoPhotosError(f"none of {len(photos)} photos could be decoded; the first: {bad[0].reason}")
    return Intake(photos=tuple(p for p, _ in good), looked=tuple(k for _, k in good), rejected=bad)
