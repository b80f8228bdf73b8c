"""Metadata repaired by links, against flights of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.repair import repair
from skyquilt.matching.candidates import sequence
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.verify import Verify
from tests.alignment.flights import fly, lawn
from tests.alignment.surveys import WIDTH


def links_of(flight, reach=45.0):
    xy = flight.C[:, :2]
    n = len(xy)
    pairs = {
        (i, j) for i in range(n) for j in range(i + 1, n) if np.hypot(*(xy[i] - xy[j])) < reach
    }
    found = [
        Verify()(
            i,
            j,
            flight.features[i],
            flight.features[j],
            Mutual()(flight.features[i], flight.features[j]),
            WIDTH,
        )
        for i, j in sorted(pairs | set(sequence(n)))
    ]
    return [k for k in found if k]


@pytest.fixture(scope="module")
def flight():
    return fly(lawn(3, 4), yaw=20.0, gps=0.5, tilt=0.3, points=5000)


@pytest.fixture(scope="module")
def links(flight):
    return links_of(flight)


def off(a, b):
    return abs((a - b + 180) % 360 - 180)


def test_headings_that_lie_are_put_right_and_named(flight, links):
    lying = list(flight.priors)
    for i in (4, 5, 6):
        lying[i] = replace(lying[i], yaw_deg=lying[i].yaw_deg + 180)
    found = repair(flight.photos, lying, flight.features, links)
    assert all(off(p.yaw_deg, 20.0) < 2.0 for p in found.priors)
    assert (
        len(found.notes) == 3
        and "P004.jpg reports a heading of -160 degrees, its pixels show 2" in found.notes[0]
    )
    assert [p.yaw_source for p in found.priors][3:7] == ["xmp-gimbal", "pixels", "pixels", "pixels"]


def test_headings_that_are_missing_are_filled(flight, links):
    blind = [replace(p, yaw_deg=np.nan) for p in flight.priors]
    found = repair(flight.photos, blind, flight.features, links)
    assert all(off(p.yaw_deg, 20.0) < 3.0 for p in found.priors) and not found.notes


def test_headings_that_agree_stay(flight, links):
    found = repair(flight.photos, flight.priors, flight.features, links)
    assert [p.yaw_deg for p in found.priors] == [
        p.yaw_deg for p in flight.priors
    ] and not found.notes


def test_the_tilt_of_a_file_turned_in_a_viewer_turns_with_it(flight, links):
    lying = [replace(p, pitch_deg=3.0, roll_deg=-2.0) for p in flight.priors]
    lying[5] = replace(lying[5], yaw_deg=lying[5].yaw_deg + 180)
    photos = list(flight.photos)
    photos[5] = replace(photos[5], editor="a viewer")
    found = repair(photos, lying, flight.features, links).priors
    assert (found[5].pitch_deg, found[5].roll_deg) == (-3.0, 2.0) and (
        found[4].pitch_deg,
        found[4].roll_deg,
    ) == (3.0, -2.0)


def test_heights_come_from_image_scale_whatever_altitudes_say(flight, links):
    wrong = [replace(p, map_C=p.map_C + [0, 0, 8.0 * i]) for i, p in enumerate(flight.priors)]
    found = repair(flight.photos, wrong, flight.features, links)
    assert np.allclose(found.heights_m, 60.0, rtol=0.03) and np.ptp(found.heights_m) > 0


def test_positions_worse_than_stated_widen_their_deviation(flight, links):
    rng = np.random.default_rng(0)
    wild = [replace(p, map_C=p.map_C + [*rng.normal(0, 6, 2), 0]) for p in flight.priors]
    found = repair(flight.photos, wild, flight.features, links)
    assert all(2.0 < p.sigma_C[0] < 15.0 for p in found.priors)


def test_photos_without_links_stay_as_they_are(flight):
    found = repair(flight.photos, flight.priors, flight.features, [])
    assert list(found.priors) == flight.priors and np.isnan(found.heights_m).all()
