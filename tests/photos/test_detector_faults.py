"""Faults of thermal detectors: the oracle is the frame before it was damaged."""

import cv2
import numpy as np
import pytest
import tifffile

from skyquilt.photos.detector_faults import FindFaults, repaired
from skyquilt.photos.pixels import read_color
from skyquilt.settings import InputSettings
from skyquilt.workflows.survey_input import read_input

H, W, NOISE = 120, 160, 0.03
COLUMNS, ROW = (51, 52, 110), 70


def flight(count=12, seed=0, turn=2.0, step=23, paint=None):
    """Frames (H, W) in degrees Celsius along a line over fields, roads and houses."""
    rng = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(rng.normal(0, 1, (1200, 400)).astype(np.float32), (0, 0), 3) * 8 + 20
    for _ in range(120):
        x, y, w, h = rng.integers((0, 0, 5, 5), (390, 1190, 60, 60))
        ground[y : y + h, x : x + w] += rng.normal(0, 4)
    if paint is not None:
        paint(ground)
    ground = cv2.GaussianBlur(ground, (0, 0), 0.7)
    frames = []
    for k in range(count):
        at = cv2.getRotationMatrix2D((W / 2, H / 2), rng.normal(0, turn), 1)
        at[:, 2] -= at[:, :2] @ (120 + rng.normal(0, turn), 300 + k * step)
        seen = cv2.warpAffine(ground, at, (W, H), flags=cv2.INTER_LINEAR)
        frames.append((seen + rng.normal(0, NOISE, seen.shape)).astype(np.float32))
    return frames


def some(share, seed=5):
    return np.random.default_rng(seed).random((H, W)) < share


def lines():
    mask = np.zeros((H, W), bool)
    mask[:, COLUMNS] = mask[ROW] = True
    return mask


def stuck(shape=(H, W)):
    return np.random.default_rng(6).uniform(-10, 60, shape).astype(np.float32)


@pytest.mark.parametrize(
    ("bad", "value"),
    [
        (some(0.01), np.float32(np.nan)),
        (some(0.003), np.float32(382.2)),
        (some(0.01), stuck()),
        (lines(), np.float32(np.nan)),
        (lines(), np.float32(35.0)),
    ],
    ids=["dead", "hot", "stuck", "dead lines", "stuck lines"],
)
def test_bad_pixels_are_found_and_mended(bad, value):
    true = flight()
    faults = FindFaults()([np.where(bad, value, f) for f in true])
    assert faults is not None
    found = np.zeros(H * W, bool)
    found[faults.bad] = True
    found = found.reshape(H, W)
    assert (found & bad).sum() >= 0.98 * bad.sum()
    assert (found & ~bad).sum() <= 0.001 * bad.size
    mended = repaired(np.where(bad, value, true[4]), faults)
    left = np.abs(mended - true[4])[found & bad]
    assert np.median(left) < 0.4  # an interpolation across the ground's own texture
    good = ~found & ~bad
    assert np.array_equal(mended[good], true[4][good])


def test_errors_of_columns_and_rows_are_taken_off():
    true = flight(seed=2)
    rng = np.random.default_rng(8)
    columns, rows = rng.normal(0, 0.4, W), rng.normal(0, 0.3, H)
    damaged = [(f + columns + rows[:, None]).astype(np.float32) for f in true]
    faults = FindFaults()(damaged)
    assert faults is not None
    for true_, found in ((columns, faults.columns), (rows, faults.rows)):
        # what changes slowly along the picture is no fault of single lines
        fine = true_ - cv2.GaussianBlur(true_[None], (0, 0), 6)[0]
        assert np.std((fine - found)[10:-10]) < 0.25 * np.std(fine[10:-10])


def rails(ground):
    ground[:, 198] += 10
    ground[:, 208] += 10


def crops(ground):
    ground += 3 * np.sin(2 * np.pi * np.arange(ground.shape[1]) / 9).astype(np.float32)


@pytest.mark.parametrize("turn", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("paint", [None, rails, crops])
def test_ground_is_no_fault(paint, turn):
    faults = FindFaults()(flight(seed=3, turn=turn, paint=paint))
    if faults is not None:
        assert len(faults.bad) < 0.002 * H * W
        assert not faults.columns.any()
        assert not faults.rows.any()


def test_a_saturated_picture_has_no_stuck_pixels():
    assert FindFaults()([np.minimum(f, np.float32(20)) for f in flight(seed=4)]) is None


@pytest.mark.parametrize("count", [6, 8])
def test_few_frames_name_no_sound_pixel(count):
    """Half of a few values are alike by chance somewhere in a frame."""
    assert [FindFaults()(flight(count=count, seed=s)) for s in range(4)] == [None] * 4


def test_frames_of_one_place_do_not_tell():
    place = flight(count=1)[0]
    rng = np.random.default_rng(0)
    frames = [place + rng.normal(0, NOISE, place.shape).astype(np.float32) for _ in range(12)]
    assert FindFaults()(frames) is None


def test_text_and_logos_are_left_to_the_search_for_marks():
    bad = np.zeros((H, W), bool)
    bad[10:20, 30:60] = True
    faults = FindFaults()([np.where(bad, np.float32(60), f) for f in flight()])
    assert faults is None


def test_photos_of_a_survey_are_read_mended(tmp_path):
    bad = some(0.01)
    true = [np.round((f + 273.15) * 100) for f in flight()]
    for k, frame in enumerate(true):
        tifffile.imwrite(
            tmp_path / f"t{k:02}.tif",
            np.where(bad, 65535, frame).astype(np.uint16),
            description="unit: centikelvin",
        )
    survey = read_input(tmp_path, InputSettings()).survey
    photo = survey.photos[3]
    assert any("pixels of its detector" in n for n in survey.notes)
    assert photo.pixels_key.startswith(f"{photo.digest}-centikelvin-")
    assert np.nanmax(read_color(photo)) < 60
    assert np.abs(read_color(photo) - (true[3] / 100 - 273.15))[~bad].max() < 0.01
    for path in list(tmp_path.glob("*.tif"))[4:]:
        path.unlink()
    few = read_input(tmp_path, InputSettings()).survey
    assert few.photos[0].faults is None
    assert few.photos[0].pixels_key == f"{few.photos[0].digest}-centikelvin"
