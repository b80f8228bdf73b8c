"""Surveys that are oblique as a whole, from photos, links and what the photos report."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment import oblique_start, repairs
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.control import fit_similarity_3d
from skyquilt.alignment.oblique_guess import LOWERED, guessed_priors, lowered, misled
from skyquilt.alignment.oblique_start import (
    aslant,
    nearer,
    reported_start,
    slanting,
    tilt_warnings,
    turned_aside,
    turned_priors,
    within_noise,
)
from skyquilt.alignment.triangulate import regular
from skyquilt.geometry.camera import project
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches
from skyquilt.model.poses import MapFrame, Pose
from tests.alignment.surveys import FOCAL, HEIGHT, WIDTH, alignment, photo, prior
from tests.once import made_once

FRAME = MapFrame(crs="EPSG:32630", origin=(500000.0, 5600000.0), vertical_datum="takeoff")
CAMERA = Camera.ideal(width=WIDTH, height=HEIGHT, focal=FOCAL)


@made_once
class Slanting:
    """Photos with known poses over rough ground, reported with errors of receivers."""

    def __init__(self, places, *, gps=1.5, seed=0, alike_deg=45):
        """`places`: x, y, z in m, yaw and pitch in degrees of each photo; descriptors are alike
        from directions up to `alike_deg` apart.
        """
        rng = np.random.default_rng(seed)
        xyz = np.column_stack([rng.uniform(-110, 110, (5000, 2)), rng.gamma(0.7, 1.5, 5000)])
        self.truth, self.photos, self.priors, self.features, seen = [], [], [], [], []
        for i, (x, y, z, yaw, pitch) in enumerate(places):
            R = cam_R_map_from_angles(yaw, pitch, 0.5)
            where = Pose(cam_R_map=R, map_C=np.array([x, y, z]))
            local = where.to_camera(xyz)
            px = project(CAMERA, np.where(local[:, 2:] > 1, local, [0, 0, -1]))
            inside = np.flatnonzero(((px > 5) & (px < [WIDTH - 6, HEIGHT - 6])).all(1))
            inside = inside[local[inside, 2] < 160]
            px = px[inside] + rng.normal(0, 0.3, (len(inside), 2))
            seen.append({int(p): k for k, p in enumerate(inside)})
            self.truth.append(where)
            self.photos.append(photo(f"{i:02d}.jpg"))
            error = rng.normal(0, gps, 3)
            self.priors.append(
                prior(where.map_C + error, yaw=yaw + rng.normal(), pitch=pitch + rng.normal(0, 0.5))
            )
            words = np.zeros((len(px), 4), np.uint8)
            size = np.ones(len(px), np.float32)
            self.features.append(Features(px=px, size=size, descriptors=words, scale=1.0))
        self.links = []
        for i in range(len(places)):
            for j in range(i + 1, len(places)):
                both = sorted(seen[i].keys() & seen[j].keys())
                m = Matches(
                    index_a=np.array([seen[i][p] for p in both], int),
                    index_b=np.array([seen[j][p] for p in both], int),
                )
                turn = abs((places[j][3] - places[i][3] + 180) % 360 - 180)
                if len(both) < 20 or turn > alike_deg:
                    continue
                link = Verify()(i, j, self.features[i], self.features[j], m, WIDTH)
                if isinstance(link, Link):
                    self.links.append(link)

    def aligned(self):
        return Bundle()(self.photos, FRAME, self.priors, self.features, self.links)

    def errors(self, found):
        """Distances (n,) of centres in m from the truth, a shift of all removed, and angles (n,) of
        rotations in degrees.
        """
        apart = np.array([p.map_C - self.truth[i].map_C for i, p in found.poses.items()])
        turns = [
            np.degrees(np.arccos(np.clip((np.trace(p.cam_R_map @ R.T) - 1) / 2, -1, 1)))
            for i, p in found.poses.items()
            for R in [self.truth[i].cam_R_map]
        ]
        return np.linalg.norm(apart - np.median(apart, 0), axis=1), np.array(turns)


def orbit(count, tilt, height=40.0, pitch=None):
    reach = height * np.tan(np.radians(tilt))
    return [
        (reach * np.sin(b), reach * np.cos(b), height, np.degrees(b) - 180, pitch or tilt)
        for b in np.radians(np.arange(count) * 360 / count)
    ]


def grid(pitch):
    return [(x, y, 45.0, 0.0, pitch) for y in (-40, -22, -4) for x in (-36, -18, 0, 18, 36)]


@pytest.fixture(scope="module")
def round_about():
    """An orbit and what is found of it."""
    flown = Slanting(orbit(20, 50))
    return flown, flown.aligned()


SURVEYS = {"orbit": orbit(20, 50), "horizon": orbit(20, 45, pitch=66), "grid": grid(45)}


@pytest.mark.parametrize(
    "name", ["orbit", *(pytest.param(n, marks=pytest.mark.slow) for n in ("horizon", "grid"))]
)
def test_an_oblique_survey_is_placed(name, round_about):
    flown = Slanting(SURVEYS[name])
    found = round_about[1] if name == "orbit" else flown.aligned()
    assert len(found.poses) == len(flown.photos)
    away, turned = flown.errors(found)
    assert np.median(away) < 0.8
    assert np.median(turned) < 1.0


def by_hand(seed, count=22):
    """Photos taken round a place, that look to all sides and down by 40 to 90 degrees."""
    rng = np.random.default_rng(seed)
    places = []
    for i in range(count):
        b, reach = 2 * np.pi * 1.7 * i / count, rng.uniform(5, 35)
        x, y = reach * np.sin(b), reach * np.cos(b)
        to = rng.normal(0, 12, 2) - (x, y)
        yaw = np.degrees(np.arctan2(*to))
        places.append((x, y, rng.uniform(35, 65), yaw, rng.uniform(0, 50)))
    return places


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_photos_by_hand_are_placed_without_angles(seed):
    """Where links, taken for similarities of the ground's plane, put some of them elsewhere."""
    flown = Slanting(by_hand(seed), gps=3.0, seed=seed, alike_deg=60)
    flown.priors = [
        replace(p, yaw_deg=np.nan, sigma_C=np.array([5.0, 5.0, 15.0])) for p in untold_tilts(flown)
    ]
    found = flown.aligned()
    linked = {i for k in flown.links for i in (k.a, k.b)}
    assert set(found.poses) == linked
    C = np.array([found.poses[i].map_C for i in sorted(linked)])
    true = np.array([flown.truth[i].map_C for i in sorted(linked)])
    scale, turn = fit_similarity_3d(C - C.mean(0), true - true.mean(0))[:2]
    off = scale * (C - C.mean(0)) @ turn.T - (true - true.mean(0))
    assert np.linalg.norm(off, axis=1).max() < 0.3


