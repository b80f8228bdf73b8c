"""Photos of other places, and flights without any position."""

import json
import re
import shutil

import numpy as np
import pytest
import rasterio
import simplejpeg

from skyquilt.live.initial_pose import CLIMBED, FEW, NOWHERE
from skyquilt.live.live_map import LiveMap
from skyquilt.live.members import FAR_M
from skyquilt.live.settings import LiveSettings
from skyquilt.server.survey import LiveSurvey
from tests.end_to_end.conftest import relabel, taken_apart, with_segment
from tests.live.conftest import fed, offsets, served
from tests.live.test_crash import replay, same

SYDNEY, NEXT_ZONE = (-33.9, 151.2), (46.6, 22.0)
QUICK = LiveSettings(features=600)


def notes(live):
    return [
        json.loads(b)["text"]
        for (b,) in live.ledger.rows("select body from event where kind='note'")
    ]


def nothing_left_elsewhere(live, folder):
    """The map ends some tens of metres around its photos, and these lie where they were taken."""
    west, south, east, north = live.tiles.extent("visible", live.canvas.gsd)
    assert max(east - west, north - south) < 300
    for shown in LiveSurvey(folder).photos():
        assert np.abs(np.array(shown.ring) - (14.3, 46.6)).max() < 0.01


def moved(photo, folder, place):
    """A copy of a photo that says it was taken in another place."""
    folder.mkdir(exist_ok=True)
    copy = folder / photo.name
    shutil.copyfile(photo, copy)
    relabel(copy, place=place)
    return copy


@pytest.mark.slow
@pytest.mark.parametrize("place", [SYDNEY, pytest.param(NEXT_ZONE, marks=pytest.mark.long)])
@pytest.mark.parametrize("strangers", [pytest.param(1, marks=pytest.mark.long), 2])
def test_a_map_that_began_elsewhere_is_begun_again_where_most_photos_are(
    flight, tmp_path, place, strangers
):
    """The first photos were left on the card. The map then is as if they had said no place."""
    first = [moved(p, tmp_path / "moved", place) for p in flight.photos[:strangers]]
    live = fed(LiveMap(tmp_path / "out", QUICK), [*first, *flight.photos[strangers:]])
    assert live.members.frame.crs == "EPSG:32633"
    assert sum("it is begun again around them" in text for text in notes(live)) == 1
    assert live.ledger.counts() == {"refined": 6, "refused": 0}
    assert np.abs(offsets(live, flight)).max() < 3.0
    nothing_left_elsewhere(live, tmp_path / "out")
    live.close()


@pytest.mark.slow
def test_a_later_photo_of_another_place_says_so_and_is_placed_by_its_links_alone(flight, tmp_path):
    overlapping = moved(flight.photos[2], tmp_path / "moved", SYDNEY)
    foreign = tmp_path / "foreign.jpg"
    noise = np.random.default_rng(1).integers(0, 255, (360, 480, 3), dtype=np.uint8)
    shutil.copyfile(flight.photos[5], foreign)
    relabel(foreign, place=SYDNEY)
    block, packet, _ = taken_apart(foreign.read_bytes())
    data = simplejpeg.encode_jpeg(noise, colorspace="RGB")
    data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + packet.encode())
    foreign.write_bytes(with_segment(data, 0xE1, block))
    live = LiveMap(tmp_path / "out", QUICK)
    fed(live, [*flight.photos[:2], foreign, overlapping, *flight.photos[3:]])
    states = {m.photo.name: m.state for m in live.members.by_id.values()}
    assert states.pop("foreign.jpg") == "waiting"
    assert set(states.values()) == {"refined"}
    reason = live.ledger.row("select reason from photo where name = 'foreign.jpg'")[0]
    assert re.search(r"lies 121\d\d km from the map and is not used", reason)
    assert np.abs(offsets(live, flight)).max() < 3.0
    west, _, east, _ = live.tiles.extent("visible", live.canvas.gsd)
    assert east - west < 300
    live.close()


