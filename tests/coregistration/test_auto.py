"""Registration of two spectra against simulated truth, and everything that must be refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.everywhere import Everywhere
from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.structure import StructureMatches
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.registration import Guess, Picture, RefusedRegistration
from tests.coregistration.scenes import error, layout, pair, spectrum, turned

SHAPE = (400, 480)
SMALL = (240, 288)


@pytest.fixture(scope="module")
def auto():
    return registration_method("auto")


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "degrees"), [(0.85, 137.0), (1.2, -64.0)])
def test_any_rotation_is_found_to_a_part_of_a_pixel(auto, scale, degrees):
    truth = turned(scale, degrees, SMALL, SMALL, (9.0, -14.0))
    a, b = pair(truth, SMALL, seed=int(degrees) % 7, shape_a=SMALL)
    found = auto(Picture(values=a), Picture(values=b))
    assert found, found.reason
    assert (
        1e-4 < error(found.b_H_a, truth, SMALL) < 0.3
    )  # an error of exactly 0 would mean the truth had leaked


@pytest.mark.slow
def test_the_search_alone_finds_it_too(auto):
    blind = replace(
        auto.method, propose=StructureMatches(estimate=lambda a, b: NoEstimate(reason="not asked"))
    )
    truth = turned(1.15, 251.0, SHAPE, SHAPE, (-20.0, 11.0))
    a, b = pair(truth, seed=3)
    found = blind(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.5


@pytest.mark.slow
def test_sizes_may_differ(auto):
    truth = turned(0.55, 12.0, SHAPE, (256, 320))
    a, b = pair(truth, shape_b=(256, 320), seed=4)
    found = auto(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.4


def test_few_pixels_of_the_whole_cost_no_search(auto, monkeypatch):
    """Of 80 x 100 px as of 480 x 400, matches of both at the smaller size find it at once."""
    truth = turned(0.2, 33.0, SHAPE, (80, 100), (1.0, 2.0))
    a, b = pair(truth, shape_b=(80, 100), seed=3)
    monkeypatch.setattr(Everywhere, "__call__", None)
    found = auto(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.3


@pytest.mark.slow
def test_a_picture_of_a_part_of_the_other_is_found_in_it(auto):
    truth = turned(1.0, 200.0, SHAPE, (160, 200), (-25.0, 10.0))  # a sixth of a's area
    a, b = pair(truth, shape_b=(160, 200), seed=4)
    found = auto(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.8


@pytest.mark.slow
@pytest.mark.parametrize(  # a third and an eighth of a's area
    "shape", [(220, 270), pytest.param((140, 172), marks=pytest.mark.long)]
)
def test_parts_are_found_both_ways(auto, shape):
    right = 0
    for seed in (12, 14):
        turn = np.random.default_rng(seed).uniform(0, 360)
        truth = turned(1.0, turn, SHAPE, shape, (3.0 * seed - 40, 20 - seed))
        a, b = (Picture(values=v) for v in pair(truth, shape_b=shape, seed=seed))
        there, back = auto(a, b), auto(b, a)
        found = [there.b_H_a] if there else []
        found += [np.linalg.inv(back.b_H_a)] if back else []
        assert all(error(b_H_a, truth) < 1 for b_H_a in found)
        right += len(found)
    assert right >= 3


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [1.33, 0.75])
def test_pixels_that_are_longer_than_wide_are_found(auto, stretch):
    """A video of 1440 x 1080 px, which is to be shown as 1920, and its frames."""
    truth = turned(1.0, 15.0, SMALL, SMALL)
    truth = np.array([[stretch, 0, (1 - stretch) * SMALL[1] / 2], [0, 1, 0], [0, 0, 1]]) @ truth
    a, b = pair(truth, SMALL, seed=8, shape_a=SMALL)
    found = auto(Picture(values=a), Picture(values=b))
    assert found and found.model == "affine"
    assert 1e-4 < error(found.b_H_a, truth, SMALL) < 0.3


@pytest.mark.slow
def test_reversed_contrast_changes_nothing(auto):
    truth = turned(1.0, 20.0, SMALL, SMALL)
    a, _ = pair(np.eye(3), SMALL, seed=5, shape_a=SMALL)
    _, b = pair(truth, SMALL, seed=5, shape_a=SMALL)
    negative = np.where(b > 4, 255 - b, 0).astype(np.uint8)
    found = auto(Picture(values=a), Picture(values=negative))
    assert found and error(found.b_H_a, truth, SMALL) < 0.5


@pytest.mark.slow
def test_perspective_is_freed_where_the_pictures_show_it(auto):
    truth = turned(1.0, 5.0, SMALL, SMALL)
    truth[2, :2] = [1.5e-4, -1e-4]
    a, b = pair(truth, SMALL, seed=6, shape_a=SMALL)
    found = auto(Picture(values=a), Picture(values=b))
    assert found and found.model == "homography"
    assert error(found.b_H_a, truth, SMALL) < 0.6


@pytest.mark.slow
def test_measured_values_with_gaps(auto):
    truth = turned(1.0, 33.0, SMALL, SMALL)
    a, b = pair(truth, SMALL, seed=8, shape_a=SMALL)
    celsius = np.where(b > 4, 12 + b / 40, np.nan).astype(np.float32)
    found = auto(Picture(values=a), Picture(values=celsius))
    assert found and error(found.b_H_a, truth, SMALL) < 0.5


@pytest.mark.slow
def test_inliers_lie_where_the_transform_puts_them(auto):
    truth = turned(0.9, -20.0, SMALL, SMALL)
    a, b = pair(truth, SMALL, seed=9, shape_a=SMALL)
    found = auto(Picture(values=a), Picture(values=b))
    there = np.c_[found.px_a, np.ones(len(found.px_a))] @ truth.T
    distance = np.linalg.norm(there[:, :2] - found.px_b, axis=1)
    assert len(distance) >= 9 and np.median(distance) < 1.0 and distance.max() < 6
    assert found.evidence["patches_agreeing"] == len(found.px_a) <= found.evidence["patches"]


@pytest.mark.slow
def test_a_good_guess_is_used_and_a_wrong_one_does_no_harm(auto):
    truth = turned(1.0, 95.0, SMALL, SMALL)
    a, b = pair(truth, SMALL, seed=10, shape_a=SMALL)
    right = Guess(b_H_a=turned(1.05, 92.0, SMALL, SMALL, (15, 10)))
    wrong = Guess(b_H_a=turned(1.0, 10.0, SMALL, SMALL))
    for guess in (right, wrong):
        found = auto(Picture(values=a), Picture(values=b), guess)
        assert found and error(found.b_H_a, truth, SMALL) < 0.5


@pytest.mark.slow  # the quick tests have one in test_register
@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(k, marks=pytest.mark.long) for k in range(2, 8))]
)
def test_unrelated_pictures_are_refused_with_figures(auto, seed):
    a = np.clip(spectrum(layout(seed=seed), seed), 0, 255).astype(np.uint8)
    b = np.clip(spectrum(layout(seed=50 + seed), seed), 0, 255).astype(np.uint8)
    refused = auto(Picture(values=a), Picture(values=b))
    assert isinstance(refused, RefusedRegistration) and not refused
    assert "not confirmed" in refused.reason
    assert refused.evidence["surprise"] < 3.5  # well below the 5 that acceptance asks for


@pytest.mark.slow
def test_mirrored_pictures_are_refused(auto):
    a, b = pair(np.eye(3), seed=11)
    assert not auto(Picture(values=a), Picture(values=np.ascontiguousarray(b[:, ::-1])))


SCENE = np.clip(spectrum(layout(seed=1), 1), 0, 255).astype(np.uint8)
BAD = {
    "blank": (np.full(SHAPE, 90, np.uint8), "blank or saturated"),
    "black": (np.zeros(SHAPE, np.uint8), "blank or saturated"),
    "saturated": (np.where(SCENE > 250, SCENE, 255).astype(np.uint8), "blank or saturated"),
    "nothing measured": (np.full(SHAPE, np.nan, np.float32), "blank or saturated"),
    "tiny": (SCENE[:40, :200], "200 x 40 px"),
    "flat 16 bits": (8000 + (np.indices(SHAPE).sum(0) % 2).astype(np.uint16), "no contrast"),
    "flat degrees": (
        (20 + 0.01 * (np.indices(SHAPE).sum(0) % 3)).astype(np.float32),
        "no contrast",
    ),
}


@pytest.mark.parametrize("what", BAD)
@pytest.mark.parametrize("method", ["auto", "rfae", "structure"])
def test_what_shows_nothing_is_refused_by_every_method(what, method):
    values, reason = BAD[what]
    register = registration_method(method)
    for a, b, name in ((SCENE, values, "B"), (values, SCENE, "A")):
        refused = register(Picture(values=a), Picture(values=b))
        assert not refused
        assert reason in refused.reason and f"picture {name}" in refused.reason


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "structure"])
def test_what_has_no_place_for_a_keypoint_is_refused(method):
    """Measurements in a lattice of strips, too narrow for any keypoint, but a quarter of all."""
    scene = SCENE[: SMALL[0], : SMALL[1]]
    rows, columns = np.indices(SMALL)
    strips = Picture(values=scene, valid=(rows % 24 < 4) | (columns % 24 < 4))
    both = (strips, Picture(values=scene)), (Picture(values=scene), strips)
    for a, b in both if method == "structure" else both[:1]:  # auto goes on to search everywhere
        assert not registration_method(method)(a, b)


@pytest.mark.slow
def test_noise_is_refused(auto):
    rng = np.random.default_rng(0)
    a, b = (np.clip(rng.normal(120, 30, SHAPE), 0, 255).astype(np.uint8) for _ in "ab")
    assert not auto(Picture(values=a), Picture(values=b))


@pytest.mark.slow
def test_a_frame_of_noise_over_a_common_frame_is_refused(auto):
    """A black frame is no picture: two unrelated pictures turned by one angle have it in common."""
    turn = cv2.getRotationMatrix2D((240, 200), 30, 0.8)
    a, b = (
        cv2.warpAffine(
            np.clip(spectrum(layout(seed=s), s), 10, 255).astype(np.uint8), turn, (480, 400)
        )
        for s in (20, 21)
    )
    assert not auto(Picture(values=a), Picture(values=b))


@pytest.mark.slow
def test_large_pictures_are_sharpened_at_a_finer_resolution(auto):
    """Without it a pixel of the verdict is seven of these pictures'."""
    shape = (1500, 2000)
    truth = turned(0.95, 70.0, shape, shape, (30, -20))
    labels = np.kron(layout(375, 500, 1), np.ones((4, 4), int)).astype(np.int32)
    a = np.clip(spectrum(labels, 1, blur=1.5), 0, 255).astype(np.uint8)
    b = cv2.warpPerspective(spectrum(labels, 2, blur=1.5), truth, (2000, 1500))
    pictures = Picture(values=a), Picture(values=np.clip(b, 0, 255).astype(np.uint8))
    coarse = replace(auto.method, decide=replace(auto.method.decide, finest=1e9))(*pictures)
    fine = auto(*pictures)
    assert error(fine.b_H_a, truth, shape) < 0.15 < error(coarse.b_H_a, truth, shape) < 1.5