def there_and_back(pitch):
    """Two flights over each other, across, the camera always `pitch` degrees ahead of the nadir."""
    places = []
    for heading in (0, 90):
        for line, y in enumerate((-30, 0, 30)):
            ways = [(x, y) for x in ((-22, 0, 22), (22, 0, -22))[line % 2]]
            turn = 180 * (line % 2)
            places += [
                (*((y, x) if heading == 0 else (x, y)), 60.0, heading + turn, pitch)
                for x, y in ways
            ]
    return places


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("pitch", [25, 32])
def test_photos_that_look_somewhat_aslant_are_placed_by_what_they_report(pitch, seed):
    """Links of these, taken for similarities of the ground's plane, put half of such blocks where
    all positions looked like gross errors, 11 to 16 m away.
    """
    flown = Slanting(there_and_back(pitch), seed=seed, alike_deg=180)
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    away = [np.linalg.norm(found.poses[i].map_C - t.map_C) for i, t in enumerate(flown.truth)]
    assert np.median(away) < 1.5
    # what positions of 1.5 m, 31 m from their middle, tell of the block's direction: 0.7 degrees
    assert np.median(flown.errors(found)[1]) < 2.0


def two_aslant(pitches, *, height, seed, matches, gps):
    """Two photos 18 m apart that look aslant by so many degrees, and few matches."""
    places = [(18.0 * k, 2.0 * k, height, -85.0 + k, pitch) for k, pitch in enumerate(pitches)]
    flown = Slanting(places, seed=seed, alike_deg=180, gps=gps)
    flown.links = [
        replace(k, index_a=k.index_a[:matches], index_b=k.index_b[:matches]) for k in flown.links
    ]
    return flown


