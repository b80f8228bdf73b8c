"""Thresholds of `image` by relief and height (Y 4.9), and by the width of the photos."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.errors import UsageError
from skyquilt.matching.levelled import Level
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.ransac import Ransac
from skyquilt.papers import aligners
from skyquilt.papers.aligners import ByImage, image
from skyquilt.papers.chain import Chain
from skyquilt.papers.plane_registration import at_share
from skyquilt.settings import MosaicSettings
from tests.alignment.flights import FRAME, fly, line

ELLIPSOID = replace(FRAME, vertical_datum="ellipsoid")
"""Heights above the ellipsoid are no heights above the ground."""


def inputs(flight, frame=ELLIPSOID, **more):
    given = AlignmentInputs(
        photos=flight.photos,
        features=flight.features,
        frame=frame,
        priors=flight.priors,
        links=(),
        control=(),
        order=range(len(flight.photos)),
        grey=flight.grey,
    )
    return replace(given, **more)


@pytest.fixture
def used(monkeypatch):
    """The levelling that the last search was called with."""
    seen = []
    real = aligners._placed

    def placed(method, given):
        seen.append(method.level)
        return real(method, given)

    monkeypatch.setattr(aligners, "_placed", placed)
    return seen


def test_a_relief_without_a_height_is_divided_by_the_height_that_positions_give(used):
    """The flight is 60 m above the ground, which its priors (above the ellipsoid) do not say."""
    flight = fly(line(6), gps=0.3)
    image(MosaicSettings(method="image", relief_m=9.0))(inputs(flight))
    assert used[-1].height_m == pytest.approx(60.0, rel=0.02)
    eps = used[-1](np.zeros((9, 2)), np.zeros((9, 2)), _estimate(9)).eps_px
    assert eps == 8  # ceil(50 * 9 / 60); without a height it would be that of a tenth, 5


def _estimate(count):
    px = np.random.default_rng(0).uniform(0, 1500, (count, 2))
    return Ransac(model="similarity", minimum=3)(px, px)


def test_a_height_that_is_known_is_used_as_it_is(used):
    image(MosaicSettings(method="image", relief_m=9.0, height_m=45.0))(inputs(fly(line(3))))
    assert len(used) == 1 and used[-1].height_m == 45.0
    image(MosaicSettings(method="image", relief_m=9.0))(inputs(fly(line(3)), frame=FRAME))
    assert used[-1].height_m == 60.0  # above take-off


def test_without_a_relief_nothing_is_made_twice(used):
    image(MosaicSettings(method="image"))(inputs(fly(line(3))))
    assert len(used) == 1 and used[-1].height_m is None


def test_a_relief_that_nothing_can_be_made_of_is_refused():
    flight = fly(line(4))
    blind = [replace(p, map_C=np.full(3, np.nan)) for p in flight.priors]
    given = inputs(flight, frame=replace(ELLIPSOID, crs=None), priors=blind)
    with pytest.raises(UsageError, match="--relief .* add --height"):
        image(MosaicSettings(method="image", relief_m=2.0))(given)


@pytest.mark.parametrize("share", [1.5, 1.0, 0.4, 0.1])
def test_thresholds_shrink_with_the_width(share):
    estimate, level = at_share(Ransac(threshold_px=6.0), Level(relief_m=4, height_m=40), share)
    assert estimate.threshold_px == pytest.approx({0.4: 2.4, 0.1: 1.0}.get(share, 6.0))
    assert level.width == {0.4: 600, 0.1: 150}.get(share, 1500)


def test_a_smaller_photo_is_judged_by_smaller_thresholds():
    """Two photos, 800 px wide: 6 px of 1500 are 3.2 px of theirs. A quarter of the matches lies 5
    px off.
    """
    flight = fly(line(2), noise_px=0.1, points=2000)
    b = flight.features[1]
    moved = np.arange(len(b.px)) % 4 == 0
    features = [flight.features[0], replace(b, px=b.px + np.where(moved[:, None], (0, 5.0), 0))]
    method = Chain(
        match=Mutual(), estimate=Ransac(model="similarity", threshold_px=6.0, minimum=12)
    )
    found = ByImage(method=method)(inputs(replace(flight, features=features)))
    (join,) = found.joins
    assert join.inliers == pytest.approx(0.75 * join.matches, rel=0.08)
    assert np.abs(join.d_px).max() < 3.3
