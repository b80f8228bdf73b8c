"""What goes wrong with one photo, and what is no fault of it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from skyquilt.engine.store import Store
from skyquilt.engine.workers import HERE
from skyquilt.matching.sift import Sift
from skyquilt.matching.straightened import straightened_features
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Photo
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.photo_features import (
    FeaturedPhotos,
    find_features,
    of_one_kind,
    photo_features,
    picture_of,
)
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


def test_degrees_and_counts_are_not_one_kind():
    """Frames of a camera in degrees and of one in counts were joined in one map "in degrees"."""
    common = {
        "path": Path("a"),
        "digest": "0",
        "width": 640,
        "height": 512,
        "channels": 1,
        "dtype": "float32",
    }
    common |= {
        "band": "thermal",
        "position": None,
        "attitude": None,
        "time": None,
        "camera_key": "c",
    }
    focal = Focal(px=700.0, sigma_px=70.0, source="guess")
    units = ["celsius", "counts", "celsius"]
    photos = [Photo(name=f"{k}", unit=u, focal=focal, **common) for k, u in enumerate(units)]

    def of_one(number):
        given = tuple(photos[k] for k in number)
        return of_one_kind(
            FeaturedPhotos(photos=given, number=number, look=None, looks=None, rejected=())
        )

    assert [p.name for p in of_one((0, 1)).photos] == ["0"]  # a conversion beside its source
    found = of_one((0, 1, 2))
    assert [p.name for p in found.photos] == ["0", "2"]
    (left,) = found.rejected
    assert left.name == "1" and "thermal in counts" in left.reason
    assert "thermal in celsius" in left.reason


@pytest.mark.parametrize("told_by", ["calibration", "shown_lens"])
def test_features_of_a_fisheye_are_those_of_its_straightened_picture(tmp_path, told_by):
    """Whether files tell that it is one, or photos showed it; plain ones are kept beside."""
    path = tmp_path / "one.jpg"
    blots = np.random.default_rng(1).uniform(0, 255, (40, 60)).astype(np.uint8)
    blots = cv2.resize(blots, (480, 320), interpolation=cv2.INTER_CUBIC)
    path.write_bytes(jpeg_bytes(np.repeat(blots[..., None], 3, axis=2)))
    plain = read_photo(path)
    lens = replace(Camera.ideal(width=480, height=320, focal=250.0), fisheye=1.0, k1=-0.02)
    bent = replace(plain, **{told_by: lens})
    store = Store(folder=tmp_path / "store", registry=REGISTRY)
    found = {
        p.lens.fisheye: photo_features(p, lambda: read_color(plain), Sift(), store)
        for p in (bent, plain)
    }
    picture = picture_of(read_color(plain))
    straight = straightened_features(bent.lens, picture, (320, 480), Sift())
    assert np.array_equal(found[1].features.px, straight.px) and len(straight) > 100
    assert np.array_equal(found[0].features.px, Sift()(picture).px)
    assert np.array_equal(found[0].thumbnail, found[1].thumbnail)
    kept = [photo_features(p, pytest.fail, Sift(), store).features for p in (plain, bent)]
    assert np.array_equal(kept[1].px, straight.px) and not np.array_equal(kept[0].px, straight.px)
