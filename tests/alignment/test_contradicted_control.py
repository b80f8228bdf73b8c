"""Control points that cannot be right are told by name and amount, and right ones are not."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.contradicted_control import control_notes
from skyquilt.geometry.geoid import geoid_height
from skyquilt.model.photo import GeoPosition
from skyquilt.model.poses import ControlResidual
from tests.alignment.surveys import alignment, photo, prior
from tests.alignment.test_bundle import Flown, surveyed

SIGMA_M = np.array([0.04, 0.04, 0.1])
"""Deviations that an adjustment predicts of a point."""


def point(name="g", error=(0.0, 0.0, 0.0), px=0.4, *, check=False, sigma=SIGMA_M):
    return ControlResidual(
        name=name,
        check=check,
        error_m=np.array(error, float),
        reprojection_px=px,
        observations=4,
        sigma_m=sigma,
    )


def usual(seed=0, times=1.0, count=6):
    """Points that err as is predicted, or some times as much."""
    rng = np.random.default_rng(seed)
    return [point(f"g{k}", times * SIGMA_M * rng.normal(size=3)) for k in range(count)]


def notes(points, *, shift=(0.0, 0.0), sigma=1.5, at=None, datum="control"):
    """Notes on points that hold a map, whose photos report to be `shift` beside their places."""
    found = alignment(8)
    found = replace(found, control=tuple(points), frame=replace(found.frame, vertical_datum=datum))
    told = [prior(p.map_C - (*shift, 0.0), sigma=sigma) for p in found.poses.values()]
    return control_notes(found, [photo(position=at) for _ in told], told)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("times", [1.0, 4.0])
def test_points_that_err_as_surveys_do_are_not_told(seed, times):
    assert notes(usual(seed, times)) == ()


@pytest.mark.parametrize("check", [False, True])
@pytest.mark.parametrize("error", [(10.0, 0.0, 0.0), (0.0, 0.0, -10.0), (10.0, 0.0, np.nan)])
def test_a_point_that_lies_elsewhere_is_named_with_its_amount(check, error):
    (said,) = notes([*usual(), point("corner", error, check=check)])
    assert "corner (10 m off)" in said and "g1" not in said


def test_points_of_exchanged_names():
    said = notes([*usual(), point("a", (80, 0, 0)), point("b", (-80, 0, 0))])
    assert "a (80 m off), b (80 m off)" in said[0] and len(said) == 1


def test_marks_that_do_not_belong_together():
    (said,) = notes([*usual(), point("corner", (2.0, 0.0, 0.0), px=24.0)])
    assert "corner (24 px)" in said


@pytest.mark.parametrize("px", [80.0, np.nan, 1e11])
def test_where_most_marks_are_wrong_how_pixels_are_counted_is_told(px):
    (said,) = notes([point(f"g{k}", (9.0, 3.0, np.nan), px=px) for k in range(5)])
    assert "5 of 5" in said and "upper left corner" in said


def test_where_most_points_lie_off_none_is_blamed():
    (said,) = notes(usual(times=60.0))
    assert "one another" in said and "g1" not in said


@pytest.mark.parametrize(
    ("shift", "sigma", "told"), [((300, -40), 1.5, "303 m"), ((9, 0), 1.5, ""), ((60, 0), 30, "")]
)
def test_a_map_far_from_the_photos_positions(shift, sigma, told):
    said = notes(usual(), shift=shift, sigma=sigma)
    assert len(said) == bool(told)
    assert told in "".join(said)


@pytest.mark.parametrize(("height", "told"), [(61.0, ""), (85.0, ""), (999.0, "939 m lower")])
def test_heights_far_from_those_that_photos_report(height, told):
    """Photos lie at 60 m by the points."""
    at = GeoPosition(
        latitude_deg=50.8, longitude_deg=-0.14, altitude_m=height, datum="egm96", sea_level_m=height
    )
    said = notes(usual(), at=at)
    assert len(said) == bool(told) and told in "".join(said)
    over = float(geoid_height(50.8, -0.14))
    assert over > 40  # so that heights above the ellipsoid, taken for others, are told
    on = replace(at, altitude_m=60 - over, sea_level_m=60 - over)
    assert f"{over:.0f} m higher" in "".join(notes(usual(), at=on))
    assert notes(usual(), at=on, datum="ellipsoid") == ()


def test_without_points_or_a_place_nothing_is_told():
    assert notes([]) == ()
    found = alignment(8, crs=None)
    assert control_notes(replace(found, control=(point(px=99.0),)), [], []) == ()


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_one_wrong_point_of_a_flight_is_named_and_bends_nothing():
    flown = Flown(6)
    control = surveyed(flown)
    good = flown.aligned(control=control)
    control[4] = replace(control[4], xyz=control[4].xyz + (3.0, 0, 0))
    bad = flown.aligned(control=control)
    assert control_notes(good, flown.photos, flown.priors) == ()
    (said,) = control_notes(bad, flown.photos, flown.priors)
    assert "g4 (3 m off)" in said
    for i in good.poses:
        assert bad.poses[i].map_C == pytest.approx(good.poses[i].map_C, abs=0.2)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_points_without_heights_leave_the_map_its_own():
    flown = Flown(6)
    flat = [replace(c, xyz=np.r_[c.xyz[:2] + (1.5, -2), np.nan]) for c in surveyed(flown)]
    found = flown.aligned(control=flat)
    shift = np.mean([p.map_C - flown.truth.C[i] for i, p in found.poses.items()], axis=0)
    assert shift[:2] == pytest.approx([1.5, -2], abs=0.3) and abs(shift[2]) < 3
