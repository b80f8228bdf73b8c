"""Keypoints follow what is done to the image; coordinates are those of the full image's pixel
centres.
"""

import cv2
import numpy as np
import pytest

from skyquilt.imaging.grey import full_px, halved, shrink, stretched, to_grey8
from skyquilt.matching.keypoints import spread
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.model.features import DESCRIPTOR_UNIT
from tests.texture import texture


@pytest.fixture(scope="module")
def picture():
    return np.clip(texture(480, 640, seed=3), 0, 255).astype(np.uint8)


def warped(image, angle, scale, shift):
    """The image under a similarity about its centre, and the (2, 3) matrix that did it."""
    h, w = image.shape
    M = cv2.getRotationMatrix2D(((w - 1) / 2, (h - 1) / 2), angle, scale)
    M[:, 2] += shift
    return cv2.warpAffine(image, M, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), M


@pytest.mark.parametrize(
    ("angle", "scale", "shift", "within", "share"),
    [
        (0, 1, (13, -7), 0.05, 0.6),
        (0, 1, (4.5, 2.25), 0.2, 0.3),
        (30, 1, (5, 5), 0.3, 0.25),
        (0, 0.8, (0, 0), 0.4, 0.15),
        (180, 1, (0, 0), 0.1, 0.6),
    ],
)
def test_keypoints_move_with_the_image(picture, angle, scale, shift, within, share):
    other, M = warped(picture, angle, scale, shift)
    sift = Sift(count=800, longest=640)
    a, b = sift(picture), sift(other)
    matches = Mutual()(a, b)
    expected = a.px[matches.index_a] @ M[:, :2].T + M[:, 2]
    off = np.linalg.norm(b.px[matches.index_b] - expected, axis=1)
    good = off < 3
    assert good.mean() > 0.9 and good.sum() > share * len(a)
    assert np.median(off[good]) < within
    bias = np.median((b.px[matches.index_b] - expected)[good], axis=0)
    assert np.abs(bias).max() < 0.06  # nothing is half a pixel off


@pytest.mark.parametrize("size", [(1201, 1602), (600, 800)])
def test_a_blob_is_found_where_it_is_in_full_pixels(size):
    """Shrunken or not, the centre of a Gaussian blob comes back in coordinates of the full
    image.
    """
    height, width = size
    y, x = np.mgrid[:height, :width]
    centres = np.random.default_rng(1).uniform(0, 1, (16, 2)) * 20 + np.stack(
        np.meshgrid([80, 260, 440, 620], [80, 220, 360, 500]), -1
    ).reshape(-1, 2)
    image = np.full(size, 60.0)
    for cx, cy in centres:
        near = np.s_[max(0, int(cy) - 80) : int(cy) + 80, max(0, int(cx) - 80) : int(cx) + 80]
        u, v = x[near] - cx, y[near] - cy
        image[near] += 160 * np.exp(-(u**2 + 1.2 * v**2 + 0.3 * u * v) / (2 * 10.0**2))
    found = Sift(count=400, longest=800)(image.astype(np.uint8))
    assert found.scale == pytest.approx(max(1.0, width / 800), rel=2e-3)
    off = np.array([found.px[np.linalg.norm(found.px - c, axis=1).argmin()] - c for c in centres])
    near = np.linalg.norm(off, axis=1) < 3
    assert near.sum() >= 12
    assert np.abs(off[near]).max() < 0.15 and np.abs(off[near].mean(0)).max() < 0.05


@pytest.mark.parametrize("octave", [0, 1])
def test_a_later_first_octave_leaves_out_small_features_and_moves_none(octave):
    """Blobs of 10 px stay where they were drawn; of the features of noise, the smallest go."""
    y, x = np.mgrid[:160, :200]
    centres = np.array([[50.3, 40.6], [150.2, 50.4], [100.7, 110.1]])
    image = np.full((160, 200), 60.0)
    for cx, cy in centres:
        image += 160 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 200)
    noisy = image + np.random.default_rng(1).normal(0, 12, image.shape)
    blobs, usual, later = (
        Sift(longest=640, first_octave=first)(np.clip(of, 0, 255).astype(np.uint8))
        for of, first in ((image, octave), (noisy, -1), (noisy, octave))
    )
    nearest = np.linalg.norm(blobs.px[:, None] - centres, axis=2).min(0)
    assert nearest.max() < 0.25
    assert len(later) < len(usual) / 2
    assert later.size.min() > 1.5 ** (octave + 1) * usual.size.min()


