"""Cameras that contradict the shutter, the square pixels and the centre that are assumed of them.

Whole maps with them: `tests/end_to_end/test_untold_shutter.py`; resized pictures: `test_bundle.py`.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment import repairs
from skyquilt.alignment.outcome import ASPECT, NO_FIT
from skyquilt.alignment.problem import READOUT
from skyquilt.alignment.setup import priors_by_camera, set_up
from skyquilt.alignment.start import find_start
from skyquilt.alignment.unfit_cameras import (
    CX,
    CY,
    cut_cameras,
    cut_notes,
    false_focals,
    fits_cut,
    loosened,
    other_focals,
    uncentred,
    unfit_cameras,
    unfit_notes,
    whole_focals,
)
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Shutter
from tests.alignment.surveys import FOCAL, HEIGHT, WIDTH, alignment, photo, prior
from tests.alignment.test_bundle import Flown

UNKNOWN = Shutter(readout_s=0.0, sigma_s=0.010, source="unknown")
TOLD = Shutter(readout_s=0.030, sigma_s=0.003, source="table")


def found_as(*, readout_s=0.0, aspect=1.0, notes=()):
    camera = Camera(
        width=WIDTH, height=HEIGHT, focal=FOCAL, cx=400.0, cy=300.0, aspect=aspect,
        readout_s=readout_s,
    )  # fmt: skip
    return replace(alignment(), cameras={"cam": camera}, notes=notes)


def judged(found, photos, distortion="full"):
    return unfit_cameras(found, priors_by_camera(photos, distortion))


@pytest.mark.parametrize(
    ("readout_ms", "aspect", "unfit"),
    [
        (0.0, 1.0, False),
        (10.0, 1.003, False),  # a deviation each
        (-10.0, 0.997, False),
        (23.0, 1.0, True),
        (0.0, 1.007, True),
        (16.0, 0.995, True),  # 1.6 and 1.7 deviations
    ],
)
def test_contradictions_are_those_beyond_the_priors(readout_ms, aspect, unfit):
    found = found_as(readout_s=readout_ms / 1000, aspect=aspect)
    photos = [photo(f"{i}.jpg", shutter=UNKNOWN) for i in range(8)]
    assert judged(found, photos) == ({"cam"} if unfit else set())
    # where nothing is adjusted, nothing contradicts
    assert judged(found, photos, "4") == ({"cam"} if readout_ms > 22 else set())


def test_what_is_stated_is_not_questioned_here():
    calibrated = Camera(width=WIDTH, height=HEIGHT, focal=FOCAL, cx=400.0, cy=300.0, aspect=1.01,
                        sigmas=(1.0, 1.0, 1.0, *[1e-3] * 3, *[1e-4] * 2, 5e-4, 0.0))  # fmt: skip
    photos = [photo(f"{i}.jpg", shutter=TOLD, calibration=calibrated) for i in range(8)]
    assert judged(found_as(readout_s=0.060, aspect=1.03), photos) == set()


def test_photos_that_fit_no_camera_contradict_what_is_assumed():
    note = f"The photos of cam {NO_FIT}: and more."
    photos = [photo(f"{i}.jpg", shutter=UNKNOWN) for i in range(8)]
    assert judged(found_as(notes=(note,)), photos) == {"cam"}
    assert judged(found_as(notes=(note.replace("cam", "cam 2", 1),)), photos) == set()


@pytest.mark.parametrize(
    ("readout_ms", "said"),
    [
        (60.0, "within 60 ms (0:"),
        (-30.0, "within 30 ms, the last row first (0:"),
        (-0.2, "within 0 ms (0:"),
    ],
)
def test_a_readout_from_below_is_told_as_such(readout_ms, said):
    found = found_as(readout_s=readout_ms / 1000, aspect=1.03)
    (note,) = unfit_notes(found, {"cam"})
    assert said in note and "the ratio 1.030 (1:" in note


def test_only_what_is_assumed_of_these_cameras_is_loosened(setup_of):
    setup = setup_of({"a": UNKNOWN, "b": UNKNOWN, "c": TOLD})
    rows = [setup.camera_keys.index(k) for k in "abc"]
    loose = loosened(setup, {"a", "c"}).base.sigma_K
    a, b, c = rows
    assert np.array_equal(loose[b], setup.base.sigma_K[b])
    assert loose[a, READOUT] == 0.1 and loose[a, ASPECT] == loose[c, ASPECT] == 0.1
    assert loose[c, READOUT] == pytest.approx(TOLD.sigma_s)
    rest = [k for k in range(loose.shape[1]) if k not in (READOUT, ASPECT)]
    assert np.array_equal(loose[:, rest], setup.base.sigma_K[:, rest])
    assert loosened(setup, ()) is setup


def found_at(cx, cy, *, notes=()):
    camera = Camera(width=WIDTH, height=HEIGHT, focal=FOCAL, cx=cx, cy=cy)
    return replace(alignment(), cameras={"cam": camera}, notes=notes)


@pytest.mark.parametrize(
    ("right", "down", "cut"),
    [(0, 0, False), (16, 16, False), (25, 0, True), (-20, -18, True), (0, 110, True)],
)
def test_pictures_are_taken_for_cropped_beyond_three_deviations(right, down, cut):
    """One deviation is a hundredth of the longer side: 8 px."""
    found = found_at((WIDTH - 1) / 2 + right, (HEIGHT - 1) / 2 + down)
    photos = [photo(f"{i}.jpg") for i in range(8)]
    assert cut_cameras(found, priors_by_camera(photos, "full")) == ({"cam"} if cut else set())


def test_a_calibrated_principal_point_is_not_questioned():
    calibrated = Camera(width=WIDTH, height=HEIGHT, focal=FOCAL, cx=400.0, cy=300.0,
                        sigmas=(1.0, 1.0, 1.0, *[1e-3] * 3, *[1e-4] * 2, 5e-4, 0.0))  # fmt: skip
    photos = [photo(f"{i}.jpg", calibration=calibrated) for i in range(8)]
    note = f"The photos of cam {NO_FIT}: and more."
    priors = priors_by_camera(photos, "full")
    assert cut_cameras(found_at(500.0, 300.0, notes=(note,)), priors) == set()
    plain = priors_by_camera([photo(f"{i}.jpg") for i in range(8)], "full")
    assert cut_cameras(found_at(400.0, 300.0, notes=(note,)), plain) == {"cam"}


def test_only_principal_points_of_these_cameras_are_loosened(setup_of):
    setup = setup_of({"a": UNKNOWN, "b": UNKNOWN, "c": TOLD})
    loose = uncentred(setup, {"a"}).base.sigma_K
    a = setup.camera_keys.index("a")
    assert loose[a, [CX, CY]] == pytest.approx(0.15 * WIDTH)
    loose[a, [CX, CY]] = setup.base.sigma_K[a, [CX, CY]]
    assert np.array_equal(loose, setup.base.sigma_K)
    assert uncentred(setup, ()) is setup


@pytest.mark.parametrize(
    ("cx", "cy", "said"),
    [(499.5, 189.5, "100 px right of their middle and 110 px above it"),
     (379.5, 309.5, "20 px left of their middle and 10 px below it")],
)  # fmt: skip
def test_where_the_axis_meets_is_told(cx, cy, said):
    assert said in cut_notes(found_at(cx, cy), {"cam"})[0]


def flown_as(find):
    """A survey whose adjustment finds principal points by what it is begun with."""
    priors = priors_by_camera([photo(f"{i}.jpg") for i in range(8)], "full")
    return repairs.Survey(
        names=[], cameras=[], speeds=None, linked=8, adjust=find, guess=None, sizes=lambda cut: {},
        beginnings=None,
        unfit=lambda t: frozenset(), focals=lambda t: ({}, True), false_focals=lambda t: ({}, True),
        cut=lambda t: cut_cameras(t.found, priors),
        wholes=lambda t: whole_focals(t.found, t.begun.cut, t.begun.focals),
    )  # fmt: skip


@pytest.mark.parametrize("slanting", [True, False])
def test_principal_points_that_stood_for_tilts_are_held_again(slanting, monkeypatch):
    """Photos that look ahead, begun as if they looked down, show the axis far above the picture.
    Those that were cut off show it so wherever they look.
    """

    def find(begun):
        off = (begun.guess is None or not slanting) and (110.0 if begun.cut else 30.0)
        return found_at((WIDTH - 1) / 2, (HEIGHT - 1) / 2 - off)

    def guessed(last, survey):
        return survey.tried(last.begun, guess=last.begun.priors)

    monkeypatch.setattr("skyquilt.alignment.enlarged.misfit_px", lambda found: 1.0)
    monkeypatch.setattr("skyquilt.alignment.unfit_cameras.misfit_px", lambda found: 1.0)
    monkeypatch.setattr(repairs, "fits_cut", lambda *both: True)
    wanted = ("_cut_pictures", "_held_in_the_middle")
    cut, held = (r for name in wanted for r in repairs.REPAIRS if r.__name__ == name)
    monkeypatch.setattr(repairs, "REPAIRS", (cut, guessed, held))
    survey = flown_as(find)
    begun = repairs.Beginning(priors=[prior((0.0, 0.0, 60.0))] * 8)
    last = repairs.repaired(repairs.Tried(found=find(begun), begun=begun), survey)
    assert last.begun.cut == (set() if slanting else {"cam"})
    assert last.notes == (() if slanting else cut_notes(last.found, {"cam"}))


@pytest.mark.parametrize(("cx", "fits"), [(700.0, True), (WIDTH + 5.0, False), (-5.0, False)])
def test_no_picture_is_cut_off_beyond_its_middle(cx, fits, monkeypatch):
    monkeypatch.setattr("skyquilt.alignment.unfit_cameras.fits_better", lambda *_, **more: True)
    assert fits_cut(found_at(cx, 300.0), alignment()) == fits


@pytest.mark.parametrize(
    ("right", "down", "longer"),
    [(160, 0, 1.4), (-160, 10, 1.4), (39, 30, None), (0, 200, 1.25), (0, 100, None)],
)
def test_focal_lengths_count_for_the_picture_before_it_was_cut_off(right, down, longer):
    """800 x 600 px; the principal point is in the middle of the whole picture."""
    found = found_at((WIDTH - 1) / 2 + right, (HEIGHT - 1) / 2 + down)
    told = {} if longer is None else {"cam": pytest.approx(longer)}
    assert whole_focals(found, {"cam"}, {}) == told
    told = {} if longer is None else {"cam": pytest.approx(2 * longer)}
    assert whole_focals(found, {"cam"}, {"cam": 2.0}) == told
    assert whole_focals(found, (), {}) == {}


@pytest.mark.parametrize("fits", [True, False])
def test_a_cut_picture_begins_again_with_the_focal_length_of_the_whole(fits, monkeypatch):
    def find(begun):
        right = 160.0 if begun.cut else 30.0
        return found_at((WIDTH - 1) / 2 + right, (HEIGHT - 1) / 2)

    monkeypatch.setattr(repairs, "fits_cut", lambda *both: True)
    monkeypatch.setattr(repairs, "fits_as_well", lambda *both: fits)
    (cut,) = (r for r in repairs.REPAIRS if r.__name__ == "_cut_pictures")
    begun = repairs.Beginning(priors=[prior((0.0, 0.0, 60.0))] * 8)
    last = cut(repairs.Tried(found=find(begun), begun=begun), flown_as(find))
    assert last.begun.cut == {"cam"}
    assert last.begun.focals == ({"cam": pytest.approx(1.4)} if fits else {})


@pytest.fixture
def setup_of():
    def made(shutters):
        flown = Flown()
        photos = [
            replace(p, camera_key=key, shutter=shutters[key])
            for p, key in zip(flown.photos, sorted(shutters) * 6, strict=True)
        ]
        start = find_start(photos, flown.priors, flown.features, flown.links, 0.0)
        return set_up(photos, flown.priors, start, distortion="full", repair=True)

    return made


@pytest.mark.parametrize(
    ("found", "begun", "again"),
    [
        (1400.0, {}, 4.0),  # it tends there, and its prior holds it back
        (935.0, {}, (935 / 700) ** 2),  # less than what a guess allows, but pictures leave it open
        (765.0, {}, None),
        (2800.0, {"cam": 4.0}, None),
        (3500.0, {"cam": 4.0}, 6.25),
    ],
)
def test_guessed_focal_lengths_begin_again_where_they_tend(found, begun, again):
    guess = Focal(px=FOCAL, sigma_px=175.0, source="guess")
    multiples, sure = other_focals(alignment(focal=found), {"cam": guess}, begun)
    assert multiples == ({} if again is None else {"cam": pytest.approx(again)})
    assert sure == (again is None)


@pytest.mark.parametrize(
    ("found", "begun", "again", "certain"),
    [
        (760.0, {}, None, True),  # 1.7 deviations
        (800.0, {}, (8 / 7) ** 2, False),  # 2.9: what is told holds it back
        (600.0, {}, (6 / 7) ** 2, False),
        (1050.0, {}, 1.5**2, True),  # 10
        (2100.0, {}, 6.0, True),
        (1000.0, {"cam": 1.4}, None, True),
        (1400.0, {"cam": 1.4}, 2.0, True),  # begun too far from it
    ],
)
def test_focal_lengths_that_files_tell_begin_again_where_pictures_contradict(
    found, begun, again, certain
):
    told = Focal(px=FOCAL, sigma_px=35.0, source="35mm")
    multiples, sure = false_focals(alignment(focal=found), {"cam": told, "other": told}, begun)
    assert multiples == ({} if again is None else {"cam": pytest.approx(again)})
    assert sure is certain
