"""The stated error of a registration: against drawn errors, and for pictures blank in part."""

import numpy as np
import pytest

from skyquilt.coregistration.agreement import Agree, Shifts
from skyquilt.coregistration.error_field import FREE, StateError, overlap_corners
from skyquilt.coregistration.methods import RegisterSettings, registration_method
from skyquilt.coregistration.orientation import orientation
from skyquilt.coregistration.stated_error import TOLERANCE, error_map, state_error, tolerated
from skyquilt.errors import UsageError
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.model.registration import (
    ErrorField,
    Picture,
    RefusedRegistration,
    Registration,
    offsets,
)
from skyquilt.papers.spectral_bench import corner_error
from tests.coregistration.scenes import pair, turned

SHAPE = (400, 480)
CORNERS = np.array([[0.0, 0], [255, 0], [255, 255], [0, 255]])
FRAME = {"centre": np.array([127.5, 127.5]), "unit": 180.0, "reach": 12.0}


def patches(low, high):
    x, y = np.meshgrid(np.arange(low, high, 42.0), np.arange(20, 250, 42.0))
    return np.c_[x.ravel(), y.ravel()]


def patched(px, shift, width=0.3):
    return Shifts(px=px, shift=shift, width=np.full(len(px), width))


def test_offsets_are_the_derivatives_of_a_homography():
    """Against differences of homographies that differ from the identity by one entry."""
    unit, small = 180.0, 1e-3
    px = np.array([[10.0, 20], [200, 30], [90, 240]])
    entries = {4: (0, 0), 6: (2, 0), 7: (2, 1)}
    back = np.array([[1, 0, -127.5], [0, 1, -127.5], [0, 0, 1]])
    for k, at in entries.items():
        h = np.eye(3)
        h[at] += small * (-1 / unit**2 if at[0] == 2 else 1 / unit)
        if k == 4:
            h[1, 1] -= small / unit
        moved = transfer(np.linalg.inv(back) @ h @ back, px) - px
        assert moved == pytest.approx(small * offsets(px, FRAME["centre"], unit)[:, :, k], abs=1e-6)


def test_a_lens_is_one_wherever_its_middle_lies():
    """The third power of the distance from any place is a sum of these changes."""
    px = patches(20, 250)
    J = offsets(px, FRAME["centre"], FRAME["unit"], lens=True)
    assert J.shape == (len(px), 2, 13) and np.linalg.matrix_rank(J.reshape(-1, 13)) == 13
    assert (J[..., :8] == offsets(px, FRAME["centre"], FRAME["unit"])).all()
    q = px - [60.0, 170.0]
    shift = 1e-6 * q * (q**2).sum(1, keepdims=True)
    told = np.linalg.lstsq(J.reshape(-1, 13), shift.ravel(), rcond=None)[0]
    assert J @ told == pytest.approx(shift, abs=1e-9)


def bent_by(lens_px, low, high):
    """Patches of a picture whose corners a lens moves by so many px, about a place beside its
    middle, and where its corners are then.
    """

    def moved(px):
        q = (px - [140.0, 110.0]) / FRAME["unit"]
        return lens_px * q * ((q**2).sum(1, keepdims=True) - 0.4)

    px = np.concatenate([patches(low, high)] * 2)
    shift = moved(px) + np.random.default_rng(8).normal(0, 0.4, px.shape)
    return patched(px, shift), np.linalg.norm(moved(CORNERS), axis=1)


@pytest.mark.parametrize("columns", [(20, 250), (20, 190), (60, 190)])
def test_what_a_lens_bends_is_within_the_bound(columns):
    """By up to 6 px at a corner, which a similarity cannot follow: also where no patches lie at
    the rim.
    """
    told, actual = bent_by(9.0, *columns)
    state = StateError()
    scatter = state.scatter(told, free=4, **FRAME)
    still = np.zeros(8)
    bound = state.bent(told, scatter, still, CORNERS, FRAME["reach"], still).bound_px(CORNERS)
    assert actual.max() > 1.5 * state(scatter, 4).bound_px(CORNERS).max()
    assert (actual <= bound).all() and bound.max() < 2.5 * actual.max()


def test_without_patches_lenses_bend_as_they_usually_do():
    """Two shifts in the middle tell nothing of the corners: the bound is that of the prior."""
    px = np.array([[120.0, 127.5], [135.0, 127.5]])
    told, state = patched(np.repeat(px, 12, 0), np.zeros((24, 2))), StateError()
    scatter = state.scatter(told, free=4, **FRAME)
    for times in (1, 2):
        corners = FRAME["centre"] + times * (CORNERS - FRAME["centre"])
        none = np.zeros(8)
        bound = state.bent(told, scatter, none, corners, FRAME["reach"], none).bound_px(corners)
        rim = times * 127.5 * np.sqrt(2)
        assert (bound > 2.4 * state.lens * rim).all()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["similarity", "homography"])
