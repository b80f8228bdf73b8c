"""Colours on both sides of a seam, and objects that seams cut, against known pictures."""

import cv2
import numpy as np
import pytest

from skyquilt.model.raster import Grid
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.tie_surface import level
from skyquilt.quality import seam_look
from skyquilt.quality.seam_look import cut_objects, seam_colours
from skyquilt.quality.seam_points import SeamPoint
from skyquilt.quality.seam_views import Look, lab_of, views_at
from tests.ortho.scenes import view

GSD = 0.05
GRID = Grid(west=-5.0, north=5.0, gsd=GSD, width=200, height=200)
POINTS = [SeamPoint(row=r, column=c, a=0, b=1) for r, c in ((100, 100), (120, 80))]


def lab(rgb):
    """CIE L*a*b* (D65) of an sRGB colour, by the formulas of IEC 61966-2-1 and CIE 15."""
    c = np.asarray(rgb, float) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = (
        np.array(
            [
                [0.4124564, 0.3575761, 0.1804375],
                [0.2126729, 0.7151522, 0.0721750],
                [0.0193339, 0.1191920, 0.9503041],
            ]
        )
        @ linear
        / (0.950456, 1.0, 1.088754)
    )
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def colours(first, second, exposure=NEUTRAL, apart=1.0):
    views = {0: view(0, 0.0, 0.0), 1: view(1, apart, 0.0)}
    camera = views[0].camera
    shown = [np.full((camera.height, camera.width, 3), c, np.uint8) for c in (first, second)]
    look = Look(
        surface=level(0.0), pixels=lambda i: shown[i], exposure=exposure, native_gsd=GSD, gsd=GSD
    )
    return seam_colours(views_at(POINTS, GRID, views, look).lab)


@pytest.mark.parametrize(
    ("first", "second"), [((100, 100, 100), (110, 110, 110)), ((90, 120, 60), (60, 110, 130))]
)
def test_the_step_is_the_distance_of_the_colours(first, second):
    found = colours(first, second)
    asked = np.linalg.norm(lab(first) - lab(second))
    assert found.at == pytest.approx([asked, asked], rel=0.01)
    assert found.beside == pytest.approx([asked, asked], rel=0.01)
    assert found.figures["median"] == found.figures["beside_p95"]
    assert found.figures["measured"] == 2


def test_balanced_photos_have_no_step():
    gain = np.log((110 / 145) / (100 / 155))
    even = Exposure(
        gains={0: np.full(3, gain, np.float32), 1: np.zeros(3, np.float32)},
        fields={i: np.zeros(6, np.float32) for i in (0, 1)},
    )
    assert colours((100,) * 3, (110,) * 3, even).at.max() < 0.05
    assert colours((100,) * 3, (110,) * 3).at.min() > 3


def test_a_place_that_one_photo_does_not_show_has_no_colour():
    found = colours((100,) * 3, (110,) * 3, apart=500.0)
    assert np.isnan(found.at).all() and found.figures["median"] is None
    assert found.figures["measured"] == 0


def test_the_share_of_seams_over_things_that_stand():
    """Photo 1 left of photo 2; in the lower half things stand where they meet."""
    cells = Grid(west=0.0, north=4.0, gsd=1.0, width=4, height=4)
    tall = np.zeros((4, 4), bool)
    tall[2:, 2] = True
    shown = np.array([[1, 1, 2, 2]] * 4)
    zero = np.zeros((4, 4), np.int32)
    labels = Labels(cells=cells, factor=8, photo=zero, hidden=tall & False, tall=tall)
    assert cut_objects(shown, cells, labels) == 0.5
    tall[:, 2] = False
    assert cut_objects(shown, cells, labels) == 0.0
    assert cut_objects(np.ones((4, 4), int), cells, labels) is None
    assert cut_objects(np.where(shown == 2, 0, 1), cells, labels) is None  # a rim is no seam


def test_strips_of_a_map_have_the_same_share(monkeypatch):
    rng = np.random.default_rng(7)
    shown = rng.integers(0, 4, (23, 17))
    cells = Grid(west=0, north=0, gsd=1, width=17, height=23)
    labels = Labels(
        cells=cells,
        factor=1,
        photo=shown.astype(np.int32),
        hidden=np.zeros(shown.shape, bool),
        tall=rng.random(shown.shape) < 0.3,
    )
    at_once = cut_objects(shown, cells, labels)
    monkeypatch.setattr(seam_look, "STRIP", 4)
    assert cut_objects(shown, cells, labels) == at_once


def test_colours_are_those_of_the_standard_and_of_opencv():
    rgb = np.random.default_rng(1).random((500, 3)) ** 3
    rgb[0], rgb[1] = 0, 1
    known = cv2.cvtColor(rgb[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0]
    np.testing.assert_allclose(lab_of(rgb), [lab(255 * c) for c in rgb], atol=0.01)
    np.testing.assert_allclose(lab_of(rgb), known, atol=0.6)  # it interpolates in a table
