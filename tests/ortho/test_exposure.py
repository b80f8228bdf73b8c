"""Gains of known size are found again; black and white stay; two gains are one."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.geometry import block_cholesky
from skyquilt.model.raster import Window
from skyquilt.ortho import differences
from skyquilt.ortho.earlier import complete, with_new
from skyquilt.ortho.exposure import (
    NEUTRAL,
    SAMPLES,
    WHITES,
    Balance,
    Exposure,
    image_place,
    odds_table,
    with_odds,
)
from skyquilt.ortho.radiometry import Levelling
from skyquilt.quality.tone import tone_residual
from skyquilt.settings import PictureSettings
from tests.ortho.scenes import FLAT, GRID, block, composer, photograph

gains = st.floats(-1.5, 1.5)


def odds_scaled(x, g, white=255.0):
    """Value 0..255 with its odds to `white` multiplied by exp(g), by the definition."""
    x = np.asarray(x, float) / white
    with np.errstate(divide="ignore"):
        return np.minimum(white / (1 + (1 - x) / np.maximum(x, 1e-300) * np.exp(-g)), 255)


@given(st.lists(gains, min_size=1, max_size=4), st.sampled_from(WHITES))
def test_tables_scale_the_odds(g, white):
    table = odds_table(np.array(g, np.float32), white)
    assert table.shape == (1, 256, len(g)) and table.dtype == np.uint8
    for band, gain in enumerate(g):
        expected = odds_scaled(np.arange(256), np.float32(gain), white)
        assert np.abs(table[0, :, band] - expected).max() <= 0.51
        assert table[0, 0, band] == 0 and (table[0, 255, band] == 255 or white > 255)
        assert (np.diff(table[0, :, band].astype(int)) >= 0).all()


@given(gains, gains)
def test_two_gains_are_one(g, h):
    """exp(g) after exp(h) is exp(g + h): exactly, but for rounding between."""
    x = np.arange(256)
    assert odds_scaled(odds_scaled(x, g), h) == pytest.approx(odds_scaled(x, g + h), abs=1e-9)
    one, two, both = (odds_table(np.array([v], np.float32))[0, :, 0] for v in (g, h, g + h))
    slope = np.exp(abs(h))  # of the second table at its steepest
    assert np.abs(two[one].astype(int) - both).max() <= 1 + 0.5 * slope


@given(st.integers(0, 10**6), st.sampled_from([1, 3]), st.sampled_from(WHITES))
def test_fields_of_odds_are_the_tables_pixel_by_pixel(seed, bands, white):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (20, 30, bands)).astype(np.uint8)
    pixels[0], pixels[1] = 0, 255
    g = rng.uniform(-1, 1, (20, 30, bands)).astype(np.float32)
    out = with_odds(pixels, np.exp(g), white)
    assert out.dtype == np.uint8 and out.shape == pixels.shape
    assert np.abs(out - odds_scaled(pixels, g, white)).max() <= 0.51
    assert not out[0].any() and ((out[1] == 255).all() or white > 255)


@pytest.fixture(scope="module")
def lit():
    """Six photos of one ground, each under its own gain per band."""
    views = block()
    rng = np.random.default_rng(1)
    true = {v.photo: rng.uniform(-0.3, 0.3) + rng.uniform(-0.05, 0.05, 3) for v in views}
    pictures = {}
    for v in views:
        grey = np.clip(photograph(v), 12, 240)
        pictures[v.photo] = np.rint(
            np.dstack([odds_scaled(grey, g) for g in true[v.photo]])
        ).astype(np.uint8)
    return views, pictures, true


def test_gains_are_found_again(lit):
    """What was multiplied in comes out, to a common factor per band, to 0.02 in log odds."""
    views, pictures, true = lit
    found = Balance()(views, pictures, FLAT, GRID.bounds)
    mine = np.array([found.gains[v.photo] for v in views])
    expected = -np.array([true[v.photo] for v in views])
    error = (mine - mine.mean(0)) - (expected - expected.mean(0))
    assert np.abs(error).max() < 0.02
    assert np.median(mine, axis=0) == pytest.approx(0, abs=1e-6)
    assert np.abs(expected).max() > 0.2  # there was something to find
    assert not any(found.uneven(v.photo) for v in views)


@pytest.mark.slow
def test_photos_that_overlap_much_are_sampled_less_and_gains_are_found_again(lit):
    """Samples per photo do not grow with the number of photos that show a point; with fewer of
    them, priors weigh as much less.
    """
    views, pictures, true = lit
    many = [replace(v, photo=1000 * k + v.photo) for k in range(12) for v in views]
    shown = {v.photo: pictures[v.photo % 1000] for v in many}
    balance = Balance(points=1)
    few = balance.samples(views, pictures, FLAT, GRID.bounds)
    more = balance.samples(many, shown, FLAT, GRID.bounds)
    assert 1 > few.prior == pytest.approx(12 * more.prior)
    assert np.bincount(more.row).mean() < 1.2 * SAMPLES
    assert np.bincount(more.row).mean() == pytest.approx(SAMPLES, rel=0.4)
    found = balance(many, shown, FLAT, GRID.bounds)
    mine = np.array([found.gains[v.photo] for v in views])
    expected = -np.array([true[v.photo] for v in views])
    error = (mine - mine.mean(0)) - (expected - expected.mean(0))
    assert np.abs(error).max() < 0.03


def test_values_in_proportion_to_the_light_are_told_from_curved_ones(lit):
    """Photos of a linear sensor, each with its own factor: odds to the far white bring them
    together, odds to 255 do not.
    """
    views, curved, true = lit
    factors = {k: float(np.exp(g.mean())) for k, g in true.items()}
    straight = {
        v.photo: np.rint(np.clip(photograph(v), 12, 180)[..., None] * factors[v.photo]).astype(
            np.uint8
        )
        for v in views
    }
    assert Balance()(views, curved, FLAT, GRID.bounds).white == WHITES[0]
    found = Balance()(views, straight, FLAT, GRID.bounds)
    assert found.white == WHITES[-1]
    old = Balance().under(WHITES[0])(views, straight, FLAT, GRID.bounds)
    assert old.white == WHITES[0]

    def residual(exposure):
        told = tone_residual(views, straight, FLAT, GRID.bounds, exposure)
        return told["median"]

    assert residual(found) < 0.7 * residual(old)
    # photos that are added are corrected as those that are there
    first = views[0].photo
    more = {"gains": {**old.gains, 99: old.gains[first]}, "fields": {**old.fields, 99: np.zeros(6)}}
    grown = with_new(found, replace(old, **more))
    assert grown.white == found.white and complete(grown, views).white == found.white


def test_white_balance_of_a_linear_sensor_is_found_where_photos_are_equally_bright(lit):
    """Factors on the bands whose mean changes nothing: the grey values of photos tell nothing of
    the response, their colours do. What was multiplied in comes out of all values alike.
    """
    views = lit[0]
    tints = np.random.default_rng(3).uniform(-0.3, 0.3, (len(views), 2))
    true = {v.photo: 1 + np.array([a, b, -a - b]) for v, (a, b) in zip(views, tints, strict=True)}
    pictures = {}
    for v in views:
        grey = np.clip(photograph(v), 12, 150)
        pictures[v.photo] = np.rint(grey[..., None] * true[v.photo]).astype(np.uint8)
    found = Balance()(views, pictures, FLAT, GRID.bounds)
    assert found.white == WHITES[-1]
    levels = np.array([20.0, 60.0, 120.0])[:, None]
    even = np.stack(
        [found.brightened(levels * true[v.photo], np.exp(found.gains[v.photo])) for v in views]
    )
    assert (even.std(0) < 0.02 * levels).all()


def test_the_map_loses_its_patches(lit):
    views, pictures, _ = lit
    whole = Window(row=0, column=0, height=GRID.height, width=GRID.width)
    neutral = {
        v.photo: np.rint(np.dstack([np.clip(photograph(v), 12, 240)] * 3)).astype(np.uint8)
        for v in views
    }
    target = composer(views, neutral, GRID, bands=3)(whole)

    def spread(exposure):
        made = composer(views, pictures, GRID, bands=3, exposure=exposure)(whole)
        ok = target.photo >= 0
        off = made.pixels[ok].astype(float) - target.pixels[ok]
        return float(np.std([off[target.photo[ok] == v.photo].mean() for v in views]))

    before, after = spread(NEUTRAL), spread(Balance()(views, pictures, FLAT, GRID.bounds))
    assert before > 5 and after < 0.12 * before


@pytest.mark.parametrize(
    "bits", [10, 16, *(pytest.param(v, marks=pytest.mark.slow) for v in (12, 14))]
)
def test_photos_of_more_bits_are_balanced_as_those_of_eight(lit, bits):
    """The same pictures with more bits get the same gains and the same map, but for rounding; the
    lightest values tell how many of the 16 bits are used.
    """
    views, eight, _ = lit
    step = (2**bits - 1) / 255
    deep = {k: np.rint(p * step).astype(np.uint16) for k, p in eight.items()}
    ground = SimpleNamespace(views=views, surface=FLAT, grid=GRID, growth=None)
    common = {"balance": Balance(), "drift": None, "settings": PictureSettings(), "unit": ""}
    of_eight = Levelling(dtype="uint8", thumbnails=eight, **common)(ground)
    levelled = Levelling(dtype="uint16", thumbnails=deep, **common)
    found = levelled(ground)
    assert found.level == pytest.approx(step)
    for k, gain in of_eight.gains.items():
        assert found.gains[k] == pytest.approx(gain, abs=0.01)
    whole = Window(row=0, column=0, height=GRID.height, width=GRID.width)
    a, b = (
        composer(views, p, GRID, bands=3, exposure=e, dtype=t)(whole).pixels
        for p, e, t in ((eight, of_eight, np.uint8), (deep, found, np.uint16))
    )
    assert b.dtype == np.uint16 and np.abs(b / step - a).max() < 2
    tones = [
        tone_residual(views, p, FLAT, GRID.bounds, e) for p, e in ((eight, of_eight), (deep, found))
    ]
    assert tones[1]["median"] == pytest.approx(tones[0]["median"], rel=0.1)
    assert replace(levelled, measured=True)(ground) is NEUTRAL


def test_vignetting_is_found_by_camera(lit):
    """All photos lose light towards their corners, each under its own gain: the fall is found to a
    hundredth of its odds, up to a constant, and the gains beside it.
    """
    views, _, true = lit
    x, y = np.meshgrid(*((np.arange(n) - (n - 1) / 2) / 249.5 for n in (400, 300)))
    r2 = x * x + y * y
    dark = -0.6 * r2 - 0.3 * r2 * r2
    pictures = {
        v.photo: np.rint(odds_scaled(np.clip(photograph(v), 12, 240), dark + true[v.photo].mean()))[
            ..., None
        ].astype(np.uint8)
        for v in views
    }
    found = Balance()(views, pictures, FLAT, GRID.bounds)
    for v in views:
        assert found.uneven(v.photo)
        gone = np.log(found.odds(v.photo, *image_place(v, *np.meshgrid(range(400), range(300)))))
        off = gone[..., 0] + dark
        assert np.ptp(off[10:-10, 10:-10]) < 0.1, np.ptp(off)
    shift = [found.gains[v.photo][0] + true[v.photo].mean() for v in views]
    assert np.ptp(shift) < 0.03


def test_moving_things_do_not_count(lit):
    """A white car park that one photo alone shows, on a tenth of it."""
    views, pictures, true = lit
    spoilt = {k: p.copy() for k, p in pictures.items()}
    spoilt[views[2].photo][100:180, 100:260] = 235
    a = Balance()(views, pictures, FLAT, GRID.bounds).gains
    b = Balance()(views, spoilt, FLAT, GRID.bounds).gains
    assert max(np.abs(a[k] - b[k]).max() for k in a) < 0.06


def test_nothing_to_compare(lit):
    views, pictures, _ = lit
    assert Balance()(views[:1], pictures, FLAT, GRID.bounds) is NEUTRAL
    assert Balance()(views, {}, FLAT, GRID.bounds) is NEUTRAL
    black = {v.photo: np.zeros((300, 400, 3), np.uint8) for v in views}
    assert Balance()(views, black, FLAT, GRID.bounds) is NEUTRAL


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_an_area_that_some_photos_do_not_show(lit):
    """A map of one pixel, in one corner: the others have no sample at all."""
    views, pictures, _ = lit
    x, y = min((tuple(v.footprint.min(0)) for v in views), key=sum)
    far = [
        v for v in views if (v.footprint.min(0) - 0.2 * np.ptp(v.footprint, 0).max() > (x, y)).any()
    ]
    assert far
    samples = Balance().samples(views, pictures, FLAT, (x, y, x + 0.1, y + 0.1))
    assert not set(samples.row) & {views.index(v) for v in far}


def test_measured_values_are_never_touched(lit):
    views, _, _ = lit
    values = {v.photo: np.full((300, 400, 1), 21.5, np.float32) for v in views}
    exposure = Exposure(
        gains={v.photo: np.array([0.7], np.float32) for v in views},
        fields={v.photo: np.ones(6, np.float32) for v in views},
    )
    made = composer(views, values, GRID, dtype=np.float32, exposure=exposure)(
        Window(row=64, column=64, height=64, width=64)
    )
    assert made.pixels == pytest.approx(21.5)


def stated_plainly(terms, row, point, y, ridge, count):
    """The robust solution by full matrices: of each point's samples the weighted mean is taken off,
    then least squares.
    """
    k = terms.shape[1]
    A = np.zeros((len(y), count * k))
    for sample, photo in enumerate(row):
        A[sample, photo * k : (photo + 1) * k] = terms[sample]
    w, x = np.ones(len(y)), np.zeros((count * k, y.shape[1]))
    same = (point[:, None] == point).astype(float)
    for _ in range(6):
        mean = same * w / (same @ w)[:, None]
        root = np.sqrt(w)[:, None]
        B, z = root * (A - mean @ A), root * (y - mean @ y)
        pull = np.diag(np.tile(ridge, count) * differences.SIGMA_LEVEL**2 * differences.CORRELATED)
        before, x = x, np.linalg.solve(B.T @ B + pull, -B.T @ z)
        if np.abs(x - before).max() < differences.SETTLED:
            break
        level = y + A @ x
        w = 1 / (1 + ((level - mean @ level) ** 2).mean(1) / 0.25**2)
    return x.reshape(count, k, -1)


@pytest.mark.parametrize("leaf", [2, 1000])
@pytest.mark.parametrize(("k", "bands"), [(6, 1), (1, 3)])
def test_blocks_give_what_full_matrices_give(k, bands, leaf, monkeypatch):
    monkeypatch.setattr(block_cholesky, "LEAF", leaf)
    rng = np.random.default_rng(k)
    seen = rng.random((60, 7)) < 0.5
    seen[0] = False
    seen[1] = True
    point, row = np.nonzero(seen)
    shuffled = rng.permutation(len(row))
    _, point = np.unique(point[shuffled], return_inverse=True)
    row = row[shuffled]
    terms = np.concatenate([np.ones((len(row), 1)), rng.uniform(-1, 1, (len(row), k - 1))], 1)
    y, ridge = rng.normal(0, 0.4, (len(row), bands)), rng.uniform(1, 50, k)
    pairs = differences.Pairs.of(row, point, rng.uniform(0, 9, (7, 2)))
    found = differences.robust_differences(terms, pairs, y, ridge)
    assert np.abs(found - stated_plainly(terms, row, point, y, ridge, 7)).max() < 1e-9


@pytest.mark.parametrize("leaning", [0.0, 0.25])
def test_things_that_lean_do_not_move_the_gains(leaning):
    """A third of each photo's samples is darker, as where crowns lean over a lawn, and more so in
    some photos: weights of their own scatter leave the gains where they are; scattered samples of
    usual surveys keep the wide ones.
    """
    rng = np.random.default_rng(4)
    n, points = 12, 900
    point = np.repeat(np.arange(points), 4)
    row = np.concatenate([rng.choice(n, 4, replace=False) for _ in range(points)])
    true, share = rng.uniform(-0.3, 0.3, n), rng.uniform(0.1, 0.5, n)
    light = rng.uniform(-1, 1, points)[point] + rng.normal(0, 0.01, len(point))
    light -= leaning * (rng.random(len(point)) < share[row])
    pairs = differences.Pairs.of(row, point, rng.uniform(0, 1, (n, 2)))
    ones, ridge = np.ones((len(row), 1)), np.array([4.0])

    def off(closely):
        y = (light - true[row])[:, None]
        found = differences.robust_differences(ones, pairs, y, ridge, closely=closely)[:, 0, 0]
        return float((found - true - (found - true).mean()).std())

    assert off(closely=True) < 0.006
    assert (off(closely=False) > 0.015) == (leaning > 0)


def test_close_weights_are_not_taken_where_light_differs_over_each_photo(lit):
    """There the middle of all samples counts."""
    views, pictures, _ = lit
    rng = np.random.default_rng(2)
    uneven = {}
    for v in views:
        h, w, _ = pictures[v.photo].shape
        waves = rng.normal(0, 0.25, (6, 8)).astype(np.float32)
        field = cv2.resize(waves, (w, h), interpolation=cv2.INTER_CUBIC)[..., None]
        grey = np.clip(pictures[v.photo].astype(float), 12, 240)
        uneven[v.photo] = np.rint(odds_scaled(grey, field)).astype(np.uint8)
    balance = Balance().under(WHITES[0])
    samples = balance.samples(views, uneven, FLAT, GRID.bounds)
    where = np.array([v.footprint.mean(0) for v in views])
    pairs = differences.Pairs.of(samples.row, samples.point, where)
    wide, _ = balance._best(samples, views, pairs, MADE_NOW, closely=False)
    close, _ = balance._best(samples, views, pairs, MADE_NOW, closely=True)
    found = balance(views, uneven, FLAT, GRID.bounds)
    assert all((found.gains[v.photo] == wide.gains[v.photo]).all() for v in views)
    assert any((close.gains[v.photo] != wide.gains[v.photo]).any() for v in views)


def test_an_interrupted_balance_goes_on_with_what_it_had(lit):
    """Solutions are kept by name; none is computed twice, and the result is the same."""
    views, pictures, _ = lit
    kept: dict[str, Exposure] = {}
    solved = []

    class Counting(Balance):
        def _solve(self, *args, **options):
            solved.append(options)
            return super()._solve(*args, **options)

    def held(name, make):
        if name not in kept:
            kept[name] = make()
        return kept[name]

    whole = Counting()(views, pictures, FLAT, GRID.bounds, Keep(held=held))
    first = len(solved)
    again = Counting()(views, pictures, FLAT, GRID.bounds, Keep(held=held))
    assert first > 1 and len(solved) == first
    alone = Balance()(views, pictures, FLAT, GRID.bounds)
    for other in (again, alone):
        assert other.white == whole.white
        assert all((other.gains[v.photo] == whole.gains[v.photo]).all() for v in views)
        assert all((other.fields[v.photo] == whole.fields[v.photo]).all() for v in views)
