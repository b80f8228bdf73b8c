"""Texts burnt into pictures do not connect photos of the live map."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from skyquilt.geometry.camera import project
from skyquilt.live.live_map import LiveMap
from skyquilt.live.marks import LOOKED, LiveMarks
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import WHOLE
from skyquilt.ortho.blend import Feather
from skyquilt.simulate.settings import Control, Route
from tests.live.conftest import fed, made, offsets

pytestmark = pytest.mark.slow
LINES = ((8, 350), (8, 58), (8, 86))
"""Where the text stands in px: it covers a tenth of the picture."""


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """14 photos of 480 x 360 px in lines."""
    control = Control(points=0, checks=0)
    return made(tmp_path_factory, "marks", seed=3, route=Route(photos=14), control=control)


@pytest.fixture(scope="module")
def stamped(plain, tmp_path_factory):
    """The same photos with a text."""
    folder = tmp_path_factory.mktemp("stamped")
    for path in plain.photos:
        image = Image.open(path)
        pixels = np.array(image.convert("RGB"))
        for at in LINES:
            text = "SKYCAM 4K  46.59N 14.29E ALT 120"
            cv2.putText(pixels, text, at, 0, 0.75, (255, 255, 255), 2, cv2.LINE_AA)
        kept = {"exif": image.info["exif"], "xmp": image.info["xmp"], "quality": 92}
        Image.fromarray(pixels).save(folder / path.name, **kept)
    return sorted(folder.iterdir())


@pytest.fixture(scope="module")
def unmarked(plain, tmp_path_factory):
    """The map of the photos without a text."""
    live = fed(opened(tmp_path_factory.mktemp("unmarked") / "out"), plain.photos)
    yield live
    live.close()


@pytest.fixture(scope="module")
def marked(stamped, tmp_path_factory):
    """The map of those with it."""
    live = fed(opened(tmp_path_factory.mktemp("marked") / "out", deterministic=True), stamped)
    yield live
    live.close()


def opened(folder, **settings):
    return LiveMap(folder, LiveSettings(gsd_cm=20, **settings))


def rms(live, flight):
    return np.sqrt((offsets(live, flight)[:, :2] ** 2).mean(0)).max()


RIM = 40
"""Pixels of a photo at its rim: where it gives way to another one is told from node to node of the
drawn map, 16 pixels of 20 cm apart; those of a photo are of 15 cm.
"""


def white(live):
    """Share of the ground that three photos and more show, not at their rims, that is white as
    letters are.
    """
    tiles = [
        (live.tiles.get(a), shown_by(live, a) >= 3) for a in live.tiles.addresses("visible", 0)
    ]
    return np.concatenate([t.pixels.min(-1)[t.shown & many] > 200 for t, many in tiles]).mean()


def shown_by(live, address):
    """How many photos show each pixel of a tile, on level ground, not at their rims."""
    grid = address.grid(live.canvas.gsd)
    x, y = np.meshgrid(grid.x(np.arange(grid.width)), grid.y(np.arange(grid.height)))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, live.canvas.ground)])
    count = np.zeros(x.size, int)
    for member in live.members.by_id.values():
        local = member.pose.to_camera(ground)
        px = project(live.members.camera(member), local)
        wide, high = member.photo.width, member.photo.height
        inside = ((px > RIM) & (px < (wide - RIM, high - RIM))).all(1)
        count += inside & (local[:, 2] > 0)
    return count.reshape(x.shape)


def test_a_text_in_every_picture_moves_nothing(plain, unmarked, marked):
    """Without marks it moved photos of one flight by 16 m. Positions scatter by 2 m."""
    assert [m.state for m in marked.members.by_id.values()] == ["refined"] * 14
    assert rms(marked, plain) < 1.2 * rms(unmarked, plain) < 1.5
    marks = unmarked.live_links.marks.known.masks, marked.live_links.marks.known.masks
    assert not marks[0] and len(marks[1]) == 1
    said = [body["text"] for _, (kind, body) in _events(marked) if kind == "note"]
    assert sum("same marks at the same place" in text for text in said) == 1


def test_a_text_is_drawn_only_where_nothing_else_is(
    unmarked, marked, stamped, tmp_path, monkeypatch
):
    """It is found when some photos are drawn already: their tiles are drawn again."""
    monkeypatch.setattr(LiveMarks, "shown", lambda self, camera: None)
    everywhere = fed(opened(tmp_path / "all", deterministic=True), stamped)
    try:
        mended, text, without = map(white, (marked, everywhere, unmarked))
    finally:
        everywhere.close()
    assert text > without + 0.003
    assert mended - without < 0.25 * (text - without)  # 0.09; the rest lies between nodes
    off = []
    for address in marked.tiles.addresses("visible", 0):
        stored, compose = (
            marked.tiles.get(address),
            marked.canvas._composer(address, Feather(width_px=2.0)),
        )
        if compose is None:  # a photo that moved since has left it empty
            assert not stored.shown.any()
            continue
        now = compose.drawn(compose.plan(WHOLE))
        both = stored.shown & (now.photo >= 0)
        off.append(np.abs(stored.pixels[both].astype(int) - now.pixels[both]).max(-1))
    assert (np.concatenate(off) > 40).mean() < 0.02


def test_frames_are_not_drawn(plain, tmp_path):
    """They are found at the sixth photo: tiles of the others are drawn again."""
    (tmp_path / "framed").mkdir()
    for path in plain.photos[:8]:
        image = Image.open(path)
        pixels = np.full((360, 480, 3), 255, np.uint8)
        pixels[18:-18, 24:-24] = np.array(image.convert("RGB"))[18:-18, 24:-24]
        kept = {"exif": image.info["exif"], "xmp": image.info["xmp"], "quality": 92}
        Image.fromarray(pixels).save(tmp_path / "framed" / path.name, **kept)
    live = fed(
        opened(tmp_path / "out", deterministic=True), sorted((tmp_path / "framed").iterdir())
    )
    tiles = [live.tiles.get(a) for a in live.tiles.addresses("visible", 0)]
    live.close()
    white = np.concatenate([(t.pixels[t.shown] > 250).all(-1) for t in tiles])
    assert len(white) > 50_000 and white.mean() < 0.001  # with the frames drawn: 0.11


def test_a_restart_goes_on_with_the_same_marks(stamped, tmp_path):
    through = fed(opened(tmp_path / "through", deterministic=True), stamped[:9])
    begun = fed(opened(tmp_path / "again", deterministic=True), stamped[:7])
    looked = begun.ledger.meta(LOOKED)
    begun.close()
    again = fed(opened(tmp_path / "again", deterministic=True), stamped[7:9])
    try:
        assert list(looked.values()) == [6]
        for a, b in zip(through.members.on_map(), again.members.on_map(), strict=True):
            assert a.links == b.links
            assert np.array_equal(a.pose.map_C, b.pose.map_C)
        masks = [next(iter(m.live_links.marks.known.masks.values())) for m in (through, again)]
        assert np.array_equal(*masks)
    finally:
        through.close()
        again.close()


@pytest.mark.parametrize("said", ["text", [1], {"camera": "many"}, {"camera": -3}])
def test_a_damaged_list_of_looks_counts_as_none(stamped, tmp_path, said):
    live = fed(opened(tmp_path / "out"), stamped[:2])
    try:
        live.ledger.put_meta(LOOKED, said)
        assert live.live_links.marks._told("camera") == 0
    finally:
        live.close()


def _events(live):
    rows = live.ledger.rows("select seq, kind, body from event order by seq")
    return [(seq, (kind, json.loads(body))) for seq, kind, body in rows]


def test_blocks_are_divided_where_a_link_alone_held_them_together(plain, tmp_path):
    live = fed(opened(tmp_path / "out"), plain.photos[:5])
    members = live.members
    try:
        for i in range(1, 6):
            for j in sorted(members.by_id[i].links):
                members.parted(i, j)
        assert members.blocks == {i: {i} for i in range(1, 6)}
        for a, b in (1, 2), (2, 3), (4, 5), (3, 4), (1, 3):
            members.joined(a, b)
        members.parted(1, 2)  # 1 - 3 - 2 still holds
        assert members.blocks == {1: {1, 2, 3, 4, 5}}
        members.parted(3, 4)
        assert members.blocks == {1: {1, 2, 3}, 4: {4, 5}}
        assert members.block_of == {1: 1, 2: 1, 3: 1, 4: 4, 5: 4}
    finally:
        live.close()
