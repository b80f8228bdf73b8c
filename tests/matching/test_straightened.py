"""Features of straightened pictures, on ground that is drawn with a known lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.matching.lens_kind import CERTAIN, FOCALS, STRAIGHT, as_fisheye, fisheyes
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.matching.straightened import straightened_features
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link

WIDTH, HEIGHT, FOCAL = 640, 480, 352.0
GROUND, CENTRE = 2400, 1200.0
"""Side of the ground's picture in px, and its middle; a photo lies 160 px above it."""


@pytest.fixture(scope="module")
def ground():
    """A level ground of blots of all sizes (GROUND, GROUND)."""
    rng = np.random.default_rng(3)
    image = np.zeros((GROUND, GROUND), np.float32)
    for size in (300, 600, 1200, 2400):
        blots = rng.normal(0, 1, (size, size)).astype(np.float32)
        blots = cv2.GaussianBlur(blots, (0, 0), 1.5)
        image += cv2.resize(blots / blots.std(), (GROUND, GROUND), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 22 * image, 0, 255).astype(np.uint8)


def fisheye(focal=FOCAL):
    return replace(Camera.ideal(width=WIDTH, height=HEIGHT, focal=focal), fisheye=1.0)


def on_ground(camera, px, east, turned_deg):
    """What a photo that looks straight down shows at pixels (n, 2): px of the ground's picture."""
    ray = rays(camera, px)
    turn = np.radians(turned_deg)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return CENTRE + (160 * ray[:, :2] / ray[:, 2:]) @ R.T + [east, 0]


def photo(ground, camera, east, turned_deg=0.0):
    """What a photo shows, with noise."""
    v, u = np.indices((HEIGHT, WIDTH)).reshape(2, -1)
    at = on_ground(camera, np.column_stack([u, v]).astype(float), east, turned_deg)
    x, y = at.astype(np.float32).reshape(HEIGHT, WIDTH, 2).transpose(2, 0, 1)
    drawn = cv2.remap(ground, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    noise = np.random.default_rng(int(east)).normal(0, 3, drawn.shape)
    return np.clip(drawn + noise, 0, 255).astype(np.uint8)


def plain(picture):
    return Sift()(picture)


def straight(picture, camera, size=(HEIGHT, WIDTH)):
    return straightened_features(camera, picture, size, Sift())


def shared(a, b, camera):
    link = Verify()(0, 1, a, b, Mutual()(a, b), WIDTH, (camera, camera))
    return link if isinstance(link, Link) else None


@pytest.mark.slow
@pytest.mark.parametrize("turned_deg", [0.0, 140.0])
def test_photos_that_share_their_rims_are_linked_where_plain_pictures_are_not(ground, turned_deg):
    """160 px above the ground and 300 px apart: what lies 62 degrees from one axis, or less, lies
    43 degrees on the other side of the other."""
    camera = fisheye()
    pictures = photo(ground, camera, 0.0), photo(ground, camera, 300.0, turned_deg)
    before = shared(*map(plain, pictures), camera)
    a, b = (straight(p, camera) for p in pictures)
    now = shared(a, b, camera)
    assert len(now) > 2 * (len(before) if before else 15)
    off = on_ground(camera, a.px[now.index_a], 0.0, 0.0)
    off -= on_ground(camera, b.px[now.index_b], 300.0, turned_deg)
    assert np.median(np.linalg.norm(off, axis=1)) < 2.0  # of the ground, and 0.5 px of a photo


def test_keypoints_lie_where_the_photo_shows_them(ground):
    """Those of a turned photo lie on those of the other, within a fraction of a pixel."""
    camera = fisheye()
    a, b = (straight(photo(ground, camera, 0.0, turn), camera) for turn in (0.0, 90.0))
    both = Mutual()(a, b)
    at = project(camera, rays(camera, a.px[both.index_a])[:, [1, 0, 2]] * [1, -1, 1])
    off = np.linalg.norm(at - b.px[both.index_b], axis=1)
    assert len(both) > 150
    assert np.median(off) < 0.35


def test_pixels_are_those_of_the_full_photo(ground):
    """A picture of half the size gives the same places, and a scale for it."""
    camera = fisheye(2 * FOCAL)
    camera = replace(camera, width=2 * WIDTH, height=2 * HEIGHT, cx=2 * camera.cx + 0.5,
                     cy=2 * camera.cy + 0.5)  # fmt: skip
    picture = photo(ground, fisheye(), 0.0)
    small, large = straight(picture, fisheye()), straight(picture, camera, (2 * HEIGHT, 2 * WIDTH))
    both = Mutual()(small, large)
    by = fit("similarity", small.px[both.index_a], large.px[both.index_b])
    assert len(both) > 200
    assert abs(by[0, 0] - 2) < 0.005 and abs(by[0, 1]) < 0.005
    assert np.linalg.norm(transfer(by, np.array([[0.0, 0.0]])) - 0.5) < 1.0
    assert large.scale == pytest.approx(2 * small.scale, rel=0.01)


def nothing():
    return Features(px=np.zeros((0, 2)), size=np.zeros(0), descriptors=np.zeros((0, 4)), scale=1.0)


def asked_of(counts, links=(), photos=8):
    """The lens that is found where pairs share `counts` inliers, by the focal length's multiple."""
    pinhole, pairs = Camera.ideal(width=WIDTH, height=HEIGHT, focal=FOCAL), []

    def inliers(a, b, lens):
        pairs.append((a, b))
        return counts[int(np.argmin(np.abs(np.array(FOCALS) - lens.focal / FOCAL)))]

    tried = [(i, i + 1) for i in range(photos - 1)]
    found = fisheyes(
        dict.fromkeys(range(photos), "one"),
        {"one": pinhole},
        lambda _: nothing(),
        links,
        tried,
        lambda a, b: (np.zeros((0, 2)), np.zeros((0, 2))),
        inliers,
    )
    return found.get("one"), pairs


def test_what_is_hardly_linked_is_asked_by_straightened_pictures():
    found, pairs = asked_of((4, 9, 30))
    assert found == as_fisheye(Camera.ideal(width=WIDTH, height=HEIGHT, focal=FOCAL), FOCALS[2])
    assert set(pairs) == {(i, i + 1) for i in range(7)}  # one after the other
    few = CERTAIN // 7
    assert asked_of((few, few, few))[0] is None


def test_a_lens_whose_plain_pictures_share_as_much_is_none():
    index = np.arange(20)
    links = [
        Link(a=i, b=i + 1, index_a=index, index_b=index, b_S_a=1 + 0j) for i in range(2)
    ]  # 40 inliers in two of the seven pairs
    most = int(STRAIGHT * 40 / 7)
    assert asked_of((most, 0, 0), links)[0] is None
    assert asked_of((most + 2, 0, 0), links)[0].fisheye
