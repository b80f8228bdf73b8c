"""Where few photos have positions, nothing shows what these are worth, and a note says so."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.alignment.outcome import unconfirmed


def told(number, positions, points=0):
    C0, X0 = np.full((number, 3), np.nan), np.full((9, 3), np.nan)
    C0[:positions], X0[:points] = 0.0, 0.0
    setup = SimpleNamespace(stated_sigma_C=np.full((number, 3), 1.5))
    return unconfirmed(setup, SimpleNamespace(C0=C0, X0=X0))


@pytest.mark.parametrize(
    ("number", "positions", "words"),
    [(20, 1, "the position of one of 20"), (20, 5, "the positions of 5 of 20"), (5, 2, "2 of 5")],
)
def test_a_map_that_rests_on_few_positions_of_many_photos_says_so(number, positions, words):
    (note,) = told(number, positions)
    assert words in note and "(1.5 m)" in note


@pytest.mark.parametrize(
    ("number", "positions", "points"), [(20, 20, 0), (20, 6, 0), (20, 0, 0), (4, 2, 0), (20, 3, 4)]
)
def test_enough_positions_none_and_control_points_need_no_such_note(number, positions, points):
    """Six positions and more show by their scatter what they are worth."""
    assert told(number, positions, points) == ()
