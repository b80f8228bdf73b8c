"""Flight lines and pairs across them (A 2.1, 2.2, 2.4)."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from skyquilt.papers.flightline_geometry import (
    by_distance,
    by_heading,
    middle_out,
    pairs_across,
    reversals,
    shooting_distances,
)
from tests.alignment.flights import lawn, line


def sizes(lines):
    return [len(part) for part in lines]


def test_the_histogram_is_that_of_the_paper():
    xy = lawn(4, 6, step=20.0, apart=45.0)
    found = shooting_distances(xy)
    d = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    assert found.width_m == pytest.approx((d.max() - d.min()) / 9)
    assert found.commonest_m == pytest.approx(20.0)
    assert found.range_m == pytest.approx((20 - 2 * 25 / 9, 20 + 5 * 25 / 9))


@pytest.mark.parametrize(("count", "lines"), [(73, 6), (168, 6)])
@pytest.mark.parametrize("heading", [0.0, 37.0, 90.0])
def test_surveys_of_the_papers_size_fall_into_their_lines(count, lines, heading):
    each = [len(part) for part in np.array_split(np.arange(count), lines)]
    turn = np.radians(heading)
    rotate = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    rows = [line(n, 20.0, start=(60.0 * k, 0.0)) for k, n in enumerate(each)]
    xy = np.concatenate([r if k % 2 == 0 else r[::-1] for k, r in enumerate(rows)]) @ rotate.T
    xy += np.random.default_rng(1).normal(0, 1.0, xy.shape)
    assert sizes(by_heading(xy)) == each
    assert (
        sizes(by_distance(xy)) == each
    )  # 60 m to the next line against 20 m along it: distance tells, too


def test_lines_as_far_apart_as_photos_are_told_by_heading_only():
    xy = lawn(4, 6, step=25.0, apart=25.0) + np.random.default_rng(2).normal(0, 0.3, (24, 2))
    assert sizes(by_heading(xy)) == [6, 6, 6, 6]
    assert sizes(by_distance(xy)) != [6, 6, 6, 6]


def test_a_line_that_turns_back_is_noticed():
    there = line(6, 20.0)
    xy = np.concatenate([there, there[::-1] + (1.0, 5.0)])
    assert reversals(xy, range(12)) == 1
    assert reversals(there, range(6)) == 0


def test_equal_distances_are_one_line():
    assert sizes(by_distance(line(7))) == [7]


def test_no_pair_across_belongs_to_an_obtuse_triangle():
    xy = lawn(3, 6) + np.random.default_rng(5).normal(0, 2.0, (18, 2))
    lines = by_heading(xy)
    pairs = pairs_across(xy, lines)
    line_of = {i: k for k, part in enumerate(lines) for i in part}
    assert pairs and all(i < j and line_of[i] != line_of[j] for i, j in pairs)
    for simplex in Delaunay(xy).simplices:
        a, b, c = (xy[k] for k in simplex)
        sides = sorted(float(np.sum((p - q) ** 2)) for p, q in ((a, b), (b, c), (a, c)))
        if sides[2] > sides[0] + sides[1] + 1e-6:  # obtuse, by the law of cosines
            edges = {
                tuple(sorted((int(simplex[i]), int(simplex[j]))))
                for i, j in ((0, 1), (1, 2), (0, 2))
            }
            assert not edges & set(pairs)


def test_photos_on_one_line_have_no_pairs_across():
    assert pairs_across(line(6), [[0, 1, 2], [3, 4, 5]]) == []


def test_middle_out_alternates():
    assert middle_out([0, 1, 2, 3, 4]) == [2, 3, 1, 4, 0]
    assert middle_out([7, 8]) == [7, 8]
    assert middle_out([9]) == [9]
    assert sorted(middle_out(list(range(24)))) == list(range(24))
