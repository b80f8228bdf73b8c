"""The parts of the search, each against a slow loop, another library or an algebraic property."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from skyquilt.coregistration.agreement import Agree, _fisher
from skyquilt.coregistration.auto import Within
from skyquilt.coregistration.candidates import (
    Candidate,
    Nearby,
    corners,
    distinct,
    middle,
    peaks,
    same_view,
    similarity,
)
from skyquilt.coregistration.decision import Decide, distinctness
from skyquilt.coregistration.everywhere import Everywhere, _Plane, highest
from skyquilt.coregistration.orientation import (
    Pyramid,
    between,
    full_size,
    orientation,
    spectra,
    turned,
    warped,
)
from skyquilt.coregistration.repeats import Repeats
from skyquilt.coregistration.subpixel import SubpixelRefinement
from skyquilt.coregistration.usable import usable
from skyquilt.model.registration import Picture
from tests.coregistration.scenes import error, layout, pair, spectrum
from tests.coregistration.scenes import turned as turned_by

SHAPE = (400, 480)


def of(picture, side=128.0, valid=None):
    found = usable(Picture(values=picture, valid=valid))
    return orientation(found.grey, found.valid, side)


@pytest.fixture(scope="module")
def scene():
    return np.clip(spectrum(layout(seed=2), 2), 0, 255).astype(np.uint8)


def test_fields_know_no_contrast(scene):
    a, b = of(scene), of(255 - scene)
    assert np.abs(a.fields - b.fields).max() < 1e-3
    assert np.abs(a.fields).max() > 1  # not because they are empty


def test_a_quarter_turn_of_the_picture_turns_the_fields(scene):
    square = scene[:400, :400]
    a, b = of(square, 400.0), of(np.ascontiguousarray(np.rot90(square, -1)), 400.0)
    quarter = np.array([[0, -1, 399], [1, 0, 0], [0, 0, 1.0]])  # clockwise on the screen
    moved, valid = warped(a, quarter, b.shape)
    both = (valid > 0.5) & (b.valid > 0.5)
    assert both.mean() > 0.9
    assert np.abs(moved - b.fields)[both].max() < 0.02


def test_turning_is_a_group(scene):
    a = of(scene).fields
    assert np.allclose(turned(turned(a, 0.3), 0.5), turned(a, 0.8), atol=1e-5)
    assert np.allclose(turned(a, np.pi), a, atol=1e-5)  # an orientation is one of 180 degrees
    assert np.abs(turned(a, np.pi / 2)[..., :2] + a[..., :2]).max() < 1e-5


def test_resolutions_and_full_size_are_inverse(scene):
    a, b = of(scene, 90.0), of(scene[:300], 110.0)
    h = np.array([[0.9, 0.1, 5], [-0.1, 0.95, 8], [1e-4, -2e-4, 1]])
    assert np.allclose(full_size(a, b, between(a, b, h)), h)


def test_spectra_are_those_of_complex_fields(scene):
    fields = of(scene, 40.0).fields
    first = np.fft.fft2(fields[..., 0] + 1j * fields[..., 1], s=(64, 64))
    assert np.abs(spectra(fields, (64, 64))[0] - first).max() < 1e-3 * np.abs(first).max()


@pytest.mark.parametrize("quarter", range(4))
def test_a_correlation_is_the_sum_over_the_overlap(scene, quarter):
    """One place of the FFT's surface against the warp and the sum written out, all quarters of a
    turn.
    """
    a, b = of(scene, 60.0), of(scene[30:, 20:], 60.0)
    plane, scale, angle = _Plane.of(a, b), 1.1, 0.4
    field, overlap = (of_all[quarter] for of_all in plane.correlations(a, scale, angle))
    turn = quarter * np.pi / 2
    middle = np.array([(a.shape[1] - 1) / 2, (a.shape[0] - 1) / 2])
    for x, y in ((0, 0), (4, plane.side - 8), (plane.side - 12, 4)):
        place = plane.place(x, y, quarter)
        moved, valid = warped(a, similarity(scale, angle + turn, middle, place), b.shape)
        assert field[y, x] == pytest.approx(
            (moved * b.fields).sum(dtype=float), abs=0.03 * float(np.abs(field).max())
        )
        assert overlap[y // 4, x // 4] == pytest.approx(
            float((valid * b.valid).sum()), rel=0.15
        )  # counted on a grid of 4 px


def test_the_highest_peaks_of_many_fields_are_those_of_each():
    z = np.random.default_rng(3).normal(size=(4, 40, 56)).astype(np.float32)
    z[2] = -1  # nothing above 0
    each = [(k, *p) for k, one in enumerate(z) for p in peaks(one.copy(), 3)]
    assert sorted(highest(z.copy(), 3)) == sorted(each)


@pytest.mark.parametrize("degrees", [205.0])
def test_everywhere_has_the_truth_among_its_best(degrees):
    truth = turned_by(1.0, degrees, SHAPE, SHAPE, (12, -8))
    a, b = (of(p, 80.0) for p in pair(truth, seed=1))
    best = distinct(Everywhere(smallest=0.93, largest=1.08)(a, b), a.shape, 3, 3)
    small = between(a, b, truth)
    assert (
        min(
            np.linalg.norm(corners(c.b_H_a, a.shape) - corners(small, a.shape), axis=1).max()
            for c in best
        )
        < 4
    )


@pytest.mark.slow
@pytest.mark.parametrize("corner", [(256, 304), (0, 0), (256, 0)])
def test_a_part_is_found_in_every_corner_of_the_whole(corner):
    """An eighth of the area, in another spectrum; the whole must lie in the plane with its rim."""
    one, other = pair(np.eye(3), seed=6)
    top, left = corner
    whole = of(one, 160.0)
    part = of(np.ascontiguousarray(other[top : top + 144, left : left + 176]), 80.0)
    truth = between(part, whole, np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]]))
    search = Everywhere(turns=0.85, smallest=1 / 2.9, largest=1 / 1.45, overlap=0.6)
    best = distinct(search(part, whole), part.shape, 3, 3)
    off = [corners(c.b_H_a, part.shape) - corners(truth, part.shape) for c in best]
    assert min(np.linalg.norm(o, axis=1).max() for o in off) < 5


def test_the_first_field_alone_is_correlated():
    a, b = (of(p, 48.0) for p in pair(np.eye(3), seed=6))
    plane = _Plane.of(a, b, parts=2)
    field = plane.correlations(a, 1.0, 0.3)[0][1]
    half = np.pi / 2
    for x, y in ((0, 0), (4, plane.side - 8)):
        to = similarity(1.0, 0.3 + half, middle(a.shape), plane.place(x, y, 1))
        moved = warped(a, to, b.shape)[0]
        direct = (moved * b.fields)[..., :2].sum(dtype=float)
        assert field[y, x] == pytest.approx(direct, abs=0.03 * float(np.abs(field).max()))


@pytest.mark.parametrize(
    ("shape", "scales"),
    [
        ((960, 1200), (1 / 8, 1 / 4)),  # all of them
        ((600, 800), (96 / 600, 1 / 4)),  # a part of 96 px is the least
        ((450, 800), None),  # hardly any
    ],
)
def test_parts_with_too_few_pixels_are_not_searched(shape, scales):
    way = Within(times=5.0, least_px=96, search=Everywhere(smallest=1 / 8, largest=1 / 4))
    search = way.fitting(shape)
    assert (search and (search.smallest, search.largest)) == scales


def test_nearby_finds_what_lies_near_a_guess():
    truth = turned_by(1.1, 4.0, SHAPE, SHAPE, (25, -18))
    a, b = (of(p, 128.0) for p in pair(truth, seed=2))
    best = distinct(Nearby()(a, b, same_view(SHAPE, SHAPE)), a.shape, 3, 1)[0]
    off = corners(best.b_H_a, a.shape) - corners(between(a, b, truth), a.shape)
    assert np.linalg.norm(off, axis=1).max() < 4


@pytest.mark.parametrize("freedom", ["similarity", "affine", "homography"])
def test_sharpening_goes_to_a_part_of_a_pixel(freedom):
    truth = turned_by(1.05, 20.0, SHAPE, SHAPE)
    if freedom != "similarity":
        truth[:2, :2] @= np.array([[1.03, 0.02], [0.0, 0.98]])
    if freedom == "homography":
        truth[2, :2] = [5e-5, -8e-5]
    a, b = (of(p, 256.0) for p in pair(truth, seed=3))
    start = between(a, b, truth) @ np.array([[1, 0.004, 1.5], [-0.004, 1, -1.2], [0, 0, 1]])
    fit = SubpixelRefinement(freedom=freedom, steps=12)(a, b, start)
    assert error(full_size(a, b, fit.b_H_a), truth) < 0.25 < error(full_size(a, b, start), truth)
    assert fit.correlation > 0.4


def test_sharpening_never_makes_it_worse(scene):
    a, b = of(scene), of(np.ascontiguousarray(scene[::-1]))
    for shift in (0.0, 9.0):
        start = np.array([[1, 0, shift], [0, 1, -shift], [0, 0, 1.0]])
        before = SubpixelRefinement(steps=0)(a, b, start).correlation
        assert SubpixelRefinement()(a, b, start).correlation >= before


def test_distinct_keeps_the_best_of_those_that_agree():
    def at(x, score):
        return Candidate(b_H_a=np.array([[1, 0, x], [0, 1, 0], [0, 0, 1.0]]), score=score)

    kept = distinct([at(0, 1.0), at(0.5, 3.0), at(10, 2.0), at(11, 1.5)], (50, 60), 2.0, 10)
    assert [(c.b_H_a[0, 2], c.score) for c in kept] == [(0.5, 3.0), (10, 2.0)]
    assert len(distinct(kept, (50, 60), 2.0, 1)) == 1


def test_peaks_wrap_around():
    field = np.zeros((20, 30))
    field[0, 0], field[19, 29], field[10, 10] = 5, 4, 3
    assert list(peaks(field, 3)) == [(5.0, 0, 0), (3.0, 10, 10)]


def test_fisher_is_fishers():
    ranks = np.random.default_rng(0).uniform(0.001, 1, 25)
    assert _fisher(ranks) == pytest.approx(-np.log10(stats.combine_pvalues(ranks, "fisher").pvalue))
    assert _fisher(np.zeros(0)) == 0


@pytest.mark.slow
def test_agreement_is_uniform_for_unrelated_pictures_and_large_for_related_ones():
    surprises = []
    for seed in range(7):
        a, b = (
            of(np.clip(spectrum(layout(seed=s), s), 0, 255).astype(np.uint8), 200.0)
            for s in (seed, 60 + seed)
        )
        surprises.append(Agree()(a, b, np.eye(3)).surprise)
    assert np.median(surprises) < 1.0 and max(surprises) < 3  # places not chosen: a p-value
    truth = turned_by(1.0, 10.0, SHAPE, SHAPE)
    a, b = (of(p, 256.0) for p in pair(truth, seed=4))
    small = between(a, b, truth)
    found = Agree()(a, b, small)
    assert found.surprise > 10 and len(found.px) > 0.8 * found.patches
    off = Agree()(a, b, np.array([[1, 0, 6], [0, 1, 0], [0, 0, 1.0]]) @ small)
    assert off.surprise < found.surprise / 2 and not len(off.px)


def test_agreement_tells_the_shift(scene):
    a = of(scene, 256.0)
    found = Agree(near=3)(a, a, np.array([[1, 0, 2], [0, 1, -1], [0, 0, 1.0]]))
    assert np.abs(np.median(found.shift, axis=0) - [-2, 1]).max() < 0.05
    half = Agree()(a, a, np.array([[1, 0, 0.5], [0, 1, -0.25], [0, 0, 1.0]]))
    assert np.abs(np.median(half.shift, axis=0) - [-0.5, 0.25]).max() < 0.15


def test_distinctness_of_a_picture_on_itself_and_beside(scene):
    a = of(scene, 128.0)
    beside = np.array([[1, 0, 20], [0, 1, 14], [0, 0, 1.0]])
    assert distinctness(a, a, np.eye(3)) > 20 > 6 > distinctness(a, a, beside)


def test_a_frame_is_no_picture(scene):
    bright = np.clip(scene, 30, 220)
    for scale in (0.9, 0.5):  # the smaller one leaves whole rows black
        turn = cv2.getRotationMatrix2D((240, 200), 25, scale)
        framed, whole = (cv2.warpAffine(p, turn, (480, 400)) for p in (bright, np.ones_like(scene)))
        found = usable(Picture(values=framed))
        assert (found.valid != (whole > 0)).mean() < 0.01
    bright[:3], bright[-3:], bright[:, :3], bright[:, -3:] = 100, 100, 100, 100
    assert usable(Picture(values=bright)).valid.all()  # dark and bright places inside are picture


def test_bars_of_any_colour_are_no_picture(scene):
    screen = np.full((SHAPE[0] + 90, SHAPE[1] + 140), 77, np.uint8)
    screen[60 : 60 + SHAPE[0], 50 : 50 + SHAPE[1]] = scene
    valid = usable(Picture(values=screen)).valid
    assert valid[60 : 60 + SHAPE[0], 50 : 50 + SHAPE[1]].mean() > 0.99
    assert valid.sum() <= scene.size


def test_what_a_hot_thing_leaves_of_the_levels_is_picture(scene):
    """A fire takes 230 of 256 levels, and the scene is in the others: the darkest of it are no
    frame.
    """
    dim = np.rint(20 + scene / 255 * 14).astype(np.uint8)
    dim[100:120, 200:230] = 255
    assert usable(Picture(values=dim)).valid.mean() > 0.9


def test_what_is_given_as_invalid_stays_so(scene):
    valid = np.zeros(SHAPE, bool)
    valid[50:300, 40:400] = True
    assert (usable(Picture(values=scene, valid=valid)).valid <= valid).all()


def test_colour_is_brightness(scene):
    rgb = np.dstack([scene, scene, scene])
    assert (
        np.abs(usable(Picture(values=rgb)).grey - usable(Picture(values=scene)).grey).max() < 0.01
    )


@pytest.mark.parametrize("largest", [1e9, 1e18])
def test_values_of_any_size_are_registered_alike(scene, largest):
    """Sums over patches of squares were infinite from 1e17 on: a registration of which nothing was
    known ended in a traceback.
    """
    usual = usable(Picture(values=scene.astype(np.float32)))
    large = usable(Picture(values=scene.astype(np.float32) * np.float32(largest)))
    assert np.array_equal(large.valid, usual.valid) and not large.reason
    assert np.isfinite((large.grey**2).sum(dtype=np.float32))
    np.testing.assert_allclose(
        large.grey / large.grey.max(), usual.grey / usual.grey.max(), rtol=1e-5, atol=1e-6
    )


def test_fishers_tail_is_scipys():
    from scipy.stats import chi2

    from skyquilt.coregistration.agreement import _fisher

    rng = np.random.default_rng(0)
    for n in (1, 2, 9, 40):
        ranks = rng.uniform(1e-4, 1, n)
        assert np.isclose(
            _fisher(ranks), -chi2.logsf(-2 * np.log(ranks).sum(), 2 * n) / np.log(10), rtol=1e-9
        )
    assert _fisher(np.zeros(0)) == 0.0 and _fisher(np.ones(3)) == 0.0


def test_faults_of_single_pixels_and_lines_are_no_picture(scene):
    """Dead pixels and lines have no value, hot and stuck ones one far off; an area without
    measurements stays one.
    """
    rng = np.random.default_rng(1)
    values = 290 + scene / 20  # 2 to 11 degrees
    chance = rng.random(values.shape)
    bad = (chance < 0.01) | (np.arange(480) == 200) | (np.arange(400) == 77)[:, None]
    faulty = np.where(bad, np.where(chance < 0.005, np.nan, 655.35), values).astype(np.float32)
    faulty[300:340, 100:160] = np.nan
    found = usable(Picture(values=faulty))
    assert (~found.valid).sum() == 40 * 60 and not found.valid[300:340, 100:160].any()
    near = np.abs(found.grey - values)[found.valid]
    assert np.mean(near > 0.5) < 0.01 and near.max() < 12


def crossing(seed):
    """(480, 640) brightness of two roads at right angles; the ground beside them is random."""
    rng = np.random.default_rng(seed)
    grounds = [cv2.GaussianBlur(rng.normal(size=(480, 640)), (0, 0), s) for s in (2, 5, 12)]
    picture = 105 + 0.5 * sum(g / g.std() for g in grounds)
    for corner, end in (((0, 165), (640, 285)), ((240, 0), (360, 480))):
        cv2.rectangle(picture, corner, end, 30.0, -1)
        cv2.rectangle(picture, corner, end, 200.0, 2)
    return picture


@pytest.mark.slow
def test_crossings_of_other_roads_confirm_nothing():
    """Patches along the two roads agree as well as those of one place; those beside them do not."""
    one, other = (np.clip(crossing(k), 0, 255).astype(np.uint8) for k in range(2))
    one, negative, other = (
        usable(Picture(values=values)) for values in (one, 255 - one, 255 - other)
    )
    pyramid = Pyramid(a=one, b=other, sides=(256.0,))
    there = SubpixelRefinement()(*pyramid.at(pyramid.last), np.eye(3))
    found = Agree()(*pyramid.at(pyramid.last), there.b_H_a)
    assert found.surprise > 5 and found.beside_edges < 2
    refused = Decide()(pyramid, [there])
    assert not refused and "straight edges" in refused.reason
    own = Pyramid(a=one, b=negative, sides=(256.0,))
    assert Decide()(own, [SubpixelRefinement()(*own.at(own.last), np.eye(3))])


def test_another_place_need_have_no_patch_in_common(scene):
    """What a shows is twice in b, left and right."""
    strip, rng = scene[:, :150].astype(np.float32), np.random.default_rng(3)
    b = np.full(SHAPE, 128, np.float32)
    b[:, :150], b[:, -150:] = strip, strip
    noise = [rng.normal(0, 4, s) for s in (strip.shape, SHAPE)]
    a, b = (
        of(np.clip(p + n, 0, 255).astype(np.uint8), s)
        for p, n, s in zip((strip, b), noise, (256 * np.sqrt(150 / 480), 256.0), strict=True)
    )
    at = between(a, b, np.eye(3))
    rival = Repeats()(a, b, at, Agree())
    assert rival is not None
    assert rival.shift == pytest.approx((330 * b.small_S_full[0, 0], 0), abs=1)
    once = b.fields.copy()
    once[:, -int(0.4 * b.shape[1]) :] = 0
    assert Repeats()(a, replace(b, fields=once), at, Agree()) is None


def roofs(seed):
    """(256, 320) roofs in a grid, of which a fifth is missing, in brightness of their own."""
    rng = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(rng.normal(size=(256, 320)), (0, 0), 2.0)
    picture = 100 + 8 * ground / ground.std()
    for y in range(8, 250, 44):
        for x in range(8, 310, 52):
            if rng.random() < 0.8:
                level = float(rng.uniform(20, 230))
                cv2.rectangle(picture, (x, y), (x + 36, y + 28), level, -1)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.7), 0, 255).astype(np.uint8)


def test_a_grid_with_gaps_of_another_place_is_refused():
    """At one of many periods the gaps of both lie on each other by chance: the second best one
    correlates to 0.75 of it, and patches do not prefer it.
    """
    one, other = roofs(3), roofs(1003)
    one, negative, other = (usable(Picture(values=v)) for v in (one, 255 - one, other))
    pyramid = Pyramid(a=one, b=other, sides=(256.0,))
    period = 52 * pyramid.at(0)[0].small_S_full[0, 0]  # of 25, here they fit best
    start = np.array([[1, 0, period], [0, 1, 0], [0, 0, 1.0]])
    best = SubpixelRefinement(steps=3)(*pyramid.at(0), start)
    assert Agree()(*pyramid.at(0), best.b_H_a).surprise > 5
    assert Repeats(partly=0.85, undisputed=0.0)(*pyramid.at(0), best.b_H_a, Agree()) is None
    refused = Decide()(pyramid, [best])
    assert not refused and "the pictures repeat" in refused.reason
    own = Pyramid(a=one, b=negative, sides=(256.0,))
    assert Decide()(own, [SubpixelRefinement()(*own.at(0), np.eye(3))])
