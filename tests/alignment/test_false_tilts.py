"""Tilts that nobody measured are not believed; measured ones are, whatever else is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment import repairs
from skyquilt.alignment.false_tilts import told_no_tilt
from tests.alignment.test_bundle import Flown


def off(found, flown):
    """Angles (n,) in degrees of the axes from the true ones."""
    cosine = [found.poses[i].cam_R_map[2] @ flown.truth.R[i][2] for i in sorted(found.poses)]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_a_fixed_camera_that_claims_to_look_straight_down(seed, monkeypatch):
    """The aircraft leans by 8 degrees; files say 0, as exactly as those of a gimbal do. What is
    found then is what is found where files do not tell.
    """
    flown = Flown(seed, lines=4, per_line=6, points=900, true_tilt_deg=8.0)
    flown.priors = [replace(p, pitch_deg=0.0, roll_deg=0.0) for p in flown.priors]
    found = flown.aligned()
    assert sum("tilts of the camera contradict" in n for n in found.notes) == 1
    monkeypatch.setattr(repairs, "told_no_tilt", lambda found, priors: (priors, ""))
    believing = flown.aligned()
    flown.priors = [replace(p, sigma_tilt_deg=8.0) for p in flown.priors]
    untold = flown.aligned()
    errors = [np.median(off(f, flown)) for f in (found, believing, untold)]
    assert errors[0] < 0.8 * errors[1]
    assert errors[0] == pytest.approx(errors[2], abs=0.1)


@pytest.mark.parametrize(
    "wrong", ["nothing", pytest.param("yaws", marks=pytest.mark.slow), "few", "untold"]
)
def test_tilts_that_are_right_stay(wrong):
    flown = Flown(4, lines=4, per_line=6, points=900, true_tilt_deg=8.0)
    if wrong == "yaws":
        flown.priors = [replace(p, yaw_deg=p.yaw_deg + 180) for p in flown.priors]
    if wrong == "few":
        some = [replace(p, pitch_deg=0.0, roll_deg=0.0) for p in flown.priors[:8]]
        flown.priors = [*some, *flown.priors[8:]]
    if wrong == "untold":
        flown.priors = [
            replace(p, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=6.0) for p in flown.priors
        ]
    found = flown.aligned()
    assert told_no_tilt(found, flown.priors) == (flown.priors, "")
    assert not any("tilts of the camera" in n for n in found.notes)
