"""What goes wrong with one photo, and what is no fault of it."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.engine.store import Store
from skyquilt.engine.workers import HERE
from skyquilt.matching.sift import Sift
from skyquilt.photos.read import read_photo
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.photo_features import find_features
from tests.photos.conftest import jpeg_bytes


def test_a_full_memory_is_no_fault_of_the_photos(tmp_path):
    """They would be left out of the map, one after the other."""
    path = tmp_path / "one.jpg"
    path.write_bytes(jpeg_bytes(np.full((48, 64, 3), 90, np.uint8)))
    photo = read_photo(path)
    store = Store(folder=tmp_path / "store", registry=REGISTRY)

    def pixels(index):
        if index:
            raise MemoryError("Unable to allocate 9 GiB")
        return np.zeros((photo.height, photo.width, 3), np.uint8)

    photos = [photo, replace(photo, digest="other")]
    with pytest.raises(MemoryError, match=r"to read one\.jpg"):
        list(find_features(photos, pixels, Sift(), store, HERE))