def trees(seed, jitter):
    """(560, 620) brightness of trees in rows 34 px apart, 38 px along them, each up to `jitter` px
    (standard deviation) off its place; `seed` None leaves the ground bare.
    """
    rng = np.random.default_rng(seed)
    field = np.zeros((560, 620), np.float32)
    for y in range(15, 560, 34):
        for x in range(15, 620, 38):
            at = np.rint(np.array([x, y]) + rng.normal(0, jitter, 2)).astype(int)
            cv2.circle(field, (int(at[0]), int(at[1])), 9, 90.0, -1)
    return cv2.GaussianBlur(field, (0, 0), 1.0)


@pytest.mark.slow
def test_what_repeats_is_refused_and_found_where_trees_stand_off_their_rows(auto):
    """Two parts of a field: nothing tells the periods apart, so neither picture may be moved."""
    seed = 0
    rng = np.random.default_rng(seed)
    noise = [rng.normal(0, 6, (320, 380)).astype(np.float32) for _ in range(2)]
    right, down = (int(n) for n in rng.integers(20, 90, 2))
    outcome = {}
    for jitter in (0.0, 3.0):
        field = trees(seed, jitter)
        a = np.clip(100 + field[100:420, 100:480] + noise[0], 0, 255).astype(np.uint8)
        moved = field[100 + down : 420 + down, 100 + right : 480 + right]
        b = np.clip(200 - 0.8 * moved + noise[1], 0, 255).astype(np.uint8)
        outcome[jitter] = auto(Picture(values=a), Picture(values=b))
    assert isinstance(outcome[0.0], RefusedRegistration)
    assert "the pictures repeat" in outcome[0.0].reason
    truth = np.array([[1, 0, -right], [0, 1, -down], [0, 0, 1.0]])
    assert outcome[3.0], outcome[3.0].reason
    assert error(outcome[3.0].b_H_a, truth) < 1


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 25.0])
def test_rows_of_crops_tell_no_place_along_them(auto, degrees):
    y, x = np.mgrid[:480, :640]
    across = x * np.cos(np.radians(degrees)) + y * np.sin(np.radians(degrees))
    rng = np.random.default_rng(4)
    a, b = (
        np.clip(
            128 + 60 * np.sin(2 * np.pi * (across + s) / 22) + rng.normal(0, 15, x.shape), 0, 255
        )
        for s in (0, 7)
    )
    outcome = auto(Picture(values=a.astype(np.uint8)), Picture(values=255 - b.astype(np.uint8)))
    assert isinstance(outcome, RefusedRegistration)


@pytest.mark.slow
def test_faults_of_a_detector_hide_nothing(auto):
    """Half a percent of pixels without a value, half a percent hot, a dead row."""
    truth = turned(0.9, 20.0, SMALL, SMALL, (5.0, -4.0))
    a, b = pair(truth, SMALL, seed=3, shape_a=SMALL)
    chance = np.random.default_rng(2).random(b.shape)
    frame = np.where(chance > 0.995, 382.0, 5 + b / 20)
    frame[(chance < 0.005) | (np.arange(240) == 70)[:, None]] = np.nan
    found = auto(Picture(values=a), Picture(values=frame.astype(np.float32), valid=b > 0))
    assert found, found.reason
    assert error(found.b_H_a, truth, SMALL) < 0.5
