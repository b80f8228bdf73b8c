"""Observations are moved to where larger images agree; the truth is a painted ground."""

import numpy as np
import pytest

from skyquilt.alignment import least_squares_matching
from skyquilt.alignment.least_squares_matching import LeastSquaresMatching
from skyquilt.alignment.tracks import Tracks
from skyquilt.geometry.camera import project
from skyquilt.imaging.grey import shrink
from tests.ortho.scenes import block, photograph


@pytest.fixture(scope="module")
def scene():
    """Photos, ground points (n, 3), and tracks of true observations."""
    views = {v.photo: v for v in block()}
    pictures = {i: np.clip(photograph(v), 0, 255).astype(np.uint8) for i, v in views.items()}
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(-20, 20, 500), rng.uniform(-14, 14, 500), np.zeros(500)])
    rows = []
    for point, X in enumerate(xyz):
        for photo, view in views.items():
            (px,) = project(view.camera, view.pose.to_camera(X[None]))
            if (px > 25).all() and (px < (374, 274)).all():
                rows.append((point, photo, *px))
    point, photo, u, v = np.array(rows).T
    several = np.bincount(point.astype(int), minlength=500)[point.astype(int)] > 1
    known, number = np.unique(point[several].astype(int), return_inverse=True)
    tracks = Tracks(
        point=number,
        photo=photo[several].astype(int),
        px=np.column_stack([u, v])[several],
        sigma_px=np.full(int(several.sum()), 0.5),
    )
    return views, pictures, xyz[known], tracks


def sharpened(scene, px):
    found = matched(scene, px)
    return found.px, found.sigma_px


def matched(scene, px, longest=1000):
    views, pictures, xyz, tracks = scene
    return LeastSquaresMatching(longest=longest)(
        Tracks(point=tracks.point, photo=tracks.photo, px=px, sigma_px=tracks.sigma_px),
        xyz,
        {i: v.pose for i, v in views.items()},
        {i: v.camera for i, v in views.items()},
        lambda photo, longest: shrink(pictures[photo], longest)[0],
    )


def disturbed(scene):
    """Observations wrong by a pixel or so, except for the most central one of each point."""
    _, _, _, tracks = scene
    off = np.linalg.norm(tracks.px / (400, 300) - 0.5, axis=1)
    first = np.array([off[tracks.point == p].min() for p in range(tracks.count)])
    wrong = off > first[tracks.point]
    rng = np.random.default_rng(6)
    outwards = np.sign(tracks.px - (200, 150)) * rng.uniform(0.2, 1.3, tracks.px.shape)
    return tracks.px + wrong[:, None] * outwards, wrong


def test_observations_move_to_where_the_central_one_looks(scene):
    px, wrong = disturbed(scene)
    truth = scene[3].px
    found, sigma = sharpened(scene, px)
    assert np.array_equal(found[~wrong], px[~wrong])
    moved = wrong & (sigma < 0.5)
    assert moved.sum() > 0.8 * wrong.sum()
    before, after = (np.linalg.norm(p[moved] - truth[moved], axis=1) for p in (px, found))
    assert np.median(before) > 0.8 and np.median(after) < 0.1
    assert np.percentile(after, 95) < 0.4


def test_where_photos_differ_observations_are_known_to_be_blunter(scene):
    """In the western half each photo sees its own noise, as in leaves that move."""
    views, pictures, xyz, tracks = scene
    rng = np.random.default_rng(8)
    west = xyz[tracks.point, 0] < 0
    noisy = {}
    for i, view in views.items():
        height, width = pictures[i].shape
        v, u = np.mgrid[:height, :width]
        local = np.stack([(u - view.camera.cx), (v - view.camera.cy)], 2) / view.camera.focal
        ray = np.concatenate([local, np.ones((height, width, 1))], 2) @ view.pose.cam_R_map
        ground = view.pose.map_C[0] - ray[..., 0] / ray[..., 2] * view.pose.map_C[2]
        level = np.where(ground < 0, 12.0, 0.0)
        noisy[i] = np.clip(pictures[i] + rng.normal(0, 1, level.shape) * level, 0, 255).astype(
            np.uint8
        )
    px, wrong = disturbed(scene)
    found = matched((views, noisy, xyz, tracks), px)
    moved = wrong & (found.sigma_px < 0.5)
    error = np.linalg.norm(found.px - tracks.px, axis=1)
    told = [np.median(found.relative[moved & side]) for side in (west, ~west)]
    actual = [np.median(error[moved & side]) for side in (west, ~west)]
    assert actual[0] > 1.5 * actual[1]
    assert 0.6 < (told[0] / told[1]) / (actual[0] / actual[1]) < 1.6


def test_rounded_sides_of_reduced_pictures_do_not_stretch_observations(scene):
    """Of 300 rows a picture of 250 px has 188, not 187.5: 0.27 % more."""
    tracks = scene[3]
    px, wrong = disturbed(scene)
    found = matched(scene, px, longest=250)
    off = np.linalg.norm(tracks.px / (400, 300) - 0.5, axis=1)
    first = np.array([tracks.px[own][off[own].argmin()] for own in of_points(tracks)])
    moved = wrong & (found.sigma_px < 0.5)
    apart, error = (
        (p - q)[moved, 1]
        for p, q in zip((tracks.px, found.px), (first[tracks.point], tracks.px), strict=True)
    )
    good = np.abs(error) < 0.6
    assert moved.sum() > 0.5 * wrong.sum() and good.mean() > 0.9
    assert abs(np.polyfit(apart[good], error[good], 1)[0]) < 7e-4


def of_points(tracks):
    return [np.flatnonzero(tracks.point == p) for p in range(tracks.count)]


def test_what_does_not_look_alike_stays(scene):
    views, pictures, xyz, tracks = scene
    px, wrong = disturbed(scene)
    rng = np.random.default_rng(7)
    noise = {i: rng.integers(0, 255, p.shape, np.uint8) for i, p in pictures.items()}
    found, sigma = sharpened((views, noise, xyz, tracks), px)
    assert (found == px).all(1).mean() > 0.99 and (sigma == 0.5).mean() > 0.99


def test_places_that_no_patch_confirms_count_least(scene):
    """In one of the photos there is nothing but noise."""
    views, pictures, xyz, tracks = scene
    px, _ = disturbed(scene)
    spoilt = min(pictures)
    noise = np.random.default_rng(7).integers(0, 255, pictures[spoilt].shape, np.uint8)
    found = matched((views, pictures | {spoilt: noise}, xyz, tracks), px)
    stays = (tracks.photo == spoilt) & (found.sigma_px == 0.5)
    assert stays.sum() > 50
    assert (found.relative[stays] == LeastSquaresMatching().bluntest).all()
    assert np.median(found.relative[tracks.photo != spoilt]) < 1.5


def test_parts_do_not_change_the_result(scene, monkeypatch):
    px, _ = disturbed(scene)
    whole = sharpened(scene, px)
    monkeypatch.setattr(least_squares_matching, "PART", 200)
    assert len(list(scene[3].parts(200))) > 5
    in_parts = sharpened(scene, px)
    assert all(np.array_equal(a, b) for a, b in zip(whole, in_parts, strict=True))


def test_no_observations_are_no_fault(scene):
    views, pictures, _, _ = scene
    nothing = Tracks(
        point=np.zeros(0, np.int64),
        photo=np.zeros(0, np.int64),
        px=np.zeros((0, 2)),
        sigma_px=np.zeros(0),
    )
    found = LeastSquaresMatching()(nothing, np.zeros((0, 3)), {}, {}, lambda p, _: pictures[p])
    assert len(found.px) == 0