@pytest.mark.parametrize(
    ("pitches", "height", "seed", "matches", "gps", "most_deg"),
    [((20, 10), 60.0, 1, 46, 2.5, 4.0), ((36, 18), 50.0, 2, 40, 2.0, 9.0)],
)
def test_two_photos_that_look_aslant_begin_as_they_report(
    pitches, height, seed, matches, gps, most_deg
):
    """Taken for a similarity, their link turned them by 30 degrees, and 10 and 17 from their
    angles; those that look aslant by much were begun so where few rays told the ground.
    """
    flown = two_aslant(pitches, height=height, seed=seed, matches=matches, gps=gps)
    found = flown.aligned()
    off = [
        np.degrees(np.arccos(np.clip(p.cam_R_map[2] @ flown.truth[i].cam_R_map[2], -1, 1)))
        for i, p in found.poses.items()
    ]
    assert len(off) == 2 and max(off) < most_deg


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [25, 32])
def test_photos_without_angles_among_those_that_look_aslant_hang_on_them(pitch):
    """11 to 13 m away as well, before."""
    flown = Slanting(there_and_back(pitch), seed=2, alike_deg=180)
    for i in range(0, len(flown.priors), 3):
        flown.priors[i] = replace(
            flown.priors[i],
            yaw_deg=np.nan,
            sigma_yaw_deg=np.inf,
            pitch_deg=0.0,
            roll_deg=0.0,
            sigma_tilt_deg=6.0,
        )
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    away = [np.linalg.norm(found.poses[i].map_C - t.map_C) for i, t in enumerate(flown.truth)]
    assert max(away) < 3.5


@pytest.fixture(scope="module")
def ahead():
    """A flight that looks ahead by 15 degrees and what is found of it."""
    flown = Slanting(there_and_back(15), alike_deg=180)
    return flown, flown.aligned()


def test_photos_that_stay_turned_are_hung_on_the_others(ahead):
    """Where neither links nor positions hold them, single ones end in false minima: 19 degrees and
    13 m aside, of a flight without positions.
    """
    flown, found = ahead
    aside = rotation_from_vector(np.array([0.2, 0.0, 0.0]))

    def turned(photos):
        poses = {
            i: replace(p, cam_R_map=aside @ p.cam_R_map) if i in photos else p
            for i, p in found.poses.items()
        }
        return replace(found, poses=poses)

    asked = []

    def adjust(begun):
        asked.append(begun)
        return turned({3}) if len(asked) == 1 else found

    survey = repairs.Survey(
        names=[p.name for p in flown.photos],
        cameras=["cam"] * len(flown.photos),
        speeds=None,
        linked=len(flown.photos),
        adjust=adjust,
        sizes=lambda cut: {},
        unfit=None,
        false_focals=None,
        cut=None,
        wholes=None,
        focals=None,
        beginnings=lambda tried: oblique_start.NO_BEGINNINGS,
        guess=None,
    )
    last = repairs.Tried(found=turned({1, 3, 5}), begun=repairs.Beginning(priors=flown.priors))
    as_reported = next(r for r in repairs.REPAIRS if r.__name__ == "_as_reported")
    assert as_reported(last, survey).found is found
    assert [(b.name, b.aside) for b in asked] == [
        ("as reported ", frozenset()),
        ("without turned ", frozenset({3})),
    ]


