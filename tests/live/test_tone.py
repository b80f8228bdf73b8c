"""Photos under gains of their own come to one brightness, one after the other."""

import numpy as np
import pytest

from skyquilt.live.tone import Tone
from tests.ortho.scenes import FLAT, block, photograph


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
