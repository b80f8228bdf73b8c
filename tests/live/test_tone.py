"""Photos under gains of their own come to one brightness, one after the other."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live import background_adjustment
from skyquilt.live.tone import Tone
from skyquilt.ortho import cloud_shadows
from skyquilt.ortho.exposure import NEUTRAL, Exposure, image_place
from skyquilt.ortho.ground import Ground
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import methods_for
from tests.ortho.scenes import FLAT, block, photograph
from tests.ortho.test_exposure import GRID


def odds(x):
    return np.log(x / (255 - x))


@pytest.fixture(scope="module")
def flight():
    views = block()
    rng = np.random.default_rng(5)
    true = {v.photo: rng.uniform(-0.4, 0.4) for v in views}
    pictures = {}
    for v in views:
        grey = np.clip(photograph(v), 20, 230)
        lit = 255 / (1 + np.exp(-(odds(grey) + true[v.photo])))
        pictures[v.photo] = np.repeat(np.rint(lit)[..., None], 3, 2).astype(np.uint8)
    return views, pictures, true


def test_each_photo_comes_to_the_level_of_those_before(flight):
    """The spread of the gains left is a sixth of the spread that was put in."""
    views, pictures, true = flight
    tone = Tone(pictures.__getitem__)
    for k, view in enumerate(views):
        tone.settle(view, views[:k], FLAT, measured=False, drift=False)
    found = tone.exposure.gains
    left = [found[v.photo].mean() + true[v.photo] for v in views]
    assert np.ptp(list(true.values())) > 0.4
    assert np.ptp(left) < np.ptp(list(true.values())) / 6
    assert found[views[0].photo] == pytest.approx(0)
    tone.forget(views[0].photo)
    assert views[0].photo not in tone.exposure.gains


def test_temperatures_get_an_offset_only_where_wanted(flight):
    views, pictures, _ = flight
    warm = {k: pictures[views[0].photo][..., :1].astype(np.float32) / 10 for k in pictures}
    drifted = {k: v + 0.3 * n for n, (k, v) in enumerate(warm.items())}
    same = [views[0], type(views[0])(**{**vars(views[0]), "photo": views[1].photo})]
    for drift in (True, False):
        tone = Tone(drifted.__getitem__)
        for k, view in enumerate(same):
            tone.settle(view, same[:k], FLAT, measured=True, drift=drift)
        assert not tone.exposure.gains
        given = tone.exposure.offsets
        assert (
            (given[same[1].photo] == pytest.approx(-0.3 * 0.95, abs=0.01)) if drift else not given
        )


def shaded(view, cloud):
    """(h, w) log odds over a photo, of shades (n, n)."""
    h, w = view.camera.height, view.camera.width
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    return cloud_shadows.over(cloud, *image_place(view, u, v))


@pytest.fixture(scope="module")
def clouded(flight):
    """The same photos, each under the shadow of a cloud of its own, and what evens these out."""
    views, pictures, true = flight
    nodes = np.linspace(-cloud_shadows.REACH, cloud_shadows.REACH, cloud_shadows.NODES)
    dark, shades = {}, {}
    for k, v in enumerate(views):
        away = np.hypot(*np.meshgrid(nodes - np.sin(2.4 * k) / 2, nodes - np.cos(2.4 * k) / 2))
        shades[v.photo] = (0.9 / (1 + np.exp((away - 0.4) / 0.08))).astype(np.float32)
        lit = np.clip(pictures[v.photo].astype(float), 1, 254)
        lit = odds(lit) - shaded(v, shades[v.photo])[..., None]
        dark[v.photo] = np.rint(255 / (1 + np.exp(-lit))).astype(np.uint8)
    gains = {i: np.full(3, 0.7 - g, np.float32) for i, g in true.items()}
    zero = np.zeros(6, np.float32)
    return dark, Exposure(gains=gains, fields=dict.fromkeys(gains, zero), shades=shades)


def test_shades_found_for_photos_together_are_kept_and_others_come_to_them(flight, clouded):
    """A new photo is compared with its neighbours as they are drawn, without their shadows."""
    views, _, true = flight
    dark, found = clouded
    tone = Tone(dark.__getitem__)
    *before, last = views
    for k, view in enumerate(before):
        tone.settle(view, views[:k], FLAT, measured=False, drift=False)
    level = np.median([g.mean() for g in tone.exposure.gains.values()])
    shown = {v.photo for v in before[1:]}
    assert tone.take(found, shown) == sorted(shown)  # one left the map since, one was not there yet
    for view in before:
        tone.settle(view, before, FLAT, measured=False, drift=False)
    now = tone.exposure
    assert set(now.shades) == shown
    apart = [now.gains[i].mean() + true[i] for i in shown]
    assert np.ptp(apart) < 1e-5
    assert np.median([now.gains[i].mean() for i in shown]) == pytest.approx(level, abs=0.1)
    tone.settle(last, before, FLAT, measured=False, drift=False)
    inside = found.shades[last.photo]
    shadow = shaded(last, inside)
    left = tone.exposure.gains[last.photo].mean() + true[last.photo] - np.median(apart)
    assert 0 < left < shadow.max()  # a gain for all of its picture: as much as of most of it
    assert left == pytest.approx(np.median(shadow), abs=0.25)
    tone.forget(views[1].photo)
    assert views[1].photo not in tone.exposure.shades
    assert tone.take(NEUTRAL, shown) == []


@pytest.mark.parametrize("cloudy", [True, False])
def test_a_thorough_adjustment_looks_for_shadows_of_clouds(flight, clouded, cloudy):
    views, pictures, _ = flight
    dark, _ = clouded
    photo = SimpleNamespace(unit="", dtype="uint8", channels=3, saved_grey=False)
    small = iter([(dark if cloudy else pictures)[v.photo] for v in views])
    number = {v.photo: 100 + v.photo for v in views}
    job = SimpleNamespace(
        ids={v.photo: number[v.photo] for v in views},
        photos={v.photo: photo for v in views},
        methods=methods_for(MosaicSettings()),
    )
    ground = Ground(surface=FLAT, views=tuple(views), grid=GRID, native_gsd=0.1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            background_adjustment, "_look", lambda *_: SimpleNamespace(thumbnail=next(small))
        )
        found = background_adjustment._clouded(ground, job, None)
    assert set(found.shades) <= set(found.gains) <= set(number.values())
    assert (len(found.shades) > len(views) // 2) == cloudy and bool(found.gains) == cloudy
    photo.unit = "celsius"
    assert background_adjustment._clouded(ground, job, None) is NEUTRAL
