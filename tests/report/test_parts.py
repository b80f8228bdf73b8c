import base64

import cv2
import numpy as np
import pytest

from skyquilt.report import CameraResiduals, SeamMark, images
from skyquilt.report.ground import ground_of
from skyquilt.report.layers import exaggeration, seam_kinds
from skyquilt.report.numbers import decimals_of, fixed, nice, seconds, significant
from skyquilt.report.residuals import COLUMNS, ROWS, mean_field, systematic
from skyquilt.report.svg import ticks

from .report_cases import run


def test_numbers_are_written_for_people():
    assert fixed(-1234.5, 1) == "\u22121\u202f234.5"
    assert fixed(float("nan")) == fixed(None) == fixed("x") == "\u2013"
    assert fixed(-0.0001, 2) == "0.00"
    assert significant(0.0123456) == "0.0123"
    assert significant(1.6) == "1.60"
    assert [seconds(v) for v in (0.123, 12.34, 125, 7384)] == [
        "0.12 s",
        "12.3 s",
        "2 min 05 s",
        "2 h 03 min",
    ]


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3.2, 4.7), (1e-6, 2e-6), (0, 12345), (2, -2)])
def test_ticks_are_round_and_few(low, high):
    found = ticks(low, high, 6)
    assert 2 <= len(found) <= 12
    assert all(min(low, high) - 1e-9 <= value <= max(low, high) + 1e-9 for value, _ in found)
    assert len({label for _, label in found}) == len(found)


def test_steps_are_round():
    assert [nice(10, 5), nice(11, 5), nice(0.3, 1), nice(0, 3)] == [2, 5, 0.5, 1]
    assert [decimals_of(v) for v in (20, 1, 0.5, 0.02)] == [0, 0, 1, 2]


def decode(uri):
    return cv2.imdecode(
        np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_UNCHANGED
    )


def test_a_palette_png_decodes_to_its_colours():
    index = np.arange(12, dtype=np.uint8).reshape(3, 4)
    colours = np.random.default_rng(0).integers(0, 255, (12, 4), dtype=np.uint8)
    found = decode(images.png_uri(index, colours))
    assert np.array_equal(found[..., [2, 1, 0, 3]], colours[index])


def test_a_jpeg_keeps_its_colours():
    rgba = np.zeros((32, 32, 4), np.uint8)
    rgba[:] = (200, 60, 20, 255)
    assert np.abs(decode(images.jpeg_uri(rgba))[..., ::-1].astype(int) - (200, 60, 20)).max() < 6


def test_outlines_follow_the_alpha_and_its_holes():
    alpha = np.zeros((40, 60), np.uint8)
    alpha[5:35, 10:50] = 255
    alpha[15:20, 20:30] = 0
    rings = images.outline(alpha)
    assert len(rings) == 2
    assert np.allclose([rings[0].min(0), rings[0].max(0)], [[10, 5], [50, 35]], atol=0.51)


def test_arrows_are_exaggerated_until_they_can_be_seen():
    data = run()
    ground = ground_of(data)
    factor = exaggeration(data.shots, ground)
    assert factor in (1, 2, 5, 10)
    assert exaggeration([], ground) == 1


def test_ground_holds_map_and_photos():
    west, south, east, north = ground_of(run()).bounds
    assert west < -40 and south < -40 and east > 100 and north > 100


def test_seam_colours():
    values = (0.1, 0.7, 1.5, 3.0, 9.0, None)
    assert seam_kinds([SeamMark(x=0, y=0, disparity_px=v) for v in values]).tolist() == [
        0,
        1,
        2,
        3,
        4,
        5,
    ]


def field(shift, n=20_000):
    rng = np.random.default_rng(3)
    px = rng.uniform(0, 1, (n, 2)) * (4000, 3000)
    residual = rng.normal(0, 0.5, (n, 2)) + shift * (px - (2000, 1500)) / 2500
    return CameraResiduals(camera="a", width=4000, height=3000, px=px, residual_px=residual)


def test_chance_is_no_distortion_and_distortion_is():
    at, mean, n = mean_field(field(0.0))
    assert len(at) == COLUMNS * ROWS and n.sum() == 20_000
    assert systematic(field(0.0), mean, n) < 0.03
    _, mean, n = mean_field(field(1.0))
    assert 0.4 < systematic(field(1.0), mean, n) < 0.7
