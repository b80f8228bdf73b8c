"""Flights without positions: the map begins without a place, and gets one when a photo tells it."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.live.initial_pose import NOWHERE
from skyquilt.live.kept_frame import in_frame_of
from skyquilt.live.live_map import LiveMap
from skyquilt.live.placeless import FEWEST, LARGER, PLACED
from skyquilt.live.settings import LiveSettings
from skyquilt.model.poses import Alignment, MapFrame, Motion, Pose, no_ties
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.survey import LiveSurvey
from skyquilt.simulate.settings import Route
from tests.end_to_end.conftest import relabel
from tests.live.conftest import fed, made, served
from tests.live.test_crash import replay, same
from tests.live.test_elsewhere import notes, nothing_left_elsewhere

QUICK = LiveSettings(features=600)
NOWHERE_FRAME = MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="unknown", metric=False)


def placeless(paths, folder):
    """Copies of photos that tell neither where nor how they were taken."""
    folder.mkdir(exist_ok=True)
    copies = []
    for path in paths:
        copies.append(folder / path.name)
        shutil.copyfile(path, copies[-1])
        relabel(copies[-1], drop=("position", "xmp"))
    return copies


def misfit(live, flight):
    """(n, 2) errors in m of the centres of all photos on the map, after the similarity that fits
    them best to the true ones: place, north and scale are not known.
    """
    shown = list(live.members.on_map())
    a = np.array([complex(*m.pose.map_C[:2]) for m in shown])
    b = np.array([complex(*flight.centre(m.photo.name)[:2]) for m in shown])
    a, b = a - a.mean(), b - b.mean()
    off = np.vdot(a, b) / np.vdot(a, a) * a - b
    return np.column_stack([off.real, off.imag])


def _similar(pose, scale, turn, shift):
    moved = pose.motion
    if moved is not None:
        moved = Motion(shift_m=scale * turn @ moved.shift_m, turn_rad=moved.turn_rad)
    C = scale * turn @ pose.map_C + shift
    return Pose(cam_R_map=pose.cam_R_map @ turn.T, map_C=C, motion=moved)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_an_adjustment_comes_back_into_the_frame_of_the_map(count):
    """Whatever similarity lies between them is undone, also where the photos of both are one, and
    photos and ground that the map does not have come along.
    """
    rng = np.random.default_rng(count)
    angles = rng.uniform((-180, -8, -8), (180, 8, 8), (count + 3, 3))
    centres = np.column_stack(
        [rng.uniform(-40, 40, (count + 3, 2)), rng.uniform(45, 55, count + 3)]
    )
    motion = Motion(shift_m=np.array([0.2, -0.1, 0.0]), turn_rad=np.full(3, 1e-3))
    poses = {
        i: Pose(cam_R_map=cam_R_map_from_angles(*angles[i]), map_C=centres[i], motion=motion)
        for i in range(count + 3)
    }
    ground = np.column_stack([rng.uniform(-50, 50, (31, 2)), np.full(31, 2.5)])
    a, scale, shift = np.radians(rng.uniform(-180, 180)), rng.uniform(0.3, 3), rng.uniform(-9, 9, 3)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    done = Alignment(
        method="", why="", frame=NOWHERE_FRAME, cameras={}, camera_of={}, blocks=(),
        poses={i: _similar(p, scale, turn, shift) for i, p in poses.items()},
        ties=replace(no_ties(), xyz=scale * ground @ turn.T + shift),
    )  # fmt: skip
    held = in_frame_of(done, {i: poses[i] for i in range(count)}, 2.5)
    assert held is not None
    assert np.allclose(held.ties.xyz, ground, atol=1e-9)
    for i, pose in poses.items():
        assert np.allclose(held.poses[i].map_C, pose.map_C, atol=1e-9)
        assert np.allclose(held.poses[i].cam_R_map, pose.cam_R_map, atol=1e-12)
        assert np.allclose(held.poses[i].motion.shift_m, motion.shift_m, atol=1e-12)
    assert in_frame_of(done, {99: poses[0]}, 2.5) is None


@pytest.mark.slow
def test_without_positions_the_map_begins_with_four_and_tells_no_place(flight, tmp_path):
    """It is as true as a map can be without a place, and no other program is told one."""
    photos = placeless(flight.photos, tmp_path / "in")
    with served(tmp_path / "out", QUICK) as site:
        for path in photos[: FEWEST - 1]:
            site.send(path)
        waiting, queues = ["waiting"] * (FEWEST - 1), site.live.queues
        site.until(lambda: list(site.states().values()) == waiting and not queues.untried)
        assert not site.web.get("/info").json()["layers"]
        for path in photos[FEWEST - 1 :]:
            site.send(path)
        site.until(lambda: list(site.states().values()) == ["refined"] * 6)
        site.settle()
        assert np.abs(misfit(site.live, flight)).max() < 0.15
        told = notes(site.live)
        assert told[0] == f"{NOWHERE}."
        assert sum("place, north and scale are not known" in text for text in told) == 1
        info = site.web.get("/info").json()
        assert info["placeless"]
        assert {(n["name"], n["crs"]) for n in info["layers"]} >= {("visible", None)}
        west, south, east, north = info["layers"][0]["bounds"]
        assert -0.01 < west < 0 < east < 0.01 and -0.01 < south < 0 < north < 0.01
        about = [
            f"/tiles/18/{x}/{y}?layer=visible"
            for x in (2**17 - 1, 2**17)
            for y in (2**17 - 1, 2**17)
        ]
        assert 200 in [site.web.get(tile).status_code for tile in about]
        for photo in site.web.get("/photos").json()["photos"]:
            assert photo["at"] is None and not photo["ring"]
        assert site.web.get("/at?lon=0&lat=0").json()["crs"] is None
        assert not site.web.get("/photos?lon=0&lat=0").json()["photos"]
        for path in (
            "/tiles.json", "/export?bbox=-0.001,-0.001,0.001,0.001", "/photos/1/place?lon=0&lat=0"
        ):  # fmt: skip
            assert site.web.get(path).status_code == 404, path
        offered = site.web.get("/wms?SERVICE=WMS&REQUEST=GetCapabilities")
        assert offered.status_code == 200 and "visible" not in offered.text
        PublishedFiles(LiveSurvey(site.folder), site.folder).step(now=True)
        assert not (site.folder / "map.tif").exists()
        assert not (site.folder / "map.mbtiles").exists()


@pytest.mark.slow
def test_headings_are_told_to_be_those_that_photos_report(flight, tmp_path):
    photos = placeless(flight.photos[:4], tmp_path / "in")
    for path in photos:
        shutil.copyfile(flight.folder / "photos" / path.name, path)
        relabel(path, drop=("position",))
    live = fed(LiveMap(tmp_path / "out", QUICK), photos)
    assert any("its place and scale are not known" in text for text in notes(live))
    for member in live.members.on_map():  # the simulated compass errs by some degrees
        R = member.pose.cam_R_map @ flight.rotation(member.photo.name).T
        assert np.degrees(np.arccos((np.trace(R) - 1) / 2)) < 8
    live.close()


@pytest.mark.slow
def test_with_a_photo_that_has_a_position_it_is_begun_again_with_its_place(flight, tmp_path):
    photos = placeless(flight.photos[:5], tmp_path / "in")
    live = fed(LiveMap(tmp_path / "out", QUICK), photos)
    assert live.members.placeless
    fed(live, flight.photos[5:])
    assert live.members.frame.crs == "EPSG:32633"
    assert f"{PLACED}." in notes(live)
    assert live.ledger.counts() == {"refined": 6, "refused": 0}
    assert np.abs(misfit(live, flight)).max() < 0.15
    nothing_left_elsewhere(live, tmp_path / "out")
    live.close()


@pytest.mark.slow
def test_it_goes_on_after_a_restart_and_after_being_killed(flight, tmp_path):
    inbox = tmp_path / "in"
    placeless(flight.photos, inbox)
    undisturbed = json.loads(replay(tmp_path / "undisturbed", inbox).stdout)
    assert len(undisturbed["poses"]) == 6
    for k, (point, count) in enumerate(
        [("photo refined", 3), ("map begun without a place", 1), ("tiles written", 2)]
    ):
        died = replay(tmp_path / f"{k}", inbox, point, count)
        assert died.returncode == -9, died.stderr
        same(replay(tmp_path / f"{k}", inbox), undisturbed)


@pytest.mark.slow
def test_a_map_without_a_place_that_began_with_few_others_is_begun_again(
    flight, tmp_path, tmp_path_factory
):
    """The first photos show another place, and are not linked with the flight."""
    other = made(tmp_path_factory, "elsewhere", seed=77, route=Route(photos=4))
    first = placeless(other.photos, tmp_path / "other")
    for path in first:
        path.rename(path.with_name(f"A_{path.name}"))
    first = sorted((tmp_path / "other").iterdir())
    larger = made(tmp_path_factory, "larger", seed=3, route=Route(photos=12))
    live = LiveMap(tmp_path / "out", QUICK)
    fed(live, [*first, *placeless(larger.photos, tmp_path / "in")])
    assert f"{LARGER}." in notes(live)
    shown = {m.photo.name for m in live.members.on_map()}
    assert shown == {p.name for p in larger.photos}
    assert np.abs(misfit(live, larger)).max() < 0.3
    live.close()


@pytest.mark.slow
def test_a_photo_that_is_linked_with_one_that_waits_is_placed(tmp_path, tmp_path_factory):
    """A photo that hangs on the others by too little waits with its links; the map goes on."""
    flown = made(tmp_path_factory, "larger", seed=3, route=Route(photos=12))
    photos = placeless(flown.photos, tmp_path / "in")
    live = fed(LiveMap(tmp_path / "out", QUICK), photos[:11])
    waits = live.members.by_id[11]
    waits.pose, waits.state = None, "waiting"
    with live.ledger.change():
        live.members.save(waits)
    live.add(photos[11])
    assert live.ledger.counts()["refused"] == 0
    assert live.members.by_id[12].state == "refined"
    live.close()