def test_photos_without_positions_begin_where_they_were_found(ahead):
    flown, found = ahead
    nowhere = [replace(p, map_C=np.full(3, np.nan)) for p in flown.priors]
    assert oblique_start.aslant(nowhere)
    begin = oblique_start.beginnings(found, flown.photos, nowhere)
    assert begin.centres.keys() == set(found.held)
    for i, centre in begin.centres.items():
        np.testing.assert_array_equal(centre, found.poses[i].map_C)


def swaying(seed, off=0.0, without=()):
    """Twelve photos of a drone without a gimbal, near to one another for their height, whose
    compass is off; some report no position.
    """
    pitch = np.random.default_rng(seed).normal(0, 11, 12)
    ways = [(x, line) for line in range(3) for x in ((0, 12, 24, 36), (36, 24, 12, 0))[line % 2]]
    places = [
        (x, 18 * line, 90.0, 90 + 180 * (line % 2), p)
        for (x, line), p in zip(ways, pitch, strict=True)
    ]
    flown = Slanting(places, seed=seed, alike_deg=180)
    flown.priors = [
        replace(p, yaw_deg=p.yaw_deg + off, map_C=np.full(3, np.nan) if i in without else p.map_C)
        for i, p in enumerate(flown.priors)
    ]
    return flown


@pytest.mark.slow
@pytest.mark.parametrize("off", [60.0, 12.0])
@pytest.mark.parametrize("seed", [2, 4, 5])
def test_a_compass_does_not_turn_photos_that_sway(seed, off):
    """Their tilts point elsewhere by as much as the compass is off, which held the map by it: it
    was turned by 2 to 15 degrees.
    """
    flown = swaying(seed, off)
    away, turned = flown.errors(flown.aligned())
    assert len(away) == 12
    assert np.median(turned) < 1.7 and np.median(away) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 2])
