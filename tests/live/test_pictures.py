"""Photos as small as the growing map needs them: made once, and the same ever after."""

import numpy as np
import pytest

from skyquilt.imaging.grey import shrink
from skyquilt.live import reduced_pictures as pictures
from skyquilt.live.live_map import LiveMap
from skyquilt.live.reduced_pictures import STAGE, SmallPictures
from skyquilt.photos.pixels import read_color


@pytest.fixture
def live(flight, tmp_path):
    opened = LiveMap(tmp_path / "map")
    opened.add(flight.photos[0])
    yield opened
    opened.close()


def test_a_small_picture_is_made_once(live, monkeypatch):
    member, canvas = live.members.by_id[1], live.canvas
    first = canvas._pictures(1)
    longest = canvas._pictures.longest(member, canvas.gsd, canvas.ground)
    assert max(first.shape) == longest < max(member.photo.width, member.photo.height)
    expected = shrink(read_color(member.photo), longest)[0]
    assert (
        np.sqrt(((first.astype(float) - expected) ** 2).mean()) < 4
    )  # JPEG, and another way of halving
    assert len(list((live.store.folder / STAGE).glob("*.npz"))) == 1

    monkeypatch.setattr(pictures, "read_color", None)  # a photo is not decoded again
    live.full.clear()
    again = SmallPictures(live.full, live.members.by_id, live.store)
    assert again.longest(member, canvas.gsd, canvas.ground) == longest
    assert np.array_equal(again(1), first)
    assert again.decoded == 1 and again(1) is again(1)


def test_the_size_of_a_picture_stays_when_its_photo_moves(live):
    member, canvas = live.members.by_id[1], live.canvas
    longest = canvas._pictures.longest(member, canvas.gsd, canvas.ground)
    assert canvas._pictures.longest(member, canvas.gsd / 2, canvas.ground - 30) == longest
    anew = SmallPictures(live.full, live.members.by_id, live.store)
    assert anew.longest(member, canvas.gsd / 2, canvas.ground) > 1.5 * longest
