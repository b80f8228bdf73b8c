"""Black rims of pictures against the shapes that were drawn, and dark ground that is none."""

import warnings

import cv2
import numpy as np
import pytest

from skyquilt.imaging.blank import LONGEST, STEP, Blank, blank_rim, find_blanks
from skyquilt.imaging.nodes import inside_everywhere, project_all, project_nodes
from skyquilt.imaging.view_limits import ViewLimits
from skyquilt.imaging.views import make_views
from skyquilt.model.surface import Surface
from tests.alignment.test_oblique import CAMERA, block, hills, pose

HIGH, WIDE = 192, LONGEST


def ground(count=8, seed=0, dark=90):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 2 * dark, (count, 12, 16)).astype(np.float32)
    return [cv2.resize(c, (WIDE, HIGH), interpolation=cv2.INTER_CUBIC).clip(0, 255) for c in coarse]


def away(x=128.0, y=96.0):
    """Distance of each pixel from a place."""
    return np.hypot(*(np.mgrid[:HIGH, :WIDE] - np.array([y, x])[:, None, None]))


def noisy(picture, seed):
    grain = np.abs(np.random.default_rng(seed).normal(0, 2, picture.shape))
    return np.clip(picture + grain, 0, 255).astype(np.uint8)


def shown(shape):
    return {
        "circle": away() < 110,
        "bars": np.broadcast_to(np.abs(np.arange(HIGH) - 96) < 74, (WIDE, HIGH)).T,
        "corner": away(0, 0) > 60,
    }[shape]


@pytest.mark.parametrize("shape", ["circle", "bars", "corner"])
def test_black_rims_are_found_where_they_were_drawn(shape):
    keep = shown(shape)
    mask = blank_rim([noisy(p * keep, i) for i, p in enumerate(ground())])
    assert mask is not None and (mask == ~keep).mean() > 0.995


def test_frames_of_two_colours_and_the_date_in_a_bar_are_found():
    """The text of the date changes from photo to photo."""
    frame, bar = np.ones((HIGH, WIDE), bool), np.zeros((HIGH, WIDE), bool)
    frame[5:-5, 5:-5], bar[:25] = False, True
    pictures = ground()
    for i, p in enumerate(pictures):
        p[frame], p[bar] = 250, 0
        p[8:18, 40 + 3 * i : 80 + 5 * i : 4] = 255
    mask = blank_rim([p.astype(np.uint8) for p in pictures])
    assert mask is not None and (mask == (frame | bar)).mean() > 0.995


def test_water_fog_and_burnt_skies_at_the_rim_are_no_frame():
    """Alike in all photos, but it fades into what they show; a white sky that ends sharply does not
    lie at the same place of all.
    """
    pictures = ground()
    fade = np.clip(away(0, 0) / 150 - 0.4, 0, 1)
    fog = [190 + fade * (p - 190) for p in pictures]
    assert blank_rim([noisy(p, i) for i, p in enumerate(fog)]) is None
    for i, p in enumerate(pictures):
        p[: 12 * (i % 4)] = 255
    assert blank_rim([noisy(p, i) for i, p in enumerate(pictures)]) is None


@pytest.mark.parametrize("kind", ["ground", "vignetting", "night", "few", "hole"])
def test_dark_ground_is_no_rim(kind):
    """Corners that a lens darkens rise slowly; a shadow lies at one place in some photos only; what
    is black in the middle is no rim.
    """
    pictures = ground(dark=90 if kind != "night" else 15)
    if kind == "vignetting":
        pictures = [p * np.clip(1.2 - (away() / 150) ** 2, 0.02, 1) for p in pictures]
    if kind in ("ground", "night"):
        for i, p in enumerate(pictures[1:]):
            p[20 * i : 20 * i + 40, :30] = 3
    if kind == "hole":
        pictures = [p * (away() > 30) for p in pictures]
    if kind == "few":
        keep = shown("circle")
        cameras = dict.fromkeys(range(4), ("c", (WIDE, HIGH)))
        told = find_blanks(cameras, (), lambda i, longest: noisy(pictures[i] * keep, i))
        assert told == ({}, ())
    else:
        assert blank_rim([noisy(p, i) for i, p in enumerate(pictures)]) is None


