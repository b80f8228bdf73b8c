"""Positions that contradict the pictures as a whole are told, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.contradicted_positions import position_warnings
from tests.alignment.surveys import alignment, prior

LINES = np.array([(20.0 * (i % 5), 30.0 * (i // 5), 60.0) for i in range(20)])
"""Four lines of five photos."""


def block(centres=LINES, **more):
    found = alignment(len(centres), **more)
    poses = {i: replace(found.poses[i], map_C=C) for i, C in enumerate(np.asarray(centres))}
    return replace(found, poses=poses)


def told_at(places, sigma=1.5):
    return [prior(C, sigma=sigma) for C in places]


def turned(places, degrees, scale=1.0):
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    return np.asarray(places) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def mirrored(places):
    return np.asarray(places) * (-1, 1, 1)


@pytest.mark.parametrize("sigma", [0.02, 1.5, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_noise_and_an_offset_of_all_are_no_contradiction(sigma, seed):
    noise = np.random.default_rng(seed).normal(0, sigma, LINES.shape)
    assert position_warnings(told_at(LINES + noise + (8, -5, 40), sigma), block()) == []


def test_a_third_of_gross_errors_is_told_photo_by_photo_only():
    places = LINES.copy()
    places[::3] += (70, -40, 0)
    assert position_warnings(told_at(places), block()) == []


def test_control_points_that_bend_a_precise_flight_a_little_are_no_contradiction():
    assert position_warnings(told_at(turned(LINES, 0.2, 1.003), 0.02), block()) == []


@pytest.mark.parametrize("degrees", [0.0, 35.0, 90.0])
def test_mirrored_positions(degrees):
    noise = np.random.default_rng(1).normal(0, 1.0, LINES.shape)
    (told,) = position_warnings(told_at(turned(mirrored(LINES), degrees) + noise), block())
    assert "mirrored" in told


@pytest.mark.parametrize(("degrees", "scale"), [(60.0, 1.0), (0.0, 4.0), (0.0, 0.05)])
def test_a_block_that_lies_elsewhere_than_its_positions(degrees, scale):
    found = block(turned(LINES, degrees, scale))
    (told,) = position_warnings(told_at(LINES), found)
    assert "contradict" in told and "mirrored" not in told
    centred, away = (p - np.median(p, axis=0) for p in (LINES, turned(LINES, degrees, scale)))
    off = np.hypot(*(centred - away)[:, :2].T)
    off = np.median(off)
    assert f"more than {off:.0f} m" in told


def test_nothing_is_said_of_few_photos_or_of_a_map_without_place():
    assert position_warnings(told_at(mirrored(LINES))[:5], block(LINES[:5])) == []
    assert position_warnings(told_at(mirrored(LINES)), block(crs=None)) == []
