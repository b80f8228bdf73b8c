"""Blurred photos yield to sharp ones on the growing map too, and are told."""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.live.blur import LiveBlur
from skyquilt.live.doubled import tell_doubled
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import WHOLE
from skyquilt.live.veils import LiveVeils
from skyquilt.model.features import Link
from skyquilt.ortho.blend import Feather
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from tests.live.conftest import fed, made
from tests.live.test_overexposed import tiles_of

SPOILT = (2, 7)
"""Photos that are blurred, of twelve in three lines."""


def shaken(path, target, px=11):
    """The photo as it is with a camera that moved by so many pixels, with its metadata."""
    image = Image.open(path)
    moved = cv2.blur(np.asarray(image), (px, 1))
    held = io.BytesIO()
    exif = piexif.dump(piexif.load(image.info["exif"]))
    Image.fromarray(moved).save(held, "JPEG", quality=92, exif=exif, xmp=image.info.get("xmp"))
    target.write_bytes(held.getvalue())


def notes_of(live):
    rows = live.ledger.rows("select body from event where kind = 'note' order by seq")
    texts = [json.loads(body)["text"] for (body,) in rows]
    return [text for text in texts if "blurred" in text]


def test_notes_are_told_at_the_first_and_when_there_are_twice_as_many(tmp_path):
    ledger = Ledger(tmp_path, write=True)
    told = []
    for count in range(12):
        tell_doubled(ledger, "some", count, lambda n=count: told.append(n) or [f"{n}"])
    assert told == [1, 2, 4, 8]
    rows = ledger.rows("select body from event where kind = 'note' order by seq")
    assert [json.loads(body)["text"] for (body,) in rows] == ["1", "2", "4", "8"]
    ledger.close()


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """The growing map of a flight, of the same with two photos blurred, and of these drawn as they
    are.
    """
    flown = made(
        tmp_path_factory, "twelve", seed=11, lens=Lens().scaled(640, 480),
        route=Route(photos=12), control=Control(points=0),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("blur")
    paths = []
    for k, path in enumerate(flown.photos):
        paths.append(folder / path.name if k in SPOILT else path)
        if k in SPOILT:
            shaken(path, paths[-1])
    settings = LiveSettings(deterministic=True, features=800)
    found = [
        fed(LiveMap(folder / name, settings), some)
        for name, some in (("good", flown.photos), ("blur", paths))
    ]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(LiveBlur, "look", lambda *_: [])
        patched.setattr(LiveVeils, "look", lambda *_: [])  # blur takes contrast, too
        found.append(fed(LiveMap(folder / "all", settings), paths))
    yield found
    for live in found:
        live.close()


def shown_by(live, address, numbers):
    """Where a tile shows one of these photos."""
    compose = live.canvas._composer(address, Feather(width_px=2.0))
    return np.isin(compose.drawn(compose.plan(WHOLE)).photo, numbers)


def detail_in(tile, mask):
    """Sum of the second differences of a tile within a mask."""
    grey = tile.pixels.astype(np.float32).mean(-1)
    return np.abs(cv2.Laplacian(grey, cv2.CV_32F))[mask].sum()


@pytest.mark.slow
def test_a_blurred_photo_is_shown_only_where_no_sharp_one_is(maps):
    """Where blur was seen, the map has as much detail as that of the sharp flight."""
    good, blur, every = maps
    numbers = [k + 1 for k in SPOILT]
    area, details = np.zeros(2), np.zeros(3)
    for address, tile in tiles_of(every).items():
        if not tile.shown.any():
            continue
        was, now = (shown_by(live, address, numbers) for live in (every, blur))
        area += was.sum(), now.sum()
        inner = cv2.erode((was & ~now).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        details += [detail_in(live.tiles.get(address), inner) for live in maps]
        # nothing is left empty
        assert (tile.shown & ~blur.tiles.get(address).shown).sum() <= 0.002 * tile.shown.size
    assert area[0] > 8000
    assert area[1] < 0.25 * area[0]
    sharp, mended, before = details
    assert before < 0.7 * sharp
    assert mended > 0.85 * sharp


@pytest.mark.slow
def test_blurred_photos_alone_are_told_and_a_restart_knows_them(maps, tmp_path):
    good, blur, _ = maps
    names = [sorted(m.photo.name for m in blur.members.by_id.values())[k] for k in SPOILT]
    assert notes_of(good) == []
    one, two = notes_of(blur)
    assert one.startswith(f"One photo is blurred against others of the same ground ({names[0]})")
    assert two.startswith(
        f"So far 2 photos are blurred against others of the same ground ({names[0]}, {names[1]})"
    )
    known = LiveBlur(blur.live_links)
    assert known.blurred == blur.refinement.blur.blurred == {k + 1 for k in SPOILT}
    for member in blur.members.by_id.values():  # judged anew, each verdict is the same
        assert not known.look(member)


@pytest.mark.parametrize("turned", [False, True])
def test_the_order_in_which_two_photos_were_linked_does_not_matter(turned):
    """A photo that was refined again is the first one of its new links; it had been refused where
    it has fewer features than the other, or compared at wrong places.
    """
    rng = np.random.default_rng(0)
    px = {i: rng.uniform(5, 475, (n, 2)) for i, n in ((1, 90), (2, 300))}
    sharp = {1: 1.0, 2: 2.0}  # where it shows what the other one does; elsewhere it is blank
    detail = {i: np.full((48, 48, 3), np.nan) for i in px}
    index = {1: np.arange(80), 2: np.arange(200, 280)}
    for i in px:
        row, column = np.floor((px[i][index[i]] + 0.5) / 10).astype(int).T[::-1]
        detail[i][row, column] = sharp[i]
    photo = SimpleNamespace(width=480, height=480)
    a, b = (2, 1) if turned else (1, 2)
    link = Link(a=a, b=b, index_a=index[a], index_b=index[b], b_S_a=1 + 0j)
    live_links = SimpleNamespace(
        members=SimpleNamespace(
            by_id={i: SimpleNamespace(photo=photo) for i in px},
            ledger=SimpleNamespace(meta=lambda key: None),
        ),
        link=lambda *_: link,
        features=lambda i: SimpleNamespace(px=px[i]),
        detail=detail.__getitem__,
    )
    blur = LiveBlur(live_links)
    assert blur._lacks(1, 2) == pytest.approx([1.0, 1.0])
    assert blur._lacks(2, 1) == pytest.approx([-1.0, -1.0])
    for b_S_a, told in ((-1.2, True), (1j, False), (1.5, False)):  # from a side, from farther away
        live_links.link = lambda *_, s=complex(b_S_a): replace(link, b_S_a=s)
        assert (LiveBlur(live_links)._lacks(1, 2) is not None) == told
