"""A guessed focal length that is far too short, as of a long lens, is told by heights."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.aligners import Auto, ByLinks, by_pose
from skyquilt.alignment.crowded_positions import without_crowded
from skyquilt.model.photo import Focal
from tests.alignment.surveys import FOCAL
from tests.alignment.test_crowded_positions import LINES, at_one_place, inputs
from tests.alignment.test_oblique_start import Slanting


def flown(times, *, source="guess", seed=0, gps=1.5):
    """A flight whose lens is so many times as long as files or a guess have it."""
    survey = Slanting(LINES, seed=seed, gps=gps)
    px = FOCAL / times
    told = Focal(px=px, sigma_px=0.25 * px, source=source)
    survey.photos = [replace(p, focal=told) for p in survey.photos]
    return survey


def aligned(survey, priors):
    return Auto(bundle=ByLinks(), pose=by_pose(None, repair=True))(inputs(survey, priors))


@pytest.mark.slow
@pytest.mark.parametrize(("times", "gps"), [(3.0, 1.5), (6.0, 0.5)])
def test_heights_and_positions_tell_it(times, gps):
    survey = flown(times, gps=gps)
    found = aligned(survey, survey.priors)
    assert len(found.held) == len(survey.photos)
    (camera,) = found.cameras.values()
    assert camera.focal == pytest.approx(FOCAL, rel=0.05)
    (note,) = [n for n in found.notes if "No file tells the focal length" in n]
    assert "about" in note
    high = np.median([found.poses[i].map_C[2] - found.ground_m for i in found.held])
    assert high == pytest.approx(44, rel=0.05)  # above ground of a metre


@pytest.mark.slow
@pytest.mark.parametrize(
    ("times", "source", "heights"), [(1.3, "guess", True), (3.0, "guess", False)]
)
def test_a_usual_lens_and_heights_that_are_not_told_change_nothing(times, source, heights):
    survey = flown(times, source=source)
    priors = survey.priors
    if not heights:
        priors = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in priors]
    found = aligned(survey, priors)
    assert not any("No file tells the focal length" in n for n in found.notes)


def test_positions_that_lie_as_pictures_show_do_not_crowd():
    """The pictures of a long lens show photos too far apart; those of the remote control lie about
    without order.
    """
    survey = flown(8.0)
    near = [replace(p, sigma_C=np.array([9.0, 9.0, 12.0])) for p in survey.priors]
    given = inputs(survey, near)
    assert without_crowded(given) == (given, ())
    remote = at_one_place(survey, 3.0)
    assert without_crowded(inputs(survey, remote))[1]
