"""Text, scales and logos that both pictures carry: unrelated pictures are not registered by them,
and the scene is registered in spite of them.
"""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.marks import FindMarks
from skyquilt.coregistration.methods import registration_method
from skyquilt.model.registration import Picture

from .scenes import error, layout, pair, spectrum, turned

SHAPE = (400, 480)


@pytest.fixture(scope="module")
def auto():
    return registration_method("auto")


def marked(grey):
    """A picture with what a drone's screen writes over it, as JPEG keeps it."""
    picture = np.ascontiguousarray(grey).copy()

    def text(x, y, words, size=0.5):
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(picture, words, (x, y), font, size, 255, 1, cv2.LINE_AA)

    def line(x0, y0, x1, y1):
        cv2.line(picture, (x0, y0), (x1, y1), 255, 1, cv2.LINE_AA)

    text(12, 24, "2026-05-14 10:22:41")
    text(12, 388, "D 243m H 120m HS 8.2 VS 0.1")
    text(330, 24, "REC 00:12:44")
    text(400, 388, "FLIR", 0.8)
    for k in range(10):
        line(25, 80 + 26 * k, 40 + 12 * (k % 2), 80 + 26 * k)
        text(60, 84 + 26 * k, str(10 * k), 0.35)
    for k in range(14):
        line(110 + 20 * k, 40, 110 + 20 * k, 48 + 6 * (k % 2))
    line(230, 170, 230, 230)
    line(200, 200, 260, 200)
    for x0, y0, x1, y1 in ((160, 130, 310, 130), (160, 270, 310, 270)):
        line(x0, y0, x1, y1)
    for x in (160, 310):
        line(x, 130, x, 270)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def bare(seed, contrast=1.0):
    grey = 100 + contrast * (spectrum(layout(seed=seed), seed, noise=3 / contrast) - 100)
    return np.clip(grey, 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_unrelated_pictures_are_not_registered_by_marks(auto, seed):
    a, b = (Picture(values=marked(bare(s, contrast=0.2))) for s in (seed, seed + 20))
    naive = auto.method(a, b)
    assert naive  # without the search for marks, these are what is found
    found = auto(a, b)
    assert not found
    assert "significance" in found.reason or "marks" in found.reason or "position" in found.reason


def drawn(grey):
    """A smaller picture with the same marks, drawn at its own size: lines of one px, other text."""
    height, width = grey.shape
    by = width / SHAPE[1]
    picture = np.ascontiguousarray(grey).copy()

    def text(x, y, words, size=0.5):
        at, font = (round(x * by), round(y * by)), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(picture, words, at, font, size * by, 0, 3, cv2.LINE_AA)
        cv2.putText(picture, words, at, font, size * by, 255, 1, cv2.LINE_AA)

    text(12, 24, "2026-05-14 10:22:41")
    text(12, 388, "D 243m H 120m HS 8.2 VS 0.1")
    text(330, 24, "REC 00:12:44")
    text(400, 388, "FLIR", 0.8)
    for k in range(10):
        text(60, 84 + 26 * k, str(10 * k), 0.35)
    box = [round(v * by) for v in (160, 130, 310, 270)]
    cv2.rectangle(picture, box[:2], box[2:], 255, 1)
    for k in range(14):
        x = round((110 + 20 * k) * by)
        cv2.line(picture, (x, round(40 * by)), (x, round((48 + 6 * (k % 2)) * by)), 255, 1)
    middle = (round(230 * by), round(200 * by))
    cv2.drawMarker(picture, middle, 255, cv2.MARKER_CROSS, round(60 * by), 1)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_marks_in_pictures_of_other_sizes_register_nothing(auto, seed):
    small = cv2.resize(bare(seed + 20, 0.2), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    a, b = (Picture(values=drawn(v)) for v in (bare(seed, 0.2), small))
    assert auto.method(a, b)  # without the search for marks, these are what is found
    assert not auto(a, b)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_scene_is_registered_in_spite_of_marks(auto, seed):
    truth = turned(1.05, 8.0 - 5 * seed, SHAPE, SHAPE, (15.0, -12.0))
    a, b = pair(truth, seed=seed)
    found = auto(Picture(values=marked(a)), Picture(values=marked(b)))
    assert found and error(found.b_H_a, truth) < 1.0


def test_marks_are_where_they_were_written():
    find = FindMarks()
    a, b = (bare(s, contrast=0.4) for s in (5, 25))
    marks = find(Picture(values=marked(a)), Picture(values=marked(b)))
    assert marks is not None and marks.certain.shape == SHAPE
    written = marked(np.full(SHAPE, 100, np.uint8)) > 180
    assert marks.certain[written].mean() > 0.5
    far = cv2.dilate(written.astype(np.uint8), np.ones((15, 15), np.uint8)) == 0
    assert marks.certain[far].mean() < 0.1
    cleared = marks.cleared(Picture(values=marked(a))).values
    assert (cleared[marks.certain == 0] == marked(a)[marks.certain == 0]).all()


@pytest.mark.parametrize("seed", range(6))
def test_scenes_have_no_marks(seed):
    find = FindMarks()
    assert find(Picture(values=bare(seed)), Picture(values=bare(seed + 20))) is None
    a, b = pair(turned(1.0, 3.0, SHAPE, SHAPE), seed=seed)
    assert find(Picture(values=a), Picture(values=b)) is None


@pytest.mark.parametrize("seed", range(3))
def test_pictures_that_are_alike_as_a_whole_have_no_marks(seed):
    grey = np.random.default_rng(seed).normal(128, 40, SHAPE).clip(0, 255).astype(np.uint8)
    grey = cv2.addWeighted(grey, 0.5, bare(seed), 0.5, 0)
    noisy = grey + np.random.default_rng(9).normal(0, 3, SHAPE)
    noisy = np.clip(noisy, 0, 255).astype(np.uint8)
    assert FindMarks()(Picture(values=grey), Picture(values=noisy)) is None


def test_measured_values_and_other_frames_have_none():
    a = marked(bare(1))
    assert FindMarks()(Picture(values=a), Picture(values=a.astype(np.float32))) is None
    assert FindMarks()(Picture(values=a), Picture(values=a[:, :400])) is None