def test_bounds_hold_for_drawn_errors(model):
    """Patches with errors of 0.7 px each (in the left half, for the similarity), and the transform
    fitted to them.
    """
    rng = np.random.default_rng(5)
    state = StateError(dependence=1.0, misfit=1e-3, shared=0.0, blur=0.0, rarity=0.0, chosen=1.0)
    px = patches(20, 140 if model == "similarity" else 240)
    held = []
    for _ in range(150):
        shift = rng.normal(0, 0.7, px.shape)
        error = transfer(fit(model, px, px + shift), CORNERS) - CORNERS
        scatter = state.scatter(patched(px, shift), free=FREE[model], **FRAME)
        held.append(np.linalg.norm(error, axis=1) <= state(scatter, FREE[model]).bound_px(CORNERS))
    assert 0.91 < np.mean(held) < 0.99


def test_patches_that_match_anywhere_are_left_out():
    rng = np.random.default_rng(2)
    px = np.concatenate([patches(20, 250)] * 3)
    shift = rng.normal(0, 0.5, px.shape)
    wild = rng.random(len(px)) < 0.4
    shift[wild] = rng.uniform(-12, 12, (wild.sum(), 2))
    scatter = StateError().scatter(patched(px, shift), free=4, **FRAME)
    assert scatter.sigma == pytest.approx(0.5, rel=0.15)
    assert scatter.information[0, 0] == pytest.approx((~wild).sum(), rel=0.1)


def test_the_bound_grows_away_from_the_patches_and_with_their_scatter():
    rng = np.random.default_rng(3)
    px = patches(20, 140)
    unit = rng.normal(0, 1, px.shape)
    state = StateError()
    one, three = (
        state(state.scatter(patched(px, size * unit), free=4, **FRAME), 4).bound_px(CORNERS)
        for size in (0.3, 0.9)
    )
    assert (one[[1, 2]] > 1.25 * one[[0, 3]]).all()
    assert three == pytest.approx(3 * one, rel=0.15)


def test_broad_peaks_widen_the_bound():
    px = patches(20, 250)
    shift = np.random.default_rng(4).normal(0, 0.5, px.shape)
    state = StateError()
    sharp, broad = (
        state(state.scatter(patched(px, shift, size), free=4, **FRAME), 4) for size in (0.1, 0.5)
    )
    assert broad.bound_px(CORNERS) == pytest.approx(5**0.3 * sharp.bound_px(CORNERS))


def test_patches_between_those_of_the_test_are_half_a_patch_off():
    """They tell the same shift."""
    a, b = pair(turned(1.0, 0.0, SHAPE, SHAPE, (3.0, 2.0)), seed=14)
    fields = [orientation(p.astype(np.float32), np.ones(SHAPE, bool), 256.0) for p in (a, b)]
    agree, there = Agree(), np.eye(3)
    told, both = agree(*fields, there).every, agree.shifts(*fields, there)
    own, more = both.px[: len(told.px)], both.px[len(told.px) :]
    assert (own == told.px).all() and (both.shift[: len(own)] == told.shift).all()
    assert len(more) > 0.6 * len(own) and np.unique((more - own[0]) % 42).tolist() == [21.0]
    # the picture lies (3, 2) px off, less its reduction
    shift = np.median(both.shift[len(own) :], axis=0)
    assert shift == pytest.approx(np.array([3.0, 2.0]) * 256 / np.sqrt(400 * 480), abs=0.2)


def test_two_registrations_that_differ_widen_the_bound_along_their_difference():
    """A shift widens it everywhere alike, a turn at the corners, by the stated share each."""
    px = patches(20, 250)
    state = StateError()
    still = state.scatter(patched(px, np.zeros_like(px)), free=4, **FRAME)
    for k, size in ((0, 3.0), (3, 2.0)):
        change = offsets(CORNERS, FRAME["centre"], FRAME["unit"])[:, :, k] * size
        apart = still.parameters(CORNERS, change)
        assert apart[k] == pytest.approx(size)
        wide = state(still, 4, apart).bound_px(CORNERS)
        expected = 1.96 * state.apart * np.linalg.norm(change, axis=1)
        assert wide == pytest.approx(expected, rel=0.02)


def test_few_matching_patches_and_a_homography_widen_the_bound():
    """Where half of the patches match anywhere, by the share that matches; where the model was
    chosen by the same patches, twice.
    """
    rng = np.random.default_rng(6)
    px = np.concatenate([patches(20, 250)] * 4)
    shift = rng.normal(0, 0.5, px.shape)
    plain = StateError(rarity=0.0, chosen=1.0)
    wild = np.arange(len(px)) % 2 == 0
    shift[wild] = rng.uniform(-12, 12, (wild.sum(), 2))
    scatter = plain.scatter(patched(px, shift), free=4, **FRAME)
    assert scatter.share == pytest.approx(0.5, abs=0.05)
    fewer, usual = (s(scatter, 4).bound_px(CORNERS) for s in (StateError(), plain))
    assert fewer / usual == pytest.approx((0.75 / scatter.share) ** 0.3)
    freer = StateError(rarity=0.0)(scatter, 8).bound_px(CORNERS)
    assert freer == pytest.approx(2 * plain(scatter, 8).bound_px(CORNERS))


