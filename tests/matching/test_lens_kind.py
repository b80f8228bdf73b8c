"""The kind of a lens against simulated matches of photos taken with a known one."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.geometry.camera import pixels, project, rays
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.matching.lens_kind import FEWEST, as_fisheye, as_pinhole, fisheyes, may_be_fisheye
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches

WIDTH, HEIGHT = 1200, 900


def lens(focal, *, fisheye, k1=0.0):
    ideal = Camera.ideal(width=WIDTH, height=HEIGHT, focal=focal)
    return replace(ideal, fisheye=float(fisheye), k1=k1)


def survey(camera, *, relief, count=4, noise=0.3, seed=5, hill=0.0, points=6000):
    """Features of photos of one line, 30 % of the height apart, and all pairs of neighbours with
    their true matches and some false ones; above the top of a hill where it has a height.
    """
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-90, 150, (points, 2)), rng.uniform(0, relief, points)])
    xyz[:, 2] += hill * (np.exp(-(np.hypot(xyz[:, 0] - 18, xyz[:, 1]) ** 2) / 100**2) - 1)
    seen = []
    for n in range(count):
        R = cam_R_map_from_angles(*rng.normal(0, 2, 3))
        px = project(camera, (xyz - (12.0 * n, 0, 40.0)) @ R.T)
        px += rng.normal(0, noise, px.shape)
        inside = ((px > 0) & (px < (WIDTH - 1, HEIGHT - 1))).all(1)
        seen.append((np.flatnonzero(inside), px[inside]))
    features = [
        Features(
            px=px,
            size=np.ones(len(px), np.float32),
            descriptors=np.zeros((len(px), 0), np.uint8),
            scale=1.0,
        )
        for _, px in seen
    ]
    matches = {}
    for a in range(count - 1):
        _, ia, ib = np.intersect1d(seen[a][0], seen[a + 1][0], return_indices=True)
        wrong = rng.random(len(ia)) < 0.2
        ib[wrong] = rng.permutation(ib[wrong])
        matches[a, a + 1] = Matches(index_a=ia, index_b=ib)
    return features, matches


def judge(reported, features, matches):
    """What `fisheyes` finds, with the product's verification, and how many links there were."""
    tried = [Verify()(i, j, features[i], features[j], m, WIDTH) for (i, j), m in matches.items()]
    links = [k for k in tried if isinstance(k, Link)]

    def matched(i, j):
        return features[i].px[matches[i, j].index_a], features[j].px[matches[i, j].index_b]

    asked = {"one": lens(reported, fisheye=False)}
    cameras = dict.fromkeys(range(len(features)), "one")
    found = fisheyes(cameras, asked, features.__getitem__, links, list(matches), matched)
    return found, len(links)


@pytest.mark.slow
@pytest.mark.parametrize("relief", [6.0, 0.5])
@pytest.mark.parametrize(
    ("focal", "reported"), [(730.0, 730.0), (560.0, 520.0), (560.0, 900.0), (640.0, 560.0)]
)
def test_a_fisheye_is_found_by_its_matches(focal, reported, relief):
    """Fields of view of the diagonal of 118, 153 and 134 degrees, with right and wrong metadata."""
    features, matches = survey(lens(focal, fisheye=True, k1=-0.05), relief=relief)
    found, _ = judge(reported, features, matches)
    assert list(found) == ["one"]
    assert found["one"].fisheye
    assert 0.6 < found["one"].focal / focal < 1.45


@pytest.mark.slow
@pytest.mark.parametrize("relief", [6.0, 0.5])
@pytest.mark.parametrize(
    ("focal", "k1"), [(900.0, 0.0), (900.0, -0.12), (560.0, 0.02), (700.0, 0.1)]
)
def test_a_wide_pinhole_stays_one(focal, k1, relief):
    features, matches = survey(lens(focal, fisheye=False, k1=k1), relief=relief)
    found, links = judge(focal, features, matches)
    assert links >= 2
    assert not found


@pytest.mark.parametrize("focal", [833.0, 930.0])
def test_a_pinhole_stays_one_over_a_steep_hill_which_bends_pictures_as_a_fisheye_does(focal):
    camera = lens(focal, fisheye=False)
    features, matches = survey(camera, relief=2.0, noise=0.1, hill=80.0, points=2500)
    found, links = judge(focal, features, matches)
    assert links >= FEWEST
    assert not found


def test_a_lens_is_asked_for_its_kind_only_where_nothing_tells_it():
    wide = lens(700.0, fisheye=False)
    assert may_be_fisheye(wide)
    assert not may_be_fisheye(replace(wide, k1=-0.1))
    assert not may_be_fisheye(as_fisheye(wide))
    assert not may_be_fisheye(lens(1400.0, fisheye=False))


def test_a_fisheye_s_pixels_lie_where_a_pinhole_shows_them():
    told = replace(lens(700.0, fisheye=True, k1=0.03), aspect=1.002, cx=610.0)
    px = np.random.default_rng(0).uniform(0, (WIDTH, HEIGHT), (50, 2))
    pinhole = replace(told, fisheye=0.0, k1=0.0)
    assert as_pinhole(told, px) == pytest.approx(
        pixels(rays(told, px)[:, :2], pinhole.vector), abs=1e-9
    )
    assert as_pinhole(pinhole, px) is px
