"""The incremental story against simulated truth."""

import re
import shutil
import socket
import sqlite3
import threading
import time

import numpy as np
import pytest
import rasterio

from skyquilt.errors import OutputError, UsageError
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.geometry.geoid import geoid_height
from skyquilt.live.live_map import LiveMap
from skyquilt.live.replay_flight import FlySettings, fly, order_of, preview_of
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import WHOLE
from skyquilt.ortho.blend import Feather
from skyquilt.photos.survey import read_survey
from skyquilt.quality.replay import correlation
from skyquilt.raster.map_source import TileSource
from skyquilt.raster.tile_store import SIDE
from tests.end_to_end.conftest import relabel, taken_apart
from tests.live.conftest import fed, offsets
from tests.photos.conftest import with_segment


def mapped(folder, paths, **settings):
    return fed(LiveMap(folder, LiveSettings(**settings)), paths)


@pytest.mark.slow
def test_two_drones_a_yaw_lie_losses_and_disorder_make_one_coherent_map(drones, tmp_path):
    photos = read_survey(drones.folder / "photos").photos
    arrivals = order_of(photos, FlySettings(drones=2, loss=0.1, reorder=0.2, seed=4))
    names = [p.name for _, p, _ in arrivals]
    assert len(names) < len(photos)
    assert names != sorted(names)
    live = mapped(tmp_path / "out", [p.path for _, p, _ in arrivals])
    assert [m.state for m in live.members.by_id.values()] == ["refined"] * len(names)
    assert len(live.members.block(1)) == len(names)
    error = offsets(live, drones)
    rms = np.sqrt((error**2).mean(0))
    # positions scatter by 2 m; links hold photos to each other far better
    assert (rms[:2] > 1e-4).all()
    assert (rms[:2] < 0.8).all()
    turns = [
        angle_difference_deg(
            *(
                angles_from_cam_R_map(R)[0]
                for R in (m.pose.cam_R_map, drones.rotation(m.photo.name))
            )
        )
        for m in live.members.on_map()
    ]
    assert np.abs(turns).max() < 1.5
    live.close()


@pytest.fixture(scope="module")
def small(flight, tmp_path_factory):
    folder = tmp_path_factory.mktemp("live") / "out"
    live = mapped(folder, flight.photos, deterministic=True, features=500)
    yield live
    live.close()


def test_the_map_shows_the_truth(small, flight):
    frame = small.members.frame
    source = TileSource(
        tiles=small.tiles, layer="visible", crs=frame.crs, origin=frame.origin, gsd=small.canvas.gsd
    )
    part = source.part(source.bounds(), small.canvas.gsd)
    with rasterio.open(flight.folder / "truth" / "truth_ortho.tif") as truth:
        assert truth.crs.to_string() == frame.crs
        shift = np.median(
            [
                m.pose.map_C[:2] + frame.origin - flight.centre(m.photo.name)[:2]
                for m in small.members.on_map()
            ],
            axis=0,
        )
        rows, columns = np.nonzero(part.shown)
        chosen = np.random.default_rng(0).choice(len(rows), 4000)
        rows, columns = rows[chosen], columns[chosen]
        x = part.west + (columns + 0.5) * part.gsd - shift[0]
        y = part.north - (rows + 0.5) * part.gsd - shift[1]
        true = np.array(list(truth.sample(zip(x, y, strict=True))))[:, :3].astype(float)
    known = true.sum(1) > 0
    seen = part.pixels[rows, columns].astype(float)
    assert known.mean() > 0.5
    assert correlation(seen[known].mean(1), true[known].mean(1)) > 0.6
    swapped = correlation(seen[known].mean(1), np.roll(true[known].mean(1), 7))
    assert swapped < 0.2  # the figure means something


def test_the_same_content_twice_is_one_photo(small, flight, tmp_path):
    copy = tmp_path / "other_name.jpg"
    shutil.copyfile(flight.photos[0], copy)
    before = len(small.members.by_id)
    assert small.add(copy).text == "it was already received"
    assert len(small.members.by_id) == before


