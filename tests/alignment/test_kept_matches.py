"""Shares of matches that an adjustment keeps, of tie points written down by hand."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.kept_matches import kept_matches, tie_points_at
from skyquilt.model.features import Features, Link
from skyquilt.model.poses import TiePoints
from tests.alignment.surveys import alignment

PLACES = np.arange(20)[:, None] * [30.0, 20.0] + 50


def points(*rows):
    """Observations (point, photo, keypoint)."""
    point, photo, key = np.array(rows).T
    return TiePoints(
        xyz=np.zeros((int(point.max()) + 1, 3)),
        point=point,
        photo=photo,
        px=PLACES[key] + 0.4,  # observations were refined
        residual_px=np.zeros((len(rows), 2)),
    )


def features(scale=1.0):
    words = np.zeros((len(PLACES), 4), np.uint8)
    return Features(px=PLACES, size=np.ones(len(PLACES)), descriptors=words, scale=scale)


def link(a, b, count):
    every = np.arange(count)
    return Link(a=a, b=b, index_a=every, index_b=every, b_S_a=1 + 0j)


def test_a_photo_whose_observations_are_gone_has_kept_few():
    """Photos 0 and 1 agree in ten points; of 2 only two are left, and one lies elsewhere."""
    both = [(k, i, k) for k in range(10) for i in (0, 1)]
    found = points(*both, (0, 2, 0), (1, 2, 1), (12, 2, 5), (12, 3, 5))
    links = [link(0, 1, 12), link(0, 2, 8), link(1, 2, 8)]
    kept = kept_matches(replace(alignment(4), ties=found), [features()] * 4, links)
    # of 12 matches of 0 and 1 ten are shown, of 8 with photo 2 all by the other one
    assert kept == {
        0: pytest.approx((10 + 2) / (10 + 8)),
        1: pytest.approx((10 + 2) / (10 + 8)),
        2: pytest.approx((2 + 2) / (8 + 8)),
        3: 1.0,
    }


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_a_tie_point_lies_where_a_keypoint_is(scale):
    ties = points((0, 1, 4), (1, 1, 7), (2, 0, 9))
    off = np.array([[2.9, 0.0], [3.1 * scale, 0.0]]) * [[scale], [1.0]]
    asked = np.array([PLACES[4] + 0.4, PLACES[7] + 0.4]) + off
    assert tie_points_at(ties, 1, asked, scale).tolist() == [0, -1]
    assert tie_points_at(ties, 5, asked, scale).tolist() == [-1, -1]
    assert tie_points_at(ties, 1, np.zeros((0, 2)), scale).tolist() == []
