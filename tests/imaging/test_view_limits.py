"""What photos may show, against angles and distances computed point by point."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.imaging.blank import around
from skyquilt.imaging.nodes import STEP, densify, inside_everywhere, node_places, project_nodes
from skyquilt.imaging.view_limits import (
    COARSEST,
    ViewLimits,
    cut,
    ground_sizes,
    limits_for,
    support_of,
)
from skyquilt.imaging.views import footprint
from skyquilt.live.tile_drawing import Newest
from skyquilt.model.raster import Grid, Window
from skyquilt.ortho.blend import Average, Feather
from skyquilt.ortho.plan import planned
from tests.ortho.scenes import CAMERA, FLAT, view

WIDE = Grid(west=-150.0, north=250.0, gsd=0.5, width=600, height=800)
WHOLE = Window(row=0, column=0, height=800, width=600)


def shown(shot, limits):
    """(h, w) the pixels of `WIDE` that a photo may be drawn on, and their places."""
    shot = replace(shot, limits=limits, footprint=footprint(CAMERA, shot.pose, FLAT, limits=limits))
    nodes = project_nodes(shot, *node_places(WIDE, FLAT, WHOLE))
    mask = inside_everywhere(nodes, densify(nodes.u, 800, 600), densify(nodes.v, 800, 600))
    x, y = np.meshgrid(WIDE.x(np.arange(600)), WIDE.y(np.arange(800)))
    return shot, mask, x, y


@pytest.mark.parametrize("angle", [40.0, 60.0, 70.0, 80.0])
@pytest.mark.parametrize("pitch", [50.0, 70.0, 85.0])
def test_nothing_is_drawn_beyond_the_angle_and_everything_below(angle, pitch):
    shot, mask, x, y = shown(view(0, 5, -3, yaw=20, pitch=pitch), ViewLimits(angle_deg=angle))
    d = np.stack([x - 5, y + 3, np.full(x.shape, -40.0)], -1)
    real = np.degrees(np.arctan2(np.hypot(d[..., 0], d[..., 1]), 40.0))
    if mask.any():
        assert real[mask].max() <= angle + 1e-3
    local = d @ shot.pose.cam_R_map.T
    ahead = (local[..., 2] > 5) & (np.abs(local[..., 0]) < 0.5 * local[..., 2])
    ahead &= np.abs(local[..., 1]) < 0.38 * local[..., 2]
    missing = ahead & (real < angle - 1.0) & ~mask
    assert missing.mean() < 2e-3  # steps of nodes at the rim
    corners = shot.footprint
    if len(corners):
        assert np.degrees(np.arctan(np.hypot(*(corners - (5, -3)).T) / 40)).max() < angle + 2
        for px, py in zip(x[mask][::97], y[mask][::97], strict=True):
            assert corners[:, 0].min() - 1 <= px <= corners[:, 0].max() + 1
            assert corners[:, 1].min() - 1 <= py <= corners[:, 1].max() + 1


def test_the_sky_is_never_ground():
    """A node above the camera, as a wrong surface may have it, is seen under no angle."""
    shot = view(0, 0, 0, pitch=85)
    x, y = np.array([[0.0, 10.0]]), np.array([[60.0, 60.0]])
    nodes = project_nodes(replace(shot, limits=ViewLimits(angle_deg=90)), x, y, x * 0 + 45.0)
    assert not nodes.seen.any()


def test_nothing_is_drawn_far_from_known_heights():
    ties = np.array([[x, y, 0.0] for x in range(-20, 21, 5) for y in range(-20, 21, 5)])
    limits = limits_for(ties, np.zeros((0, 2)), np.array([40.0]), 70.0, 0.1)
    _, mask, x, y = shown(view(0, 0, 0, pitch=60), limits)
    dx, dy = (np.abs(v - np.clip(5 * np.round(v / 5), -20, 20)) for v in (x, y))
    away = np.hypot(dx, dy)
    tangent = np.hypot(x, y) / 40
    assert mask.any()
    assert away[mask].max() < 40 + 0.5
    assert (away * tangent)[mask].max() < 40 + 2
    _, free, _, _ = shown(view(0, 0, 0, pitch=60), ViewLimits())
    near = free & (away < 36) & (away * tangent < 36)
    assert (mask | ~near).all()


def test_the_support_is_the_distance_to_the_nearest_place():
    rng = np.random.default_rng(2)
    places = rng.uniform(-80, 80, (60, 2))
    support = support_of(places, 25.0)
    at = rng.uniform(-100, 100, (400, 2))
    exact = np.min(np.linalg.norm(places[None] - at[:, None], axis=2), axis=1)
    assert np.abs(support.away.at(*at.T) - exact).max() < 2.5 * support.away.cell
    kept = cut(np.c_[at[exact < 25], np.ones((exact < 25).sum())][:3], np.zeros((0, 3)))
    assert len(kept) == 3
    square = np.array([[-500.0, -500], [500, -500], [500, 500], [-500, 500]])
    outline = ViewLimits(support=support).supported(square)
    assert np.abs(outline).max() < 80 + 26
    for place in places:
        a, b = outline, np.roll(outline, -1, 0)
        side = (b[:, 0] - a[:, 0]) * (place[1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (
            place[0] - a[:, 0]
        )
        assert (side > 0).all()


def test_ground_sizes_are_those_of_a_slanting_pixel():
    """At the axis of a camera tilted by t, h / f / cos^2 t along the slant."""
    for pitch in (0.0, 40.0, 60.0):
        shot = view(0, 0, 0, pitch=pitch, camera=replace(CAMERA, k1=0, k2=0, p1=0, p2=0))
        centre = 40 * np.tan(np.radians(pitch))
        x, y = np.meshgrid(np.arange(-2, 3) * 0.2, centre - np.arange(-2, 3) * 0.2)
        nodes = project_nodes(shot, x, y, 0 * x)
        size = ground_sizes(nodes.u, nodes.v, 0.2)[2, 2]
        assert size == pytest.approx(40 / 350 / np.cos(np.radians(pitch)) ** 2, rel=0.02)


@pytest.mark.parametrize("blend", [Feather(), Average()])
def test_a_smeared_view_yields_where_another_photo_is_sharp(blend):
    """A photo from five times as high, straight above, is the most vertical one there; a low one
    that looks aside is sharper.
    """
    limits = ViewLimits(coarsest_m=COARSEST * 40 / 350)
    high = replace(view(0, 0, 0, z=240.0), limits=limits)
    low = replace(view(1, 12, 0, z=40.0, pitch=0.0), limits=limits)
    grid = Grid(west=-64.0, north=64.0, gsd=0.25, width=512, height=512)
    window = Window(row=0, column=0, height=512, width=512)
    plan = planned(window, grid, [high, low], FLAT, blend, counted=True, earlier=None)
    nodes = {n.view.photo: n for n in plan.nodes}
    both = project_nodes(low, *node_places(grid, FLAT, window)).seen
    assert nodes[1].seen[both].all()
    inner = both.copy()
    for axis in (0, 1):
        inner &= np.roll(both, 1, axis) & np.roll(both, -1, axis)
    corners = np.roll(inner, 1, 0) & np.roll(inner, -1, 0)
    assert not nodes[0].seen[inner & corners].any()
    assert nodes[0].seen[~both & project_nodes(high, *node_places(grid, FLAT, window)).seen].all()
    alone = planned(window, grid, [high], FLAT, blend, counted=True, earlier=None)
    assert alone.nodes[0].seen.all()
    assert STEP == 16


@pytest.mark.parametrize("blend", [Feather(), Newest()])
def test_a_marked_part_yields_where_another_photo_shows_the_ground(blend):
    """The left half of the newer, more vertical photo is marked; both photos see the same place."""
    half = np.zeros((48, 64), np.bool_)
    half[:, :32] = True
    other = view(0, -12, 0)
    size = other.camera.width, other.camera.height
    marked = replace(view(1, 0, 0), limits=ViewLimits(mark=around(half, size)))
    grid = Grid(west=-64.0, north=64.0, gsd=0.25, width=512, height=512)
    window = Window(row=0, column=0, height=512, width=512)
    x, y, z = node_places(grid, FLAT, window)
    free, also = project_nodes(marked, x, y, z), project_nodes(other, x, y, z).seen
    white = free.seen & (free.u < 0.45 * size[0])
    inner = cv2.erode(also.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    plan = planned(window, grid, [other, marked], FLAT, blend, counted=False, earlier=None)
    now = {n.view.photo: n for n in plan.nodes}
    assert (white & inner).sum() > 20
    assert not now[1].seen[white & inner].any()
    left = free.seen & ((free.u > 0.55 * size[0]) | ~also)
    assert now[1].seen[left].all()
    assert dict(zip(now, plan.near, strict=True))[0][white & inner].all()
    alone = planned(window, grid, [marked], FLAT, blend, counted=False, earlier=None)
    assert np.array_equal(alone.nodes[0].seen, free.seen)