def test_the_bound_follows_the_pixels():
    state = StateError()
    px = patches(20, 140)
    shift = np.random.default_rng(1).normal(0, 1, px.shape)
    field = state(state.scatter(patched(px, shift), free=4, **FRAME), 4)
    moved = field.moved(2.5, np.array([7.0, -3.0]))
    assert moved.bound_px(2.5 * CORNERS + [7, -3]) == pytest.approx(2.5 * field.bound_px(CORNERS))


def test_the_corners_of_the_overlap():
    right = np.array([[1, 0, 100.0], [0, 1, 0], [0, 0, 1]])
    found = overlap_corners(right, (50, 200), (50, 200))
    assert sorted(map(tuple, np.round(found, 1))) == [
        (99.5, -0.5),
        (99.5, 49.5),
        (199.5, -0.5),
        (199.5, 49.5),
    ]
    horizon = np.array([[1, 0, 0], [0, 1, 0], [0.02, 0, -1.0]])
    assert overlap_corners(horizon, (50, 200), (50, 200))[:, 0].tolist() == [
        -0.5,
        199.5,
        199.5,
        -0.5,
    ]


def growing(slope=0.02):
    """An identity whose bound grows from B's left edge."""
    covariance = np.zeros((8, 8))
    covariance[2, 2] = covariance[3, 3] = slope**2
    error = ErrorField(centre=np.array([0.0, 50]), unit=1.0, covariance=covariance, shared=1e-6)
    none = np.zeros((0, 2))
    return Registration(model="similarity", b_H_a=np.eye(3), px_a=none, px_b=none, error=error)


def test_what_is_stated_and_tolerated():
    """A bound of slope * 2.448 px per px of distance from one point, by hand."""
    shape, found = (100, 300), growing()
    said = state_error(found, shape, shape, 8.0)
    assert said.error_px == pytest.approx(2.448 * 0.02 * np.hypot(299.5, 50.5), rel=0.01)
    reach = 8 / (2.448 * 0.02)
    assert said.valid_share == pytest.approx(reach / 300, abs=0.02)
    assert said.valid_a[:, 0].max() == pytest.approx(reach, abs=4)
    refused = tolerated(found, said)
    assert isinstance(refused, RefusedRegistration)
    assert "14.9 px in a corner" in refused.reason and "8.0 px are tolerated" in refused.reason
    assert tolerated(found, state_error(found, shape, shape, 20.0)) is found
    assert state_error(found, shape, shape, None).tolerance_px == pytest.approx(
        TOLERANCE * np.hypot(*shape)
    )


def test_a_lens_may_bend_a_part_of_the_picture():
    """Where most is within the tolerance, a note tells the rest; a stated tolerance, or too small a
    part, refuses it.
    """
    shape, found = (100, 300), growing()
    said = state_error(found, shape, shape, 10.0)
    kept = tolerated(found, said, bent=True)
    assert isinstance(kept, Registration) and 0.5 < said.valid_share < 0.8
    assert f"{said.valid_share:.0%} of the picture are within 10.0 px" in kept.note
    assert "a corner may be 15 px off" in kept.note
    assert isinstance(tolerated(found, said), RefusedRegistration)
    assert not tolerated(found, state_error(found, shape, shape, 5.0), bent=True)


def test_the_map_agrees_with_the_bounds():
    found = growing()
    grid = error_map(found, (100, 300), (100, 200), 10.0)
    assert grid.shape == (10, 30) and np.isnan(grid[:, 20:]).all()
    x, y = 10 * 12 + 4.5, 10 * 3 + 4.5
    assert grid[3, 12] == pytest.approx(
        float(found.error.bound_px(np.array([[x, y]]))[0]), rel=1e-5
    )


@pytest.mark.parametrize("tolerance", [0.0, -3.0, float("nan"), 1e308])
def test_a_tolerance_is_a_number_of_pixels(tolerance):
    with pytest.raises(UsageError, match="tolerance"):
        RegisterSettings(tolerance_px=tolerance)


def test_methods_without_a_stated_error_take_no_tolerance():
    with pytest.raises(UsageError, match="does not state its error"):
        RegisterSettings(method="surf", tolerance_px=5.0)


@pytest.mark.slow
def test_a_picture_that_is_blank_in_part_says_so():
    """The error is within the bound, and the bound larger than with the whole picture, and more so
    on the blank side.
    """
    truth = turned(1.0, 12.0, SHAPE, SHAPE, (6.0, -4.0))
    a, b = pair(truth, seed=14)
    auto = registration_method("auto")
    valid = np.zeros(SHAPE, bool)
    valid[:, :220] = True
    whole = auto(Picture(values=a), Picture(values=b))
    half = auto(Picture(values=a, valid=valid), Picture(values=b))
    bounds = []
    for found in (whole, half):
        said = state_error(found, SHAPE, SHAPE, None)
        assert corner_error(found.b_H_a, truth, SHAPE, SHAPE) <= said.error_px < 6
        bounds.append(said)
    assert bounds[1].error_px > 1.25 * bounds[0].error_px
    left = bounds[1].corners_a[:, 0] < 240
    assert bounds[1].corners_px[~left].mean() > 1.3 * bounds[1].corners_px[left].mean()
