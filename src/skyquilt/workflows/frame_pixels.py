"""Pixels of photos. A frame of a clip is decoded from the clip once and then kept in the store: to
find a frame, all since a key frame before it are decoded, which costs as much as several photos.
"""

from typing import Any

from numpy.typing import NDArray

from skyquilt.engine.store import Store
from skyquilt.model.photo import Photo
from skyquilt.photos.kept_frames import kept_frame
from skyquilt.photos.pixels import decode_jpeg, read_color

STAGE = "looks"
"""Their folder in the store: that of what was seen of their clips."""


def pixels_of(photo: Photo, store: Store) -> NDArray[Any]:
    """Pixels of a photo, as `read_color` gives them; those of a frame are the ones kept, also when
    it is decoded for the first time.

    Raises:
        UnreadablePhotoError: they cannot be decoded. OutputError: a frame cannot be stored.
    """
    if photo.frame_s is None:
        return read_color(photo)
    body = store.get_or(STAGE, photo.digest, lambda: kept_frame(read_color(photo)))
    return decode_jpeg(body.tobytes())
