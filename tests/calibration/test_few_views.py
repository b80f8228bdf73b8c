"""One or two views, with priors: deviations that the truth respects, and words for what is open."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from skyquilt.calibration.few_views import FREE, FewViews, cannot_know
from skyquilt.calibration.workflow import CalibrateSettings, calibrate
from skyquilt.errors import RefusedError, UsageError
from skyquilt.model.camera import ADJUSTABLE
from skyquilt.simulate.board import Lamp, Sensor, sweep, tilted
from tests.calibration.boards import BOARD, CAMERA, CHESS, LENS, frontal, poses
from tests.calibration.test_calibrate import pose_of, view

SETTINGS = CalibrateSettings(columns=7, rows=6, square_m=0.1, few_views=True, jobs=1)
LOOSE = FewViews(focal_px=736.0, sigma_px=221.0)
"""What is guessed of a thermal picture 640 px wide; the truth is 690 px."""


def seen(pose, seed=0, noise=0.1, camera=CAMERA):
    return view("v", pose_of(pose), np.random.default_rng(seed), noise, camera=camera)


def test_one_tilted_view_narrows_the_focal_length_and_finds_k1():
    found = LOOSE([seen(poses()[0])], BOARD)
    assert abs(found.camera.focal - CAMERA.focal) < 2 * found.sigma("focal") < 0.2 * CAMERA.focal
    for name in ("cx", "cy", "k1", "k2"):
        off = getattr(found.camera, name) - getattr(CAMERA, name)
        assert abs(off) < 2.5 * found.sigma(name)
    assert found.camera.k3 == found.camera.p1 == 0 and found.sigma("k1") < 0.1


def test_a_board_that_is_not_tilted_leaves_the_prior():
    """Nothing tells the focal length from the distance."""
    found = LOOSE([seen(frontal())], BOARD)
    assert found.sigma("focal") / found.camera.focal > 0.15
    assert "Hardly determined" in (said := cannot_know(found, LOOSE)[0])
    assert "focal length" in said and "k1" not in said
    told = replace(LOOSE, focal_px=700.0, sigma_px=7.0)([seen(frontal())], BOARD)
    assert told.camera.focal == pytest.approx(700, abs=12) and told.sigma("focal") < 15


@pytest.mark.slow
def test_deviations_are_neither_too_small_nor_too_large():
    """24 tilted boards, lenses with principal points as they are made (9 px), the truth of each
    within its deviations.
    """
    z = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 5])
        off = rng.normal(0, 9, 2)
        camera = replace(
            CAMERA, focal=float(rng.uniform(600, 850)), cx=319.5 + off[0], cy=239.5 + off[1]
        )
        found = LOOSE([seen(poses(seed)[seed % 5], seed, camera=camera)], BOARD)
        z.append(
            [(getattr(found.camera, n) - getattr(camera, n)) / found.sigma(n) for n in FREE[:4]]
        )
    assert (np.mean(np.abs(z) < 2, axis=0) > 0.9).all()
    assert 0.3 < np.std(np.array(z)[:, 0]) < 1.3


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    """The frames of one sweep of a lamp over one board, as in Y 5.1."""
    folder = tmp_path_factory.mktemp("heated") / "frames"
    folder.mkdir()
    pose = tilted(24, 12, 3, (0.0, 0.0, 1.55))
    frames = sweep(LENS, CHESS, pose, Lamp(), Sensor(), np.random.default_rng([1, 9]))
    for k, frame in enumerate(frames):
        tifffile.imwrite(folder / f"f{k:03d}.tif", np.asarray(frame, np.float32) - 273.15)
    return folder


@pytest.mark.slow
def test_one_heated_sweep_is_a_calibration(heated, tmp_path):
    """Y Tables 6.2 and 6.3 rest on one."""
    with pytest.raises(RefusedError, match="add --few-views"):
        calibrate(heated, tmp_path / "no", replace(SETTINGS, few_views=False))
    m = calibrate(heated, tmp_path / "out", SETTINGS).metrics
    focal = m["centres"]["parameters"]["focal"]
    assert m["views_used"] == 1 and abs(focal["value"] - LENS.focal) < 2 * focal["sigma"]
    assert m["registration"] is None is m["centres"]["held_out_px"]
    # the centres are the better marks, as in the thesis: 0.36, 0.38 px against 0.49, 0.51
    assert max(m["centres"]["mean_error_px"]) < min(m["corners"]["mean_error_px"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert len(m["unknown"]) == 4 and "What so few views leave open" in page
    camera = next(iter(json.loads((tmp_path / "out" / "cameras.json").read_text()).values()))
    assert camera["width"] == 640
    # weighted as printed the board is found too, its marks less exactly
    asked = replace(SETTINGS, weights="printed")
    printed = calibrate(heated, tmp_path / "printed", asked).metrics
    assert printed["views_used"] == 1
    assert printed["centres"]["rms_px"] > m["centres"]["rms_px"]


def test_a_focal_length_needs_few_views():
    with pytest.raises(UsageError, match="--focal has no effect"):
        CalibrateSettings(columns=7, rows=6, square_m=0.1, focal_px=700)
    with pytest.raises(UsageError, match="--focal 1 lies outside"):
        replace(SETTINGS, focal_px=1.0)
    with pytest.raises(UsageError, match="'phi' is not one of contrast, printed"):
        replace(SETTINGS, weights="phi")
    with pytest.raises(ValueError, match="one size"):
        LOOSE([], BOARD)
    assert len(ADJUSTABLE) == 9