def test_tiles_that_were_left_alone_look_as_if_drawn_now(small):
    """Only tiles on which a changed photo shows are drawn again: the others must not lag behind."""
    compared = []
    for address in small.tiles.addresses("visible", 0):
        compose = small.canvas._composer(address, Feather(width_px=2.0))
        assert compose is not None
        now, stored = compose.drawn(compose.plan(WHOLE)), small.tiles.get(address)
        both = stored.shown & (now.photo >= 0)
        assert (stored.shown ^ (now.photo >= 0)).mean() < 0.02
        compared.append(np.abs(stored.pixels[both].astype(int) - now.pixels[both]).max(-1))
    off = np.concatenate(compared)
    assert len(off) > 20_000
    assert np.median(off) <= 4  # what JPEG changes
    assert (off > 40).mean() < 0.02


def test_a_photo_that_stands_by_its_metadata_yields_to_linked_ones(small):
    """What others show, too, is drawn from them."""
    members = small.members.by_id
    member = members[sorted(members)[len(members) // 2]]
    addresses = small.canvas.place(member, small.members.camera(member))

    def shown():
        """The photo that each pixel shows, of all tiles; -1 = none."""
        compose = (small.canvas._composer(a, Feather(width_px=2.0)) for a in addresses)
        return np.stack([c.drawn(c.plan(WHOLE)).photo for c in compose])

    before = shown()
    member.state = "placed"
    small.canvas.place(member, small.members.camera(member))
    loose = shown()
    small.canvas.remove(member.id)
    without = shown()
    member.state = "refined"
    small.canvas.place(member, small.members.camera(member))
    others = without >= 0
    assert np.array_equal(shown(), before)
    own, kept = (((photo == member.id) & others).sum() for photo in (before, loose))
    assert own > 3000 and kept < 0.3 * own  # the rims of those that others show remain
    assert np.array_equal(loose >= 0, before >= 0)


def test_folders_of_earlier_versions(small, tmp_path):
    folder = tmp_path / "old"
    live = LiveMap(folder)
    known = live.ledger.meta("settings")
    live.ledger.put_meta("settings", {k: v for k, v in known.items() if k != "thermal_unit"})
    live.close()
    LiveMap(folder).close()  # an option that did not exist then stands at its default
    with pytest.raises(UsageError, match="features"):
        LiveMap(folder, LiveSettings(features=700))
    with sqlite3.connect(folder / "tiles.db") as db:
        db.execute("pragma user_version=512")
    with pytest.raises(OutputError, match="another version"):
        LiveMap(folder)


def test_a_restart_finds_everything_as_it_was(small, flight):
    poses = {m.photo.name: m.pose for m in small.members.on_map()}
    other = LiveMap(small.folder, small.settings)
    assert {m.photo.name for m in other.members.on_map()} == set(poses)
    for member in other.members.on_map():
        assert np.array_equal(member.pose.map_C, poses[member.photo.name].map_C)
        assert np.array_equal(member.pose.cam_R_map, poses[member.photo.name].cam_R_map)
    assert not other.redraw.dirty  # nothing is to be drawn again
    for address in other.tiles.addresses("visible", 0):
        assert other.tiles.get(address).pixels.shape == (SIDE, SIDE, 3)
    other.close()


@pytest.mark.parametrize(
    "other",
    [{"features": 300}, {"gsd_cm": 7.0}, {"crs": "EPSG:32634"}, {"vertical_datum": "ellipsoid"}],
    ids=lambda other: next(iter(other)),
)
def test_other_settings_are_refused_on_the_same_folder(flight, tmp_path, other):
    LiveMap(tmp_path / "out", LiveSettings()).close()
    with pytest.raises(UsageError, match=next(iter(other))):
        LiveMap(tmp_path / "out", LiveSettings(**other))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"shutter": "slow"}, "--shutter 'slow'"),
        ({"shutter_readout_ms": 0}, "--shutter-readout 0"),
        ({"shutter_readout_ms": -5}, "--shutter-readout -5"),
        ({"shutter_readout_ms": 10_000}, "at most 1000 ms"),
        ({"shutter_readout_ms": float("nan")}, "--shutter-readout nan"),
        ({"shutter": "global", "shutter_readout_ms": 30}, "no readout"),
        ({"vertical_datum": "moon"}, "--vertical-datum 'moon'"),
        ({"max_view_angle": 91}, "--max-view-angle 91"),
    ],
)
def test_settings_that_are_refused(asked, words):
    with pytest.raises(UsageError, match=words):
        LiveSettings(**asked)


