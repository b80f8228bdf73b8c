"""Merge rules on layers of exact numbers."""

import numpy as np
import pytest

from skyquilt.ortho.blend import Average, Feather, First, Layer, Multiband

H, W, GSD, FLYING = 64, 96, 0.1, 50.0


def layer(photo, x, value, *, y=0.0, hide=None, height=FLYING, dtype=np.uint8, bands=3):
    """A photo of one colour, its camera at x, y m; the window's middle is the origin."""
    gx, gy = np.meshgrid((np.arange(W) - (W - 1) / 2) * GSD, -(np.arange(H) - (H - 1) / 2) * GSD)
    score = (((gx - x) ** 2 + (gy - y) ** 2) / height**2).astype(np.float32)
    if hide is not None:
        score = np.where(hide, np.float32(np.inf), score)
    return Layer(
        photo=photo,
        pixels=np.full((H, W, bands), value, dtype),
        score=score,
        centre=(x, y),
        height=height,
    )


@pytest.mark.parametrize("width", [4.0, 6.0, 12.0])
@pytest.mark.parametrize("seam", [0.0, 1.23, -2.0])
def test_a_seam_is_a_straight_ramp_of_the_stated_width(width, seam):
    """Two photos of 0 and 200: the mix grows linearly from 0 to 1 over exactly `width` px about
    equal angles.
    """
    a, b = layer(4, seam - 8, 0), layer(9, seam + 8, 200)
    pixels, photo = Feather(width_px=width).merge([a, b], GSD)
    distance = (np.arange(W) - (W - 1) / 2) - seam / GSD
    expected = 200 * np.clip(0.5 + distance / width, 0, 1)
    assert np.abs(pixels[:, :, 0].astype(float) - expected).max() <= 1.01
    assert (photo == np.where(distance < 0, 4, 9)).all()
    touched = ((pixels > 0) & (pixels < 200)).any((0, 2)).sum()
    assert width - 2 <= touched <= width + 1


def test_no_feather_no_mix():
    pixels, _ = Feather(width_px=0).merge([layer(0, -8, 10), layer(1, 8, 200)], GSD)
    assert set(np.unique(pixels)) == {10, 200}


def test_far_from_seams_pixels_are_untouched():
    rng = np.random.default_rng(0)
    a, b = layer(0, -8, 0), layer(1, 8, 0)
    a.pixels[:], b.pixels[:] = rng.integers(0, 255, (2, H, W, 3))
    pixels, _ = Feather(width_px=6).merge([a, b], GSD)
    assert (pixels[:, :44] == a.pixels[:, :44]).all() and (pixels[:, 52:] == b.pixels[:, 52:]).all()


def test_where_one_photo_ends_the_other_is_pure():
    hide = np.arange(W)[None].repeat(H, 0) < 40
    a, b = layer(0, -8, 50), layer(1, 8, 200, hide=hide)
    pixels, photo = Feather(width_px=6).merge([a, b], GSD)
    assert (pixels[:, :40] == 50).all() and (photo[:, :40] == 0).all()
    everywhere = np.ones((H, W), bool)
    pixels, photo = Feather().merge(
        [layer(0, 0, 9, hide=everywhere), layer(1, 1, 9, hide=everywhere)], GSD
    )
    assert (photo == -1).all() and not pixels.any()


@pytest.mark.parametrize(
    "rule", [Feather(), Average(), Multiband(levels=3), First()], ids=lambda r: type(r).__name__
)
def test_photos_of_one_colour_make_a_map_of_it(rule):
    layers = [layer(k, 5 * k - 10, 137, y=3 * (-1) ** k) for k in range(5)]
    pixels, _ = rule.merge(layers, GSD)
    assert (pixels == 137).all()


@pytest.mark.parametrize(
    "rule", [Feather(), Average(), Multiband(levels=2), First()], ids=lambda r: type(r).__name__
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_type_and_range_are_kept(rule, dtype):
    rng = np.random.default_rng(1)
    layers = [layer(k, 6 * k - 9, 0, dtype=dtype) for k in range(4)]
    top = {np.uint8: 255, np.uint16: 65535, np.float32: 1e4}[dtype]
    for k in layers:
        k.pixels[:] = (rng.random(k.pixels.shape) > 0.5) * top
    pixels, photo = rule.merge(layers, GSD)
    assert pixels.dtype == dtype and pixels.shape == (H, W, 3) and (photo >= 0).all()
    if not isinstance(rule, Multiband):
        assert pixels.min() >= 0 and pixels.max() <= top


def test_average_is_exact():
    hide = np.arange(W)[None].repeat(H, 0) < 50
    pixels, _ = Average().merge([layer(0, 0, 10), layer(1, 3, 20, hide=hide), layer(2, 6, 40)], GSD)
    assert (pixels[:, :50] == 25).all() and (pixels[:, 50:] == 23).all()  # 70 / 3 = 23.3
    values, _ = Average().merge(
        [layer(0, 0, 10.5, dtype=np.float32), layer(1, 3, 21.0, dtype=np.float32)], GSD
    )
    assert values == pytest.approx(15.75)


def test_the_photo_taken_first_wins():
    hide = np.arange(H)[:, None].repeat(W, 1) < 20
    pixels, photo = First().merge([layer(7, 9, 1, hide=hide), layer(2, 0, 2)], GSD)
    assert (photo[:20] == 2).all() and (photo[20:] == 7).all() and (pixels[20:] == 1).all()


def test_multiband_is_a_wider_smoother_seam():
    """Two colours: monotone from one to the other, far ends pure, and wider than a few pixels."""
    pixels, photo = Multiband(levels=3).merge([layer(0, -8, 40), layer(1, 8, 200)], GSD)
    line = pixels[H // 2, :, 0].astype(int)
    assert (np.diff(line) >= 0).all() and line[0] == 40 and line[-1] == 200
    assert 6 < ((line > 45) & (line < 195)).sum() < 40
    assert (photo[:, :48] == 0).all() and (photo[:, 48:] == 1).all()


def test_multiband_of_one_picture_seen_twice_is_that_picture():
    """Laplacian pyramids of equal layers collapse to the layer whatever the seams."""
    rng = np.random.default_rng(2)
    image = rng.integers(0, 255, (H, W, 3)).astype(np.uint8)
    layers = [layer(k, 9 * k - 9, 0) for k in range(3)]
    for k in layers:
        k.pixels[:] = image
    pixels, _ = Multiband(levels=4).merge(layers, GSD)
    assert np.abs(pixels.astype(int) - image).max() <= 1
