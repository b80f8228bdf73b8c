"""What smoke veils yields to clear photos on the growing map too, and is told."""

import json

import numpy as np
import pytest

from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.veils import KEY, LiveVeils
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Pictures, Route
from tests.live.conftest import fed, made
from tests.live.test_overexposed import tiles_of


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """The growing map of a flight, and of the same over fires."""
    flights = [
        made(
            tmp_path_factory, f"fires{fires}", seed=501, lens=Lens().scaled(800, 600),
            route=Route(photos=20), control=Control(points=0), pictures=Pictures(fires=fires),
        ).photos
        for fires in (0, 3)
    ]  # fmt: skip
    folder = tmp_path_factory.mktemp("veils")
    settings = LiveSettings(deterministic=True, features=800)
    found = [
        fed(LiveMap(folder / name, settings), photos)
        for name, photos in zip(("clear", "smoke"), flights, strict=True)
    ]
    yield found
    for live in found:
        live.close()


def notes_of(live):
    rows = live.ledger.rows("select body from event where kind = 'note' order by seq")
    return [t for (body,) in rows if "smoke" in (t := json.loads(body)["text"])]


@pytest.mark.slow
def test_smoke_is_shown_only_where_no_clear_photo_is(maps):
    """Against the map of the clear flight; where smoke does not yield, 0.15 of this map are off."""
    clear, smoke = maps
    apart, mine = [], tiles_of(smoke)
    for address, tile in tiles_of(clear).items():
        if (other := mine.get(address)) is not None:
            both = tile.shown & other.shown
            apart.append(np.abs(tile.pixels.astype(float) - other.pixels).mean(-1)[both])
    assert (np.concatenate(apart) > 40).mean() < 0.135


@pytest.mark.slow
def test_smoke_alone_is_told_and_a_restart_knows_it(maps):
    clear, smoke = maps
    assert notes_of(clear) == []
    first, *more = notes_of(smoke)
    assert first.startswith("So far: ") and "a part of the ground through smoke" in first
    assert len(more) < 5
    known, now = LiveVeils(smoke.live_links, smoke.heights, ()), smoke.refinement.veils
    numbers = [i for i in smoke.members.by_id if now.of(i) is not None]
    assert numbers
    for i in smoke.members.by_id:
        a, b = known.of(i), now.of(i)
        assert (a is None) == (b is None)
        assert a is None or (a.size == b.size and np.array_equal(a.room, b.room))
    with smoke.ledger.change():
        for said in ("[1, 2]", '"x"', "null", "[NaN]", "{}"):
            smoke.ledger.db.execute(
                "update meta set value = ? where key = ?", (said, f"{KEY}{numbers[0]}")
            )
            damaged = LiveVeils(smoke.live_links, smoke.heights, ())
            assert damaged.of(numbers[0]) is None
            assert all(damaged.of(i) is not None for i in numbers[1:])
