"""Smaller copies of photos of the same survey: previews, thumbnails, what was made to be sent.

They show nothing that the photos do not, and would make the map as coarse as they are.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from pathlib import PurePosixPath

from skyquilt.model.photo import Photo, RejectedPhoto

SMALLER = 0.8
"""A copy has less than this share of the photo's width; ..."""
SAME = 0.03
"""... the same shape and the same angle of view, within this share."""


def without_reduced(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    """The photos without smaller copies of others, and these with their reason.

    A copy states the same place and time and has the same angle of view or name; or it has the
    same name and no metadata.
    """
    alike: dict[Hashable, list[Photo]] = defaultdict(list)
    for photo in photos:
        for key in _keys(photo):
            alike[key].append(photo)
    copy_of: dict[str, str] = {}
    for group in alike.values():
        largest = max(group, key=lambda p: (p.width, p.name))
        for photo in group:
            if _is_reduced(photo, largest):
                copy_of[photo.name] = largest.name
    kept = tuple(p for p in photos if p.name not in copy_of)
    return kept, tuple(
        RejectedPhoto(name=name, reason=f"it is a smaller copy of {original}")
        for name, original in copy_of.items()
    )


def _keys(photo: Photo) -> Iterator[Hashable]:
    """What a photo shares with its copies."""
    place = photo.position
    if photo.time is not None and place is not None:
        yield photo.time, place.latitude_deg, place.longitude_deg, photo.band, photo.band_name
    yield _stem(photo)


def _stem(photo: Photo) -> str:
    return PurePosixPath(photo.name).stem.lower()


def _is_reduced(photo: Photo, original: Photo) -> bool:
    """Whether a photo is a smaller copy of one that shares a key with it."""
    ratio = photo.width / original.width
    if ratio > SMALLER or abs(photo.height / original.height / ratio - 1) > SAME:
        return False
    if photo.time is None and photo.position is None:
        told = original.time is not None or original.position is not None
        return told and _stem(photo) == _stem(original)
    a, b = photo.position, original.position
    if a is None or b is None or photo.time != original.time or photo.band != original.band:
        return False
    if (a.latitude_deg, a.longitude_deg) != (b.latitude_deg, b.longitude_deg):
        return False
    same_view = abs(photo.focal.px / original.focal.px / ratio - 1) < SAME
    return same_view or _stem(photo) == _stem(original)
