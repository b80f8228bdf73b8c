"""Features, a thumbnail and a grey image of each photo, all from one decoding.

The batch and live workflows both use `photo_features`, so that they share artefacts in a store.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.clock import Steps
from skyquilt.engine.pixel_cache import Box, PhotoParts, PixelCache, Step
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Workers
from skyquilt.errors import NoPhotosError, OutputError, PhotoFailedError, UnreadablePhotoError
from skyquilt.imaging.grey import detail, halved, shrink, to_grey8
from skyquilt.matching.straightened import straightened_features
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.ortho.palettes import palette_notes
from skyquilt.outside import out_of_memory
from skyquilt.photos.kept_frames import kept_frame
from skyquilt.photos.pixels import decode_jpeg, lost, read_color
from skyquilt.photos.read import rejected
from skyquilt.workflows.methods import Detector

PICTURE = 1000
"""Longest side in px of the grey images kept of every photo for the refinement of observations and
the search of heights.
"""
KEPT_BYTES = 150_000_000
"""Bytes of grey images, and of features, kept in memory; the others are read from the store."""
MOST_LONGEST = 2**20
"""More px than grey images are asked for: images of several sizes are kept together."""
PhotoPixels = Callable[[int], NDArray[Any]]
"""Full-size pixels of a photo by its index."""
FRAMES = "looks"
"""Folder in the store of frames of clips: that of what was seen of their clips."""
THUMBNAIL = 256
"""Longest side in px of the thumbnails kept for exposure and the report."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotoFeatures:
    """Data computed from one decoding of a photo."""

    features: Features
    """Keypoints."""
    thumbnail: NDArray[Any]
    """(h, w[, bands])."""
    detail: NDArray[np.float32]
    """(rows, columns, 3) how sharp the picture is in its cells (`imaging.grey.detail`)."""

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.features.nbytes + int(self.thumbnail.nbytes + self.detail.nbytes)


