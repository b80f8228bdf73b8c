"""The first stage of the adjustment of large surveys."""

import numpy as np
import pytest

from skyquilt.alignment import stages
from skyquilt.engine.kept import Keep
from tests.alignment.blocks import make_block

WIDE = np.array([40.0, 15.0, 15.0, 0.15, 0.1, 0.01, 1e-3, 1e-3, 3e-3, 1e-3])
"""Deviations of a lens of which little is known."""


def stepped(problem, state):
    """The first stage, and the number of steps of all photos."""
    names = []

    def held(part, make):
        names.append(part)
        return make()

    return *stages.rough(problem, state, Keep(held=held)), len(names)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_some_photos_of_a_large_survey_tell_its_lens_first(monkeypatch, seed, cameras):
    """The whole ends where it ends without them, in fewer steps."""
    block = make_block(
        seed, lines=8, per_line=8, points=900, lies=0.02, cameras=cameras, sigma_k=WIDE
    )
    problem, sure, many = stepped(block.problem, block.start)
    monkeypatch.setattr(stages, "ASKED", 24)
    found, state, few = stepped(block.problem, block.start)
    assert few <= 0.7 * many
    assert abs(len(found.px) - len(problem.px)) < 0.002 * len(problem.px)
    one, other = stages.fine(problem, sure)[1], stages.fine(found, state)[1]
    assert np.abs(other.K - one.K)[:, 0].max() < 0.03 * WIDE[0]
    assert np.abs(other.C - one.C).max() < 0.1 * np.abs(block.start.C - block.truth.C).max()


def test_photos_that_stand_for_all_are_of_each_camera(monkeypatch):
    """Neighbours at four places; of several cameras each at one place at least."""
    monkeypatch.setattr(stages, "ASKED", 16)
    for cameras, places in ((1, 4), (2, 4), (3, 3), (5, 5)):
        block = make_block(0, lines=12, per_line=10, points=50, cameras=cameras)
        chosen = stages._places_of(block.problem, block.start)
        assert set(block.problem.camera[chosen]) == set(range(cameras))
        assert 3 * places <= len(chosen) <= 4 * places
        apart = np.linalg.norm(block.start.C[chosen, None, :2] - block.start.C[chosen, :2], axis=2)
        near = np.sort(apart + np.eye(len(apart)) * 1e9, axis=1)[:, 0]
        assert near.max() < 40 and apart.max() > 60
