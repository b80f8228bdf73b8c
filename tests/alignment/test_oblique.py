"""Weak and oblique photos, resection and levelling, on points with known poses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.alignment.aligners import (
    share_shown,
    shown_already,
    with_loose_photos,
    without_strange_blocks,
)
from skyquilt.alignment.determined import deviation_px, weak_photos
from skyquilt.alignment.dominant_plane import dominant_normal, levelled
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.oblique import (
    found_oblique,
    hung,
    looked_at,
    reported_oblique,
    resected,
    tilt_deg,
)
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from skyquilt.matching.candidates import Nearest
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link
from skyquilt.model.poses import Alignment, MapFrame, Pose, TiePoints
from tests.alignment.surveys import photo, prior

CAMERA = Camera(width=1000, height=750, focal=830.0, cx=505.0, cy=371.0, k1=-0.08, k2=0.03)
LOCAL = MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="unknown")


def pose(x, y, *, z=60.0, yaw=0.0, pitch=0.0, roll=0.0):
    return Pose(cam_R_map=cam_R_map_from_angles(yaw, pitch, roll), map_C=np.array([x, y, z]))


def seeing_nothing(photos, done, value=90):
    """What an alignment is given of photos without keypoints, whose pixels are all alike."""
    blank = Features(
        px=np.zeros((0, 2)), size=np.zeros(0), descriptors=np.zeros((0, 4), np.uint8), scale=1.0
    )
    return AlignmentInputs(
        photos=photos,
        features=[blank] * len(photos),
        frame=done.frame,
        priors=(),
        links=(),
        control=(),
        order=range(len(photos)),
        grey=lambda i, longest: np.full((48, longest), value, np.uint8),
    )


def cam_R_map_of(poses):
    return np.array([p.cam_R_map for p in poses])


def hills(count, seed=0, wide=80.0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-wide, wide, (count, 2)), rng.normal(0, 2, count)])


def seen(where, xyz):
    local = where.to_camera(xyz)
    px = project(CAMERA, np.where(local[:, 2:] > 1, local, [0, 0, -1]))
    good = ((px > 5) & (px < [994, 744])).all(1)
    return px, good


def block(poses, xyz, *, shows=None):
    """An alignment in which every photo sees the points that fall into it (`shows` may forbid)."""
    rows = []
    for i, where in enumerate(poses):
        px, good = seen(where, xyz)
        if shows and i in shows:
            good &= shows[i](px, xyz)
        rows += [(p, i, *px[p]) for p in np.flatnonzero(good)]
    rows.sort()
    point, photo, u, v = np.array(rows).T
    often = np.bincount(point.astype(int), minlength=len(xyz)) >= 2
    keep = often[point.astype(int)]
    noise = np.random.default_rng(1).normal(0, 0.3, (keep.sum(), 2))
    ties = TiePoints(
        xyz=xyz,
        point=point[keep].astype(np.int64),
        photo=photo[keep].astype(np.int64),
        px=np.column_stack([u, v])[keep],
        residual_px=noise,
    )
    return Alignment(
        method="bundle",
        why="",
        frame=LOCAL,
        poses=dict(enumerate(poses)),
        cameras={"c": CAMERA},
        camera_of=dict.fromkeys(range(len(poses)), "c"),
        blocks=(tuple(range(len(poses))),),
        ties=ties,
    )


LAWN = [pose(x, y) for y in (-30, 0, 30) for x in (-40, -20, 0, 20, 40)]
NOTHING = replace(prior((np.nan,) * 3), yaw_deg=np.nan)


def test_a_sound_block_has_no_weak_photo():
    assert weak_photos(block(LAWN, hills(3000)), [NOTHING] * 15) == {}


def test_a_photo_held_by_a_small_corner_is_named_with_figures():
    corner = {14: lambda px, xyz: (px < 160).all(1)}
    found = weak_photos(block(LAWN, hills(6000), shows=corner), [NOTHING] * 15)
    assert list(found) == [14]
    assert "hangs on the other photos by too little" in found[14]
    assert "% of its picture" in found[14]
    told = [prior((np.nan,) * 3)] * 14 + [prior((40, 30, 60.0), sigma=0.1, sigma_z=0.1)]
    assert weak_photos(block(LAWN, hills(6000), shows=corner), told) == {}


@pytest.mark.parametrize(
    ("roll_deg", "position", "weak"), [(0.0, True, False), (0.0, False, True), (15.0, True, True)]
)
def test_a_photo_without_angles_hangs_on_few_points_where_nothing_else_explains_them(
    roll_deg, position, weak
):
    """Points over 6 % of a picture hold a photo that looks straight down from where it says it is;
    they may show another direction where it has no position, or is found to be tilted."""
    band = {14: lambda px, xyz: px[:, 1] < 52}
    lawn = [*LAWN[:14], pose(40, 30, roll=roll_deg)]
    untold = [replace(prior(p.map_C), yaw_deg=np.nan, sigma_tilt_deg=6.0) for p in LAWN]
    if not position:
        untold = [replace(p, map_C=np.full(3, np.nan)) for p in untold]
    found = weak_photos(block(lawn, hills(20000), shows=band), untold)
    assert list(found) == [14] * weak and all("8% are needed" in why for why in found.values())


def test_photos_that_only_hold_each_other_are_weak_together():
    """Three photos with hundreds of points in common, one of which shares a corner with the rest:
    however well they agree with one another, nothing holds them.
    """
    apart = [pose(130 + 8 * k, 60) for k in range(3)]
    xyz = np.concatenate([hills(3000), hills(2000, 3, 40.0) + [135, 60, 0]])
    first = len(LAWN)
    own = {k: lambda px, xyz: xyz[:, 0] > 90 for k in (first + 1, first + 2)}
    own[first] = lambda px, xyz: (xyz[:, 0] > 90) | (np.arange(len(xyz)) % 400 == 0)
    found = weak_photos(block([*LAWN, *apart], xyz, shows=own), [NOTHING] * (first + 3))
    assert sorted(found) == [first, first + 1, first + 2]


@pytest.mark.parametrize(
    ("displaced_m", "reporting", "kept"), [(0.0, 6, True), (4.0, 6, False), (0.0, 4, False)]
)
def test_a_line_beside_the_rest_is_held_by_its_own_positions(displaced_m, reporting, kept):
    """Six photos that share a corner with the rest, as flight lines far apart do. Their positions
    place them as they would a block that is linked with nothing, unless tie points moved them.
    """
    line = [pose(130, 20 * k - 50) for k in range(6)]
    xyz = np.concatenate([hills(3000), hills(3000, 3, 70.0) + [150, 0, 0]])
    first = len(LAWN)
    own = {first + k: lambda px, xyz: xyz[:, 0] > 90 for k in range(1, 6)}
    own[first] = lambda px, xyz: (xyz[:, 0] > 90) | (np.arange(len(xyz)) % 400 == 0)
    found = block([*LAWN, *line], xyz, shows=own)
    rng = np.random.default_rng(2)
    told = [
        replace(
            prior(found.poses[k].map_C + [*rng.normal(0, 0.5, 2), 0], sigma=0.5), yaw_deg=np.nan
        )
        for k in range(first)
    ]
    for k in range(6):
        at = found.poses[first + k].map_C + [*rng.normal(0, 0.5, 2), 0] + [displaced_m, 0, 0]
        told.append(NOTHING if k >= reporting else replace(prior(at, sigma=0.5), yaw_deg=np.nan))
    left_out = set(weak_photos(found, told))
    assert left_out == (set() if kept else set(range(first, first + 6)))


@pytest.mark.parametrize("wide", [1.0, 0.15])
def test_the_deviation_is_the_scatter_of_resections(wide):
    where, xyz = pose(0, 0, pitch=12, roll=-5), hills(5000)
    px, good = seen(where, xyz)
    good &= (np.abs(px - [500, 375]) < wide * np.array([500, 375])).all(1)
    xyz, px = xyz[good][:40], px[good][:40]
    rng = np.random.default_rng(4)
    sigma = 0.8
    rim = np.array([[20.0, 15], [980, 15], [980, 735], [20, 735]])
    ray = rays(CAMERA, rim) @ where.cam_R_map
    far = where.map_C - ray * (60 / ray[:, 2])[:, None]
    there = project(CAMERA, where.to_camera(far))
    moved = []
    for _ in range(150):
        again, _ = resected(CAMERA, xyz, px + rng.normal(0, sigma, px.shape), 20.0)
        moved.append(np.linalg.norm(project(CAMERA, again.to_camera(far)) - there, axis=1))
    real = np.sqrt((np.array(moved) ** 2).mean(0)).max()
    told = deviation_px(where, CAMERA, xyz, rng.normal(0, sigma, px.shape), None)
    assert real / 1.5 < told < 1.5 * real


def test_observations_without_residuals_are_as_sharp_as_pictures_are_matched():
    """Pictures are matched at 1000 px, smaller ones as they are, to a tenth of a pixel: a photo of
    160 px is known to the same part of a pixel as one of 1000, one of 4000 to four times as much.
    """
    where, xyz = pose(0, 0, pitch=12, roll=-5), hills(5000)
    xyz = xyz[seen(where, xyz)[1]][:30]
    told = []
    for size in (0.16, 1.0, 4.0):
        width, height = round(1000 * size), round(750 * size)
        camera = Camera.ideal(width=width, height=height, focal=830.0 * size)
        told.append(deviation_px(where, camera, xyz, np.zeros((len(xyz), 2)), None))
    assert told[0] == pytest.approx(told[1], rel=0.02)
    assert told[2] == pytest.approx(4 * told[1], rel=0.02)
    assert told[0] < 0.007 * 160


ONE = np.zeros(len(LAWN), int)
"""Links connect all photos."""


@pytest.mark.parametrize("pitch", [0.0, 45.0, 72.0])
def test_resection_finds_the_pose_among_wrong_points(pitch):
    where, xyz = pose(3, -20, yaw=33, pitch=pitch, roll=4), hills(4000, wide=200)
    px, good = seen(where, xyz)
    xyz, px = xyz[good][:300], px[good][:300]
    rng = np.random.default_rng(7)
    px = px + rng.normal(0, 0.5, px.shape)
    wrong = rng.random(len(px)) < 0.4
    px[wrong] = rng.uniform(0, 700, (wrong.sum(), 2))
    found, agreed = resected(CAMERA, xyz, px, 4.0)
    assert np.linalg.norm(found.map_C - where.map_C) < 0.6
    assert agreed[~wrong].mean() > 0.98
    assert agreed[wrong].mean() < 0.05
    none, _ = resected(CAMERA, xyz, rng.uniform(0, 700, px.shape), 4.0)
    assert none is None


def test_reported_tilts():
    level, slanting = prior((0, 0, 60.0)), prior((0, 0, 60.0), pitch=60)
    assert reported_oblique([level] * 8 + [slanting] * 3) == {8, 9, 10}
    assert reported_oblique([level] * 3 + [slanting] * 8) == frozenset()  # an oblique survey
    assert tilt_deg(cam_R_map_from_angles(80, 30, 40)) == pytest.approx(
        np.degrees(np.arccos(np.cos(np.radians(30)) * np.cos(np.radians(40))))
    )


def test_a_photo_that_fell_elsewhere_is_hung_on_the_others_again():
    done = block(LAWN, hills(3000))
    priors = [prior(p.map_C, yaw=0.0) for p in LAWN]
    lost = dict.fromkeys(done.held, 0.7)
    assert found_oblique(done, {}, priors, lost, ONE) == frozenset()
    far = done.poses | {3: pose(-16, 41, z=77, pitch=20)}
    assert found_oblique(replace(done, poses=far), {}, priors, lost, ONE) == {3}
    whole = dict.fromkeys(done.held, 0.9)  # position and angles are false: pictures agree
    assert found_oblique(replace(done, poses=far), {}, priors, whole, ONE) == frozenset()
    near = done.poses | {3: pose(20, -30, pitch=20)}  # where it reports: its angles may be false
    assert found_oblique(replace(done, poses=near), {}, priors, lost, ONE) == frozenset()
    level = done.poses | {3: pose(-16, 41, z=77)}  # its position may be false
    assert found_oblique(replace(done, poses=level), {}, priors, lost, ONE) == frozenset()
    untold = [replace(p, sigma_tilt_deg=6.0) for p in priors]
    assert found_oblique(replace(done, poses=far), {}, untold, lost, ONE) == frozenset()
    most = {i: pose(-16, 41, z=77, pitch=20) for i in range(9)}
    assert (
        found_oblique(replace(done, poses=done.poses | most), {}, priors, lost, ONE) == frozenset()
    )


@pytest.mark.parametrize(
    ("away_m", "turned_deg", "placed"),
    [
        (0.0, 0.0, True),
        (40.0, 0.0, True),
        (0.0, 25.0, True),
        (3.0, 25.0, True),
        (40.0, 25.0, False),
    ],
)
def test_tie_points_do_not_put_an_oblique_photo_far_from_all_that_it_reports(
    away_m, turned_deg, placed
):
    """Ground that looks alike elsewhere does so, with few matches but consistent ones."""
    done = block(LAWN, hills(6000))
    where = pose(0, -25, pitch=45)
    own = done.ties.photo == 7
    seen_px, good = seen(where, done.ties.xyz[done.ties.point[own]])
    px = np.concatenate([done.ties.px[own][good], seen_px[good]])
    some = [
        Features(
            px=at, size=np.ones(len(at)), descriptors=np.zeros((len(at), 4), np.uint8), scale=1.0
        )
        for at in np.split(px, 2)
    ]
    index = np.arange(len(some[0].px), dtype=np.uint16)
    link = Link(a=7, b=15, index_a=index, index_b=index, b_S_a=1 + 0j)
    blank = replace(some[0], px=np.zeros((0, 2)))
    features = [some[0] if i == 7 else blank for i in range(15)] + [some[1]]
    told = prior(where.map_C + [away_m, 0, 0], yaw=0.0, pitch=45.0 + turned_deg)
    priors = [prior(p.map_C, yaw=0.0) for p in LAWN] + [replace(told, sigma_C=np.full(3, 0.02))]
    photos = [replace(photo(f"{i}.jpg"), camera_key="c") for i in range(16)]
    found = hung(done, {}, photos, priors, features, [link], frozenset({15}))
    assert (15 in found.poses) == placed
    if placed:
        assert np.linalg.norm(found.poses[15].map_C - where.map_C) < 0.01
    else:
        assert found.rejected[15] == (
            "its tie points would put it 40 m from its position and turn it by 25 degrees from"
            " what it reports"
        )


def test_a_photo_without_tie_points_in_common_is_told_as_such():
    done = block(LAWN, hills(300))
    photos = [SimpleNamespace(camera_key="c", lens=CAMERA)] * 16
    features = [SimpleNamespace(px=np.zeros((0, 2)), scale=1.0)] * 16
    found = hung(done, {}, photos, [NOTHING] * 16, features, [], frozenset({15}))
    assert found.rejected == {15: "no tie point connects it with photos that are placed"}


def test_photos_without_angles_lie_elsewhere_where_they_lost_their_matches():
    """However they look; and those that look far aslant belong where they keep most of them."""
    done = block(LAWN, hills(3000))
    whole = dict.fromkeys(done.held, 1.0)
    reported = [prior(p.map_C, yaw=0.0) for p in LAWN]
    untold = [replace(p, sigma_tilt_deg=6.0) for p in reported]
    aslant = replace(done, poses=done.poses | {3: pose(-16, 41, pitch=40)})
    assert found_oblique(aslant, {}, untold, whole, ONE) == frozenset()
    assert found_oblique(aslant, {}, untold, whole | {3: 0.7}, ONE) == {3}
    assert found_oblique(done, {}, untold, whole | {3: 0.7}, ONE) == frozenset()
    assert found_oblique(done, {}, untold, whole | {3: 0.5}, ONE) == {3}
    assert found_oblique(done, {}, reported, whole | {3: 0.5}, ONE) == frozenset()
    assert found_oblique(done, {}, untold, dict.fromkeys(whole, 0.5), ONE) == frozenset()


def test_the_dominant_plane_levels_the_map_whatever_stands_on_it():
    xyz = hills(2000)
    xyz[:, 2] *= 0.3
    xyz[:700, 2] += np.random.default_rng(3).uniform(4, 15, 700)  # trees
    done = block(LAWN, xyz)
    Q = rotation_from_vector(np.array([0.2, -0.15, 0.0]))
    tilted = replace(
        done,
        poses={
            i: Pose(cam_R_map=p.cam_R_map @ Q.T, map_C=Q @ p.map_C) for i, p in done.poses.items()
        },
        ties=replace(done.ties, xyz=xyz @ Q.T),
    )
    again = levelled(tilted)
    assert np.degrees(np.arccos(dominant_normal(again.ties.xyz, 1.8)[2])) < 0.05
    assert max(tilt_deg(p.cam_R_map) for p in again.poses.values()) < 0.4
    for i, where in again.poses.items():  # nothing in the pictures changes
        before = project(CAMERA, tilted.poses[i].to_camera(tilted.ties.xyz[:50]))
        after = project(CAMERA, where.to_camera(again.ties.xyz[:50]))
        np.testing.assert_allclose(after, before, atol=1e-6)


@pytest.mark.parametrize(
    ("pitch", "lines", "slope", "climb", "vertical"),
    [
        (0.0, (0, 180, 0), 20.0, 20.0, True),
        (0.0, (0, 180, 0), 0.0, 0.0, True),
        (25.0, (0, 180, 0), 0.0, 0.0, False),  # cameras tilted on their drones look two ways
        (25.0, (0, 0, 0), 0.0, 0.0, False),  # and so might these on a slope: the ground counts
        (0.0, (0, 0, 0), 20.0, 0.0, True),  # flown at one height over a slope
        (0.0, (0, 0, 0), 20.0, 20.0, False),  # along it: cameras might be tilted
    ],
)
def test_ground_is_a_slope_where_photos_of_several_headings_or_one_height_look_the_same_way(
    pitch, lines, slope, climb, vertical
):
    rng = np.random.default_rng(4)
    xyz = hills(2000) * (1, 1, 0.3)
    xyz[:, 2] += np.tan(np.radians(slope)) * xyz[:, 0]
    flown = [
        pose(x, y, z=60 + np.tan(np.radians(climb)) * x, yaw=yaw, pitch=pitch + rng.normal(0, 1))
        for y, yaw in zip((-30, 0, 30), lines, strict=True)
        for x in (-40, -20, 0, 20, 40)
    ]
    done = block(flown, xyz)
    Q = rotation_from_vector(np.array([0.3, -0.2, 0.4]))
    turned = replace(
        done,
        poses={
            i: Pose(cam_R_map=p.cam_R_map @ Q.T, map_C=Q @ p.map_C) for i, p in enumerate(flown)
        },
        ties=replace(done.ties, xyz=xyz @ Q.T),
    )
    again = levelled(turned)
    tilts = [tilt_deg(p.cam_R_map) for p in again.poses.values()]
    assert (np.median(tilts) < 2) == vertical
    ground = np.degrees(np.arccos(dominant_normal(again.ties.xyz, 1.8)[2]))
    assert ground == pytest.approx(slope if vertical else 0.0, abs=1.0)


@pytest.mark.parametrize(("slope", "climb", "most"), [(4.0, 0.0, 0.9), (4.0, 4.0, 2.5)])
def test_ground_that_slopes_a_little_tilts_a_map_less_than_it_slopes(slope, climb, most):
    """Axes 1 degree off one by one, and level flight, or flight along the slope, count as well."""
    rng = np.random.default_rng(5)
    xyz = hills(2000) * (1, 1, 0.1)
    xyz[:, 2] += np.tan(np.radians(slope)) * xyz[:, 0]
    flown = [
        pose(x, y, z=60 + np.tan(np.radians(climb)) * x, yaw=yaw, pitch=rng.normal(0, 1))
        for y, yaw in zip((-30, 0, 30), (0, 180, 0), strict=True)
        for x in (-40, -20, 0, 20, 40)
    ]
    again = levelled(block(flown, xyz))
    leaning = cam_R_map_of(flown).transpose(0, 2, 1) @ cam_R_map_of(again.poses.values())
    assert np.degrees(np.arccos(leaning[:, 2, 2])).max() < most


def test_a_photo_without_links_is_not_drawn_over_what_others_show():
    """A lens cap in the middle of a survey adds black; at its rim it might be woods or water."""
    done = block(LAWN, hills(3000))
    assert shown_already(pose(0, 0), CAMERA, done)
    assert shown_already(pose(70, 0, z=-1.0), CAMERA, done)  # taken on the ground
    assert not shown_already(pose(75, 0), CAMERA, done)
    # what is far aside is not shown, though a polynomial of the lens folds it into the picture
    folding = replace(CAMERA, k1=-0.0092, k2=0.0231, k3=-0.0366)
    lens = replace(done, cameras=dict.fromkeys(done.cameras, folding))
    assert share_shown(pose(0, 0), folding, lens, lens.held) > 0.95
    ring = [pose(x, y) for x in (-160, -120, 0, 120, 160) for y in (-160, -120, 120, 160)]
    assert max(share_shown(p, folding, lens, lens.held) for p in ring) == 0


@pytest.mark.parametrize(("away_m", "left_out"), [(0.0, True), (15.0, True), (70.0, False)])
def test_photos_that_only_match_one_another_are_not_drawn_over_what_the_others_show(
    away_m, left_out
):
    """Two pictures of a room, taken before the flight, are linked with each other; so are photos
    of a second field, which are part of the map.
    """
    two = [pose(away_m, 0), pose(away_m + 10, 0)]
    done = block([*LAWN, *two], hills(3000))
    own = tuple(range(len(LAWN)))
    done = replace(done, blocks=(own, (15, 16)))
    photos = [photo(f"{i}.jpg", key="A") for i in range(len(LAWN) + 2)]
    found = without_strange_blocks(done, seeing_nothing(photos, done))
    assert found.poses.keys() == {*own, *(() if left_out else (15, 16))}
    assert found.rejected.keys() == ({15, 16} if left_out else set())
    assert any("2 photos are left out" in note for note in found.notes) == left_out
    assert set(found.ties.photo) == found.poses.keys()


@pytest.mark.parametrize(
    ("low_m", "high_m", "apart_m", "left_out"),
    [
        (0.3, 60.0, 0.4, True),  # pictures of the ground at take-off
        (6.0, 60.0, 0.4, False),  # a hover
        (0.3, 60.0, 15.0, False),  # a strip as high as take-off, over a valley
        (0.3, 12.0, 0.4, False),  # a flight hardly above the ground
        (None, 60.0, 0.4, False),
    ],
)
def test_photos_taken_on_the_ground_are_left_out_whatever_their_number(
    low_m, high_m, apart_m, left_out
):
    ground = [pose(90 + apart_m * k, 0, z=7.0) for k in range(10)]
    done = block([*LAWN, *ground], hills(3000))
    own, others = tuple(range(15)), tuple(range(15, 25))
    done = replace(done, blocks=(own, others))
    photos = [
        photo(f"{i}.jpg", key="A", position=None, height_m=high_m if i in own else low_m)
        for i in range(25)
    ]
    found = without_strange_blocks(done, seeing_nothing(photos, done))
    assert found.rejected.keys() == (set(others) if left_out else set())
    assert any("on the ground" in note and "15.jpg" in note for note in found.notes) == left_out


@pytest.mark.parametrize(("level", "placed"), [(0, False), (255, False), (11, False), (90, True)])
def test_a_black_or_white_photo_is_not_placed_by_its_metadata(level, placed):
    where = [pose(20.0 * x, 20.0 * y) for x in range(3) for y in range(3)]
    done = replace(block(where, hills(600)), frame=replace(LOCAL, crs="EPSG:32630"))
    photos = [photo(f"{i}.jpg", key="A") for i in range(10)]
    priors = [*(prior(p.map_C) for p in where), prior((110.0, 20.0, 60.0))]
    inputs = replace(seeing_nothing(photos, done, level), priors=priors)
    found = with_loose_photos(done, inputs)
    assert (9 in found.poses) == placed
    assert placed or "black or white" in found.rejected[9]
    assert not placed or found.notes[-1].startswith("9.jpg is placed by its metadata: it could")


# places by which oblique photos are paired


def rig(at, height=60.0, tilt=45.0):
    """Priors of five cameras on a drone at places (x, y): down, and aslant to four sides."""
    return [
        replace(prior((x, y, height)), pitch_deg=pitch, yaw_deg=float(yaw))
        for x, y in at
        for yaw, pitch in [(0, 0.0), *((side, tilt) for side in (0, 90, 180, 270))]
    ]


@settings(max_examples=50, deadline=None)
@given(st.floats(36, 59), st.floats(-180, 180), st.floats(20, 300), st.floats(-50, 500))
def test_where_an_oblique_photo_looks_is_where_its_axis_meets_the_ground(tilt, yaw, height, ground):
    told = replace(prior((7.0, -3.0, ground + height)), pitch_deg=tilt, yaw_deg=yaw)
    places = looked_at([told, prior((0, 0, ground + height))], ground)
    ray = cam_R_map_from_angles(yaw, tilt)[2]
    meets = told.map_C - ray * height / ray[2]
    assert np.allclose(meets, [*places[0, :2], ground], atol=1e-6 * height)
    assert np.linalg.norm(places[0, 2:]) == pytest.approx(height * np.sin(np.radians(tilt)))
    assert np.allclose(places[1], 0, atol=1e-9)  # looks straight down


def test_photos_that_tell_no_view_count_by_their_position():
    level = [prior((x, 0.0, 60.0)) for x in (0, 10)]
    slanting = replace(level[0], pitch_deg=50.0)
    unknown = replace(slanting, yaw_deg=np.nan)
    assert looked_at(level, 0.0) is None
    assert looked_at([*level, slanting], np.nan) is None  # nothing tells how far it looks
    assert looked_at([*level, slanting, unknown], 0.0)[3].tolist() == [0, 0, 0, 0]
    below = replace(slanting, map_C=np.array([0.0, 0, -20]))  # counts as high as the others
    horizon = replace(slanting, pitch_deg=89.0)
    places = looked_at([*level, slanting, below, horizon], 0.0)
    assert places[3].tolist() == places[2].tolist()
    assert 60 * 1.7 < np.linalg.norm(places[4, :2]) < 60 * 2.01


def test_photos_of_five_cameras_are_paired_with_those_that_look_alike():
    """By positions, four of each photo's nearest ones were of its own place, and show the ground
    from other sides: a drone with five cameras was mapped in parts.
    """
    at = [(18.0 * x, 24.0 * y) for y in range(4) for x in range(5)]
    priors = rig(at)
    side = [k % 5 for k in range(len(priors))]
    near = {
        (i, j)
        for i in range(len(priors))
        for j in range(i + 1, len(priors))
        if side[i] == side[j] and np.hypot(*np.subtract(at[i // 5], at[j // 5])) < 31
    }

    def missed(places):
        return len(near - set(Nearest()(places))) / len(near)

    assert missed(looked_at(priors, 0.0)) == 0
    assert missed(np.array([p.map_C[:2] for p in priors])) > 0.4