@pytest.mark.parametrize(("doubled", "more"), [(128, 3.0), (127, 1.0)])
def test_small_pictures_are_enlarged_and_show_as_many_more_features(doubled, more):
    """Of a picture of 128 px, doubled, the keypoints are where they are in its own pixels."""
    small, rng = texture(104, 134, seed=5), np.random.default_rng(2)
    views = small[4:100, 3:131], small[:96, :128]  # the same ground 3 px to the left, 4 px up
    noisy = [np.clip(v + rng.normal(0, 1, v.shape), 0, 255).astype(np.uint8) for v in views]
    a, b = (Sift(doubled=doubled)(v) for v in noisy)
    usual = Sift(doubled=0)(noisy[0])
    assert (len(a) > more * len(usual)) == (more > 1) and (a.scale == 0.5) == (more > 1)
    matches = Mutual()(a, b)
    off = b.px[matches.index_b] - a.px[matches.index_a] - [3, 4]
    good = np.linalg.norm(off, axis=1) < 1
    assert good.mean() > 0.9 and np.abs(np.median(off[good], axis=0)).max() < 0.06


def test_the_pixel_convention_of_shrinking():
    """A pixel of a picture shrunk by k covers k of the full one's: centre 0 lies at (k - 1) / 2."""
    assert full_px(np.array([[0.0, 0.0], [9.0, 4.0]]), (5, 10), (20, 40)).tolist() == [
        [1.5, 1.5],
        [37.5, 17.5],
    ]
    image = np.zeros((40, 80), np.uint8)
    small, scale = shrink(image, 20)
    assert small.shape == (10, 20) and scale == 4.0
    assert shrink(image, 100)[0] is image


def test_spreading_keeps_the_strongest_of_every_cell():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1, (5000, 2)) ** 3 * (640, 480)  # crowded in one corner
    response = rng.random(5000)
    keep = spread(xy, response, (480, 640), 600, 10)
    assert len(keep) == 600 == len(set(keep.tolist()))
    cell = (xy / (640, 480) * 10).astype(int) @ (1, 10)
    crowd, kept = np.bincount(cell, minlength=100), np.bincount(cell[keep], minlength=100)
    fair = kept[crowd > kept].min()  # cells that lost some all keep at least what the fair share is
    assert (kept >= np.minimum(crowd, fair)).all() and kept.max() <= fair + 1
    for c in range(100):
        mine, lost = (
            np.intersect1d(keep, np.flatnonzero(cell == c)),
            np.setdiff1d(np.flatnonzero(cell == c), keep),
        )
        if len(mine) and len(lost):
            assert response[mine].min() >= response[lost].max()
    assert (spread(xy[:10], response[:10], (480, 640), 600, 10) == np.arange(10)).all()


@pytest.mark.xfail(
    strict=True,
    reason="OpenCV keeps the strongest 1.4 x count of the whole photo before they are spread: on"
    " real photos a tenth of"
    " the cells stays bare. Spreading before describing mends it for 20 % more time and a higher"
    " reprojection error.",
)
def test_no_corner_of_a_photo_stays_bare(picture):
    dull = picture.astype(float)
    dull[:, :320] = 120 + 0.35 * (dull[:, :320] - 120)  # low contrast in the left half
    found = Sift(count=400)(dull.astype(np.uint8))
    column, row = (found.px / (640, 480) * 4).astype(int).T
    assert np.bincount(row * 4 + column, minlength=16).min() >= 10


def test_descriptors_are_roots_of_unit_length(picture):
    found = Sift(count=300, longest=640)(picture)
    assert len(found) == 300
    stored = found.descriptors.astype(float)
    assert found.descriptors.dtype == np.uint8 and found.descriptors.max() < 255
    assert np.linalg.norm(stored, axis=1) / DESCRIPTOR_UNIT == pytest.approx(
        1, abs=0.01
    )  # rounding
    assert np.linalg.norm(found.unit, axis=1) == pytest.approx(1, abs=1e-5)
    # RootSIFT squared adds up to one: the L1 norm of SIFT
    detector = cv2.SIFT.create(420, contrastThreshold=0.015, enable_precise_upscale=True)
    raw = detector.detectAndCompute(picture, None)[1]
    root = np.sqrt(raw / raw.sum(1, keepdims=True))
    assert (found.unit @ root.T).max(1) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("kind", ["uint16", "float32", "float32 with gaps", "colour", "one band"])
