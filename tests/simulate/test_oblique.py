"""Oblique photos: the sky is where the true rays go up, and the other photos stay the same."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.errors import UsageError
from skyquilt.simulate import prepare, preset
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.expose import exposer
from skyquilt.simulate.flight import fly, plan
from skyquilt.simulate.scene import empty_scene
from skyquilt.simulate.settings import FlightSettings, Pictures, Route

LENS = Lens().scaled(320, 240)


def test_the_other_photos_are_the_same_and_eight_of_forty_show_five_skies():
    route = Route(photos=32)
    plain, mixed = (
        fly(plan(r, LENS), r, 1.5, 3, "SIM") for r in (route, replace(route, oblique=8))
    )
    extra = [s for s in mixed if "oblique" in s.name]
    assert [s for s in mixed if s not in extra] == plain
    assert len(extra) == 8
    assert sorted(s.pitch for s in extra) == pytest.approx(np.linspace(57, 80, 8))
    half = np.degrees(np.arctan((LENS.height / 2 - LENS.offset_y) / LENS.focal))
    assert sum(s.pitch + half > 90 for s in extra) == 5


def test_impossible_numbers_are_refused():
    for change in ({"oblique": -1}, {"oblique_tilts": (60.0, 85.0)}, {"tilt_noise": 31.0}):
        with pytest.raises(UsageError):
            prepare(replace(preset("demo"), route=Route(**change)))


@pytest.mark.slow
def test_the_horizon_is_where_true_rays_are_level(tmp_path):
    settings = FlightSettings(lens=LENS, route=Route(photos=4, oblique=2, oblique_tilts=(70, 80)))
    world = prepare(settings)
    scene = empty_scene(world.country.grid(settings.resolution), thermal=False, scratch=tmp_path)
    for _ in world.country.draw(scene, settings.weather, scratch=tmp_path):
        pass
    camera = exposer(scene, LENS)
    clear = Pictures(noise=0, blur=0, vignetting=0)
    for shot in (s for s in world.visible.shots if "oblique" in s.name):
        picture = camera.visible(shot, clear, 1.0, np.random.default_rng(0)).astype(int)
        rays = np.dstack([camera.directions, np.ones((240, 320))]) @ shot.rotation
        up = np.degrees(np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1])))
        blue = picture[..., 2] - picture[..., 0]
        assert (up > 2).mean() > 0.02
        assert blue[up > 2].min() > 20
        # no sky below: the ground near the camera has texture
        ground = cv2.cvtColor(picture.astype(np.uint8), cv2.COLOR_RGB2GRAY)[up < -30]
        assert ground.std() > 8
        assert np.percentile(blue[up < -30], 99) < 20