def test_photos_that_sway_and_have_no_position_begin_beside_their_neighbours(seed, monkeypatch):
    begun = []
    kept = oblique_start.beginnings

    def noted(*given):
        begun.append(kept(*given))
        return begun[-1]

    monkeypatch.setattr("skyquilt.alignment.bundle.beginnings", noted)
    monkeypatch.setattr("skyquilt.alignment.repairs.AWAY", 0.0)
    flown = swaying(seed, 60.0, without=(2, 7))
    away, turned = flown.errors(flown.aligned())
    assert len(away) == 12 and np.median(away) < 1.5
    assert begun[0].centres.keys() == {2, 7}
    for i, centre in begun[0].centres.items():
        assert np.linalg.norm(centre - flown.truth[i].map_C) < 12
    true = np.array([180 * (i // 4 % 2) + 90.0 for i in begun[0].yaw_deg])
    apart = (np.array([*begun[0].yaw_deg.values()]) - true + 180) % 360 - 180
    assert len(apart) == 12 and np.abs(apart).max() < 15  # 60 before


def test_an_adjustment_with_far_more_observations_is_the_better_one(round_about):
    flown, found = round_about
    ties = found.ties
    some = np.arange(len(ties.point)) % 3 > 0
    less = replace(
        found,
        ties=replace(
            ties, **{n: getattr(ties, n)[some] for n in ("point", "photo", "px", "residual_px")}
        ),
    )
    assert nearer(found, less, flown.priors)
    assert not nearer(less, found, flown.priors) and not nearer(found, found, flown.priors)


@pytest.mark.slow
def test_photos_that_do_not_tell_their_pose_hang_on_the_others():
    flown = Slanting(orbit(20, 50), seed=2)
    flown.priors[7] = prior((np.nan,) * 3, pitch=50)
    found = flown.aligned()
    assert np.linalg.norm(found.poses[7].map_C - flown.truth[7].map_C) < 2


def test_points_in_a_camera_s_own_plane_can_be_solved():
    H = np.array([np.eye(3), np.diag([1e20, 0, 0]), np.full((3, 3), 1e25)])
    assert np.isfinite(np.linalg.solve(regular(H), np.ones((3, 3, 1)))).all()
    assert (regular(H)[0] == H[0]).all()


def test_what_is_an_oblique_survey():
    level, tilted = prior((0, 0, 60.0)), prior((0, 0, 60.0), pitch=45)
    assert slanting([level] * 3 + [tilted] * 8)
    assert not slanting([level] * 8 + [tilted] * 3)
    some = prior((0, 0, 60.0), pitch=20)
    assert aslant([some] * 6 + [level] * 5)
    assert not aslant([some] * 5 + [level] * 6)
    assert not aslant([tilted] * 11)  # the survey itself is oblique
    assert aslant([some] * 5 + [prior((np.nan,) * 3, pitch=20)] * 6)
    assert not aslant([some] * 5 + [replace(some, sigma_tilt_deg=6.0)] * 6)  # they do not tell
    flown = Slanting(orbit(12, 50))
    assert reported_start(flown.photos, flown.priors, flown.features, ()) is None


def untold_tilts(flown):
    return [replace(p, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=6.0) for p in flown.priors]


def test_photos_that_an_adjustment_turned_are_taken_to_report_that(round_about):
    flown, found = round_about
    level = untold_tilts(flown)
    assert turned_priors(found, flown.priors) is None
    assert tilt_warnings(flown.priors, found) == []
    turned = turned_priors(found, level)
    assert slanting(turned)
    aside = turned_aside(found, level)  # positions of 1.5 m, 40 m from their middle
    assert np.degrees(np.arccos((np.trace(aside) - 1) / 2)) < 3.0
    for i, p in enumerate(turned):
        R = cam_R_map_from_angles(p.yaw_deg, p.pitch_deg, p.roll_deg)
        assert found.poses[i].cam_R_map @ aside.T == pytest.approx(R, abs=1e-9)
    (says,) = tilt_warnings(level, found)
    assert "none reports its camera angles" in says
    nowhere = [replace(p, map_C=np.full(3, np.nan)) for p in level]
    assert turned_priors(found, nowhere) is None
    (says,) = tilt_warnings(nowhere, found)
    assert "was taken to be level" in says and "rest on positions" not in says
    across = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in level]  # as in clips of Mavic 2
    (says,) = tilt_warnings(across, found)
    assert "none reports a height or camera angles: that plane was taken to be level" in says


def test_walls_around_what_photos_show_from_above_are_told():
    flown = Slanting([*orbit(20, 50), *grid(2)[:5]])
    found = replace(alignment(25), poses=dict(enumerate(flown.truth)))
    (says,) = tilt_warnings(flown.priors, found)
    assert "20 of 25 photos look aslant" in says and "--max-view-angle 40" in says
    assert tilt_warnings(flown.priors, found, 40.0) == []
    round_about = Slanting(orbit(20, 50))
    found = replace(alignment(20), poses=dict(enumerate(round_about.truth)))
    assert tilt_warnings(round_about.priors, found) == []  # nothing is shown from above


@pytest.mark.slow
def test_an_orbit_begun_as_if_it_looked_down_is_begun_again(monkeypatch):
    """The first adjustment ends with the whole block tilted by ten degrees."""
    flown = Slanting(orbit(20, 50), seed=1)
    whole, untouched = flown.aligned(), Bundle._block
    flown.priors = untold_tilts(flown)
    aside = np.radians(10.0)
    lean = np.array(
        [[1, 0, 0], [0, np.cos(aside), -np.sin(aside)], [0, np.sin(aside), np.cos(aside)]]
    )
    middle = np.mean([p.map_C for p in whole.poses.values()], 0) * [1, 1, 0]
    leaning = {
        i: Pose(cam_R_map=p.cam_R_map @ lean.T, map_C=lean @ (p.map_C - middle) + middle)
        for i, p in whole.poses.items()
    }
    begun = []

    def block(self, photos, frame, priors, *rest):
        begun.append(priors)
        if len(begun) == 1:
            return replace(whole, poses=leaning)
        return untouched(self, photos, frame, priors, *rest)

    monkeypatch.setattr(Bundle, "_block", block)
    begun_with = np.median(flown.errors(replace(whole, poses=leaning))[0])
    away, turned = flown.errors(flown.aligned())
    assert 3 <= len(begun) <= 6
    assert np.median(away) < 2 < 5 < begun_with  # receivers err by 1.5 m
    assert np.median(turned) < 2.5


def test_rays_that_do_not_meet_tell_no_ground_but_from_one_place():
    """The height above take-off counts for photos that cannot tell the ground, not for those whose
    headings are false.
    """
    apart = Slanting(orbit(20, 50), seed=180)
    away = [replace(p, yaw_deg=p.yaw_deg + 180) for p in apart.priors]
    told = (apart.photos, away, apart.features, apart.links)
    assert reported_start(*told, 0.0) is None
    assert not within_noise(apart.priors) and not within_noise(apart.priors[:3])
    middle = np.mean([p.map_C for p in apart.priors], axis=0)
    crowd = [replace(p, map_C=middle + 0.01 * (p.map_C - middle)) for p in apart.priors]
    assert within_noise(crowd)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [90, 180])
def test_headings_that_are_all_false_by_one_angle_are_corrected(turn):
    flown = Slanting(orbit(20, 50), seed=turn)
    flown.priors = [replace(p, yaw_deg=p.yaw_deg + turn) for p in flown.priors]
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    away, turned = flown.errors(found)
    assert np.median(away) < 0.8
    assert np.median(turned) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pitch_counted_from_straight_down_is_found_by_the_pictures(seed):
    flown = Slanting(grid(2), seed=seed)
    ahead = [replace(p, yaw_deg=p.yaw_deg, pitch_deg=p.pitch_deg + 90) for p in flown.priors]
    flown.priors = ahead
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    assert np.median(flown.errors(found)[0]) < 2.0
    assert LOWERED in found.notes
    for own, where in zip(lowered(found, ahead), flown.truth, strict=True):
        R = cam_R_map_from_angles(own.yaw_deg, own.pitch_deg, own.roll_deg)
        assert np.degrees(np.arccos((np.trace(R @ where.cam_R_map.T) - 1) / 2)) < 5


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("told", ["alike", "some", "compass", "gimbal yaw"])
def test_photos_that_look_down_whatever_they_report_are_found_by_the_pictures(told):
    """One angle in all files; pitch counted from straight down in some; a compass that is off as
    well, or headings that tell nothing.
    """
    flown, rng = Slanting(grid(2), seed=4), np.random.default_rng(4)
    wrong = {
        "alike": lambda i, p: replace(p, pitch_deg=45.0, roll_deg=0.0),
        "some": lambda i, p: replace(p, pitch_deg=p.pitch_deg + 90 * (i % 2)),
        "compass": lambda i, p: replace(p, pitch_deg=p.pitch_deg + 90, yaw_deg=p.yaw_deg + 90),
        "gimbal yaw": lambda i, p: replace(p, pitch_deg=90.0, yaw_deg=rng.uniform(-180, 180)),
    }[told]
    flown.priors = [wrong(i, p) for i, p in enumerate(flown.priors)]
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    assert np.median(flown.errors(found)[0]) < 2.0
    said = LOWERED if told in ("compass", "gimbal yaw") else "they look down: their tilts were not"
    assert any(said in note for note in found.notes)


def test_what_looks_at_the_horizon_is_not_lowered():
    flown = Slanting(orbit(24, 40, pitch=72), seed=1)
    found = replace(alignment(24), poses=dict(enumerate(flown.truth)))
    assert lowered(found, flown.priors) is flown.priors


@pytest.mark.slow
def test_photos_without_angles_are_guessed_to_look_at_the_middle():
    flown = Slanting(orbit(24, 40), seed=3)
    level = [replace(p, yaw_deg=np.nan) for p in untold_tilts(flown)]
    guess = guessed_priors(flown.photos, level, flown.features, flown.links)
    for own, where in zip(guess, flown.truth, strict=True):
        R = cam_R_map_from_angles(own.yaw_deg, own.pitch_deg, own.roll_deg)
        assert np.degrees(np.arccos((np.trace(R @ where.cam_R_map.T) - 1) / 2)) < 15
    flown.priors = level
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    assert np.median(flown.errors(found)[0]) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [30, pytest.param(40, marks=pytest.mark.long)])
def test_tilts_that_all_photos_have_in_common_are_found(pitch):
    """Without camera angles they were taken to look down, and the map was tilted in their place."""
    lines = [
        ((-28, -14, 0, 14, 28)[:: 1 - 2 * (k % 2)], y) for k, y in enumerate((-30, -10, 10, 30))
    ]
    headings = (90.0, 270.0, 90.0, 270.0)
    places = [
        (x, y, 50.0, h, pitch) for (xs, y), h in zip(lines, headings, strict=True) for x in xs
    ]
    flown = Slanting(places, seed=2, alike_deg=60)
    flown.priors = [
        replace(p, yaw_deg=np.nan, sigma_C=np.array([5.0, 5.0, 15.0])) for p in untold_tilts(flown)
    ]
    found = flown.aligned()
    assert len(found.held) == len(flown.photos)
    assert np.median(flown.errors(found)[0]) < 2.0
    tilts = [np.degrees(np.arccos(-p.cam_R_map[2, 2])) for p in found.poses.values()]
    assert np.median(tilts) == pytest.approx(pitch, abs=3.0)
    assert tilt_warnings(flown.priors, found)


