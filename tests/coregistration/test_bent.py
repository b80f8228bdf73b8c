"""Pictures that a lens bends: the oracle is the distortion that they were given."""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.agreement import Shifts
from skyquilt.coregistration.bent import Bending
from skyquilt.coregistration.methods import registration_method
from skyquilt.model.registration import Picture
from tests.coregistration.scenes import error, pair, turned

SHAPE = (240, 288)
TRUTH = turned(0.97, 6.0, SHAPE, SHAPE, (5.0, -7.0))


def bent(picture, share):
    """The picture with corners moved towards its middle (share > 0: barrel) or away from it."""
    height, width = picture.shape
    y, x = np.mgrid[:height, :width]
    seen = np.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1)
    unit = np.hypot(width, height) / 2
    true = seen.copy()
    for _ in range(40):
        true = seen / (1 - share * ((true / unit) ** 2).sum(-1, keepdims=True))
    true = (true + [(width - 1) / 2, (height - 1) / 2]).astype(np.float32)
    return cv2.remap(picture, true[..., 0], true[..., 1], cv2.INTER_LINEAR)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.2, -0.2])
def test_a_picture_that_a_lens_bends_is_refused_with_this_reason(share):
    a, b = pair(TRUTH, SHAPE, seed=12, shape_a=SHAPE)
    outcome = registration_method("auto")(Picture(values=a), Picture(values=bent(b, share)))
    assert not outcome
    assert "bent by its lens" in outcome.reason


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_one_that_is_bent_by_little_is_registered(share):
    a, b = pair(TRUTH, SHAPE, seed=12, shape_a=SHAPE)
    outcome = registration_method("auto")(Picture(values=a), Picture(values=bent(b, share)))
    assert outcome
    assert error(outcome.b_H_a, TRUTH, SHAPE) < 0.5 + 0.02 * np.hypot(*SHAPE) * (share > 0)


@pytest.mark.parametrize("radial", [0.0, 25.0, -25.0])
def test_the_departure_is_that_of_the_shifts(radial):
    rng = np.random.default_rng(1)
    shape, unit = (240, 280), np.hypot(240, 280) / 2
    y, x = np.meshgrid(np.linspace(20, 220, 7), np.linspace(20, 260, 7))
    px = np.c_[x.ravel(), y.ravel()]
    q = (px - [139.5, 119.5]) / unit
    true = radial * q * (q**2).sum(1, keepdims=True) + [0.6, -0.4]
    shift = true + rng.normal(0, 0.3, px.shape)
    shift[::7] = rng.uniform(-12, 12, shift[::7].shape)  # patches that match anywhere
    corners = np.array([[0.0, 0], [279, 0], [0, 239], [279, 239]])
    found = Bending()(Shifts(px=px, shift=shift, width=np.ones(len(px))), shape, corners)
    if radial == 0:
        assert found is None
    else:
        assert found == pytest.approx(abs(radial), abs=3.0)
