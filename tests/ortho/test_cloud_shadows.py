"""Shadows of clouds that move, with shadows that are known."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.ortho.cloud_shadows import (
    DIFFERENT,
    EXPLAINED,
    NODES,
    REACH,
    SURELY,
    apart,
    explained,
    over,
    shade,
    shades,
)
from skyquilt.ortho.earlier import complete, with_new
from skyquilt.ortho.exposure import NEUTRAL, Balance, Exposure, image_place
from skyquilt.quality.tone import tone_residual
from skyquilt.simulate.clouds import PERIOD_M, WIND_MS, clouds_of
from tests.ortho.test_exposure import FLAT, GRID, block, odds_scaled, photograph

PHOTOS, EACH = 16, 500


def flight(seed, shadows, noise=0.03):
    """Samples of photos side by side, each of which shows a round shadow at a place of its own:
    points, photos, places, levels, and the shadows of the samples.
    """
    rng = np.random.default_rng(seed)
    ground = rng.uniform(0, 1, (4000, 2)) * [4.0, 3.0]
    level = rng.normal(0, 0.5, len(ground))
    found = []
    for photo in range(PHOTOS):
        centre = np.array([0.5 + photo % 4, 0.4 + 0.7 * (photo // 4)])
        seen = np.flatnonzero((np.abs(ground - centre) < [0.8, 0.6]).all(1))
        seen = rng.permutation(seen)[:EACH]
        place = ground[seen] - centre
        cloud = centre + rng.uniform(-0.5, 0.5, 2)
        dark = shadows / (1 + np.exp((np.hypot(*(ground[seen] - cloud).T) - 0.4) / 0.05))
        now = level[seen] - dark + rng.normal(0, noise, len(seen))
        found.append((seen, np.full(len(seen), photo), place, now, dark))
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_photos_agree_once_their_shadows_are_evened_out(seed):
    point, row, place, level, dark = flight(seed, 0.9)
    found = shades(point, row, place, level, np.ones(PHOTOS, bool))
    assert found.shape == (PHOTOS, NODES, NODES)
    even = level + shade(found, row, place)
    assert apart(point, level) > 3 * apart(point, even)
    # what a sample gets is its shadow, less what all photos of its point have of them
    total = np.bincount(point, dark) / np.maximum(np.bincount(point), 1)
    several = np.bincount(point)[point] > 2
    expected = (dark - total[point])[several]
    assert np.corrcoef(expected, shade(found, row, place)[several])[0, 1] > 0.9


def test_shadows_are_told_from_scatter():
    point, row, place, level, _ = flight(4, 0.9)
    assert (explained(point, row, place, level, PHOTOS) > SURELY).sum() > 12
    for noise in (0.02, 0.1, 0.3):
        point, row, place, level, _ = flight(5, 0.0, noise)
        assert explained(point, row, place, level, PHOTOS).max() < 0.3 * EXPLAINED


def test_shadows_of_a_few_photos_are_found_and_others_hardly_change():
    """Neighbours that show the same ground differ, too, but most of it is evened out where it comes
    from; photos that do not overlap with these stay.
    """
    point, row, place, level, dark = flight(6, 0.9)
    few = np.isin(row, (0, 1))
    level = np.where(few, level, level + dark)
    found = explained(point, row, place, level, PHOTOS) > SURELY
    assert {0, 1} <= set(np.flatnonzero(found)) <= {0, 1, 2, 4, 5, 6}
    drawn = shades(point, row, place, level, found)
    assert not drawn[~found].any()
    size = np.abs(shade(drawn, row, place))
    assert size[few].mean() > 4 * size[~few].mean()
    several = few & (np.bincount(point)[point] > 2)
    assert np.corrcoef(dark[several], shade(drawn, row, place)[several])[0, 1] > 0.9


def test_shades_of_samples_are_those_that_are_drawn():
    rng = np.random.default_rng(0)
    found = rng.normal(size=(2, NODES, NODES)).astype(np.float32)
    x, y = rng.uniform(-0.9, 0.9, (2, 20, 30))
    drawn = over(found[1], x, y)
    told = shade(found, np.ones(600, int), np.column_stack([x.ravel(), y.ravel()]))
    # OpenCV interpolates in steps of 1/32 pixel
    assert drawn.ravel() == pytest.approx(told, abs=0.15)
    nodes = np.linspace(-REACH, REACH, NODES)
    assert over(found[0], *np.meshgrid(nodes, nodes)) == pytest.approx(found[0], abs=1e-5)


@pytest.mark.slow
def test_a_map_of_photos_in_moving_shadows_is_even():
    """Photos differ over the ground they share by a third of what they did, and a survey in even
    light is left alone.
    """
    views = block()
    x, y = np.meshgrid(*((np.arange(n) - (n - 1) / 2) / 249.5 for n in (400, 300)))
    lit, pictures = {}, {}
    for k, v in enumerate(views):
        grey = np.clip(photograph(v), 12, 240)
        lit[v.photo] = np.repeat(grey[..., None], 3, 2).astype(np.uint8)
        away = np.hypot(x - 0.6 * np.cos(2.4 * k), y - 0.4 * np.sin(2.4 * k))
        dark = -0.9 / (1 + np.exp((away - 0.35) / 0.05))
        shadowed = np.rint(odds_scaled(grey, dark))
        pictures[v.photo] = np.repeat(shadowed[..., None], 3, 2).astype(np.uint8)
    assert not Balance()(views, lit, FLAT, GRID.bounds).shades
    found = Balance()(views, pictures, FLAT, GRID.bounds)
    assert set(found.shades) == {v.photo for v in views}
    assert found.notes and not NEUTRAL.notes
    before = tone_residual(views, pictures, FLAT, GRID.bounds, replace(found, shades={}))
    after = tone_residual(views, pictures, FLAT, GRID.bounds, found)
    assert before["median"] > 255 * 0.2 * DIFFERENT
    assert after["median"] < before["median"] / 3
    view = views[0]
    place = image_place(view, *np.meshgrid(np.arange(0, 400, 20.0), np.arange(0, 300, 20.0)))
    odds = np.log(found.odds(view.photo, *place)[..., 0])
    odds -= np.log(replace(found, shades={}).odds(view.photo, *place)[..., 0])
    assert odds == pytest.approx(over(found.shades[view.photo], *place), abs=1e-5)


def test_photos_that_join_a_map_keep_their_shades():
    none = np.zeros(3, np.float32), np.zeros(6, np.float32)
    one, two, other = (np.full((NODES, NODES), k, np.float32) for k in (1, 2, 3))

    def exposure(shades, photos):
        return Exposure(
            gains=dict.fromkeys(photos, none[0]),
            fields=dict.fromkeys(photos, none[1]),
            shades=shades,
        )

    joined = with_new(exposure({1: one}, [1, 4]), exposure({1: other, 2: two, 4: other}, [1, 2, 4]))
    assert set(joined.shades) == {1, 2}
    assert joined.shades[1] is one and joined.shades[2] is two
    shown = [replace(v, photo=k) for k, v in zip((2, 4), block(), strict=False)]
    assert set(complete(joined, shown).shades) == {2}


def test_simulated_clouds_shade_their_share_and_drift():
    clouds = clouds_of(0.3, 7)
    x, y = np.meshgrid(*2 * [np.arange(0, PERIOD_M, 2.0, np.float32)])
    light = clouds.light(x, y, 0.0)
    assert np.mean(light < 0.725) == pytest.approx(0.3, abs=0.02)
    assert 0.4 < light.min() < 0.5 and light.max() > 0.99
    moved = 10 * WIND_MS * clouds.downwind
    later = clouds.light(x + moved[0], y + moved[1], 10.0)
    assert np.abs(later - light).mean() < 0.01
    assert np.abs(clouds.light(x, y, 10.0) - light).mean() > 0.05
    assert clouds_of(0.0, 7) is None