def test_shutter_and_zero_of_heights_are_those_asked_for(flight, tmp_path):
    asked = LiveSettings(shutter_readout_ms=40, vertical_datum="ellipsoid")
    live = LiveMap(tmp_path / "out", asked)
    path = flight.photos[0]
    live.add(path)
    (member,) = live.members.by_id.values()
    assert (member.photo.shutter.readout_s, member.photo.shutter.source) == (0.04, "option")
    frame, place = live.members.frame, member.photo.position
    assert frame.vertical_datum == "ellipsoid"
    geoid = float(geoid_height(place.latitude_deg, place.longitude_deg))
    assert abs(geoid) > 5
    assert member.pose.map_C[2] == pytest.approx(place.sea_level_m + geoid, abs=0.01)
    live.close()
    with pytest.raises(UsageError, match="shutter_readout_ms"):
        LiveMap(tmp_path / "out", LiveSettings(shutter_readout_ms=20))


def test_a_datum_that_the_first_photo_does_not_allow_is_said(flight, tmp_path):
    path = tmp_path / "photo.jpg"
    _, packet, picture = taken_apart(flight.photos[0].read_bytes())
    packet, changed = re.subn(r'drone-dji:AbsoluteAltitude="[^"]*"', "", packet)
    assert changed  # without EXIF and this, only the height above take-off is left
    segment = b"http://ns.adobe.com/xap/1.0/\x00" + packet.encode()
    path.write_bytes(with_segment(picture, 0xE1, segment))
    live = LiveMap(tmp_path / "out", LiveSettings(vertical_datum="ellipsoid"))
    assert live.intake.take_file(path, "drone")
    told = " ".join(update.text for update in live.drain())
    assert "--vertical-datum ellipsoid needs heights" in told
    assert live.members.frame.vertical_datum == "takeoff"
    live.close()


@pytest.mark.slow
def test_without_repositioning_placed_photos_stay(flight, tmp_path):
    live = LiveMap(tmp_path / "out", LiveSettings(reposition=False))
    first = {}
    for path in flight.photos:
        live.add(path)
        for m in live.members.on_map():
            if m.tried:
                first.setdefault(m.id, m.pose.map_C)
    assert len(first) == len(flight.photos)
    assert all(np.array_equal(live.members.by_id[i].pose.map_C, C) for i, C in first.items())
    assert sum(m.state == "refined" for m in live.members.by_id.values()) >= len(first) - 1
    live.close()


def test_a_preview_gives_way_to_the_full_picture(flight, tmp_path):
    live = LiveMap(tmp_path / "out", LiveSettings())
    small = tmp_path / "a-preview.jpg"
    data = flight.photos[0].read_bytes()
    import skyquilt.live.replay_flight as flying

    longest, flying.PREVIEW = flying.PREVIEW, 240
    try:
        small.write_bytes(preview_of(flight.photos[0]))
    finally:
        flying.PREVIEW = longest
    assert live.add(small).what in ("placed", "loose")
    assert len(live.canvas.tiles_of(1)) > 0
    (tmp_path / "a.jpg").write_bytes(data)
    live.add(tmp_path / "a.jpg")
    assert [m.state for m in live.members.by_id.values()] == ["superseded", "placed"]
    assert live.canvas.tiles_of(1) == ()
    late = live.add(small)
    assert late.text == "it was already received"
    live.close()


