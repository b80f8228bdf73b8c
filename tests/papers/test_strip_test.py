"""Y Fig. 6.5: what keeps a strip true to shape does, and each order of distortion is a fit of its
own.
"""

import json
import re

import numpy as np
import pytest

from skyquilt.errors import OutputError, RefusedError, UsageError
from skyquilt.model.camera import ORDERS
from skyquilt.model.event import Result, StageProgress
from skyquilt.papers.strip_chain import board_camera
from skyquilt.papers.strip_test import iter_strip_test
from skyquilt.simulate import StripSettings, fly_strip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("strip") / "out"
    events = list(iter_strip_test(folder, flights=1))
    return folder, events


def ends(folder):
    found = json.loads((folder / "strip.json").read_text())
    return [float(np.median(v["eta_end"])) for v in found["variants"]], found


@pytest.mark.slow
def test_the_order_of_the_thesis(finished):
    folder, events = finished
    (none, two, four, six, tangential, flat, similarity, *halves), found = ends(folder)
    assert similarity >= 0.97
    assert (
        none < 0.3 and none < two < tangential and four < tangential and six < tangential
    )  # what decays
    assert similarity > max(none, two, four, six) and flat <= 1
    rms = [v["calibration_rms_px"] for v in found["variants"][:5]]
    assert rms == sorted(rms, reverse=True) and rms[0] > 5 * rms[-1]
    for v in found["variants"]:
        eta = v["eta"][:: v["every"]]
        assert len(v["eta"]) == 21 and eta[0] == 1 and 0 < min(eta) <= max(eta) <= 1
        assert sum(e is None for e in v["eta"]) == (0 if v["every"] == 1 else 10)
    # Y Fig. 4.5: with every other photo the overlap is 40 % and the similarity keeps the shape
    homography, similar = halves
    assert similar > 0.95 and similar > homography
    assert isinstance(events[-1], Result) and events[-1].metrics["flights"] == 1
    assert [e.done for e in events if isinstance(e, StageProgress)] == list(range(1, 10))


@pytest.mark.slow
def test_the_page_is_whole(finished):
    page = (finished[0] / "report.html").read_text()
    assert "map" not in re.findall(r'<section id="(\w+)"', page)
    assert page.count("<svg") == 2 and not re.search(r"(src|href)=\"http", page)
    _, found = ends(finished[0])
    for v in found["variants"]:
        assert page.count(v["name"]) >= 3  # in both legends and in the table
    assert page.count('<path style="fill:none') == 18


@pytest.mark.slow
def test_a_perfect_camera_over_level_boards_keeps_the_shape(tmp_path):
    """Without noise, tilt and things, the right lens model ends at 1 but for the calibration's own
    error.
    """
    settings = StripSettings(photos=6, noise=0.0, tilt=0.0, things=0.0, relief=0.0)
    *_, result = iter_strip_test(tmp_path / "o", settings, flights=1)
    etas = [v["eta_end"][0] for v in result.metrics["variants"]]
    assert min(etas[4:6]) > 0.995 and etas[0] < 0.9


@pytest.mark.slow
def test_equal_seeds_give_equal_results(tmp_path):
    settings = StripSettings(photos=3, seed=7, views=10)
    found = [
        [
            v["eta"]
            for v in list(iter_strip_test(tmp_path / name, settings, flights=1))[-1].metrics[
                "variants"
            ]
        ]
        for name in "ab"
    ]
    assert found[0] == found[1]


@pytest.mark.slow
def test_refusals(tmp_path, finished):
    with pytest.raises(OutputError, match=r"already holds strip.json; add --overwrite"):
        next(iter_strip_test(finished[0], flights=1))
    with pytest.raises(UsageError, match="flights must be 1 to 100, not 0"):
        next(iter_strip_test(tmp_path / "x", flights=0))
    for wrong, words in (
        ({"relief": 20.0}, "a third of the height"),
        ({"photos": 1}, "2 to 500"),
        ({"overlap": 0.1}, "30 to 95 %"),
    ):
        with pytest.raises(UsageError, match=words):
            next(iter_strip_test(tmp_path / "x", StripSettings(**wrong)))
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        next(iter_strip_test(tmp_path / "file"))
    with pytest.raises(RefusedError, match="do not match"):
        list(iter_strip_test(tmp_path / "n", StripSettings(noise=300.0, photos=3), flights=1))
    assert not (tmp_path / "n" / "strip.json").exists()


@pytest.mark.slow
def test_a_board_gives_the_camera_back():
    """Without noise the full model is found exactly; lower orders are other fits, not the same with
    terms left out.
    """
    settings = StripSettings()
    strip, lens = fly_strip(settings), settings.lens
    fits = {
        order: board_camera(strip.board, strip.views, (lens.width, lens.height), order)[0]
        for order in ORDERS
    }
    full = fits["6t"]
    assert full.focal == pytest.approx(lens.focal, rel=2e-3)
    assert (full.cx, full.cy) == pytest.approx((lens.cx, lens.cy), abs=3)
    assert (full.k1, full.p1, full.p2) == pytest.approx((lens.k1, lens.p1, lens.p2), abs=0.01)
    assert fits["none"].k1 == fits["2"].k2 == fits["4"].k3 == fits["6"].p1 == 0
    assert abs(fits["2"].k1 - full.k1) > 0.01 and abs(fits["4"].k2 - full.k2) > 0.005
    with pytest.raises(ValueError, match="one of none, 2, 4, 6, 6t"):
        board_camera(strip.board, strip.views, (10, 10), "8")