def test_a_map_of_many_photos_stays_where_it_is(flight, tmp_path):
    live = fed(LiveMap(tmp_path / "out", QUICK), flight.photos[:1])
    member = live.members.by_id[1]
    live.members.near = list(range(-FEW, 1))  # as many as are too many
    live.members._began = live.members._began + np.array([2 * FAR_M, 0, 0])
    assert not live.initial_pose.elsewhere(member)
    live.members.near = []
    assert live.initial_pose.elsewhere(member)
    live.close()


@pytest.mark.slow
@pytest.mark.parametrize("climb", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_map_that_began_in_the_climb_is_begun_again_with_larger_pixels(flight, tmp_path, climb):
    """Pixels for a photo from 4 m, on a flight at 60 m, are 225 tiles where one is enough."""
    first = []
    for path in flight.photos[:climb]:
        first.append(shutil.copyfile(path, tmp_path / path.name))
        relabel(first[-1], heights=-56.0)
    rest = flight.photos[climb:]
    live = LiveMap(tmp_path / "out", QUICK)
    for path in (*first, *rest[: climb + 1]):
        live.add(path)
    straight = LiveMap(tmp_path / "straight", QUICK)
    straight.add(rest[climb])
    for what in ("gsd", "cell"):
        assert live.ledger.meta(what) == straight.ledger.meta(what)
    assert notes(live).count(f"{CLIMBED}.") == 1
    assert live.ledger.counts()["refined"] > climb
    live.close()
    straight.close()


@pytest.mark.slow
def test_killed_while_it_is_begun_again(flight, tmp_path):
    inbox = tmp_path / "in"
    moved(flight.photos[0], inbox, NEXT_ZONE)
    for path in flight.photos[1:5]:
        shutil.copyfile(path, inbox / path.name)
    undisturbed = json.loads(replay(tmp_path / "undisturbed", inbox).stdout)
    assert len(undisturbed["poses"]) == 5
    for k, point in enumerate(("map begun again", "tiles written", "drawing told")):
        # the third photo's tiles, and those of the first that are taken off
        died = replay(tmp_path / f"{k}", inbox, point, 1 if k == 0 else 4)
        assert died.returncode == -9, died.stderr
        same(replay(tmp_path / f"{k}", inbox), undisturbed)


@pytest.mark.slow
def test_without_any_position_it_is_said_once_and_the_final_map_breaks_no_page(flight, tmp_path):
    """The final map has no place, so no layer can show it; its files are there."""
    photos = []
    for path in flight.photos[:2]:
        photos.append(tmp_path / path.name)
        shutil.copyfile(path, photos[-1])
        relabel(photos[-1], drop=("position",))
    with served(tmp_path / "out", QUICK) as site:
        for path in photos:
            site.send(path)
        site.until(lambda: list(site.states().values()) == ["waiting"] * 2)
        assert notes(site.live) == [f"{NOWHERE}."]
        (tmp_path / "out" / "finished").mkdir(exist_ok=True)
        with rasterio.open(
            tmp_path / "out" / "finished" / "mosaic.tif", "w", driver="GTiff", width=64, height=64,
            count=3, dtype="uint8", transform=rasterio.transform.from_origin(0, 0, 0.1, 0.1),
        ) as raster:  # fmt: skip
            raster.write(np.full((3, 64, 64), 99, np.uint8))
        for path, status in {
            "/info": 200, "/wms?SERVICE=WMS&REQUEST=GetCapabilities": 200, "/photos": 200,
            "/at?lon=14&lat=46": 200, "/files": 200, "/tiles.json": 404,
            "/tiles/3/4/2?layer=finished": 404, "/export?bbox=14,46,15,47": 404,
        }.items():  # fmt: skip
            assert site.web.get(path).status_code == status, path
        assert [f["name"] for f in site.web.get("/files").json()["files"]] == ["mosaic.tif"]
        site.send(flight.photos[2])  # the first that knows its place
        site.until(lambda: "waiting" not in site.states().values())
        assert len(notes(site.live)) >= 1 and site.web.get("/info").json()["layers"]
