"""Areas and objects as features: against outlines that are known."""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.shapes import ShapeMatches, found_shapes
from skyquilt.coregistration.usable import usable
from skyquilt.model.registration import Picture
from tests.coregistration.scenes import error, pair, turned

SHAPE = (400, 480)


def drawn(scale=1.0, degrees=0.0, at=(150, 140), dark=False):
    """One L-shaped area of a known place and size."""
    corners = np.array([[-30, -40], [0, -40], [0, 10], [40, 10], [40, 40], [-30, 40]], float)
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    placed = corners @ np.array([[c, s], [-s, c]]) + at
    picture = np.full((300, 320), 200 if dark else 60, np.uint8)
    cv2.fillPoly(picture, [np.rint(placed).astype(np.int32)], 60 if dark else 200)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


def only(picture):
    found = found_shapes(picture, np.ones(picture.shape, bool), 0.002, 0.3)
    assert 1 <= len(found.px) <= 2  # blurred edges may give a second one, a little smaller
    return found.first(1)


@pytest.mark.parametrize(
    ("scale", "degrees", "dark"), [(1.4, 0, False), (1.0, 75, True), (0.8, 200, True)]
)
def test_an_area_is_described_alike_wherever_it_lies(scale, degrees, dark):
    """Its centroid and size against the pixels drawn, its outline against the same area upright."""
    upright, picture = only(drawn()), drawn(scale, degrees, (160, 150), dark)
    found = only(picture)
    y, x = np.nonzero((picture < 130) == dark)
    assert np.linalg.norm(found.px[0] - [x.mean(), y.mean()]) < 1.0
    assert found.size[0] == pytest.approx(np.sqrt(len(x)), rel=0.09)
    assert np.linalg.norm(found.outline[0] - upright.outline[0]) < 0.12
    turn = np.degrees(found.angle[0] - upright.angle[0]) - degrees
    assert abs((turn + 90) % 180 - 90) < 6


def test_areas_cut_by_what_is_not_valid_are_left_out():
    valid = np.ones((300, 320), bool)
    valid[:, :150] = False
    assert not len(found_shapes(drawn(), valid, 0.002, 0.3).px)


def test_pictures_of_two_spectra_are_brought_together():
    truth = turned(0.9, 130.0, SHAPE, SHAPE, (5.0, -8.0))
    a, b = pair(truth, seed=16)
    proposal = ShapeMatches()(usable(Picture(values=a)), usable(Picture(values=b)))
    assert proposal.b_H_a is not None and proposal.matches >= 8
    assert error(proposal.b_H_a, truth) < 6
    found = registration_method("shapes")(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.5 and found.error is not None


def test_without_areas_there_is_a_reason():
    flat = np.tile(np.linspace(20, 230, 480), (400, 1)).astype(np.uint8)
    refused = registration_method("shapes")(Picture(values=flat), Picture(values=flat))
    assert not refused and "areas were found" in refused.reason