@dataclass(frozen=True, kw_only=True, eq=False)
class FeaturedPhotos:
    """Photos that could be read, with their features."""

    photos: tuple[Photo, ...]
    """The photos, in order of capture."""
    number: tuple[int, ...]
    """Number of each photo in `looks`."""
    look: Callable[[int, Photo], PhotoFeatures]
    """Features and thumbnail of a photo by its number, from the store or computed now."""
    looks: PixelCache[PhotoFeatures]
    """The same by its number, unless used lately."""
    rejected: tuple[RejectedPhoto, ...]
    """Photos that cannot be used, with reasons."""
    closer: Callable[[int], Features] | None = None
    """Gives the features found in a second look (`workflows.second_look`)."""
    again: frozenset[int] = frozenset()
    """Photos that were looked at twice."""

    @property
    def features(self) -> Sequence[Features]:
        """Features per photo; read when asked for, so that memory does not hold those of all."""
        return _FeaturesOf(self)

    def through(self, lenses: Mapping[str, Camera]) -> "FeaturedPhotos":
        """The same photos, those of some cameras (`camera_key`) with other lenses."""
        photos = tuple(
            replace(p, shown_lens=lenses[p.camera_key]) if p.camera_key in lenses else p
            for p in self.photos
        )
        by_number = dict(zip(self.number, photos, strict=True))
        looks = PixelCache(
            read=lambda n: self.look(n, by_number[n]), budget_bytes=self.looks.budget_bytes
        )
        return replace(self, photos=photos, looks=looks)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on photos that do not belong in one map."""
        if all(p.band != "thermal" for p in self.photos):
            return ()
        return palette_notes(self.photos, self.thumbnails(range(len(self.photos))))

    def detail(self, photo: int) -> NDArray[np.float32]:
        """How sharp the picture of a photo (index) is in its cells."""
        return self.looks.once(self.number[photo]).detail

    def thumbnails(self, photos: Sequence[int]) -> Mapping[int, NDArray[Any]]:
        """Thumbnails of these photos, by index; read when asked for."""
        return _ThumbnailsOf(self, photos)


class _FeaturesOf(Sequence[Features]):
    def __init__(self, found: FeaturedPhotos) -> None:
        self._found = found

    def __len__(self) -> int:
        return len(self._found.photos)

    @overload
    def __getitem__(self, photo: int) -> Features: ...
    @overload
    def __getitem__(self, photo: slice) -> Sequence[Features]: ...
    def __getitem__(self, photo: int | slice) -> Features | Sequence[Features]:
        if isinstance(photo, slice):
            return [self[i] for i in range(*photo.indices(len(self)))]
        found = self._found
        features = found.looks(found.number[photo]).features
        if found.closer is None or photo not in found.again:
            return features
        return features.followed_by(found.closer(photo))


class _ThumbnailsOf(Mapping[int, NDArray[Any]]):
    def __init__(self, found: FeaturedPhotos, photos: Sequence[int]) -> None:
        self._found, self._photos = found, dict.fromkeys(photos)

    def __len__(self) -> int:
        return len(self._photos)

    def __contains__(self, photo: object) -> bool:
        return photo in self._photos

    def __iter__(self) -> Iterator[int]:
        return iter(self._photos)

    def __getitem__(self, photo: int) -> NDArray[Any]:
        if photo not in self._photos:
            raise KeyError(photo)
        return self._found.looks.once(self._found.number[photo]).thumbnail


class PixelsInUse:
    """Full-size pixels of the photos in use, by their index among these."""

    def __init__(
        self, photos: Sequence[Photo], number: Sequence[int], cache: PixelCache[NDArray[Any]]
    ) -> None:
        """`number`: the number of each photo in the cache."""
        self._names, self._number = tuple(p.name for p in photos), tuple(number)
        self._nbytes = sum(
            p.width * p.height * p.channels * np.dtype(p.dtype).itemsize for p in photos
        )
        self._cache = cache

    def __call__(self, photo: int, *, once: bool = False) -> NDArray[Any]:
        """Pixels of a photo (index), read-only. `once`: it is not asked for again soon.

        Raises:
            PhotoFailedError: a photo that could be read before is lost.
            MemoryError: there is not enough memory.
        """
        try:
            return (self._cache.once if once else self._cache)(self._number[photo])
        except Exception as error:  # whatever it is, it concerns this photo alone
            name = self._names[photo]
            if out_of_memory(error):
                raise MemoryError(f"it does not suffice to decode {name}") from error
            reason = rejected(name, error).reason
            raise PhotoFailedError(name, f"it could be read before, but now {reason}") from error

    @property
    def crowded(self) -> bool:
        """Whether not all photos fit into memory."""
        return self._cache.dropped > 0 or self._nbytes > self._cache.budget_bytes

    def parts(self, asked: Mapping[int, Mapping[Step, Box]]) -> PhotoParts:
        """Keeps no more of photos than what steps ask for, by the photo's index."""
        return PhotoParts(lambda photo: self(photo, once=True), asked, self._cache)

    def make_room(self) -> None:
        """Drops the photos kept in memory where not all fit."""
        self._cache.make_room()


class GreyPictures:
    """Grey images of photos from the store; those used last are kept in memory."""

    def __init__(self, photos: Sequence[Photo], pixels: PhotoPixels, store: Store) -> None:
        self._photos, self._pixels, self._store = photos, pixels, store
        self._cache = PixelCache(read=self._load, budget_bytes=KEPT_BYTES)
        self._small = PixelCache(
            read=lambda key: self._shrunken(*divmod(key, MOST_LONGEST)),
            budget_bytes=KEPT_BYTES // 3,
        )

    def __call__(self, photo: int, longest: int) -> NDArray[np.uint8]:
        """Grey image of a photo (index), with at most `longest` px on its longest side. Those of
        more than `PICTURE` px are made when they are asked for, and kept in the store too.
        """
        if longest == PICTURE:
            return self._cache(photo)
        return self._small(photo * MOST_LONGEST + longest)

    def make_room(self) -> None:
        """Drops the images kept in memory where not all fit."""
        self._cache.make_room()
        self._small.make_room()

    def _shrunken(self, photo: int, longest: int) -> NDArray[np.uint8]:
        own = self._photos[photo]
        if longest > PICTURE and max(own.width, own.height) > PICTURE:
            return self._store.get_or(
                "pictures",
                digest(picture_key(own), longest),
                lambda: picture_of(self._pixels(photo), longest),
            )
        return np.ascontiguousarray(shrink(self._cache(photo), longest)[0])

    def _load(self, photo: int) -> NDArray[np.uint8]:
        return self._store.get_or(
            "pictures", picture_key(self._photos[photo]), lambda: picture_of(self._pixels(photo))
        )


