"""Two blocks joined by pairs of their photos: one flight against itself, in reversed contrast, in
another frame.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.settings import MosaicSettings
from skyquilt.thermal.by_pairs import by_homographies, by_pairs, overlapping, registered_of
from skyquilt.workflows.mosaic import make_map
from skyquilt.workflows.survey_input import read_input

SETTINGS = MosaicSettings(gsd_cm=15, jobs=2)
OFF = (2.1, -1.2)
"""m by which the other block lies wrong, east and north."""


@pytest.fixture(scope="module")
def scene(flight, tmp_path_factory):
    output = tmp_path_factory.mktemp("pairs") / "out"
    given = read_input(flight / "photos", SETTINGS.input)
    return result_of(make_map(given, output, SETTINGS)).scene()


@pytest.fixture(scope="module")
def other(scene):
    """The same block in negative, its frame displaced."""
    x, y = scene.aligned.alignment.frame.origin
    placed = in_frame(scene, (x + OFF[0], y + OFF[1]))
    pixels = scene.aligned.pixels
    return replace(placed, aligned=replace(placed.aligned, pixels=lambda i: 255 - pixels(i)))


def in_frame(scene, origin):
    alignment = scene.aligned.alignment
    moved = replace(alignment, frame=replace(alignment.frame, origin=origin))
    return replace(scene, aligned=replace(scene.aligned, alignment=moved))


@pytest.mark.slow
def test_a_misplaced_block_is_brought_back(scene, other):
    asked = overlapping(scene, other)
    assert 5 <= len(asked) <= 9
    found = by_pairs(scene, other)
    assert found and found.evidence["pairs_registered"] >= 5
    grid = scene.ground.grid
    px = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.6, 0.6]]) * (grid.width, grid.height)
    moved = np.c_[px, np.ones(4)] @ found.b_H_a.T
    # both maps have the same grid about their origins, so that right places are equal pixels
    assert np.linalg.norm(moved[:, :2] / moved[:, 2:] - px, axis=1).max() < 1.0


@pytest.mark.slow
def test_one_pair_suffices_by_homographies(scene, other, monkeypatch):
    """(5.7) as written, with all pairs and with one: level ground leaves some px, one pair more."""
    grid = scene.ground.grid
    px = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.6, 0.6]]) * (grid.width, grid.height)
    offs = []
    for most in (24, 1):
        monkeypatch.setattr("skyquilt.thermal.by_pairs.MOST_PAIRS", most)
        found = by_homographies(scene, other)
        assert found and found.model == "homography"
        moved = np.c_[px, np.ones(4)] @ found.b_H_a.T
        offs.append(np.linalg.norm(moved[:, :2] / moved[:, 2:] - px, axis=1))
        assert found.evidence["pairs_registered"] == (1 if most == 1 else pytest.approx(7, abs=2))
    assert offs[0].max() < 2.0 and np.median(offs[1]) < 6.0


@pytest.mark.slow
def test_blocks_that_share_no_ground_are_refused(scene, other):
    far = other.aligned.alignment.frame.origin[0] + 5000
    found = by_pairs(scene, in_frame(other, (far, 0.0)))
    assert not found and found.reason.startswith("0 of 0 overlapping pairs")


def tries(near, anywhere, count=24):
    """What is found of pairs numbered 0 to `count`, and which are sought anywhere."""
    sought = []

    def far(k):
        sought.append(k)
        return f"far {k}" if k in anywhere else None

    found = registered_of(
        [(k,) for k in range(count)], lambda k: f"near {k}" if k in near else None, far
    )
    return found, sought


def test_pairs_are_not_all_sought_everywhere():
    """Flights over different places took 100 s: each of 24 pairs was sought in all directions."""
    assert tries({3, 5, 11}, {4}) == (["near 3", "near 5", "near 11"], [])
    found, sought = tries({3}, {4, 9})
    assert found == ["near 3", "far 4", "far 9"]
    assert sorted(sought) == [k for k in range(24) if k != 3]
    found, sought = tries({3}, ())  # one alone is chance, and took as long as all
    assert found == ["near 3"] and len(sought) == 8 and 3 not in sought
    found, sought = tries((), ())
    assert not found and len(sought) == 8 and {0, 23} <= set(sought)
    found, sought = tries((), set(range(0, 24, 3)))
    assert found == [f"far {k}" for k in range(0, 24, 3)] and sorted(sought) == list(range(24))
    assert len(sought) == 24
    assert tries((), (), count=0) == ([], []) and tries((), {0, 1}, count=2)[1] == [0, 1]
