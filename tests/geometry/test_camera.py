"""Projection against OpenCV, its derivatives against differences, its inverse against itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from skyquilt.geometry.camera import (
    FURTHEST,
    distort,
    monotone_radius,
    pixels,
    project,
    project_with_derivatives,
    rays,
    shown,
    undistort,
)
from skyquilt.model.camera import Camera

small = st.floats(-0.01, 0.01)


@st.composite
def cameras(draw, fisheye=None):
    width, height = draw(st.integers(300, 6000)), draw(st.integers(300, 6000))
    focal = draw(st.floats(0.5, 3.0)) * max(width, height)
    return Camera(
        width=width,
        height=height,
        focal=focal,
        cx=(width - 1) / 2 + draw(st.floats(-0.05, 0.05)) * width,
        cy=(height - 1) / 2 + draw(st.floats(-0.05, 0.05)) * height,
        k1=draw(st.floats(-0.35, 0.35)),
        k2=draw(st.floats(-0.15, 0.15)),
        k3=draw(st.floats(-0.05, 0.05)),
        p1=draw(small),
        p2=draw(small),
        fisheye=float(draw(st.booleans()) if fisheye is None else fisheye),
    )


def points(seed, count=40, spread=0.6):
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 200, count)
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)) * z[:, None], z])


@given(cameras(fisheye=False), st.integers(0, 2**31))
def test_projection_is_opencv_s(camera, seed):
    xyz = points(seed)
    k = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    theirs = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.matrix, k)[0][:, 0]
    assert project(camera, xyz) == pytest.approx(theirs, abs=1e-8 * camera.focal)


@given(cameras(fisheye=True), st.integers(0, 2**31))
def test_a_fisheye_is_opencv_s_without_tangential_terms(camera, seed):
    camera = replace(camera, p1=0.0, p2=0.0)
    xyz = points(seed, spread=2.5)
    k = np.array([camera.k1, camera.k2, camera.k3, 0.0])
    theirs = cv2.fisheye.projectPoints(xyz[None], np.zeros(3), np.zeros(3), camera.matrix, k)[0][0]
    assert project(camera, xyz) == pytest.approx(theirs, abs=1e-8 * camera.focal)


def test_lenses_of_both_kinds_are_projected_together():
    pinhole = Camera(width=400, height=300, focal=350, cx=200, cy=150, k1=-0.1, p1=0.001)
    both = (pinhole, replace(pinhole, fisheye=1.0))
    xyz = points(3, 10)
    k = np.repeat([c.vector for c in both], len(xyz), axis=0)
    found = project_with_derivatives(k, np.tile(xyz, (2, 1)))
    for n, camera in enumerate(both):
        own = slice(n * len(xyz), (n + 1) * len(xyz))
        alone = project_with_derivatives(k[own], xyz)
        assert found.px[own] == pytest.approx(project(camera, xyz), abs=1e-9)
        assert found.d_point[own] == pytest.approx(alone.d_point, abs=1e-9)
        assert found.d_intrinsics[own] == pytest.approx(alone.d_intrinsics, abs=1e-9)


def test_behind_the_camera_is_nowhere():
    camera = Camera.ideal(width=400, height=300, focal=350)
    px = project(camera, np.array([[0.0, 0, 5], [1.0, 1, -5], [0.0, 0, 0], [2.0, 0, 1e-9]]))
    assert np.isnan(px).all(1).tolist() == [False, True, True, False]
    assert px[0] == pytest.approx([199.5, 149.5])


@settings(max_examples=40)
@given(cameras(), st.integers(0, 2**31))
def test_derivatives_are_those_of_the_projection(camera, seed):
    xyz = points(seed, 12)
    k = np.tile(camera.vector, (len(xyz), 1))
    exact = project_with_derivatives(k, xyz)
    assert exact.px == pytest.approx(project(camera, xyz), abs=1e-9 * camera.focal)

    def px(k, xyz):
        return pixels(xyz[:, :2] / xyz[:, 2:], k)

    for axis in range(3):
        h = 1e-6 * xyz[:, 2:]
        step = np.eye(3)[axis] * h
        numeric = (px(k, xyz + step) - px(k, xyz - step)) / (2 * h)
        assert exact.d_point[:, :, axis] == pytest.approx(
            numeric, rel=1e-6, abs=2e-6 * camera.focal / 0.5
        )
    assert not exact.d_intrinsics[:, :, 9].any()  # the kind of lens
    for column in range(9):
        h = 1e-6 * (camera.focal if column < 3 else 1.0)
        step = np.eye(10)[column] * h
        numeric = (px(k + step, xyz) - px(k - step, xyz)) / (2 * h)
        scale = max(1.0, float(np.abs(numeric).max()))
        assert exact.d_intrinsics[:, :, column] == pytest.approx(numeric, abs=1e-7 * scale)


@settings(max_examples=80)
@given(cameras(), st.integers(0, 2**31))
def test_undistortion_inverts_distortion(camera, seed):
    """Wherever the image's own pixels are (their radius may be beyond what folds: not asked of
    those).
    """
    rng = np.random.default_rng(seed)
    reach = min(0.98 * monotone_radius(camera), 3.0 if camera.fisheye else 0.9)
    radius, angle = reach * np.sqrt(rng.random(60)), rng.uniform(0, 2 * np.pi, 60)
    xy = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    jacobian = project_with_derivatives(
        np.tile(np.r_[1, 0, 0, camera.vector[3:8], 1, camera.fisheye], (60, 1)),
        np.c_[xy, np.ones(60)],
    )
    assume(
        np.linalg.det(jacobian.d_point[:, :, :2]).min() > 0.02
    )  # tangential terms may fold earlier
    if camera.fisheye:  # the same of the polynomial alone, at the angle
        turned = xy / radius[:, None] * np.arctan(radius)[:, None]
        flat = project_with_derivatives(
            np.tile(np.r_[1, 0, 0, camera.vector[3:8], 1, 0], (60, 1)), np.c_[turned, np.ones(60)]
        )
        assume(np.linalg.det(flat.d_point[:, :, :2]).min() > 0.02)
    px = project(camera, np.c_[xy, np.ones(60)])
    assert undistort(camera, px) == pytest.approx(xy, abs=1e-9)
    assert rays(camera, px) == pytest.approx(np.c_[xy, np.ones(60)], abs=1e-9)


def test_a_fisheye_s_picture_beyond_80_degrees_is_taken_for_its_rim():
    camera = replace(Camera.ideal(width=4000, height=3000, focal=1100), fisheye=1.0)
    corner = rays(camera, np.array([[0.0, 0.0], [3999.0, 2999.0]]))
    assert np.degrees(np.arctan(np.hypot(*corner.T[:2]))) == pytest.approx(
        np.degrees(FURTHEST), abs=1e-9
    )
    assert monotone_radius(camera) == pytest.approx(np.tan(FURTHEST))


def test_any_shape_and_no_points():
    camera = Camera(width=400, height=300, focal=350, cx=200, cy=150, k1=-0.1, p1=0.001)
    px = np.random.default_rng(0).uniform(0, 300, (4, 5, 2))
    assert undistort(camera, px)[2, 3] == pytest.approx(undistort(camera, px[2, 3:4])[0], abs=1e-12)
    assert undistort(camera, np.zeros((0, 2))).shape == (0, 2)
    assert rays(camera, px).shape == (4, 5, 3)


@given(st.floats(-2, -0.05))
def test_radius_of_the_fold_of_a_barrel(k1):
    """Slope 1 + 3 k1 r^2 falls to 0.05 at r = sqrt(0.95 / (-3 k1)), on steps of 0.005."""
    exact = np.sqrt(0.95 / (-3 * k1))
    found = monotone_radius(Camera(width=100, height=100, focal=100, cx=50, cy=50, k1=k1))
    assert min(exact, 3.0) <= found + 1e-12 <= min(exact, 3.0) + 0.005 + 1e-9


@given(cameras(fisheye=False))
def test_distortion_grows_up_to_that_radius_and_hardly_beyond(camera):
    limit = monotone_radius(camera)
    r = np.linspace(0, limit - 0.006, 500)
    k = np.r_[camera.vector[:6], 0, 0, 1, 0]
    assert (np.diff(distort(np.c_[r, 0 * r], k)[:, 0]) > 0).all()
    if limit < 3:
        step = distort(np.array([[limit, 0.0], [limit + 1e-6, 0.0]]), k)[:, 0]
        assert np.diff(step)[0] <= 0.051e-6
    mirror = Camera.ideal(width=10, height=10, focal=10)
    assert monotone_radius(mirror) == 3.0


@pytest.mark.parametrize(
    "lens",
    [
        {},
        {"k1": -0.2, "k2": 0.06},
        {"k1": -0.0092, "k2": 0.0231, "k3": -0.0366},  # as adjusted: folds back at 1.3
        {"k1": 0.02, "p1": 1e-3, "p2": -1e-3},
        {"fisheye": 1.0, "k1": -0.03},
    ],
)
def test_what_a_picture_shows_lies_on_the_rays_of_its_pixels(lens):
    """Points far aside, that a polynomial folds into the picture, do not."""
    camera = replace(Camera.ideal(width=800, height=600, focal=500.0), **lens)
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (20000, 3)) * [4, 4, 1]
    px, there = shown(camera, xyz)
    assert 50 < there.sum() < 2000 and (xyz[there, 2] > 0).all()
    back = rays(camera, px[there])
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    true = xyz[there] / np.linalg.norm(xyz[there], axis=1, keepdims=True)
    np.testing.assert_allclose(back, true, atol=1e-5)
    column, row = np.meshgrid(np.arange(1, 799, 40.0), np.arange(1, 599, 40.0))
    inside = np.column_stack([column.ravel(), row.ravel()])
    px, there = shown(camera, 7.0 * rays(camera, inside))
    assert there.all()
    np.testing.assert_allclose(px, inside, atol=0.01)
