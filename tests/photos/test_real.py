"""What the real surveys beside the checkout say."""

import time

import numpy as np
import pytest

from skyquilt.photos.contradictions import contradictions, yaw_disagreement_deg
from skyquilt.photos.pixels import read_color, read_gray
from skyquilt.photos.survey import read_survey

pytestmark = pytest.mark.real


def test_brighton(survey_data):
    survey = read_survey(survey_data("brighton"))
    assert (len(survey.photos), survey.rejected, survey.ignored) == (18, (), ("LICENSE",))
    assert all(
        p.focal.px == pytest.approx(2310, rel=0.01) and p.focal.source == "sensor"
        for p in survey.photos
    )
    edited = [p.name for p in survey.photos if p.editor]
    assert edited == [f"DJI_00{i}.JPG" for i in range(24, 30)]
    assert all("Microsoft Windows Photo Viewer" in p.editor for p in survey.photos if p.editor)
    assert all(
        p.position.datum == "takeoff" and 38 < p.position.altitude_m < 42 for p in survey.photos
    )
    assert all(
        abs(p.attitude.pitch_deg) < 1 and abs(p.attitude.roll_deg) < 1 for p in survey.photos
    )
    assert survey.photos[0].attitude.yaw_deg == pytest.approx(45, abs=0.5)
    assert survey.photos[7].attitude.yaw_deg == pytest.approx(-132, abs=0.5)
    assert any("Rolling" in n for n in survey.notes)


def test_caliterra(survey_data):
    survey = read_survey(survey_data("caliterra"))
    assert len(survey.photos) == 75
    assert all(p.focal.px == pytest.approx(4.5 / 6.17 * 1280, rel=0.01) for p in survey.photos)
    assert all(p.attitude is None and p.position is not None for p in survey.photos)
    assert any("317 to 431 m" in line for line in contradictions(survey.photos))


def test_thermal_strip(survey_data):
    survey = read_survey(survey_data("thermal-strip"))
    assert len(survey.photos) == 17
    photo = survey.photos[0]
    assert (photo.band, photo.unit, photo.dtype, photo.width, photo.height) == (
        "thermal",
        "counts",
        "float32",
        640,
        512,
    )
    assert photo.focal.px == pytest.approx(750, rel=0.05)
    assert any("no measurement" in n for n in photo.notes)
    assert all(abs(yaw_disagreement_deg(p)) > 30 for p in survey.photos)
    counts = read_color(photo)
    assert 15_000 < counts.min() < counts.max() < 25_000
    assert (
        np.corrcoef(counts[:-1].ravel(), counts[1:].ravel())[0, 1] > 0.95
    )  # an image, rightly folded
    assert np.corrcoef(counts[:, :-1].ravel(), counts[:, 1:].ravel())[0, 1] > 0.95


def test_the_radiometric_frame_lies_on_the_picture(survey_data):
    import cv2

    photo = read_survey(survey_data("thermal-strip")).photos[0]
    picture = cv2.imread(str(photo.path), cv2.IMREAD_GRAYSCALE)
    assert (
        np.corrcoef(read_gray(photo).ravel(), picture.ravel())[0, 1] > 0.8
    )  # the palette stretches locally


def test_metadata_cost_milliseconds(survey_data):
    folder = survey_data("brighton")
    read_survey(folder)
    start = time.process_time()
    read_survey(folder)
    assert (time.process_time() - start) / 18 < 0.03  # 4 ms on a quiet machine