def pixels_of(photo: Photo, store: Store) -> NDArray[Any]:
    """Pixels of a photo, as `read_color` gives them. A frame of a clip is decoded from the clip
    once and then kept in the store: to find one, all since a key frame before it are decoded, which
    costs as much as several photos.

    Raises:
        UnreadablePhotoError: they cannot be decoded, or its file holds another photo.
        OutputError: a frame cannot be stored.
    """
    if photo.frame_s is None:
        return _as_it_was(photo)
    body = store.get_or(FRAMES, photo.digest, lambda: kept_frame(read_color(photo)))
    return decode_jpeg(body.tobytes())


def _as_it_was(photo: Photo) -> NDArray[Any]:
    """Pixels of a photo whose file is the one that was read; `UnreadablePhotoError` if not."""
    pixels = read_color(photo)
    if reason := lost(photo):
        raise UnreadablePhotoError(reason)
    return pixels


def pixels_again(photo: Photo) -> NDArray[Any]:
    """Pixels of a photo that could be decoded before.

    Raises:
        PhotoFailedError: it cannot be any more, or its file holds another photo.
        MemoryError: there is not enough memory.
    """
    try:
        return _as_it_was(photo)
    except Exception as error:  # whatever it is, it concerns this photo alone
        if out_of_memory(error):
            raise MemoryError(f"it does not suffice to decode {photo.name}") from error
        reason = lost(photo) or rejected(photo.name, error).reason
        raise PhotoFailedError(photo.name, reason) from error


def features_key(photo: Photo, detector: Detector) -> str:
    """The key of a photo's features and thumbnail in the store."""
    bent = (photo.lens,) if photo.lens.fisheye else ()
    return digest(photo.pixels_key, features_recipe(detector), *bent)


def features_recipe(detector: Detector) -> tuple[Any, ...]:
    """Everything on which features and thumbnails depend, except for their photos."""
    return detector, THUMBNAIL, detail, straightened_features, *picture_recipe()


def picture_key(photo: Photo) -> str:
    """The key of a photo's grey image in the store."""
    return digest(photo.pixels_key, picture_recipe())


def picture_recipe() -> tuple[Any, ...]:
    """Everything on which grey images depend, except for their photos; part of the key of all
    results made from them.
    """
    return PICTURE, halved, shrink, to_grey8


def picture_of(pixels: NDArray[Any], longest: int = PICTURE) -> NDArray[np.uint8]:
    """The grey image of a photo's pixels, with at most `longest` px on its longest side."""
    rough = halved(pixels, longest)
    if rough.dtype == np.uint8:  # averaging one band takes a third of the time of three
        return np.ascontiguousarray(shrink(to_grey8(rough), longest)[0])
    return np.ascontiguousarray(to_grey8(shrink(rough, longest)[0]))


def thumbnail_of(pixels: NDArray[Any]) -> NDArray[Any]:
    """The thumbnail of a photo's pixels. An odd last row or column is left out: it would make
    averaging many times slower.
    """
    height, width = pixels.shape[:2]
    return np.ascontiguousarray(
        shrink(pixels[: height - height % 2, : width - width % 2], THUMBNAIL)[0]
    )


def photo_features(
    photo: Photo, pixels: Callable[[], NDArray[Any]], detector: Detector, store: Store
) -> PhotoFeatures:
    """Features and thumbnail of a photo, from the store or computed now; its grey image is stored
    beside them. `pixels` decodes the photo. Features of a fisheye's are found in its straightened
    picture.

    Raises:
        UnreadablePhotoError: its pixels cannot be decoded.
    """
    return store.get_or(
        "features", features_key(photo, detector), lambda: _look(photo, pixels(), detector, store)
    )


