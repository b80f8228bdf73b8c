"""Positions that contradict the pictures as a whole are told, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.contradicted_positions import (
    enlargement_warnings,
    loose_warnings,
    position_warnings,
)
from skyquilt.alignment.false_heights import UNUSED
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


@pytest.mark.parametrize("factors", [(1.0, 1.5), (1.0, 1.25, 1.6), (1.0, 1.15)])
@pytest.mark.parametrize("datum", [0.0, 140.0])
def test_photos_that_are_enlarged_by_other_factors_are_told(factors, datum):
    each = np.resize(factors, len(LINES))
    seen = np.column_stack([LINES[:, :2], LINES[:, 2] / each])
    noise = np.random.default_rng(2).normal(0, 0.3, len(LINES))
    places = LINES + np.column_stack([np.zeros((20, 2)), noise + datum])
    (told,) = enlargement_warnings(told_at(places), block(seen))
    assert "zoom" in told and "DigitalZoomRatio" in told
    number = int(told.split()[0])
    assert number in [int((each >= f).sum()) for f in factors[1:]]
    explained = replace(block(seen), notes=(f"The heights of 10 of 20 photos lie 14 m. {UNUSED}",))
    assert enlargement_warnings(told_at(places), explained) == []


def test_heights_that_are_told_drift_or_are_few_are_no_zoom():
    drift = np.column_stack([np.zeros((20, 2)), np.linspace(0, 20, 20)])
    two = LINES + np.column_stack([np.zeros((20, 2)), np.resize([0, 60], 20)])
    wrong = LINES.copy()
    wrong[:2, 2] += 40
    assert enlargement_warnings(told_at(LINES + drift), block()) == []
    assert enlargement_warnings(told_at(two), block(two * (1, 1, 1.3))) == []
    assert enlargement_warnings(told_at(wrong), block()) == []
    assert enlargement_warnings(told_at(two), block(two)) == []
    assert enlargement_warnings(told_at(LINES * (1, 1, np.nan)), block()) == []


@pytest.mark.parametrize(("reach", "loose"), [(2.0, True), (8.0, True), (40.0, False)])
def test_a_direction_that_positions_hardly_tell(reach, loose):
    """Rings of twelve photos without headings: what is said is twice the scatter of directions
    that fit noisy positions best.
    """
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.full(12, 50.0)])
    noise = np.random.default_rng(0).normal(0, 2.0, (300, 12, 2)) @ (1, 1j)
    z = ring[:, 0] + 1j * ring[:, 1]
    turns = np.degrees(np.angle(((z + noise) * np.conj(z)).sum(1)))
    there = ring + np.column_stack([noise[0].real, noise[0].imag, np.zeros(12)])
    headless = [replace(p, yaw_deg=np.nan) for p in told_at(there, 2.0)]
    said = loose_warnings(headless, block(ring))
    assert bool(said) == loose
    if loose:
        found = float(said[0].split("turned by ")[1].split()[0])
        assert found == pytest.approx(2 * turns.std(), rel=0.35)
    assert loose_warnings(told_at(there, 2.0), block(ring)) == []
    assert loose_warnings(headless, block(ring, crs=None)) == []


@pytest.mark.parametrize(("relief", "loose"), [(0.0, False), (1.0, False), (8.0, True)])
def test_heights_above_take_off_tell_no_scale_over_uneven_ground(relief, loose):
    """The drone takes off anywhere on ground whose heights scatter by so much: what is said is
    twice the scatter of scales, weighed with those of positions.
    """
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([8 * np.cos(angle), 8 * np.sin(angle), np.full(12, 50.0)])
    found = block(ring)
    ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), rng.normal(0, relief, 4000)])
    found = replace(found, ties=replace(found.ties, xyz=ground))
    said = loose_warnings(told_at(ring + rng.normal(0, 2.0, ring.shape), 2.0), found)
    assert bool(said) == loose
    if loose:
        by_height, by_positions = relief / 50, 2.0 / (8 * np.sqrt(12))
        both = 1 / np.hypot(1 / by_height, 1 / by_positions)
        percent = float(said[0].split("small by ")[1].split()[0])
        assert percent == pytest.approx(200 * both, rel=0.25)
        assert "uneven by" in said[0] and "turned" not in said[0]


def test_the_position_of_one_photo_tells_neither_direction_nor_scale():
    told = [replace(p, yaw_deg=np.nan) for p in told_at(LINES, 2.0)]
    only = [told[0], *(replace(p, map_C=np.full(3, np.nan)) for p in told[1:])]
    found = block(LINES)
    nowhere = replace(found, frame=replace(found.frame, vertical_datum="sea_level", takeoff_m=None))
    (said,) = loose_warnings(only, nowhere)
    assert "turned by 180 degrees" in said and "small by 100 %" in said
    assert "the position of a single photo does not tell it" in said
    none = [replace(p, map_C=np.full(3, np.nan)) for p in told]
    assert loose_warnings(none, nowhere) == []


def test_a_scale_that_positions_hardly_tell_is_told_where_no_height_above_ground_does():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), np.full(12, 50.0)])
    there = ring + np.random.default_rng(0).normal(0, 2.0, ring.shape)
    found = block(ring)
    nowhere = replace(found, frame=replace(found.frame, vertical_datum="sea_level", takeoff_m=None))
    (said,) = loose_warnings(told_at(there, 2.0), nowhere)
    percent = float(said.split("small by ")[1].split()[0])
    assert percent == pytest.approx(100 * 2 * 2.0 / np.sqrt(12 * 9), rel=0.35)
    assert "turned" not in said and loose_warnings(told_at(there, 2.0), found) == []
    climb = ring + np.column_stack([np.zeros((12, 2)), np.arange(0.0, 120, 10)])
    above = block(climb)
    above = replace(above, frame=nowhere.frame)
    assert loose_warnings(told_at(climb + there - ring, 2.0), above) == []  # heights tell it


def test_six_positions_that_fit_by_chance_do_not_hide_that_a_map_may_be_turned():
    """Two lines of three photos without headings, positions of 2 m: of maps turned by more than 5
    degrees nine in ten are told (six in ten by the scatter that is seen).
    """
    places = np.array([(12.0 * (k % 3), 20.0 * (k // 3), 50.0) for k in range(6)])
    z = (places[:, :2] - places[:, :2].mean(0)) @ (1, 1j)
    rng, told = np.random.default_rng(1), list[bool]()
    while len(told) < 100:
        noise = rng.normal(0, 2.0, (6, 2))
        w = z + noise @ (1, 1j)
        turn = np.vdot(z, w - w.mean()) / np.vdot(z, z)
        if abs(np.degrees(np.angle(turn))) < 5:
            continue
        fitted = turn * z
        found = block(np.column_stack([fitted.real, fitted.imag, places[:, 2]]))
        there = np.column_stack([w.real, w.imag, places[:, 2]])
        headless = [replace(p, yaw_deg=np.nan) for p in told_at(there, 5.0)]
        told.append(bool(loose_warnings(headless, found)))
    assert sum(told) >= 88
