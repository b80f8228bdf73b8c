"""A fisheye whose kind no metadata tell is found while the map grows."""

import json

import numpy as np
import pytest

from skyquilt.live.live_map import LiveMap
from skyquilt.live.members import FISHEYES
from skyquilt.live.settings import LiveSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from tests.live.conftest import fed, made, offsets

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """12 photos of 800 x 600 px and 118 degrees."""
    return made(
        tmp_path_factory,
        "live-fisheye",
        seed=641,
        lens=Lens(fisheye=True).scaled(800, 600).seeing(118.0),
        route=Route(photos=12, height=50.0),
        control=Control(points=0, checks=0),
    )


def opened(folder):
    return LiveMap(folder, LiveSettings(deterministic=True))


def test_photos_of_a_fisheye_are_adjusted_as_such(wide, tmp_path):
    live = fed(opened(tmp_path / "out"), wide.photos)
    try:
        members = list(live.members.by_id.values())
        assert [m.state for m in members] == ["refined"] * 12
        assert all(m.photo.lens.fisheye for m in members)
        (key,) = {m.camera for m in members}
        camera, truth = live.members.cameras[key], wide.truth["cameras"]["visible"]
        assert camera.fisheye and camera.focal == pytest.approx(truth["focal"], rel=0.02)
        away = offsets(live, wide)[:, :2]
        assert np.sqrt(((away - away.mean(0)) ** 2).mean(0)).max() < 0.6  # positions: 2 m
        told = [json.loads(body) for (body,) in live.ledger.rows("select body from event")]
        assert sum("fisheye" in body.get("text", "") for body in told) == 1
    finally:
        live.close()


def test_a_restart_goes_on_with_the_same_lens(wide, tmp_path):
    through = fed(opened(tmp_path / "through"), wide.photos[:9])
    begun = fed(opened(tmp_path / "again"), wide.photos[:7])
    lens = begun.members.by_id[1].photo.lens
    begun.close()
    again = opened(tmp_path / "again")
    try:
        assert again.members.by_id[1].photo.lens == lens and lens.fisheye
        fed(again, wide.photos[7:9])
        for a, b in zip(through.members.on_map(), again.members.on_map(), strict=True):
            assert a.links == b.links
            assert np.array_equal(a.pose.map_C, b.pose.map_C)
    finally:
        through.close()
        again.close()


@pytest.mark.parametrize("said", ["text", [1], {"camera": "wide"}, {"camera": -3}, {"camera": 1e9}])
def test_damaged_lenses_count_as_none(wide, tmp_path, said):
    live = fed(opened(tmp_path / "out"), wide.photos[:1])
    live.ledger.put_meta(FISHEYES, said)
    live.close()
    live = opened(tmp_path / "out")
    try:
        assert not live.members.fisheyes
    finally:
        live.close()


def test_a_pinhole_is_asked_now_and_then_and_stays_one(tmp_path_factory, tmp_path):
    settings = {"seed": 3, "route": Route(photos=14), "control": Control(points=0, checks=0)}
    live = fed(opened(tmp_path / "out"), made(tmp_path_factory, "marks", **settings).photos)
    try:
        lenses, (camera,) = (
            live.live_links.lenses,
            {m.photo.camera_key for m in live.members.on_map()},
        )
        assert lenses._asked[camera] >= 4 and not live.members.fisheyes
        assert not lenses.asks(
            live.members.by_id[1].photo
        )  # not before there are twice as many links
    finally:
        live.close()
