"""A photo joins placed ones that look aslant, each in another direction, as drones without a gimbal
do.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.local_adjustment import (
    LocalAdjustment,
    NotAdjusted,
    Window,
    held_setup,
    similarity_of,
    without_false_positions,
)
from skyquilt.model.features import Link
from tests.alignment.test_oblique_start import CAMERA, Slanting

AROUND = [
    (-35.0, -15.0, 50.0, 80.0, 25.0),
    (0.0, -18.0, 52.0, 95.0, -25.0),
    (35.0, -16.0, 50.0, 88.0, 17.5),
    (-28.0, 14.0, 49.0, 270.0, -25.0),
    (5.0, 12.0, 51.0, 262.0, 25.0),
]
"""x, y, z in m, heading and pitch in degrees."""


def window(pitch_deg, sigma_tilt_deg=1.0, seed=1):
    flown = Slanting([*AROUND, (-2.0, -1.0, 50.0, 80.0, pitch_deg)], seed=seed, alike_deg=180)
    new = len(AROUND)
    flown.priors[new] = replace(flown.priors[new], sigma_tilt_deg=sigma_tilt_deg)
    return flown, window_on(flown, held=range(new))


def window_on(flown, held):
    """The last photo joins the others, which stand where they were taken."""
    key, new = flown.photos[0].camera_key, len(flown.photos) - 1
    return Window(
        photos=flown.photos,
        priors=flown.priors,
        features=flown.features,
        links=flown.links,
        poses=dict(enumerate(flown.truth[:new])),
        cameras={key: CAMERA},
        camera_of=dict.fromkeys(range(new), key),
        new=new,
        held=frozenset(held),
        ground=0.0,
        sigma_xy=0.0,
    )


def off(flown, done, new):
    R = done.poses[new].cam_R_map @ flown.truth[new].cam_R_map.T
    turned = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(done.poses[new].map_C - flown.truth[new].map_C)), turned


@pytest.mark.parametrize("pitch_deg", [-25.0, 0.0, 25.0, 35.0])
def test_links_of_a_tilted_photo_agree_with_one_another(pitch_deg):
    """Taken for similarities of the picture itself, two of three contradicted one another:
    they were given up, and the photo hung on the third.
    """
    flown, asked = window(pitch_deg)
    done = LocalAdjustment()(asked)
    assert not done.dropped
    away, turned = off(flown, done, asked.new)
    assert away < 0.15 and turned < 0.15


def test_a_photo_that_does_not_tell_its_tilt_is_taken_to_look_down():
    flown, asked = window(4.0, sigma_tilt_deg=30.0)
    away, turned = off(flown, LocalAdjustment()(asked), asked.new)
    assert away < 0.3 and turned < 0.3


def test_a_link_with_another_place_is_dropped():
    flown, asked = window(20.0)
    new, features = asked.new, asked.features
    wrong = next(k for k in asked.links if k.b == new)
    aside = features[wrong.a].px[wrong.index_a] + [250, 0]
    near = np.array([np.argmin(np.hypot(*(features[wrong.a].px - p).T)) for p in aside])
    false = Link(a=wrong.a, b=new, index_a=near, index_b=wrong.index_b, b_S_a=wrong.b_S_a)
    links = [false if k is wrong else k for k in asked.links]
    done = LocalAdjustment()(replace(asked, links=links))
    assert done.dropped == ((wrong.a, new),)
    assert off(flown, done, new)[0] < 0.3
    alone = LocalAdjustment()(replace(asked, links=[]))
    assert isinstance(alone, NotAdjusted)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_positions_that_are_far_off_bend_nothing(seed):
    """A line goes on while its receiver is off by 300 m: its end was drawn aside photo by photo."""
    line = [(0.0, 22.0 * k, 50.0, 0.0, 0.0) for k in range(-2, 4)]
    flown = Slanting(line, seed=seed)
    for k in (3, 4, 5):
        flown.priors[k] = replace(flown.priors[k], map_C=flown.priors[k].map_C + [240, -180, 0])
    asked = window_on(flown, held={0, 1, 2})
    away, turned = off(flown, LocalAdjustment()(asked), asked.new)
    assert away < 1.0 and turned < 0.5


def test_positions_hold_a_map_that_has_drifted():
    """All photos around are off alike, by 20 m: then it is not the receiver that is."""
    flown = Slanting([(0.0, 22.0 * k, 50.0, 0.0, 0.0) for k in range(-2, 4)], seed=1)
    flown.priors[:] = [replace(p, map_C=p.map_C + [20.0, 0, 0]) for p in flown.priors]
    asked = window_on(flown, held={0, 1, 2})
    plane = {i: similarity_of(asked, i) for i in asked.poses}
    setup = held_setup(asked, plane, asked.links)
    assert np.isfinite(without_false_positions(setup, asked).base.C0).all()
    alone = {4: replace(flown.priors[4], map_C=flown.priors[4].map_C + [300.0, 0, 0])}
    priors = [alone.get(i, p) for i, p in enumerate(flown.priors)]
    asked = replace(asked, priors=priors)
    setup = held_setup(asked, plane, asked.links)
    kept = np.isfinite(without_false_positions(setup, asked).base.C0[:, 0])
    assert kept.tolist() == [True, True, True, True, False]


def test_points_that_only_photos_of_one_place_show_are_no_ground():
    """A hover at the end of a line, an exposure bracket, a copy of a photo: their rays meet
    anywhere, and the growing map was drawn on heights of tens of metres.
    """
    line = [(0.0, 22.0 * k, 50.0, 0.0, 0.0) for k in range(-2, 3)]
    flown = Slanting([*line, (0.05, 44.05, 50.0, 0.0, 0.0)], seed=1)
    found = LocalAdjustment()(window_on(flown, held={0, 1, 2, 3})).xyz
    assert len(found) > 40 and np.abs(found[:, 2] - np.median(found[:, 2])).max() < 5.0
