"""Marks at the same place of every picture are found, and ground is not taken for them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.matching.fixed_marks import FindFixedMarks, FixedMarks
from skyquilt.matching.sift import Sift
from skyquilt.matching.verify import Verify
from skyquilt.model.features import Features, Link
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.links import link_pair, marked_in
from skyquilt.workflows.methods import methods_for
from tests.alignment.surveys import photo
from tests.texture import texture

WIDE, HIGH = 360, 270
STAMP = (15, 240, 330, 263)
"""Left, top, right and bottom of the text in px."""
FIND = Sift(count=600)


def stamped(picture, text="SKYCAM 4K  46.59N 14.29E"):
    out = np.clip(picture, 0, 255).astype(np.uint8)
    cv2.putText(out, text, (STAMP[0], STAMP[3] - 5), 0, 0.7, 255, 2, cv2.LINE_AA)
    return out


def flight(count, step=90, seed=0):
    """Photos along a line over one texture."""
    ground = texture(HIGH, WIDE + step * count, seed)
    cuts = [ground[:, step * i : step * i + WIDE] for i in range(count)]
    return [np.clip(cut, 0, 255).astype(np.uint8) for cut in cuts]


def marks_in(pictures, cameras=None):
    features = [FIND(p) for p in pictures]
    cameras = cameras or ["cam"] * len(pictures)
    return features, FindFixedMarks()(features, cameras, [(WIDE, HIGH)] * len(pictures))


@pytest.mark.slow
def test_a_text_is_found_and_nothing_beside_it():
    features, marks = marks_in([stamped(p) for p in flight(8)])
    left, top, right, bottom = STAMP
    for one in features:
        x, y = one.px.T
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        far = (x < left - 20) | (x > right + 20) | (y < top - 20)
        found = marks.on_mark("cam", one.px)
        assert found[inside].mean() > 0.6
        assert not found[far].any()
    assert len(marks.notes) == 1


@pytest.mark.parametrize(
    "rows",
    [(30, 58, 86, 270, 300, 330, 350), pytest.param((30, 58, 86, 350), marks=pytest.mark.slow)],
)
def test_many_lines_of_text_are_no_camera_that_stands_still(rows):
    def lines(picture):
        for y in rows:
            cv2.putText(
                picture, "SKYCAM 4K  46.59N 14.29E ALT", (8, y), 0, 0.75, 255, 2, cv2.LINE_AA
            )
        return picture

    _, marks = marks_in([lines(p) for p in flight(8, seed=4)])
    y = np.array(rows) - 8.0
    assert marks.on_mark("cam", np.column_stack([np.full(len(y), 60.0), y])).mean() > 0.5
    assert not marks.on_mark("cam", np.array([[240.0, 180.0], [100.0, 200.0]])).any()


@pytest.mark.slow
def test_texts_that_change_in_part_are_found_where_they_do_not():
    _, marks = marks_in([stamped(p, f"CAM 10:3{i}") for i, p in enumerate(flight(8))])
    assert marks.on_mark("cam", np.array([[30.0, 252.0]])).all()


@pytest.mark.parametrize(
    "step", [20, *(pytest.param(v, marks=pytest.mark.slow) for v in (90, 400))]
)
def test_ground_is_no_mark(step):
    _, marks = marks_in(flight(8, step))
    assert not marks.masks and not marks.notes


def test_a_camera_that_stands_still_shows_no_marks():
    rng = np.random.default_rng(1)
    (still,) = flight(1)
    noisy = [
        np.clip(still + rng.normal(0, 2, still.shape), 0, 255).astype(np.uint8) for _ in range(8)
    ]
    assert not marks_in(noisy)[1].masks


def hovering(flown, still, seed):
    """A flight with photos from one place in it: the picture drifts by up to two px and changes in
    part, as leaves do.
    """
    rng, at, shots = np.random.default_rng(seed), len(flown) // 2, []
    (other,) = flight(1, seed=seed + 50)
    leaves = cv2.resize(rng.random((18, 24)).astype(np.float32), (WIDE, HIGH)) < 0.5
    for _ in range(still):
        noisy = np.where(leaves, rng.permutation(other.ravel()).reshape(HIGH, WIDE), flown[at])
        moved = np.roll(noisy + rng.normal(0, 3, noisy.shape), rng.integers(-2, 3, 2), (0, 1))
        shots.append(np.clip(moved, 0, 255).astype(np.uint8))
    return [*flown[:at], *shots, *flown[at:]]


@pytest.mark.slow
@pytest.mark.parametrize(("still", "seed"), [(8, 0), (16, 1)])
def test_a_hover_within_a_flight_shows_no_marks(still, seed):
    assert not marks_in(hovering(flight(8, seed=seed), still, seed))[1].masks


@pytest.mark.slow
def test_a_text_is_found_though_the_drone_hovered():
    pictures = [stamped(p) for p in hovering(flight(9), 6, 0)]
    features, marks = marks_in(pictures)
    x, y = features[0].px.T
    left, top, right, bottom = STAMP
    inside = (x > left) & (x < right) & (y > top) & (y < bottom)
    found = marks.on_mark("cam", features[0].px)
    assert found[inside].mean() > 0.6
    assert not found[y < top - 20].any()


@pytest.mark.slow
def test_every_camera_has_its_own_marks():
    plain, marked = flight(8), [stamped(p) for p in flight(8, seed=5)]
    _, marks = marks_in([*plain, *marked], ["plain"] * 8 + ["marked"] * 8)
    assert list(marks.masks) == ["marked"]


def test_few_photos_tell_nothing():
    assert not marks_in([stamped(p) for p in flight(5)])[1].masks


def test_photos_of_different_ground_are_linked_by_their_text_unless_it_is_known():
    pictures = [stamped(p) for p in flight(8, step=500)]
    features, marks = marks_in(pictures)
    photos = [photo(f"{i}.jpg") for i in range(8)]
    methods = replace(methods_for(MosaicSettings()), verify=Verify(minimum=8))

    def linked(known):
        found = []
        for pair in ((0, 1), (2, 5), (3, 7)):
            two = features[pair[0]], features[pair[1]]
            marked = marked_in(known, photos, pair, two)
            found.append(
                link_pair(*pair, two, (photos[pair[0]], photos[pair[1]]), methods, marked=marked)
            )
        return sum(isinstance(k, Link) for k in found)

    assert linked(FixedMarks()) >= 2
    assert linked(marks) == 0


def keypoints(px, descriptors):
    return Features(
        px=np.asarray(px, float),
        size=np.ones(len(px), np.float32),
        descriptors=np.asarray(descriptors, np.uint8),
        scale=1.0,
    )


def found_in(photos):
    return FindFixedMarks()(photos, ["cam"] * len(photos), [(WIDE, HIGH)] * len(photos)).masks


@pytest.mark.parametrize(("places", "found"), [(1, False), (2, False), (3, True), (9, True)])
def test_keypoints_of_several_directions_at_one_place_count_once(places, found):
    """As plants in rows have them, of which some lie on one another in any two pictures."""
    rng = np.random.default_rng(places)
    at = rng.uniform(40, 300, (places, 2)).repeat(4, axis=0)
    alike = rng.integers(0, 200, (places, 128)).repeat(4, axis=0)  # a plant is round
    photos = []
    for _ in range(8):
        px = np.concatenate([rng.uniform(0, (WIDE, HIGH), (300, 2)), at])
        photos.append(keypoints(px, np.concatenate([rng.integers(0, 200, (300, 128)), alike])))
    assert bool(found_in(photos)) == found


@pytest.mark.parametrize("seed", range(3))
def test_ground_that_looks_alike_everywhere_is_no_mark(seed):
    rng = np.random.default_rng(seed)
    plant = rng.integers(0, 200, 128) + rng.integers(0, 20, (500, 128))
    photos = [
        keypoints(
            rng.uniform(0, (WIDE, HIGH), (800, 2)),
            np.concatenate([plant, rng.integers(0, 200, (300, 128))]),
        )
        for _ in range(8)
    ]
    assert not found_in(photos)
