"""Pixels are registered to known warps, to parts of a pixel; unrelated pictures are refused."""

import cv2
import numpy as np
import pytest

from skyquilt.geometry.transforms import transfer
from skyquilt.papers.direct import Ncc, levels, motion
from skyquilt.papers.direct_refinement import Ecc, MutualInformation, PhaseCorrelation
from skyquilt.papers.picture_similarity import (
    mutual_information,
    ncc,
    ncc_of_shifts,
    phase_shift,
    rotation_and_scale,
    summit,
)
from tests.texture import texture

SIZE = (300, 400)


def pair(*parameters, seed=0, negative=False):
    """Two cuts (300, 400) of one texture; b's content is a's moved by b_H_a (3, 3) about the
    centre, other light, noise.
    """
    ground = texture(900, 1200, seed=seed, roughness=1.3)
    rng = np.random.default_rng(seed)
    H = motion(np.array(parameters), SIZE)
    corner = np.array([[1, 0, 400], [0, 1, 300], [0, 0, 1.0]])
    a = ground[300:600, 400:800]
    b = cv2.warpPerspective(
        ground, corner @ np.linalg.inv(H), SIZE[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    )
    b = 255 * np.exp(-((b - np.median(b)) ** 2) / b.var()) if negative else 0.7 * b + 30
    return [np.clip(p + rng.normal(0, 2, SIZE), 0, 255).astype(np.uint8) for p in (a, b)], H


def error(found, H):
    """Largest error over the frame, px."""
    grid = np.stack(np.meshgrid(np.linspace(0, 399, 5), np.linspace(0, 299, 5)), -1).reshape(-1, 2)
    return np.linalg.norm(transfer(found.b_H_a, grid) - transfer(H, grid), axis=1).max()


@pytest.mark.parametrize(
    ("method", "parameters", "within"),
    [
        (Ncc(), (130.3, -71.8), 0.1),
        (Ncc(), (-210.0, 40.5), 0.15),
        pytest.param(Ncc(turn=20, zoom=1.1), (60.2, 31.7, 0.3, 0.08), 0.3, marks=pytest.mark.slow),
        pytest.param(Ncc(turn=180), (-40.4, 12.0, 2.6), 0.3, marks=pytest.mark.slow),
        (PhaseCorrelation(), (90.3, -51.8), 0.15),
        (PhaseCorrelation(similarity=True), (20.3, -11.0, 0.5, 0.1), 1.5),
        (PhaseCorrelation(similarity=True), (5.0, 9.0, 3.0), 1.5),
        (Ecc(), (5.2, -4.4, 0.02, 0.01), 0.1),
        (Ecc(model="translation"), (6.3, 5.5), 0.05),
        (Ecc(model="affine"), (5.2, -4.4, 0.03), 0.1),
        pytest.param(MutualInformation(), (5.2, -4.4, 0.02, 0.01), 0.25, marks=pytest.mark.slow),
    ],
)
def test_known_motions(method, parameters, within):
    (a, b), H = pair(*parameters)
    found = method(a, b)
    assert found, found.reason
    assert error(found, H) < within and found.method in ("NCC", "phase", "ECC", "MI")
    assert 0.2 < found.overlap <= 1 and found.b_H_a[2, 2] == 1


@pytest.mark.slow
def test_a_start_brings_the_refinements_near():
    (a, b), H = pair(150.3, -60.2, 1.2, 0.1, seed=2)
    near = H @ motion(np.array([3.0, -2.0, 0.01, 0.005]), SIZE)
    for method, within in (
        (Ecc(), 0.3),
        (MutualInformation(finest=2), 0.4),
        (PhaseCorrelation(), 4.0),
        (Ncc(turn=3), 0.3),
    ):
        found = method(a, b, near)
        assert found and error(found, H) < within
    assert not Ecc()(a, b) or error(Ecc()(a, b), H) > 50  # and without it they cannot


@pytest.mark.slow
def test_mutual_information_where_correlation_fails():
    """Bright and dark of one are dark in the other, grey is bright: no correlation, but much in
    common.
    """
    (a, b), H = pair(3.2, -2.4, 0.015, seed=1, negative=True)
    found = MutualInformation(finest=2)(a, b)
    assert found and error(found, H) < 0.5
    assert abs(ncc(a, b)) < 0.3


@pytest.mark.parametrize(
    "method",
    [
        Ncc(),
        Ncc(turn=20),
        PhaseCorrelation(),
        PhaseCorrelation(similarity=True),
        Ecc(),
        pytest.param(MutualInformation(similarity=False), marks=pytest.mark.slow),
    ],
)
def test_unrelated_and_blank_pictures_are_refused(method):
    (a, _), _ = pair(0, 0, seed=3)
    (other, _), _ = pair(0, 0, seed=4)
    for b in (other, np.full(SIZE, 77, np.uint8)):
        found = method(a, b)
        assert not found and found.reason


def test_stripes_are_ambiguous():
    stripes = np.tile(
        (120 + 100 * np.sin(np.arange(400) * 2 * np.pi / 80)).astype(np.uint8), (300, 1)
    )
    noise = np.random.default_rng(0).normal(0, 3, (2, *SIZE))
    found = Ncc()(*(np.clip(stripes + n, 0, 255).astype(np.uint8) for n in noise))
    assert not found and found.reason.startswith("ambiguous")


def test_correlations_of_all_shifts_are_those_of_slow_cuts():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 1, (12, 17)), rng.normal(0, 1, (15, 11))
    ma, mb = rng.random(a.shape) < 0.8, rng.random(b.shape) < 0.7
    field, zero = ncc_of_shifts(a, b, ma, mb, overlap=0.1)
    least = 0.1 * min(ma.sum(), mb.sum())
    for dy in range(-11, 15):
        for dx in range(-16, 11):
            y0, y1, x0, x1 = max(0, -dy), min(12, 15 - dy), max(0, -dx), min(17, 11 - dx)
            both = ma[y0:y1, x0:x1] & mb[y0 + dy : y1 + dy, x0 + dx : x1 + dx]
            expected = (
                ncc(a[y0:y1, x0:x1], b[y0 + dy : y1 + dy, x0 + dx : x1 + dx], both)
                if both.sum() >= least
                else -1
            )
            assert field[zero[0] + dy, zero[1] + dx] == pytest.approx(expected, abs=1e-6)


