"""Photos in: what they say, their features, and a thumbnail each, each photo decoded once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.config import Methods
from skyquilt.errors import NoPhotosError, UnreadablePhotoError
from skyquilt.imaging.grey import halved, shrink, to_grey8
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.run.clock import Steps
from skyquilt.run.executor import in_order
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store, digest

PICTURE = 1000
"""Longest side in px of the grey pictures kept for sharpening sightings and the search of heights.
"""
KEPT_BYTES = 150_000_000
"""Grey pictures held in memory at a time; the others wait in the store."""
PhotoPixels = Callable[[int], NDArray[Any]]
"""Full-size pixels of a photo by its index."""
THUMBNAIL = 256
"""Longest side in px of the thumbnails kept for exposure and the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Looked:
    """What one look at a photo's pixels gives."""

    features: Features
    """Keypoints."""
    thumbnail: NDArray[Any]
    """(h, w[, bands])."""


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


class Pictures:
    """Grey pictures of the photos, from the store, the last ones used at hand."""

    def __init__(self, photos: Sequence[Photo], pixels: PhotoPixels, store: Store) -> None:
        self._photos, self._pixels, self._store = photos, pixels, store
        self._cache = PixelCache(read=self._load, budget_bytes=KEPT_BYTES)
        self._small = PixelCache(read=self._shrunken, budget_bytes=KEPT_BYTES // 3)
        self._longest = 0

    def __call__(self, photo: int, longest: int) -> NDArray[np.uint8]:
        """Grey picture of a photo (index), its longest side at most `longest` px."""
        if longest >= PICTURE:
            return self._cache(photo)
        if longest != self._longest:
            self._small.clear()
            self._longest = longest
        return self._small(photo)

    def _shrunken(self, photo: int) -> NDArray[np.uint8]:
        return np.ascontiguousarray(shrink(self._cache(photo), self._longest)[0])

    def _load(self, photo: int) -> NDArray[np.uint8]:
        return self._store.get_or(
            "pictures", picture_key(self._photos[photo]), lambda: picture_of(self._pixels(photo))
        )


def picture_key(photo: Photo) -> str:
    """The key of a photo's grey picture in the store."""
    return digest(photo.digest, picture_recipe())


def picture_recipe() -> tuple[Any, ...]:
    """What grey pictures depend on besides their photos: part of the key of all made from them."""
    return PICTURE, halved, shrink, to_grey8


def features_key(photo: Photo, methods: Methods) -> str:
    """The key of a photo's features and thumbnail in the store."""
    return digest(photo.digest, features_recipe(methods))


def features_recipe(methods: Methods) -> tuple[Any, ...]:
    """What features and thumbnails depend on besides their photos."""
    return methods.sift, THUMBNAIL, *picture_recipe()


def picture_of(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """The grey picture of a photo's pixels."""
    rough = halved(pixels, PICTURE)
    if rough.dtype == np.uint8:  # one band is averaged in a third of the time of three
        return np.ascontiguousarray(shrink(to_grey8(rough), PICTURE)[0])
    return np.ascontiguousarray(to_grey8(shrink(rough, PICTURE)[0]))


def thumbnail_of(pixels: NDArray[Any]) -> NDArray[Any]:
    """The thumbnail of a photo's pixels, less a last odd row or column, which would cost more than
    all others.
    """
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(
        shrink(pixels[: height - height % 2, : width - width % 2], THUMBNAIL)[0]
    )


def look(photo: Photo, index: int, cache: PhotoPixels, methods: Methods, store: Store) -> Looked:
    """Features and thumbnail of a photo; its grey picture goes to the store.

    Raises:
        UnreadablePhotoError: its pixels cannot be decoded.
    """
    pixels = cache(index)
    rough = halved(pixels, PICTURE)
    picture = picture_of(rough)
    store.put("pictures", picture_key(photo), picture)
    longest = methods.sift.longest
    # values of a sensor are made grey at the size they are searched at: what is equalised locally
    # depends on it
    source = (
        pixels
        if longest > PICTURE
        else picture
        if rough.dtype == np.uint8
        else shrink(rough, PICTURE)[0]
    )
    small, _ = shrink(source, longest)
    return Looked(
        features=methods.sift.of_shrunken(small, pixels.shape[:2]), thumbnail=thumbnail_of(rough)
    )


def take_in(
    photos: Sequence[Photo], cache: PixelCache, methods: Methods, store: Store, jobs: int
) -> Steps[Intake]:
    """Looks at every photo, or finds in the store what an earlier look gave.

    Raises:
        NoPhotosError: not one photo's pixels could be read.
    """
    cv2.setNumThreads(1)  # parallel over photos instead

    def one(index: int) -> Looked | RejectedPhoto:
        photo = photos[index]
        try:
            key = features_key(photo, methods)
            return store.get_or("features", key, lambda: look(photo, index, cache, methods, store))
        except UnreadablePhotoError as error:
            return RejectedPhoto(name=photo.name, reason=str(error))

    results = []
    for result in in_order(one, range(len(photos)), jobs=jobs):
        results.append(result)
        yield len(results), len(photos)
    good = [(p, r) for p, r in zip(photos, results, strict=True) if isinstance(r, Looked)]
    bad = tuple(r for r in results if isinstance(r, RejectedPhoto))
    if not good:
        raise NoPhotosError(
            f"none of {len(photos)} photos could be decoded; the first: {bad[0].reason}"
        )
    return Intake(photos=tuple(p for p, _ in good), looked=tuple(k for _, k in good), rejected=bad)
