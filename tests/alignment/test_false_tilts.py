"""Tilts that nobody measured are not believed; measured ones are, whatever else is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from skyquilt.alignment import false_tilts, repairs, told_poses
from skyquilt.alignment.false_tilts import common_tilts, leaning_lines, told_no_tilt
from skyquilt.alignment.setup import HALF_TURN, TURNED
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from skyquilt.model.poses import Pose
from tests.alignment.surveys import prior
from tests.alignment.test_bundle import Flown
from tests.alignment.test_oblique import CAMERA, block, hills


def off(found, flown):
    """Angles (n,) in degrees of the axes from the true ones."""
    cosine = [found.poses[i].cam_R_map[2] @ flown.truth.R[i][2] for i in sorted(found.poses)]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_a_fixed_camera_that_claims_to_look_straight_down(seed, monkeypatch):
    """The aircraft leans by 8 degrees; files say 0, as exactly as those of a gimbal do. What is
    found then is as good as what is found where files do not tell.
    """
    flown = Flown(seed, lines=4, per_line=6, points=900, true_tilt_deg=8.0)
    flown.priors = [replace(p, pitch_deg=0.0, roll_deg=0.0) for p in flown.priors]
    found = flown.aligned()
    assert sum("tilts of the camera contradict" in n for n in found.notes) == 1
    monkeypatch.setattr(repairs, "told_no_tilt", lambda found, priors: (priors, ""))
    monkeypatch.setattr(told_poses, "_scattered_tilts", lambda problem, *_: problem.sigma_R)
    believing = flown.aligned()
    flown.priors = [replace(p, sigma_tilt_deg=8.0) for p in flown.priors]
    untold = flown.aligned()
    errors = [np.median(off(f, flown)) for f in (found, believing, untold)]
    assert errors[0] < 0.8 * errors[1]
    assert errors[0] < errors[2] + 0.1


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["untold", "nothing", "yaws", "few"])
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


def lines(headings, *, ahead_deg, gps=1.0, drift=0.0, map_deg=0.0, seed=0, count=8):
    """Three lines of photos as found in a map that is tilted, and what files report: pitch with an
    error of `ahead_deg` degrees, heights that drift by so many m over the flight.
    """
    rng = np.random.default_rng(seed)
    # a line takes as long as the turn to the next, in which a drift goes on
    when = np.arange(count * len(headings)) + count * np.repeat(np.arange(len(headings)), count)
    lean = rotation_from_vector(np.radians(map_deg) * np.array([0.8, 0.6, 0.0]))
    found, told = [], []
    for line, heading in enumerate(headings):
        for k in range(count)[:: 1 - 2 * (line % 2)]:
            pitch, roll = rng.normal(0, 2, 2)
            where = np.array([25.0 * line, 12.0 * k, 60.0])
            R = cam_R_map_from_angles(heading, pitch, roll)
            found.append(Pose(cam_R_map=R @ lean.T, map_C=lean @ where))
            late = np.array([0, 0, drift * when[len(told)] / when[-1]])
            off = rng.normal(0, gps, 3) * (1, 1, 1.5)
            error = rng.normal(0, 0.5, 2)
            told.append(
                prior(
                    where + late + off,
                    yaw=heading + rng.normal(0, 3),
                    pitch=pitch + ahead_deg + error[0],
                    roll=roll + error[1],
                )
            )
    return block(found, hills(60)), told


@pytest.mark.parametrize("drift", [0.0, 15.0])
@pytest.mark.parametrize(
    ("headings", "ahead_deg", "within_deg"),
    [
        ((20, 200, 20), 5.0, 0.4),
        ((20, 200, 20), -2.0, 0.4),
        ((20, 110, 200), 12.0, 0.4),
        ((0, 0, 0), 5.0, 1.5),  # by heights
        ((0, 0, 0), -8.0, 1.5),
    ],
)
def test_an_error_that_photos_of_a_camera_have_in_common_is_corrected(
    headings, ahead_deg, within_deg, drift
):
    for seed in range(5):
        found, told = lines(headings, ahead_deg=ahead_deg, drift=drift, map_deg=3.0, seed=seed)
        right = lines(headings, ahead_deg=0.0, drift=drift, map_deg=3.0, seed=seed)[1]
        corrected, notes = common_tilts(found, told, ["c"] * len(told))
        (note,) = notes
        assert "photos of c look" in note
        off = [a.pitch_deg - b.pitch_deg for a, b in zip(corrected, right, strict=True)]
        aside = [a.roll_deg - b.roll_deg for a, b in zip(corrected, right, strict=True)]
        assert abs(np.median(off)) < within_deg and abs(np.median(aside)) < within_deg
        turned = [a.yaw_deg - b.yaw_deg for a, b in zip(corrected, right, strict=True)]
        assert np.abs((np.array(turned) + 180) % 360 - 180).max() < 3.0


@pytest.mark.parametrize(
    ("headings", "ahead_deg", "map_deg", "drift"),
    [
        ((20, 200, 20), 0.0, 3.0, 15.0),  # the map is tilted, not the gimbal
        ((20, 200, 20), 0.5, 0.0, 0.0),  # usual
        ((0, 0, 0), 0.0, 3.0, 25.0),
        ((0, 0, 0), 1.0, 0.0, 0.0),  # receivers wander by as much
        ((20,), 6.0, 0.0, 0.0),  # a drifting barometer looks the same
    ],
)
def test_other_errors_are_not_taken_for_those_of_a_gimbal(headings, ahead_deg, map_deg, drift):
    for seed in range(5):
        found, told = lines(headings, ahead_deg=ahead_deg, map_deg=map_deg, drift=drift, seed=seed)
        for corrected_by in (common_tilts, leaning_lines):
            assert corrected_by(found, told, ["c"] * len(told)) == (told, ())


@pytest.mark.slow
def test_few_photos_around_a_field_do_not_tell_a_gimbal_by_chance():
    """Five photos on each long side, two on each short one, all headed alike; heights scatter by
    2 m. One flight in eight was given an error of 3 to 15 degrees.
    """
    ring = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (4, 1), (4, 2), (3, 2), (2, 2), (1, 2), (0, 2)]
    found = told_wrongly = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        poses, told = [], []
        for x, y in [*ring, (0, 1)]:
            pitch, roll = rng.normal(0, 1, 2)
            where = np.array([45.0 * x, 45.0 * y, 90.0])
            poses.append(Pose(cam_R_map=cam_R_map_from_angles(90, pitch, roll), map_C=where))
            off = rng.normal(0, 0.5, 2)
            angles = {"yaw": 90.0, "pitch": pitch + off[0], "roll": roll + off[1]}
            told.append(prior(where + rng.normal(0, 1, 3) * (3, 3, 2), **angles))
        aligned = block(poses, hills(60))
        told_wrongly += bool(common_tilts(aligned, told, ["c"] * len(told))[1])
        told = [replace(p, pitch_deg=p.pitch_deg + 15.0) for p in told]
        found += bool(common_tilts(aligned, told, ["c"] * len(told))[1])
    assert told_wrongly == 0
    assert found > 50


@pytest.mark.parametrize(("free", "rel"), [(5, 0.05), (8, 0.012), (20, 2e-3), (300, 1e-3)])
def test_deviations_of_few_observations_are_those_of_student(free, rel):
    exact = stats.t.isf(stats.norm.sf(false_tilts.COMMON_DEVIATIONS), free)
    assert false_tilts._as_rare(free) == pytest.approx(exact, rel=rel)


def leaning(found, headings, by_deg, count=8):
    """Lines that nothing ties to one another, each turned about its middle: what is ahead of it
    rises.
    """
    poses = dict(found.poses)
    for line, heading in enumerate(headings):
        own, yaw = range(count * line, count * (line + 1)), np.radians(heading)
        right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
        lean = rotation_from_vector(np.radians(by_deg) * right)
        middle = np.mean([poses[i].map_C for i in own], axis=0)
        for i in own:
            C = middle + lean @ (poses[i].map_C - middle)
            poses[i] = Pose(cam_R_map=poses[i].cam_R_map @ lean.T, map_C=C)
    return replace(found, poses=poses)


@pytest.mark.parametrize("drift", [0.0, 15.0])
@pytest.mark.parametrize("off_deg", [-10.0, 15.0])
@pytest.mark.parametrize("headings", [(20, 200), (20, 200, 20), (0, 0, 0)])
def test_lines_that_lean_as_their_gimbal_tells_are_told_by_their_heights(headings, off_deg, drift):
    """Photos that look far ahead share nothing with those of lines back: all agreed with tilts that
    were 15 degrees off, and with no others.
    """
    for seed in range(4):
        found, told = lines(headings, ahead_deg=off_deg, seed=seed, drift=drift, gps=0.5)
        corrected, (note,) = leaning_lines(
            leaning(found, headings, off_deg), told, ["c"] * len(told)
        )
        assert "photos of c look" in note
        off = [off_deg + b.pitch_deg - a.pitch_deg for a, b in zip(told, corrected, strict=True)]
        assert abs(np.median(off)) < (4.0 if drift else 1.0)


@pytest.mark.slow
def test_a_gimbal_that_tells_too_much_does_not_tilt_the_map():
    """Its lines there outnumber those back, and won before."""
    flown = Flown(4, lines=3, per_line=6, points=900)
    flown.priors = [replace(p, pitch_deg=p.pitch_deg + 6.0) for p in flown.priors]
    found = flown.aligned()
    assert np.median(off(found, flown)) < 0.3


def test_files_that_were_turned_count_by_their_sensors():
    """By their files, all are headed alike, and the error is seen in two directions."""
    found, told = lines((20, 200, 20), ahead_deg=-2.0, map_deg=3.0)
    turned = range(8, 16)
    poses = found.poses | {
        i: replace(found.poses[i], cam_R_map=HALF_TURN @ found.poses[i].cam_R_map) for i in turned
    }
    names = found.camera_of | dict.fromkeys(turned, f"c{TURNED}")
    found = replace(
        found, poses=poses, camera_of=names, cameras=found.cameras | {f"c{TURNED}": CAMERA}
    )
    (note,) = common_tilts(found, told, ["c"] * len(told))[1]
    assert "look 1.9 degrees aside" in note or "look 2." in note


@pytest.mark.parametrize(("fit", "corrected"), [(1.0, True), (1.07, False)])
def test_an_error_of_a_gimbal_that_pictures_contradict_is_not_corrected(fit, corrected):
    """False heights of a line look like one; photos then fit worse where they are turned by it."""
    found, told = lines((0, 0, 0), ahead_deg=5.0, map_deg=5.0)
    right = lines((0, 0, 0), ahead_deg=5.0)[0]

    def residuals(aligned, px):
        ties = replace(aligned.ties, residual_px=np.full(aligned.ties.px.shape, px))
        return replace(aligned, ties=ties)

    survey = repairs.Survey(
        names=[], cameras=["c"] * len(told), speeds=None, linked=len(told),
        adjust=lambda begun: residuals(right, 0.1 * fit), unfit=None, cut=None, focals=None,
        wholes=None, false_focals=None, beginnings=None, guess=None, sizes=lambda cut: {},
    )  # fmt: skip
    first = repairs.Tried(found=residuals(found, 0.1), begun=repairs.Beginning(priors=told))
    assert (repairs._common_tilts(first, survey) is not first) == corrected