def test_scores_have_their_known_values():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 255, (2, 200, 200)).astype(np.uint8)
    assert (
        ncc(a, 255 - a) == pytest.approx(-1)
        and ncc(a, 0.3 * a + 9) == pytest.approx(1)
        and ncc(a, a * 0) == 0
    )
    assert ncc(a, b) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1])
    steps = (a // 64).astype(float)  # four values fall on bins exactly
    assert mutual_information(steps, 7 - 2 * steps, bins=4) == pytest.approx(1)
    assert mutual_information(a, b) == pytest.approx(0, abs=0.01) and mutual_information(
        a, a * 0
    ) == pytest.approx(0)
    y, x = np.mgrid[-5:6, -6:7]
    r, c, value, second = summit(1 - 0.01 * ((y - 1.3) ** 2 + (x + 2.4) ** 2))
    assert (r, c) == pytest.approx((6.3, 3.6)) and value > second


def test_phases_tell_shift_turn_and_scale():
    (a, b), _ = pair(12.3, -7.6)
    dx, dy, response = phase_shift(a, b)
    assert (dx, dy) == pytest.approx((12.3, -7.6), abs=0.1) and 0 < response <= 1
    for degrees, scale in ((0, 1), (20, 1), (-35, 1), (0, 1.15), (30, 0.9)):
        (a, b), _ = pair(0, 0, np.radians(degrees), np.log(scale))
        turn, zoom, _ = rotation_and_scale(a, b)
        assert turn == pytest.approx(degrees, abs=0.5) and zoom == pytest.approx(scale, rel=0.01)
    assert levels((400, 300), coarsest=128) == (4, 2, 1) and levels((100, 90), coarsest=128) == (1,)