@pytest.mark.slow
def test_heights_that_drift_tilt_no_photo():
    """They are uneven as those of photos that look aslant are, and nearer to many a false tilt."""
    flown = Slanting([(x, y, 45.0, 0.0, 0.0) for y in (-36, -12, 12, 36) for x in (-27, -9, 9, 27)])
    level = [replace(p, yaw_deg=np.nan) for p in untold_tilts(flown)]
    flown.priors = [replace(p, map_C=p.map_C + (0, 0, 1.5 * k)) for k, p in enumerate(level)]
    found = flown.aligned()
    assert misled(found, flown.priors, len(flown.photos))
    tilts = [np.degrees(np.arccos(-p.cam_R_map[2, 2])) for p in found.poses.values()]
    assert np.median(tilts) < 4.0
    assert tilt_warnings(flown.priors, found) == []


@pytest.mark.slow
def test_what_photos_report_is_kept_where_no_guess_is_clearly_better():
    for places in SURVEYS.values():
        flown = Slanting(places)
        assert guessed_priors(flown.photos, flown.priors, flown.features, flown.links) is None
    nowhere = [prior((np.nan,) * 3, pitch=50) for _ in flown.priors]
    assert guessed_priors(flown.photos, nowhere, flown.features, flown.links) is None


@pytest.mark.slow
@pytest.mark.parametrize(("share", "taken"), [(3, False), (1, True)])
def test_a_guess_that_leaves_the_pictures_for_the_positions_is_not_taken(monkeypatch, share, taken):
    """Mirrored or garbled positions suggest directions with which some matched rays meet: photos
    then come nearer to the positions and keep a third of their observations.
    """
    flown = Slanting([(18.0 * k, 25.0 * j, 60.0, 0.0, 0.0) for j in range(3) for k in range(5)])
    whole, begun = flown.aligned(), []
    some = slice(None, None, share)
    ties = replace(
        whole.ties,
        point=whole.ties.point[some],
        photo=whole.ties.photo[some],
        px=whole.ties.px[some],
        residual_px=whole.ties.residual_px[some],
    )
    near = {i: replace(p, map_C=flown.priors[i].map_C) for i, p in whole.poses.items()}

    def block(self, *given):
        begun.append(given)
        return whole if len(begun) == 1 else replace(whole, poses=near, ties=ties)

    monkeypatch.setattr(Bundle, "_block", block)
    monkeypatch.setattr("skyquilt.alignment.repairs.misled", lambda *given: True)
    monkeypatch.setattr("skyquilt.alignment.bundle.guessed_priors", lambda *given: flown.priors)
    found = flown.aligned()
    assert len(begun) == 2
    chosen = near if taken else whole.poses
    assert all(np.array_equal(found.poses[i].map_C, chosen[i].map_C) for i in chosen)
