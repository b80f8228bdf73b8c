"""Registration against shifts known by construction."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.imaging.gradients import has_texture, weakest_gradient
from skyquilt.imaging.registration import shift_between, shifts_between
from tests.texture import FINE, seen, texture

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "brighton"


def pairs(count, *, noise=2.0, seed=0, reach=26, roughness=1.0):
    """Patches a, b and true shifts (dy, dx): b(x + d) shows a(x), under another gain, offset and
    noise.
    """
    rng = np.random.default_rng(seed)
    fine = texture(1200, 1200, seed, roughness)
    a, b, truth = [], [], []
    for _ in range(count):
        row, column = rng.integers(reach, 1200 - 64 * FINE - reach, 2)
        s = rng.integers(-reach, reach + 1, 2)
        gain, offset = rng.uniform(0.6, 1.6), rng.uniform(-30, 30)
        a.append(seen(fine, row, column) + rng.normal(0, noise, (64, 64)))
        b.append(
            seen(fine, row - s[0], column - s[1]) * gain + offset + rng.normal(0, noise, (64, 64))
        )
        truth.append(s / FINE)
    return np.float32(a), np.float32(b), np.array(truth)


def found(shifts):
    return np.array([[s.dy, s.dx] for s in shifts])


@pytest.mark.parametrize("roughness", [0.8, 1.2, 1.6])
def test_subpixel_shifts_are_found_without_bias(roughness):
    a, b, truth = pairs(200, roughness=roughness)
    shifts = shifts_between(a, b)
    error = found(shifts) - truth
    assert all(shifts), {s.reason for s in shifts if not s}
    assert np.median(np.hypot(*error.T)) < 0.04
    assert np.percentile(np.hypot(*error.T), 95) < 0.1
    assert (abs(error.mean(0)) < 0.01).all()
    for axis in (0, 1):  # neither drawn towards zero nor towards whole pixels
        assert abs(np.polyfit(truth[:, axis], error[:, axis], 1)[0]) < 0.002
        assert abs(np.mean(error[:, axis] * np.sin(2 * np.pi * truth[:, axis]))) < 0.01


def test_the_sign_says_where_the_second_patch_shows_the_same():
    fine = texture(600, 600)
    a, b = seen(fine, 100, 100), seen(fine, 100, 100 - 3 * FINE)  # b's window lies 3 px west of a's
    shift = shift_between(a, b)
    assert shift.dx == pytest.approx(3, abs=0.01)
    assert shift.dy == pytest.approx(0, abs=0.01)
    np.testing.assert_allclose(b[:, 3:], a[:, :-3], atol=1e-3)


def test_noise_makes_errors_that_are_neither_too_large_nor_too_small():
    a, b, truth = pairs(200, noise=12.0, roughness=1.2)
    shifts = shifts_between(a, b)
    ok = np.array([bool(s) for s in shifts])
    error = np.hypot(*(found(shifts) - truth)[ok].T)
    assert ok.mean() > 0.9
    assert 0.01 < np.median(error) < 0.25
    assert (error > 1).mean() < 0.01


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 1000), gain=st.floats(0.2, 5), offset=st.floats(-500, 500))
def test_gain_and_offset_change_nothing_and_exchange_negates(seed, gain, offset):
    a, b, _ = pairs(1, seed=seed)
    shift, other, back = (
        shift_between(a[0], b[0]),
        shift_between(a[0], b[0] * gain + offset),
        shift_between(b[0], a[0]),
    )
    assert (other.dx, other.dy, other.peak) == pytest.approx(
        (shift.dx, shift.dy, shift.peak), abs=2e-3
    )
    assert (-back.dx, -back.dy, back.peak) == pytest.approx(
        (shift.dx, shift.dy, shift.peak), abs=2e-3
    )


def test_equal_patches_correlate_fully():
    a, _, _ = pairs(1)
    shift = shift_between(a[0], a[0])
    assert shift.peak == pytest.approx(1, abs=1e-3)
    assert (shift.dx, shift.dy) == pytest.approx((0, 0), abs=1e-3)


def test_unrelated_textures_are_refused():
    a, b, _ = pairs(400, seed=1)
    shifts = shifts_between(a, np.roll(b, 1, 0)[:, ::-1])
    assert np.mean([s.ok for s in shifts]) < 0.01
    assert all(s.reason for s in shifts if not s)


@pytest.mark.parametrize("roughness", [1.0, 2.0])
def test_few_unrelated_smooth_patches_are_taken_for_one(roughness):
    a, b, _ = pairs(300, seed=2, roughness=roughness, noise=0.3)
    assert np.mean([s.ok for s in shifts_between(a, np.roll(b, 7, 0).transpose(0, 2, 1))]) < 0.02


def test_stripes_and_shifts_beyond_the_search_are_refused():
    x = np.arange(64)
    stripes = np.tile(120 + 40 * np.sin(2 * np.pi * x / 6), (64, 1)).astype(np.float32)
    assert not shift_between(stripes, np.roll(stripes, 2, 1))
    fine = texture(800, 800)
    assert not shift_between(seen(fine, 100, 100), seen(fine, 100, 100 + 14 * FINE))


def test_flat_patches_have_no_texture_and_no_shift():
    rng = np.random.default_rng(0)
    flat = np.full((2, 64, 64), 90, np.float32)
    edge = np.tile(np.where(np.arange(64) < 32, 50, 200), (64, 1))[None] + rng.normal(
        0, 1.5, (1, 64, 64)
    )
    assert not has_texture(flat).any()
    assert not has_texture(rng.normal(90, 1.5, (20, 64, 64))).any()
    assert not has_texture(edge).any()  # fixes no shift along itself
    assert has_texture(edge + edge.transpose(0, 2, 1)).all()
    assert not any(shifts_between(flat, flat))


def test_weakest_gradient_of_a_known_pattern():
    y, x = np.mgrid[:64, :64]
    pattern = (0.5 * x + 2 * y)[None].astype(np.float32)
    assert weakest_gradient(pattern)[0] == pytest.approx(0, abs=1e-2)
    waves = 10 * np.sin(2 * np.pi * x / 32) + 20 * np.sin(2 * np.pi * y / 32)
    assert weakest_gradient(waves[None])[0] == pytest.approx(
        10 * 2 * np.pi / 32 / np.sqrt(2), rel=0.1
    )


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="two equal stacks"):
        shifts_between(np.zeros((2, 64, 64)), np.zeros((2, 64, 60)))
    with pytest.raises(ValueError, match="at least 80 px expected"):
        shift_between(np.zeros((64, 64)), np.zeros((64, 64)), radius=20)
    assert shifts_between(np.zeros((0, 64, 64)), np.zeros((0, 64, 64))) == []


def test_three_hundred_pairs_cost_little():
    a, b, _ = pairs(300)
    shifts_between(a[:40], b[:40])
    start = time.process_time()
    shifts_between(a, b)
    assert time.process_time() - start < 0.6  # 0.1 s on a quiet machine


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.skipif(not REAL.exists(), reason="the real survey is not beside the checkout")
def test_unrelated_real_patches_are_refused_and_real_shifts_found():
    rng = np.random.default_rng(0)
    photos = [
        cv2.imread(str(p), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        for p in sorted(REAL.glob("*.JPG"))[1:16:5]
    ]
    u, v, a, b, truth = [], [], [], [], []
    for k in range(1000):
        row, column = rng.integers(0, 2250 - 64, 2), rng.integers(0, 4000 - 64, 2)
        for j, stack in enumerate((u, v)):
            stack.append(photos[(k + j) % 3][row[j] : row[j] + 64, column[j] : column[j] + 64])
    for k in range(200):
        row, column, s = rng.integers(30, 1900), rng.integers(30, 3700), rng.integers(-24, 25, 2)
        a.append(seen(photos[k % 3], row, column) + rng.normal(0, 2, (64, 64)))
        b.append(seen(photos[k % 3], row - s[0], column - s[1]) * 0.7 + rng.normal(0, 2, (64, 64)))
        truth.append(s / FINE)
    assert np.mean([s.ok for s in shifts_between(np.array(u), np.array(v))]) < 0.005
    shifts = shifts_between(np.float32(a), np.float32(b))
    error = np.hypot(*(found(shifts) - np.array(truth)).T)
    assert np.mean([s.ok for s in shifts]) > 0.98
    assert np.median(error) < 0.03
    assert np.percentile(error, 95) < 0.1