def _look(photo: Photo, pixels: NDArray[Any], detector: Detector, store: Store) -> PhotoFeatures:
    rough = halved(pixels, PICTURE)
    picture, longest, full = picture_of(rough), detector.longest, pixels.shape[:2]
    store.put("pictures", picture_key(photo), picture)
    if photo.lens.fisheye:
        found = straightened_features(photo.lens, picture, full, detector)
    elif longest > PICTURE:
        found = detector.of_shrunken(shrink(pixels, longest)[0], full)
    else:
        # sensor values become grey at the size that is searched, since equalisation is local
        source = picture if rough.dtype == np.uint8 else shrink(rough, PICTURE)[0]
        found = detector.of_shrunken(shrink(source, longest)[0], full)
    return PhotoFeatures(features=found, thumbnail=thumbnail_of(rough), detail=detail(pixels))


def find_features(
    photos: Sequence[Photo], pixels: PhotoPixels, detector: Detector, store: Store, workers: Workers
) -> Steps[FeaturedPhotos]:
    """Features of every photo that can be decoded.

    Raises:
        NoPhotosError: no photo could be decoded.
        PhotoFailedError: the file of a photo is no longer the one that was read.
        MemoryError: there is not enough memory, which is no fault of a photo.
    """
    cv2.setNumThreads(1)  # photos are processed in parallel instead

    def look(number: int, photo: Photo) -> PhotoFeatures:
        return photo_features(photo, lambda: pixels(number), detector, store)

    looks = PixelCache(read=lambda i: look(i, photos[i]), budget_bytes=KEPT_BYTES)

    def failure(index: int) -> RejectedPhoto | None:
        try:
            if not store.has("features", features_key(photos[index], detector)):
                looks(index)
        except OutputError:  # a full disk is no fault of the photo
            raise
        except Exception as error:  # whatever it is, it concerns this photo alone
            if out_of_memory(error):
                raise MemoryError(f"it does not suffice to read {photos[index].name}") from error
            if reason := lost(photos[index]):  # others may be lost with it
                raise PhotoFailedError(photos[index].name, reason) from error
            return rejected(photos[index].name, error)
        return None

    good, bad = list[int](), list[RejectedPhoto]()
    for index, failed in enumerate(workers.each(failure, range(len(photos)))):
        if failed is None:
            good.append(index)
        else:
            bad.append(failed)
        yield index + 1, len(photos)
    if not good:
        raise NoPhotosError(
            f"none of {len(photos)} photos could be decoded; the first: {bad[0].reason}"
        )
    return FeaturedPhotos(
        photos=tuple(photos[i] for i in good),
        number=tuple(good),
        look=look,
        looks=looks,
        rejected=tuple(bad),
    )


def _kind(kind: tuple[int, str, str, str]) -> str:
    """In words: bands, type, spectrum and unit of pixels."""
    channels, dtype, band, unit = kind
    return f"{channels} x {dtype}, {band}" + (f" in {unit}" if unit else "")


def of_one_kind(found: FeaturedPhotos) -> FeaturedPhotos:
    """The photos with the most frequent kind of pixels, since all photos of a map must have the
    same kind; of kinds as frequent the one in degrees (of files that were converted to it).
    """
    kinds = [(p.channels, p.dtype, p.band, p.unit) for p in found.photos]
    common = max(set(kinds), key=lambda k: (kinds.count(k), k[3] == "celsius", k))
    keep = [i for i, k in enumerate(kinds) if k == common]
    odd = tuple(
        RejectedPhoto(
            name=p.name,
            reason=f"it is a {p.band} photo, and the map shows the {common[2]} ones; give thermal"
            " photos in a folder of their own, with --thermal"
            if p.band != common[2]
            else f"its pixels ({_kind(k)}) differ from the survey's ({_kind(common)}); save all"
            " as one kind, or map it by itself",
        )
        for p, k in zip(found.photos, kinds, strict=True)
        if k != common
    )
    return replace(
        found,
        photos=tuple(found.photos[i] for i in keep),
        number=tuple(found.number[i] for i in keep),
        rejected=(*found.rejected, *odd),
    )