@pytest.mark.parametrize("level", [255, 128, 40])
@pytest.mark.parametrize("shape", ["circle", "bars", "corner"])
def test_frames_of_one_colour_are_found_where_they_were_drawn(shape, level):
    keep = shown(shape)
    pictures = []
    for p in ground():
        framed = cv2.resize(np.where(keep, p, level), None, fx=3, fy=3).astype(np.uint8)
        packed = cv2.imencode(".jpg", framed, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        unpacked = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
        pictures.append(cv2.resize(unpacked, (WIDE, HIGH), interpolation=cv2.INTER_AREA))
    mask = blank_rim(pictures)
    assert mask is not None and (mask == ~keep).mean() > 0.98
    assert blank_rim([p.astype(np.uint8) for p in ground()]) is None


@pytest.mark.parametrize("kind", ["canal", "snow", "exposures"])
def test_even_ground_is_no_frame(kind):
    """A canal or a road at one place of every picture has some texture, or is lighter in one
    picture; snow is white where others are not.
    """
    pictures, side = ground(), np.mgrid[:HIGH, :WIDE][1] < 50
    if kind == "snow":
        pictures = [np.where(away(20 + 30 * i, 60) < 150, p, 255.0) for i, p in enumerate(pictures)]
    even = cv2.resize(np.random.default_rng(5).uniform(-8, 8, (12, 16)), (WIDE, HIGH))
    if kind == "canal":
        pictures = [np.where(side, 60 + even, p) for p in pictures]
    if kind == "exposures":
        pictures = [np.where(side, 120 + 3 * i, p) for i, p in enumerate(pictures)]
    assert blank_rim([np.round(p).astype(np.uint8) for p in pictures]) is None


def test_pictures_of_one_colour_have_no_frame():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a colour that all pixels have, no others are counted
        assert blank_rim([np.full((48, 64), 120, np.uint8)] * 4) is None


def test_a_see_through_photo_tells_for_itself():
    pictures, keep = ground(2), [away(0, 0) > 60, away(255, 0) > 90]
    cameras = dict.fromkeys(range(2), ("c", (4 * WIDE, 4 * HIGH)))
    found, notes = find_blanks(
        cameras,
        {0, 1},
        lambda i, longest: (np.maximum(pictures[i], STEP) * keep[i]).astype(np.uint8),
    )
    assert len(notes) == 1 and "2 photos of c" in notes[0]
    v, u = np.mgrid[: 4 * HIGH : 7, : 4 * WIDE : 7].astype(np.float32)
    for i, k in enumerate(keep):
        inside = found[i].at(u, v) >= 0
        want = k[v.astype(int) // 4, u.astype(int) // 4]
        near = cv2.dilate((~want).astype(np.uint8), np.ones((3, 3))) > 0
        assert not (inside & ~want).any() and (inside | near).all()


def test_dark_shadows_of_a_photo_that_might_be_see_through_stay():
    picture = np.full((HIGH, WIDE), 120, np.uint8)
    picture[:60, :90] = 9
    assert find_blanks({0: ("c", (WIDE, HIGH))}, {0}, lambda i, longest: picture) == ({}, ())


def test_views_show_nothing_where_their_photo_does():
    """The projected circle, by the textbook; a footprint ends there too."""
    rim = Blank(
        room=np.clip((80 - away(100, 75)[:150, :200]) / 16, -1, 1).astype(np.float32),
        size=(CAMERA.width, CAMERA.height),
    )
    done = block([pose(0, 0), pose(20, 0)], hills(500))
    surface = Surface(z=np.zeros((2, 2), np.float32), x0=-500, y0=-500, cell=1000, source="plane")
    one, two = make_views(done, surface, ViewLimits(blanks={0: rim}))
    plain, _ = make_views(done, surface, ViewLimits())
    assert np.ptp(one.footprint, axis=0)[0] < 0.85 * np.ptp(plain.footprint, axis=0)[0]
    x, y = np.meshgrid(np.arange(-40, 40, 1.0), np.arange(30, -30, -1.0))
    z = np.zeros_like(x)
    first, second = project_all([one, two], x, y, z)
    px = np.stack([first.u, first.v])
    circle = np.hypot(*((px.T + 0.5) / 5 - 0.5 - [100, 75]).T) <= 80
    assert (first.seen == (circle & project_nodes(plain, x, y, z).seen)).mean() > 0.995
    assert np.array_equal(first.seen, project_nodes(one, x, y, z).seen)
    assert second.seen.sum() > first.seen.sum()
    dense = [np.repeat(np.repeat(p, 16, 0), 16, 1)[16:-16, 16:-16] for p in (first.u, first.v)]
    everywhere = inside_everywhere(first, *dense)[8::16, 8::16]
    assert (everywhere == first.seen[1:-1, 1:-1]).mean() > 0.97
