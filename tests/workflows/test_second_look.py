"""Photos that no link connects with the others are looked at again, with more features."""

import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageOps

from skyquilt.model.features import Features, Link, RejectedLink
from skyquilt.settings import MosaicSettings
from skyquilt.workflows import flow
from skyquilt.workflows.links import Links
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import mosaic
from skyquilt.workflows.second_look import TRIED, _numbers, unconnected
from tests.alignment.surveys import prior
from tests.texture import texture


def link(a, b):
    return Link(a=a, b=b, index_a=np.arange(3), index_b=np.arange(3), b_S_a=1 + 0j)


def refused(a, b):
    return RejectedLink(a=a, b=b, reason="weak inliers")


def links(good, bad):
    return Links(links=tuple(link(*k) for k in good), rejected=tuple(refused(*k) for k in bad))


def features(px):
    n = len(px)
    return Features(
        px=np.array(px, float).reshape(n, 2),
        size=np.ones(n, np.float32),
        descriptors=np.arange(n, dtype=np.uint8)[:, None],
        scale=2.0,
    )


LINE = [prior([10.0 * i, 0.0, 60.0]) for i in range(20)]


def test_only_pairs_that_would_connect_photos_are_compared_again():
    known = links([(0, 1), (1, 2), (4, 5)], [(0, 2), (2, 3), (2, 4), (3, 4), (3, 5)])
    assert unconnected(6, known, LINE[:6]) == [(2, 3), (2, 4), (3, 4), (3, 5)]
    assert unconnected(3, links([(0, 1), (1, 2)], [(0, 2)]), LINE[:3]) == []


def test_the_nearest_pairs_are_compared():
    """A photo in the middle of a line of photos that are linked with one another."""
    others = [i for i in range(20) if i != 10]
    chain = list(pairwise(others))
    failed = [(min(i, 10), max(i, 10)) for i in others]
    chosen = unconnected(20, links(chain, failed), LINE)
    assert len(chosen) == TRIED
    assert {abs(a - b) for a, b in chosen} == {1, 2, 3}
    nowhere = [prior([np.nan] * 3) for _ in range(20)]
    assert unconnected(20, links(chain, failed), nowhere) == chosen


def test_features_found_before_keep_their_numbers():
    """The second features of a photo are found at the same places or at new ones."""
    first, second = features([[10, 10], [50, 20]]), features([[49.5, 20.2], [70, 70], [10, 10.8]])
    numbers = _numbers(first, second)
    both = first.followed_by(second)
    assert numbers.tolist() == [1, 3, 0]
    assert np.allclose(both.px[numbers], second.px, atol=1)
    assert len(both) == len(both.descriptors) == len(both.size) == 5


def not_at_all(found, links, *given):
    yield 0, 1
    return found, links


@pytest.mark.slow
@pytest.mark.parametrize("looks", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_photos_with_few_features_are_connected(small_flight, tmp_path, monkeypatch, looks):
    """Thirty features of a photo are too few to link all nine; a hundred and fifty are not."""
    if looks == 1:
        monkeypatch.setattr(flow, "connect", not_at_all)
    settings = MosaicSettings(surface="ties", gsd_cm=40.0)
    methods = methods_for(settings)
    few = replace(methods, detector=methods.detector.counted(30))
    metrics = mosaic(small_flight / "photos", tmp_path / "out", settings, methods=few).metrics
    assert (metrics["blocks"] == [9]) == (looks == 2)
    assert metrics["reprojection_error_px"]["mean"] < 0.5


def other_ground(picture):
    """Unrelated texture: such photos are linked with none, whatever is done to them."""
    return Image.fromarray(
        np.clip(texture(picture.height, picture.width, seed=5), 0, 255).astype(np.uint8)
    ).convert("RGB")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (ImageOps.mirror, "mirrored"),
        pytest.param(ImageOps.flip, "mirrored", marks=pytest.mark.long),
        (ImageOps.invert, "in negative"),
        (other_ground, None),
    ],
)
def test_photos_that_are_mirrored_or_in_negative_are_told(flight, tmp_path, change, said):
    """Every second photo is changed by Pillow; the others are as they were."""
    folder = tmp_path / "photos"
    shutil.copytree(flight / "photos", folder)
    for path in sorted(folder.glob("*.jpg"))[::2]:
        with Image.open(path) as picture:
            exif = picture.getexif().tobytes()
            changed = change(picture.convert("RGB"))
        changed.save(path, quality=92, exif=exif)
    settings = MosaicSettings(surface="ties", gsd_cm=40.0)
    warnings = mosaic(folder, tmp_path / "out", settings).metrics["warnings"]
    told = [w for w in warnings if "against others" in w]
    assert len(told) == (said is not None)
    assert all(f"the ground {said} against" in w for w in told)
