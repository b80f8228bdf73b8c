"""The scale of a pair: what is weighed, and that a scale moves nothing in the photos."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.depth.pair_scale import GROUND, LASTING_M, pair_scale, scaled, weighed
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.photo import GeoPosition
from skyquilt.model.poses import Alignment, ControlResidual, MapFrame, Pose, no_ties
from tests.alignment.surveys import photo, prior

CAMERA = Camera.ideal(width=800, height=600, focal=640)


def pair(above=60.0, baseline=15.0):
    """Two placed photos over ground at 440 m on which a tenth stands 10 m high, and their ties."""
    rng = np.random.default_rng(0)
    poses = {
        i: Pose(
            cam_R_map=cam_R_map_from_angles(10.0 + i, 1.0, -2.0),
            map_C=np.array([100.0 + i * baseline, 50.0, 440.0 + above]),
        )
        for i in (0, 1)
    }
    xyz = np.c_[rng.uniform(80, 140, (200, 1)), rng.uniform(30, 70, (200, 1)), np.full(200, 440.0)]
    xyz[:20, 2] += 10
    return Alignment(
        method="bundle",
        why="",
        frame=MapFrame(crs="EPSG:32633", origin=(0.0, 0.0), vertical_datum="sea_level"),
        poses=poses,
        cameras={"c": CAMERA},
        camera_of={0: "c", 1: "c"},
        blocks=((0, 1),),
        ties=replace(no_ties(), xyz=xyz),
    )


def reported(takeoff, sigma=1.5):
    position = GeoPosition(
        latitude_deg=50.0,
        longitude_deg=10.0,
        altitude_m=500.0,
        datum="sea_level",
        takeoff_m=takeoff,
    )
    return [photo(position=position)] * 2, [prior([0, 0, 500], sigma=sigma)] * 2


def test_the_weights_err_less_than_either_scale_and_than_any_fixed_weight():
    """Drawn from what is assumed: ground of any height, receivers of both kinds."""
    rng = np.random.default_rng(1)
    sigma, lasting, n = 0.15, 0.02, 20000
    kind = rng.random(n) < 0.5
    by_positions = rng.normal(0, np.where(kind, sigma, lasting))
    by_heights = rng.normal(0, GROUND, n)
    found = [
        p + np.log(weighed(h - p, sigma, lasting).factor)
        for p, h in zip(by_positions, by_heights, strict=True)
    ]
    fixed = [
        np.sqrt(np.mean((by_positions + w * (by_heights - by_positions)) ** 2))
        for w in np.linspace(0, 1, 21)
    ]
    error = np.sqrt(np.mean(np.square(found)))
    assert 0.8 * min(fixed) < error < 0.95 * min(fixed)


def test_exact_positions_keep_their_scale_and_none_leave_it_to_the_heights():
    assert weighed(0.2, 1e-4, 0.02).factor == pytest.approx(1, abs=1e-4)
    assert weighed(0.2, 50.0, 50.0).factor == pytest.approx(np.exp(0.2), rel=1e-4)
    assert weighed(0.0, 0.1, 0.02).factor == 1
    assert weighed(3.0, 0.1, 0.02).share <= 1  # a gross error stays finite


def test_the_height_is_that_above_the_ground_not_above_what_stands_there():
    photos, priors = reported(66.0)
    found = pair_scale(pair(), photos, priors)
    expected = weighed(np.log(66 / 60), 1.5 * np.sqrt(2) / 15, LASTING_M / 15)
    assert found == expected and 1.01 < found.factor < 1.1


def test_no_scale_without_heights_or_two_photos_or_where_control_tells_it():
    photos, priors = reported(66.0)
    whole = pair()
    control = ControlResidual(
        name="1", check=False, error_m=np.zeros(3), reprojection_px=0.0, observations=2
    )
    assert pair_scale(replace(whole, poses={0: whole.poses[0]}), photos, priors) is None
    assert pair_scale(replace(whole, control=(control,)), photos, priors) is None
    assert pair_scale(replace(whole, ties=no_ties()), photos, priors) is None
    assert pair_scale(whole, *reported(None)) is None
    assert pair_scale(whole, *reported(66.0, sigma=np.inf)) is None


def test_another_scale_moves_nothing_in_the_photos():
    before, after = pair(), scaled(pair(), 1.2)
    for i in (0, 1):
        a, b = (x.poses[i].to_camera(x.ties.xyz) for x in (before, after))
        assert np.allclose(b, 1.2 * a)
    centres = [np.array([p.map_C for p in x.poses.values()]) for x in (before, after)]
    assert np.allclose(*(c.mean(0) for c in centres))
    assert np.ptp(centres[1][:, 0]) == pytest.approx(18)