def test_whatever_the_sensor_gives(picture, kind):
    image = {
        "uint16": lambda: picture.astype(np.uint16) * 16 + 7000,
        "float32": lambda: picture.astype(np.float32) * 0.02 + 15,
        "float32 with gaps": lambda: np.where(
            np.arange(640) < 100, np.nan, picture * 0.02 + 15
        ).astype(np.float32),
        "colour": lambda: np.dstack([picture] * 3),
        "one band": lambda: picture[..., None],
    }[kind]()
    found = Sift(count=500)(image)
    reference = Sift(count=500)(picture)
    near = np.array([np.linalg.norm(reference.px - p, axis=1).min() for p in found.px])
    assert len(found) > 300
    assert (near < 1.5).mean() > (0.95 if kind in ("colour", "one band") else 0.3)


@pytest.mark.parametrize(
    "blank",
    [
        np.zeros((300, 400), np.uint8),
        np.full((300, 400), np.nan, np.float32),
        np.full((300, 400, 3), 255, np.uint8),
    ],
)
def test_a_blank_image_has_no_features(blank):
    found = Sift()(blank)
    assert len(found) == 0 and found.px.shape == (0, 2) and found.descriptors.shape == (0, 128)
    assert len(Mutual()(found, found)) == 0


def test_grey_of_eight_bits_is_left_alone(picture):
    assert to_grey8(picture) is picture


@pytest.mark.parametrize("size", [(2250, 4000, 3), (960, 1280), (1500, 1000, 3), (300, 400)])
def test_halving_first_changes_nothing(size):
    image = np.random.default_rng(3).integers(0, 256, size, np.uint8)
    rough = halved(image, 400)
    assert (
        max(rough.shape) >= min(400, max(size))
        and (shrink(rough, 400)[0] == shrink(image, 400)[0]).all()
    )


@pytest.mark.parametrize(("share", "haze"), [(0.12, 0), (0.12, 150), (0.2, 40)])
def test_dusk_and_haze_hide_few_features(picture, share, haze):
    """A photo with an eighth of the contrast: most of its features are those of the clear one."""
    dim = np.clip(np.rint(picture * share + haze), 0, 255).astype(np.uint8)
    clear, found = Sift(count=400)(picture), Sift(count=400)(dim)
    assert len(found) > 0.8 * len(clear)
    apart = np.hypot(*(found.px[:, None] - clear.px[None]).transpose(2, 0, 1)).min(1)
    assert (apart < 1.0).mean() > 0.6
    matched = Mutual()(clear, found)
    off = np.hypot(*(clear.px[matched.index_a] - found.px[matched.index_b]).T)
    assert len(matched) > 0.4 * len(clear) and (off < 1.0).mean() > 0.95


def test_ordinary_contrast_is_left_alone_and_two_pictures_are_stretched_alike(picture):
    (same,) = stretched(picture)
    assert same is picture
    a, b = (picture * 0.12 + 30).astype(np.uint8), (picture * 0.1 + 34).astype(np.uint8)
    x, y = stretched(a, b)
    for old, new in ((a, x), (b, y)):  # one line through the values of both
        inside = (new > 0) & (new < 255)
        slope, level = np.polyfit(
            np.r_[a[(x > 0) & (x < 255)], b[(y > 0) & (y < 255)]].astype(float),
            np.r_[x[(x > 0) & (x < 255)], y[(y > 0) & (y < 255)]].astype(float),
            1,
        )
        assert np.abs(slope * old[inside] + level - new[inside]).max() < 1.01
    assert 100 < np.ptp(np.percentile(np.r_[x, y], [1, 99])) < 160
    flat = np.full((20, 20), 90, np.uint8)
    assert np.ptp(stretched(flat)[0]) == 0
