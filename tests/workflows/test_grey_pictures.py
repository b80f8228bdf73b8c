"""Grey images of every size come from a photo's pixels once, and then from the store."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from skyquilt.engine.store import Store
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.photo_features import PICTURE, GreyPictures
from tests.alignment.surveys import photo
from tests.texture import texture

LONGEST = 1400


def test_grey_images_larger_than_the_kept_ones_are_those_of_the_pixels(tmp_path):
    """1400 of 2100 px are the means of 1.5 x 1.5 px; the photo is decoded once for each size, and
    not at all for another run with the same store.
    """
    grey = np.clip(texture(1500, 2100, seed=3), 0, 255).astype(np.uint8)
    read = []

    def pixels(index):
        read.append(index)
        return np.repeat(grey[..., None], 3, 2)

    def pictures():
        own = replace(photo("a.jpg"), width=2100, height=1500)
        return GreyPictures([own], pixels, Store(folder=tmp_path, registry=REGISTRY))

    give = pictures()
    large, kept = give(0, LONGEST), give(0, PICTURE)
    assert large.shape == (1000, LONGEST) and kept.shape == (714, PICTURE)
    mean = cv2.resize(grey, (LONGEST, 1000), interpolation=cv2.INTER_AREA)
    assert np.abs(large.astype(int) - mean).max() <= 1
    assert give(0, 500).shape == (357, 500)
    assert np.array_equal(give(0, LONGEST), large)
    assert len(read) == 2
    assert np.array_equal(pictures()(0, LONGEST), large)
    assert len(read) == 2


def test_a_photo_that_is_smaller_than_the_kept_ones_is_read_and_stored_once(tmp_path):
    grey = np.clip(texture(600, 800, seed=4), 0, 255).astype(np.uint8)
    read = []

    def pixels(index):
        read.append(index)
        return np.repeat(grey[..., None], 3, 2)

    own = replace(photo("a.jpg"), width=800, height=600)
    give = GreyPictures([own], pixels, Store(folder=tmp_path, registry=REGISTRY))
    assert np.array_equal(give(0, LONGEST), give(0, PICTURE))
    assert give(0, LONGEST).shape == (600, 800) and len(read) == 1


def test_threads_that_ask_for_other_sizes_each_get_their_own(tmp_path):
    """While one thread waits for the pixels of a photo, another asks for another size: heights
    found by two threads came from pictures of the wrong size.
    """
    grey = np.clip(texture(600, 800, seed=5), 0, 255).astype(np.uint8)
    asked, ready = threading.Event(), threading.Event()

    def pixels(index):
        if index == 0:
            asked.set()
            assert ready.wait(10)
        return np.repeat(grey[..., None], 3, 2)

    own = [replace(photo(f"{k}.jpg"), width=800, height=600, digest=f"{k}") for k in (0, 1)]
    give = GreyPictures(own, pixels, Store(folder=tmp_path, registry=REGISTRY))
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(give, 0, 500)
        assert asked.wait(10)
        assert give(1, 250).shape == (188, 250)
        ready.set()
        assert first.result().shape == (375, 500)
    assert give(0, 250).shape == (188, 250)
    assert give(0, 500).shape == (375, 500) and give(1, 250).shape == (188, 250)
