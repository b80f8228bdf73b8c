"""The camera of a band is found beside that of the map's photos, whatever its lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.band_rig import BandRig, FindBandRig
from skyquilt.coregistration.beside import Together
from skyquilt.coregistration.orientation import orientation
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import Camera
from skyquilt.model.registration import RefusedRegistration
from tests.coregistration.rigs import BandCamera, rig, seen
from tests.texture import texture

WIDE = Camera.ideal(width=900, height=700, focal=760.0)
SIZE = (480, 360)
FOCAL = 1.15 * 760.0 * 480 / 900


def shows(picture, band, *, negative=False, moved=(0.0, 0.0)):
    """A photo of a picture that a wider camera took."""
    grey = seen(picture, WIDE, band, moved)
    return np.clip(255 - grey if negative else grey, 0, 255).astype(np.uint8)


def captures(a: BandCamera, b: BandCamera, number=3, camera_a=None):
    made = (texture(700, 900, seed=k) for k in range(number))
    return [
        Together(a=shows(p, a), camera_a=camera_a or a.camera, b=shows(p, b, negative=True))
        for p in made
    ]


def apart_px(found: BandRig, a: BandCamera, b: BandCamera, camera_a):
    """How far pixels of the band are from where the true cameras have them, px of the map."""
    x, y = np.meshgrid(*(np.linspace(0, n - 1, 25) for n in SIZE))
    px = np.c_[x.ravel(), y.ravel()]
    R = rotation_from_vector(b.turn) @ rotation_from_vector(a.turn).T
    true = project(a.camera, rays(b.camera, px) @ R)
    mine = project(camera_a, rays(found.camera, px) @ found.b_R_a)
    inside = ((true > 0) & (true < np.array(SIZE) - 1)).all(1)
    return np.linalg.norm(true - mine, axis=1)[inside]


@pytest.mark.slow
def test_bands_lie_on_each_other():
    """Also where the lens of the map's photos is not quite known: the band's takes that up."""
    a, b = rig(1, *SIZE, FOCAL)
    adjusted = replace(a.camera, focal=0.99 * a.camera.focal, cx=a.camera.cx + 2, aspect=1.004)
    told = Camera.ideal(width=SIZE[0], height=SIZE[1], focal=FOCAL)
    pairs = captures(a, b, camera_a=adjusted)
    found = FindBandRig()(pairs, told, 0.01)
    assert isinstance(found, BandRig)
    off = apart_px(found, a, b, adjusted)
    assert np.median(off) < 0.1 and np.percentile(off, 95) < 0.3 and off.max() < 1.0
    assert found.share > 0.9 and found.off_px < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.2])
def test_a_band_that_is_exposed_later_is_told_from_a_turned_one(delay_s):
    """The camera keeps its heading: on lines flown back the delay is to the other side, 8 px of
    ground at 60 m.
    """
    a, b = rig(1, *SIZE, FOCAL)
    R, near, pairs = rotation_from_vector(a.turn), 1 / 60, []
    for k, flown in enumerate([[1.0, -6.0, 0.0]] * 2 + [[-1.0, 6.0, 0.0]]):
        picture, moved = texture(700, 900, seed=k), delay_s * near * np.array(flown[:2])
        pairs.append(
            Together(
                a=shows(picture, a),
                camera_a=a.camera,
                b=shows(picture, b, negative=True, moved=moved),
                nearness=np.full((3, 3), near),
                velocity=R @ np.array(flown),
            )
        )
    found = FindBandRig()(pairs, b.camera, 0.01)
    assert isinstance(found, BandRig)
    assert found.delay_s == pytest.approx(delay_s, abs=0.003)
    assert found.share > 0.9 and found.off_px < 0.25
    assert np.median(apart_px(found, a, b, a.camera)) < 0.1


def under_the_sun(material, shift):
    """(h, w, 3) a picture of materials in two colours, whose light has the same edges, up to
    `shift` px further right, as slopes that face the sun have: the further, the rougher they are.
    """
    rough = cv2.GaussianBlur(texture(*material.shape, seed=9).astype(np.float32), (0, 0), 30)
    x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in material.shape[::-1]))
    beside = shift * (rough - rough.min()) / np.ptp(rough)
    light = 0.35 + 0.65 * cv2.remap(material, x - beside, y, cv2.INTER_LINEAR) / 255
    return np.stack([material, 255 - material, np.full_like(material, 128)], 2) * light[..., None]


@pytest.mark.slow
def test_light_beside_its_materials_does_not_move_the_thermal_camera():
    """What is warm are materials; the light lies up to 1.4 px beside them in all photos."""
    a, b = rig(1, *SIZE, FOCAL)
    off = {}
    for coloured in (False, True):
        pairs = []
        for k in range(3):
            material = texture(700, 900, seed=k).astype(np.float32)
            rgb = seen(under_the_sun(material, 2), WIDE, a).astype(np.uint8)
            pairs.append(
                Together(
                    a=cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
                    camera_a=a.camera,
                    b=shows(material, b, negative=True),
                    colours=rgb if coloured else None,
                )
            )
        found = FindBandRig()(pairs, b.camera, 0.01)
        assert isinstance(found, BandRig)
        off[coloured] = np.median(apart_px(found, a, b, a.camera))
    assert off[False] > 1.0 and off[True] < off[False] / 4, off


@pytest.mark.slow
def test_a_camera_is_found_beside_the_other_where_the_depth_changes():
    """9 cm are 0.7 to 5 px of ground at 60 to 8 m."""
    a, b = rig(1, *SIZE, FOCAL)
    beside, pairs = np.array([0.08, -0.05]), []
    R = rotation_from_vector(a.turn)
    for k, nearness in enumerate((1 / 8, 1 / 20, 1 / 60)):
        picture = texture(700, 900, seed=k)
        other = shows(picture, b, negative=True, moved=beside * nearness)
        depth = np.full((3, 3), nearness)
        pairs.append(Together(a=shows(picture, a), camera_a=a.camera, b=other, nearness=depth))
    found = FindBandRig()(pairs, b.camera, 0.01)
    assert isinstance(found, BandRig)
    assert np.abs(R.T @ found.a_t_b - [*beside, 0.0]).max() < 0.01


@pytest.mark.slow
def test_a_knocked_lens_is_found():
    """It looks 4 degrees aside and is turned by 5 about its axis."""
    a, b = rig(2, *SIZE, FOCAL)
    b = replace(b, turn=b.turn + np.radians([3.0, -2.6, 5.0]))
    found = FindBandRig()(captures(a, b), b.camera, 0.01)
    assert isinstance(found, BandRig)
    assert np.median(apart_px(found, a, b, a.camera)) < 0.1


@pytest.mark.slow
def test_a_lens_that_bends_the_rim_beyond_reach_is_found():
    """Thermal lenses have a k1 of -0.1 to -0.4, which no file tells: 30 px in the corners."""
    a, b = rig(2, *SIZE, FOCAL)
    bent = replace(b.camera, k1=-0.38, k2=0.12)
    found = FindBandRig()(captures(a, replace(b, camera=bent)), replace(b.camera, k1=0, k2=0), 0.01)
    assert isinstance(found, BandRig) and found.camera.k1 == pytest.approx(-0.38, abs=0.02)
    off = apart_px(found, a, replace(b, camera=bent), a.camera)
    assert np.median(off) < 0.1 and np.percentile(off, 95) < 0.3


@pytest.mark.slow
def test_other_ground_is_refused():
    a, b = rig(3, *SIZE, FOCAL)
    pairs = captures(a, b)
    mixed = [replace(p, b=q.b) for p, q in zip(pairs, pairs[1:] + pairs[:1], strict=True)]
    found = FindBandRig()(mixed, b.camera, 0.01)
    assert isinstance(found, RefusedRegistration)
    assert "of the patches of its photos agree" in found.reason


@pytest.mark.slow
def test_a_few_captures_of_other_ground_do_no_harm():
    a, b = rig(4, *SIZE, FOCAL)
    pairs = captures(a, b, 4)
    mixed = [*pairs[:3], replace(pairs[3], b=pairs[0].b)]
    found = FindBandRig()(mixed, b.camera, 0.01)
    assert isinstance(found, BandRig)
    assert np.median(apart_px(found, a, b, a.camera)) < 0.1


def test_two_captures_are_too_few():
    a, b = rig(5, *SIZE, FOCAL)
    found = FindBandRig()(captures(a, b, 2), b.camera, 0.01)
    assert isinstance(found, RefusedRegistration)
    assert found.reason.startswith("2 of its photos were taken together")


def test_quick_fields_are_nearly_the_same():
    grey = texture(360, 480, seed=1)
    valid = np.ones(grey.shape, np.bool_)
    valid[:60] = False
    slow, quick = (orientation(grey, valid, 400, quick=q) for q in (False, True))
    assert 0 < np.abs(slow.fields - quick.fields).max() < 0.03
    assert (slow.valid == quick.valid).all()
