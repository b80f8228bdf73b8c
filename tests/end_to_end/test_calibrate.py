"""`skyquilt calibrate` from a folder of frames to its files, and what it refuses."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from skyquilt.calibration.files import CONTRACT
from skyquilt.calibration.workflow import CalibrateSettings, calibrate, iter_calibrate
from skyquilt.errors import NoPhotosError, OutputError, RefusedError, UsageError
from skyquilt.model.event import Note
from skyquilt.photos.cameras_json import read_cameras_json
from skyquilt.simulate.board import tilted
from tests.calibration.boards import LENS, frame, frontal, poses

SETTINGS = CalibrateSettings(columns=7, rows=6, square_m=0.1, jobs=1)


def write(folder, name, image):
    folder.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(folder / name, np.asarray(image, np.float32) - 273.15)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("board") / "frames"
    for k, pose in enumerate(poses()):
        write(folder, f"view{k}.tif", frame(pose, seed=k))
    write(folder, "wall.tif", np.full((480, 640), 300.0))
    return folder


@pytest.fixture(scope="module")
def done(frames, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "calibration"
    return calibrate(frames, out, SETTINGS)


@pytest.mark.slow
def test_all_files_are_there_and_mosaic_can_read_the_camera(done):
    assert sorted(p.name for p in done.output.iterdir()) == sorted(CONTRACT)
    (camera,) = read_cameras_json(done.output / "cameras.json").values()
    sigma = done.metrics["centres"]["parameters"]["focal"]["sigma"]
    assert abs(camera.focal - LENS.focal) < 3 * sigma
    assert sigma < 0.01 * LENS.focal
    assert json.loads((done.output / "calibration.json").read_text())["views_used"] == 5


@pytest.mark.slow
def test_a_frame_without_a_board_is_named(done):
    assert list(done.metrics["views_rejected"]) == ["wall.tif"]
    assert "blank" in done.metrics["views_rejected"]["wall.tif"]
    page = (done.output / "report.html").read_text()
    assert "wall.tif" in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)


@pytest.mark.slow
def test_undistortion_makes_registration_better(done):
    figures = done.metrics["registration"]
    assert figures["mse_undistorted_px2"] < 0.5 * figures["mse_raw_px2"]


@pytest.mark.slow
def test_a_taken_folder_is_left_alone(done, frames):
    with pytest.raises(OutputError, match="--overwrite"):
        calibrate(frames, done.output, SETTINGS)
    with pytest.raises(UsageError, match="contains the frames"):
        calibrate(frames, frames, SETTINGS)


@pytest.mark.slow
def test_mixed_cameras_are_refused(tmp_path):
    write(tmp_path / "in", "a.tif", frame(frontal()))
    write(tmp_path / "in", "b.tif", frame(frontal())[:400, :500])
    with pytest.raises(RefusedError, match="1 of 640x480, 1 of 500x400"):
        calibrate(tmp_path / "in", tmp_path / "out", SETTINGS)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_too_few_views_are_refused_with_the_reasons(tmp_path):
    for k, shift in enumerate(((0, 0, 1.6), (0.1, 0, 1.7))):
        write(tmp_path / "in", f"whole{k}.tif", frame(frontal(shift=shift), seed=k))
    write(tmp_path / "in", "half.tif", frame(frontal(shift=(-0.55, 0, 1.5))))
    with pytest.raises(RefusedError) as refused:
        calibrate(tmp_path / "in", tmp_path / "out", SETTINGS)
    assert "found in 2 of 3 views" in str(refused.value)
    assert "half.tif: 6 x 6 squares were found" in str(refused.value)


@pytest.mark.slow
def test_few_views_that_are_many_or_none(frames, tmp_path):
    """What is said fits the option."""
    asked = replace(SETTINGS, few_views=True, focal_px=700.0)
    events = list(iter_calibrate(frames, tmp_path / "many", asked))
    (note,) = [e.text for e in events if isinstance(e, Note) and "no effect" in e.text]
    assert "5 views are enough" in note and "nor has --focal" in note
    write(tmp_path / "in", "wall.tif", np.full((480, 640), 300.0))
    with pytest.raises(RefusedError, match="one or more is needed") as refused:
        calibrate(tmp_path / "in", tmp_path / "none", asked)
    assert "--few-views" not in str(refused.value)


@pytest.mark.slow
def test_boards_that_are_never_tilted_are_refused(tmp_path):
    for k in range(3):
        pose = tilted(0, 0, 8 * k, (0.02 * k, 0, 1.7))
        write(tmp_path / "in", f"{k}.tif", frame(pose, seed=k, noise=0.3))
    with pytest.raises(RefusedError, match="tilt the board"):
        calibrate(tmp_path / "in", tmp_path / "out", SETTINGS)


def test_no_frames_and_wrong_words(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(NoPhotosError):
        calibrate(tmp_path / "empty", tmp_path / "out", SETTINGS)
    for wrong in (
        {"columns": 2},
        {"square_m": 0.0},
        {"square_m": float("nan")},
        {"series": "often"},
    ):
        with pytest.raises(UsageError):
            CalibrateSettings(**{"columns": 7, "rows": 6, "square_m": 0.1, **wrong})
    from skyquilt.cli.calibrate import parse_board

    assert parse_board("7x6") == (7, 6)
    for wrong in ("7", "7x", "sevenxsix", "7x6x5", "-7x6"):
        with pytest.raises(UsageError, match="7x6"):
            parse_board(wrong)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.long
def test_the_real_thermal_board(tmp_path):
    data = Path(__file__).resolve().parents[3] / "shared" / "data" / "thermal-board"
    if not data.is_dir():
        pytest.skip("the thermal board is not beside this checkout")
    m = calibrate(data, tmp_path / "out", SETTINGS).metrics
    assert m["views_used"] >= 46
    centres, corners = m["centres"], m["corners"]
    assert 0.3 < centres["rms_px"] < 0.6
    assert centres["held_out_px"]["centres"] < 0.8 * corners["held_out_px"]["corners"]
    focal = [c["parameters"]["focal"] for c in (centres, corners)]
    assert abs(focal[0]["value"] - focal[1]["value"]) < 2 * np.hypot(
        focal[0]["sigma"], focal[1]["sigma"]
    )
    assert m["registration"]["reduction_percent"] > 5
