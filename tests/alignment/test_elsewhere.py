"""A photo that few tie points place far from its position was matched with what looks alike."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment import outcome
from skyquilt.alignment.determined import weak_photos
from skyquilt.alignment.oblique import without_photos
from skyquilt.alignment.start import FOCAL_NOTE
from skyquilt.alignment.unfit_cameras import cut_notes, focal_notes, unfit_notes
from tests.alignment.test_bundle import Flown

OFF = np.array([24.0, -18.0, 0.0])
PHOTO = 7


@pytest.fixture(scope="module")
def block():
    flown = Flown(3, gps=1.5)
    return flown, flown.aligned()


def moved(flown, found, number, *, by=OFF, all_of_them=False):
    """The block with a photo that lies elsewhere by the tie points that it keeps."""
    ties = found.ties
    own = np.flatnonzero(ties.photo == PHOTO)
    keep = np.ones(len(ties.photo), bool)
    keep[own[number:]] = False
    ties = replace(
        ties,
        point=ties.point[keep],
        photo=ties.photo[keep],
        px=ties.px[keep],
        residual_px=ties.residual_px[keep],
    )
    priors = [
        replace(p, map_C=p.map_C + by) if all_of_them or i == PHOTO else p
        for i, p in enumerate(flown.priors)
    ]
    return replace(found, ties=ties), priors


@pytest.mark.parametrize("number", [12, 20])
def test_a_photo_that_few_points_place_elsewhere_is_left_out(block, number):
    found, priors = moved(*block, number)
    weak = weak_photos(found, priors)
    assert set(weak) == {PHOTO}
    assert f"only {number} tie points" in weak[PHOTO] and " 30 m from its reported" in weak[PHOTO]


def test_many_points_are_believed_against_a_position(block):
    found, priors = moved(*block, 150)
    assert not weak_photos(found, priors)


def test_few_points_are_believed_where_they_agree_with_the_position(block):
    found, priors = moved(*block, 20, by=0 * OFF)
    assert not weak_photos(found, priors)
    found, priors = moved(*block, 20, by=OFF / 10)  # 3 m: two deviations
    assert not weak_photos(found, priors)
    found, priors = moved(*block, 20, all_of_them=True)  # the block lies elsewhere, not the photo
    assert not weak_photos(found, priors)


def test_the_accuracy_is_that_of_the_ground_that_other_photos_show(block):
    _, found = block
    gone = {0: "", 1: "", 2: ""}
    left = without_photos(found, gone)
    told, before = left.accuracy, found.accuracy
    assert 0 < len(told.xyz) < len(before.xyz)
    seen = {i: p for i, p in found.poses.items() if i not in gone}
    for place in told.xyz:
        shown = 0
        for i, pose in seen.items():
            x, y, z = pose.to_camera(place[None])[0]
            camera = found.camera(i)
            shown += abs(x / z * camera.focal) < camera.width and abs(y / z) * camera.focal < 600
        assert shown >= 2
    assert without_photos(found, {}) is found


def test_nothing_is_told_of_cameras_whose_photos_were_all_left_out(block):
    """A screenshot's own camera, whose focal length it does not determine, and its note."""
    _, found = block
    other = "screen 2400x1080"
    (own,) = set(found.camera_of.values())
    told = replace(found.accuracy, focal_shares={own: 0.2, other: 0.9})
    keys = (own, f"{other} 3mm", other)
    found = replace(
        found,
        camera_of={**found.camera_of, 1: other},
        cameras=dict.fromkeys(keys, found.cameras[own]),
        accuracy=told,
    )
    notes = tuple(
        note
        for key in keys
        for note in (
            f"{outcome.UNSETTLED} of {key}: it stays uncertain.",
            f"The photos of {key} {outcome.NO_FIT}: so.",
            f"The photos of {key} {outcome.SEEM}: so.",
            *unfit_notes(found, {key}),
            *cut_notes(found, {key}),
            *focal_notes(found, {key: 2.0}),
            FOCAL_NOTE.format(key, 900.0),
        )
    )
    assert len(notes) == 21
    found = replace(found, notes=notes)
    assert outcome.without_idle(found) is found
    left = outcome.without_idle(without_photos(found, {1: "a screenshot"}))
    assert left.notes == notes[:14]
    assert left.accuracy.focal_share == 0.2 and found.accuracy.focal_share == 0.9


def test_many_cameras_of_undetermined_focal_length_are_told_in_one_sentence(block):
    """The one told first is the least certain; other notes stay where they are."""
    _, found = block
    (own,) = set(found.camera_of.values())
    keys = ("a: 1", "a", "b")
    told = [f"{outcome.UNSETTLED} of {key}: it stays uncertain." for key in keys]
    found = replace(found, cameras=dict.fromkeys(keys, found.cameras[own]))
    one = replace(found, notes=("before", told[0], "after"))
    assert outcome.told_once(one) is one
    several = outcome.told_once(replace(found, notes=("before", *told, "after")))
    assert several.notes == ("before", f"{told[0]} The same is true of 2 more: a, b.", "after")


def test_the_accuracy_is_not_that_of_points_too_uncertain_for_the_ground(block):
    """Three points high above others of the ground, known to 20 m, are no tie points any more."""
    _, found = block
    told, shown = found.accuracy, np.bincount(found.ties.point)
    lost = found.ties.xyz[np.argsort(-shown)[:3]] + (0.0, 0.0, 12.0)
    more = replace(told, xyz=np.concatenate([told.xyz, lost]),
                   sigma_m=np.concatenate([told.sigma_m, np.full((3, 3), 20.0)]))  # fmt: skip
    left = without_photos(replace(found, accuracy=more), {0: ""}).accuracy
    assert len(left.xyz) > len(told.xyz) / 2
    assert left.sigma_m.max() < 2.0


@pytest.mark.slow
def test_points_that_nothing_determines_tell_nothing_of_the_ground(monkeypatch):
    """Of every tenth point the deviation is that of no information."""
    plain = Flown(3).aligned().accuracy
    told = outcome.point_deviations

    def lost(*given):
        sigma = told(*given).copy()
        sigma[::10] = 31622.8
        return sigma

    monkeypatch.setattr(outcome, "point_deviations", lost)
    found = Flown(3).aligned().accuracy
    assert len(found.xyz) == len(plain.xyz) - len(plain.xyz[::10])
    assert found.sigma_m.max() <= plain.sigma_m.max() and found.sigma_m.max() < 5
    monkeypatch.setattr(outcome, "point_deviations", lambda *g: np.full_like(told(*g), 31622.8))
    assert Flown(3).aligned().accuracy.sigma_m.min() > 31622  # all that is known


@pytest.mark.slow
def test_photos_without_a_position_state_no_deviation_of_it():
    """Four of the photos have a position, known to 4 m: so well is the place of the map."""
    flown = Flown(4, gps=4.0)
    n = len(flown.priors)
    told = {0, 3, n - 4, n - 1}
    nowhere = np.full(3, np.nan)
    flown.priors = [
        p if i in told else replace(p, map_C=nowhere, sigma_C=np.full(3, np.inf))
        for i, p in enumerate(flown.priors)
    ]
    found = flown.aligned()
    assert len(found.poses) == n > 2 * len(told)
    assert found.accuracy.shared_m == pytest.approx((4.0, 8.0))
