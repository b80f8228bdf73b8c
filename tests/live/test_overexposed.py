"""What is overexposed yields to other photos on the growing map too, and is told."""

import io
import json

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import WHOLE, Canvas
from skyquilt.live.veils import LiveVeils
from skyquilt.ortho.blend import Feather
from skyquilt.simulate.settings import Control, Route
from tests.live.conftest import fed, made

pytestmark = pytest.mark.slow
SPOILT = (1, 4)
"""Photos that are overexposed, of eight in two lines."""


def lightened(path, target, factor):
    """The photo as a longer exposure shows it, with its metadata."""
    image = Image.open(path)
    linear = (np.asarray(image) / 255.0) ** 2.2 * factor
    pixels = (255 * np.minimum(linear, 1) ** (1 / 2.2)).astype(np.uint8)
    held = io.BytesIO()
    exif = piexif.dump(piexif.load(image.info["exif"]))
    Image.fromarray(pixels).save(held, "JPEG", quality=92, exif=exif, xmp=image.info.get("xmp"))
    target.write_bytes(held.getvalue())


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    return made(
        tmp_path_factory, "eight", seed=11, route=Route(photos=8), control=Control(points=0)
    )


@pytest.fixture(scope="module")
def maps(flown, tmp_path_factory):
    """The map of the flight, of the same with two photos overexposed, and of these drawn as they
    are.
    """
    folder = tmp_path_factory.mktemp("light")
    paths = []
    for k, path in enumerate(flown.photos):
        paths.append(folder / path.name if k in SPOILT else path)
        if k in SPOILT:
            lightened(path, paths[-1], 6.0)
    settings = LiveSettings(deterministic=True)  # so the last two have the same poses
    found = [
        fed(LiveMap(folder / name, settings), some)
        for name, some in (("good", flown.photos), ("light", paths))
    ]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Canvas, "_overexposed", lambda *_: None)
        patched.setattr(LiveVeils, "look", lambda *_: [])  # white has no contrast, either
        found.append(fed(LiveMap(folder / "all", settings), paths))
    yield found
    for live in found:
        live.close()


def tiles_of(live):
    return {a: live.tiles.get(a) for a in live.tiles.addresses("visible", 0)}


def off_by(good, other):
    """Differences (n,) of two maps in levels, where both show something, by tile."""
    found = []
    for address in good.keys() & other.keys():
        one, two = good[address], other[address]
        off = np.abs(one.pixels.astype(float) - two.pixels).mean(-1)
        found.append(off[one.shown & two.shown])
    return np.concatenate(found)


def test_white_is_shown_only_where_nothing_else_is(maps):
    good, light, every = map(tiles_of, maps)
    mended, before = off_by(good, light), off_by(good, every)
    assert len(mended) > 20_000
    assert (before > 40).mean() > 0.1
    assert (mended > 40).mean() < 0.65 * (before > 40).mean()
    for address, tile in every.items():  # nothing is left empty
        assert (tile.shown & ~light[address].shown).sum() <= 0.001 * tile.shown.size


def test_tiles_with_white_photos_look_as_if_drawn_now(maps):
    """Another photo takes the place of white on tiles that were drawn before it came."""
    _, live, _ = maps
    off = []
    for address, stored in tiles_of(live).items():
        compose = live.canvas._composer(address, Feather(width_px=2.0))
        assert compose is not None
        now = compose.drawn(compose.plan(WHOLE))
        both = stored.shown & (now.photo >= 0)
        off.append(np.abs(stored.pixels[both].astype(int) - now.pixels[both]).max(-1))
    off = np.concatenate(off)
    assert np.median(off) <= 4
    assert (off > 40).mean() < 0.02


def notes_of(live):
    rows = live.ledger.rows("select body from event where kind = 'note' order by seq")
    texts = [json.loads(body)["text"] for (body,) in rows]
    return [text for text in texts if "overexposed" in text]


def test_it_is_told_whenever_there_are_twice_as_many(maps, flown):
    good, light, _ = maps
    names = [flown.photos[k].name for k in SPOILT]
    assert notes_of(good) == []
    one, two = notes_of(light)
    assert one.startswith(f"One photo is overexposed in part ({names[0]}): ")
    assert two.startswith(f"So far 2 photos are overexposed in part ({names[0]}, {names[1]}): ")


def test_a_restart_knows_and_tells_nothing_again(flown, tmp_path):
    paths = [tmp_path / path.name for path in flown.photos[:3]]
    for path, original in zip(paths, flown.photos, strict=False):
        lightened(original, path, 6.0)
    live = fed(LiveMap(tmp_path / "out", LiveSettings()), paths[:2])
    assert live.canvas.white() == [1, 2]
    told = notes_of(live)
    live.close()
    live = fed(LiveMap(tmp_path / "out", LiveSettings()), paths[2:])
    assert live.canvas.white() == [1, 2, 3]
    assert notes_of(live) == told
    assert len(told) == 2
    live.close()
