"""Areas and objects as features: against outlines that are known."""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.shapes import ShapeMatches, _described
from skyquilt.coregistration.usable import usable
from skyquilt.model.registration import Picture
from tests.coregistration.scenes import error, layout, pair, spectrum, turned

SHAPE = (400, 480)


def drawn(scale=1.0, degrees=0.0, at=(150, 140)):
    """Mask of one L-shaped area of a known place and size."""
    corners = np.array([[-30, -40], [0, -40], [0, 10], [40, 10], [40, 40], [-30, 40]], float)
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    placed = corners @ np.array([[c, s], [-s, c]]) + at
    return cv2.fillPoly(np.zeros((300, 320), np.uint8), [np.rint(placed).astype(np.int32)], 1)


def described(mask):
    """Centroid, size, angle, lengths of Fourier coefficients."""
    return _described(np.argwhere(mask)[:, ::-1].astype(np.int32))


@pytest.mark.parametrize(("scale", "degrees"), [(1.4, 0), (1.0, 75), (0.8, 200)])
def test_an_area_is_described_alike_wherever_it_lies(scale, degrees):
    upright, mask = described(drawn()), drawn(scale, degrees, (160, 150))
    found = described(mask)
    y, x = np.nonzero(mask)
    assert found[:2] == pytest.approx([x.mean(), y.mean()])
    assert found[2] == pytest.approx(np.sqrt(mask.sum()))
    assert np.linalg.norm(found[4:] - upright[4:]) < 0.08
    turn = np.degrees(found[3] - upright[3]) - degrees
    assert abs((turn + 90) % 180 - 90) < 4


def test_another_area_is_described_differently():
    upright = described(drawn())
    disc = described(cv2.circle(np.zeros((300, 320), np.uint8), (150, 140), 40, 1, -1))
    assert np.linalg.norm(disc[4:] - upright[4:]) > 0.3


@pytest.mark.slow
def test_pictures_of_two_spectra_are_brought_together():
    truth = turned(0.9, 130.0, SHAPE, SHAPE, (5.0, -8.0))
    a, b = pair(truth, seed=16)
    proposal = ShapeMatches()(usable(Picture(values=a)), usable(Picture(values=b)))
    assert proposal.b_H_a is not None and proposal.matches >= 8
    assert error(proposal.b_H_a, truth) < 6
    found = registration_method("shapes")(Picture(values=a), Picture(values=b))
    assert found and error(found.b_H_a, truth) < 0.5 and found.error is not None


def test_other_places_are_refused():
    a = np.clip(spectrum(layout(seed=20), 1), 0, 255).astype(np.uint8)
    b = np.clip(spectrum(layout(seed=21), 1), 0, 255).astype(np.uint8)
    refused = registration_method("shapes")(Picture(values=a), Picture(values=b))
    assert not refused and refused.reason
