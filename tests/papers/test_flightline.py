"""`flightline` on surveys of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.errors import AlignmentError
from skyquilt.papers.best_matches import Best
from skyquilt.papers.flightline import ByFlightline
from skyquilt.papers.ste import RansacSte
from tests.alignment.flights import FRAME, fly, lawn, line
from tests.papers.test_chain import ground_error


def run(flight, **more):
    method = ByFlightline(
        within=Best(count=150),
        across=Best(count=50),
        estimate=RansacSte(max_iterations=200),
        **more,
    )
    return method(flight.photos, FRAME, flight.priors, flight.features, range(len(flight.photos)))


@pytest.mark.slow
@pytest.mark.parametrize("heading", [57.0, 0.0, 90.0, 200.0])
def test_lines_of_any_direction_become_one_mosaic_in_its_place(heading):
    turn = np.radians(heading)
    rotate = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    flight = fly(lawn(3, 5, step=20.0, apart=30.0) @ rotate.T, yaw=heading, points=6000)
    found = run(flight)
    assert found.blocks == (tuple(range(15)),) and not found.rejected
    assert any("3 flight lines: 5, 5, 5 photos" in n for n in found.notes)
    assert 0.001 < ground_error(flight, found, free=False) < 0.5


@pytest.mark.slow
def test_photos_that_look_back_along_every_other_line_are_no_matter():
    yaw = np.repeat([0.0, 180.0, 0.0], 5)
    flight = fly(lawn(3, 5, step=20.0, apart=30.0), yaw=yaw, points=6000)
    assert ground_error(flight, run(flight), free=False) < 0.5


@pytest.mark.slow
def test_the_regression_averages_the_errors_of_positions():
    flight = fly(lawn(4, 6, step=20.0, apart=30.0), gps=1.0, points=8000, seed=2)
    found = run(flight)
    # an affinity has 6 parameters, 24 photos tell 48 numbers: what is left of 1 m is about sqrt(6 /
    # 48)
    assert 0.1 < ground_error(flight, found, free=False) < 1.2


@pytest.mark.slow
def test_the_faithful_variant_refuses_a_line_that_turns_back():
    flight = fly(lawn(4, 5, step=25.0, apart=25.0))
    with pytest.raises(
        AlignmentError, match=r"P000.jpg to P019.jpg form one flight line that turns back \d+ times"
    ):
        run(elsewhere(flight, zigzag()), split="distance")
    assert len(run(flight, split="heading").poses) == 20


def elsewhere(flight, xy):
    """The flight as if reported elsewhere."""
    priors = [
        replace(p, map_C=np.array([*q, 60.0])) for p, q in zip(flight.priors, xy, strict=True)
    ]
    return replace(flight, priors=priors)


def zigzag():
    """Twenty places along a line flown to and fro four times: equal steps, three turns back."""
    rows = [line(5, 25.0, start=(0.0, 0.0)), line(5, 25.0, start=(15.0, 120.0), heading=180.0)]
    rows += [line(5, 25.0, start=(30.0, 0.0)), line(5, 25.0, start=(45.0, 120.0), heading=180.0)]
    return np.concatenate(rows)


def test_what_it_cannot_do_is_refused_with_a_sentence():
    with pytest.raises(AlignmentError, match="8 positions show 1"):
        run(fly(line(8)))
    flight = fly(lawn(2, 4))
    flight.priors = [replace(p, map_C=np.array([np.nan, np.nan, 60.0])) for p in flight.priors]
    with pytest.raises(AlignmentError, match="0 photos have one"):
        run(flight)


@pytest.mark.slow
def test_a_photo_without_position_is_left_out_and_said_so():
    flight = fly(lawn(3, 5, step=20.0, apart=30.0), points=6000)
    flight.priors[7] = replace(flight.priors[7], map_C=np.array([np.nan, np.nan, 60.0]))
    found = run(flight)
    assert "no position" in found.rejected[7] and len(found.poses) == 14


@pytest.mark.slow
def test_a_line_that_nothing_links_is_left_out_by_name():
    xy = np.concatenate([lawn(2, 5, step=20.0, apart=30.0), line(5, 20.0, start=(400.0, 0.0))])
    flight = fly(xy, points=9000)
    found = run(flight)
    assert set(found.rejected) == {10, 11, 12, 13, 14} and any(
        "P010.jpg to P014.jpg" in n for n in found.notes
    )


@pytest.mark.slow
def test_lines_around_a_field_are_joined_at_its_corners():
    sides = [
        line(6, 20.0),
        line(5, 20.0, start=(20.0, 100.0), heading=90.0),
        line(5, 20.0, start=(100.0, 80.0), heading=180.0),
        line(4, 20.0, start=(80.0, 0.0), heading=270.0),
    ]
    flight = fly(np.concatenate(sides), gps=0.5, points=6000)
    found = run(flight)
    assert len(found.poses) == 20 and not found.rejected
    assert ground_error(flight, found, free=False) < 1.5