def test_all_that_came_of_a_shot_before_gives_way(flight, tmp_path, monkeypatch):
    """Two previews, the full photo, and that file written anew, all before one was placed; another
    shot of the same name stays.
    """
    live = LiveMap(tmp_path / "out", LiveSettings())
    for size in (200, 300):
        monkeypatch.setattr("skyquilt.live.replay_flight.PREVIEW", size)
        live.intake.take([preview_of(flight.photos[0])], f"{size}.jpg", "a")
    monkeypatch.setattr("skyquilt.live.replay_flight.PREVIEW", 480)
    live.intake.take([preview_of(flight.photos[0])], "a.jpg", "a")  # of the size of the photo
    live.intake.take([flight.photos[0].read_bytes()], "a.jpg", "a")
    live.intake.take([flight.photos[1].read_bytes()], "a.jpg", "a")
    for _ in live.drain():
        pass
    states = [m.state for m in live.members.by_id.values()]
    assert states[:3] == ["superseded"] * 3
    assert not {"superseded", "received", "refused"} & set(states[3:])
    assert [i for i in (1, 2, 3, 4, 5) if live.canvas.tiles_of(i)] == [4, 5]
    live.close()


def test_a_preview_gives_way_on_a_map_begun_again(flight, tmp_path, monkeypatch):
    """The full photo came before the map was begun again, and was not placed yet."""
    live = LiveMap(tmp_path / "out", LiveSettings())
    monkeypatch.setattr("skyquilt.live.replay_flight.PREVIEW", 240)
    live.intake.take([preview_of(flight.photos[0])], "preview.jpg", "a")
    for _ in live.drain():
        pass
    live.intake.take([flight.photos[0].read_bytes()], "a.jpg", "a")
    live.members.take_up()
    live.initial_pose.begin_again(live.members.by_id[1])
    live._reload()
    for _ in live.drain():
        pass
    assert live.members.by_id[1].state == "superseded"
    live.close()


@pytest.mark.slow
def test_a_photo_without_position_waits_and_is_placed_by_its_links(flight, tmp_path):
    lost = tmp_path / "lost.jpg"
    shutil.copyfile(flight.photos[1], lost)
    relabel(lost, drop=("position",))
    live = LiveMap(tmp_path / "out", LiveSettings())
    assert live.add(lost).what == "waiting"
    for path in (flight.photos[0], flight.photos[2], flight.photos[3]):
        live.add(path)
    found = live.members.by_id[1]
    assert found.state == "refined"
    frame = live.members.frame
    error = found.pose.map_C[:2] + frame.origin - flight.centre(flight.photos[1].name)[:2]
    assert np.hypot(*error) < 6.0  # its neighbours' positions scatter by 2 m on each axis
    live.close()


@pytest.mark.slow
def test_equal_photos_in_equal_order_give_equal_poses(flight, tmp_path):
    one, other = (
        mapped(tmp_path / name, flight.photos, deterministic=True, features=600)
        for name in ("a", "b")
    )
    for i, m in one.members.by_id.items():
        assert np.array_equal(m.pose.map_C, other.members.by_id[i].pose.map_C)
        assert np.array_equal(m.pose.cam_R_map, other.members.by_id[i].pose.cam_R_map)
    one.close()
    other.close()


@pytest.mark.parametrize("url", ["http://[x", "http://a b", "http://127.0.0.1:{port}", "http://ü/"])
def test_an_address_where_no_server_of_ours_answers_gets_a_sentence(flight, url):
    """No address at all, or a server of another kind."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]

        def answers():
            client, _ = other.accept()
            client.recv(1000)
            client.sendall(b"220 mail.example ready\r\n")
            client.close()

        threading.Thread(target=answers, daemon=True).start()
        with pytest.raises(UsageError, match="does not answer"):
            list(fly(flight.folder, url.format(port=port), FlySettings(rate=20)))


def test_replays_lose_and_reorder_as_asked(flight, tmp_path):
    photos = read_survey(flight.folder / "photos").photos * 50
    sent = order_of(photos, FlySettings(loss=0.3, reorder=0.5, previews=True, drones=3))
    small = [p.name for _, p, preview in sent if preview]
    assert 0.6 * len(photos) < len(small) < 0.8 * len(photos)
    assert sum(not preview for _, _, preview in sent) == len(small)
    inbox = tmp_path / "inbox"
    inbox.mkdir()
    began = time.monotonic()
    done = list(fly(flight.folder, str(inbox), FlySettings(rate=20, drones=2)))
    assert 0.2 < time.monotonic() - began < 3
    assert sorted(s.name for s in done) == sorted(p.name for p in flight.photos)
    assert len(list(inbox.rglob("*.jpg"))) == len(flight.photos)
