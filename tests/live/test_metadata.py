"""What settled photos teach about the metadata of those to come."""

import json
import re
import shutil
from dataclasses import replace
from datetime import timedelta

import numpy as np
import piexif
import pytest

from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import placed_plausibly
from tests.end_to_end.conftest import relabel, taken_apart
from tests.photos.conftest import with_segment

LIE_DEG = 40.0
SETTINGS = LiveSettings(features=600, deterministic=True)


def turned_compass(path):
    """Every heading that a photo's XMP states is off by as much."""
    exif, packet, picture = taken_apart(path.read_bytes())

    def off(found):
        return f'{found[1]}="{(float(found[2]) + LIE_DEG + 180) % 360 - 180:+.2f}"'

    packet, changed = re.subn(r'((?:Gimbal|Flight)YawDegree)="([^"]*)"', off, packet)
    assert changed
    data = with_segment(picture, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + packet.encode())
    path.write_bytes(with_segment(data, 0xE1, exif))


@pytest.fixture(scope="module")
def drone(flight, tmp_path_factory):
    """Six photos of a drone whose compass is turned."""
    folder = tmp_path_factory.mktemp("turned") / "drone"
    folder.mkdir()
    for path in flight.photos:
        shutil.copyfile(path, folder / path.name)
        turned_compass(folder / path.name)
    return folder


def heading_error_deg(live, flight, path):
    """How far off a photo is placed before it is compared with others."""
    accepted = live.intake.take_file(path, path.parent.name)
    live.members.take_up()
    member = live.members.by_id[accepted.id]
    found = live.refinement.local_pose.metadata.first(member).cam_R_map
    placed, true = (
        angles_from_cam_R_map(R)[0] for R in (found, flight.rotation(member.photo.name))
    )
    return abs(angle_difference_deg(placed, true))


@pytest.mark.slow
def test_a_turned_compass_is_learned_from_photos_that_settled(flight, drone, tmp_path):
    photos = sorted(drone.glob("*.jpg"))
    live = LiveMap(tmp_path / "out", SETTINGS)
    for path in photos[:5]:
        live.add(path)
    assert [m.state for m in live.members.by_id.values()] == ["refined"] * 5
    assert heading_error_deg(live, flight, photos[5]) < 8  # reported ones scatter by 5 degrees
    live.close()


@pytest.mark.slow
def test_a_restart_forgets_nothing_of_it(drone, tmp_path):
    def learned(live):
        metadata = live.refinement.local_pose.metadata
        return metadata.first(live.members.by_id[6]).cam_R_map.tolist(), metadata.scatter()

    live = LiveMap(tmp_path / "out", SETTINGS)
    for path in sorted(drone.glob("*.jpg")):
        live.add(path)
    before = learned(live)
    live.close()
    again = LiveMap(tmp_path / "out", SETTINGS)
    assert learned(again) == before
    assert 0.3 < before[1] < 5  # positions are reported with 1.5 m
    again.close()


def test_the_first_photo_is_placed_as_its_compass_says(flight, drone, tmp_path):
    """The lie is there: nobody can know better yet."""
    live = LiveMap(tmp_path / "out", SETTINGS)
    live.add(flight.photos[0])
    path = sorted(drone.glob("*.jpg"))[1]
    assert heading_error_deg(live, flight, path) == pytest.approx(LIE_DEG, abs=15)
    live.close()


def stuck(flight, folder, repeated):
    """The flight's photos, some with the position of the one before, as a stuck receiver's."""
    folder.mkdir(parents=True)
    place = None
    for k, path in enumerate(flight.photos):
        exif, _, picture = taken_apart(path.read_bytes())
        told = piexif.load(exif)
        if k in repeated:
            told["GPS"] = place
        place = told["GPS"]
        (folder / path.name).write_bytes(with_segment(picture, 0xE1, piexif.dump(told)))
    return sorted(folder.glob("*.jpg"))


def notes_of(live):
    rows = live.ledger.rows("select body from event where kind = 'note' order by seq")
    return [text for (body,) in rows if "position" in (text := json.loads(body)["text"])]


def sigmas(live):
    return {m.photo.name: m.prior.sigma_C.tolist() for m in live.members.by_id.values()}


def test_repeated_positions_are_doubted_as_in_a_whole_flight(flight, tmp_path):
    """After every photo the deviations are those that the photos so far have as a survey; those of
    the newest change as soon as the receiver goes on.
    """
    paths = stuck(flight, tmp_path / "drone", repeated={2, 3, 4})
    live = LiveMap(tmp_path / "out", SETTINGS)
    live.add(paths[0])
    for count, path in enumerate(paths[1:], 2):
        live.intake.take_file(path, "drone")
        live.members.take_up()
        photos, _ = placed_plausibly([read_photo(p) for p in paths[:count]])
        for photo in photos:
            assert sigmas(live)[photo.name][:2] == [photo.position.sigma_xy_m] * 2
    widened = [name for name, sigma in sigmas(live).items() if sigma[0] > 5]
    assert widened == [p.name for p in paths[2:5]]
    first, second = notes_of(live)  # of one photo, and of two
    assert first.startswith("So far: One photo (") and "repeats the position" in first
    assert second.startswith("So far: 2 photos (") and "repeat the position" in second
    before = sigmas(live)
    live.close()
    again = LiveMap(tmp_path / "out", SETTINGS)
    assert sigmas(again) == before and notes_of(again) == [first, second]
    again.close()


def test_a_receiver_that_never_moved_tells_no_step(flight, tmp_path):
    paths = stuck(flight, tmp_path / "drone", repeated=set(range(1, 6)))
    live = LiveMap(tmp_path / "out", SETTINGS)
    live.add(paths[0])
    for path in paths[1:]:
        live.intake.take_file(path, "drone")
    live.members.take_up()
    assert len(set(map(str, sigmas(live).values()))) == 1 and not notes_of(live)
    live.close()


def first_drawn(live, photos):
    """The pose with which each photo is drawn first, by name, as photos come one by one."""
    first = {}
    honest = live.redraw._drawn_now

    def noted(member):
        first.setdefault(member.photo.name, member.pose)
        honest(member)

    live.redraw._drawn_now = noted
    for path in photos:
        live.add(path)
    return first


@pytest.mark.slow
def test_photos_without_headings_are_linked_before_they_are_drawn(flight, tmp_path):
    """They would be drawn with north at the top; the first one is, since nothing else tells."""
    photos = []
    for path in flight.photos[:4]:
        photos.append(tmp_path / path.name)
        shutil.copyfile(path, photos[-1])
        relabel(photos[-1], drop=("xmp",))
    live = LiveMap(tmp_path / "out", SETTINGS)
    first = first_drawn(live, photos)
    live.close()
    assert [*first] == [p.name for p in photos]
    yaw = {n: angles_from_cam_R_map(p.cam_R_map)[0] for n, p in first.items()}
    true = {n: angles_from_cam_R_map(flight.rotation(n))[0] for n in first}
    off = [abs(angle_difference_deg(yaw[n], true[n])) for n in first]
    assert off[0] > 10
    assert max(off[2:]) < 10  # two photos tell their direction by their positions


def test_what_metadata_are_worth_tells_whether_photos_are_drawn_by_them(
    flight, tmp_path, monkeypatch
):
    live = LiveMap(tmp_path / "out", SETTINGS)
    metadata = live.initial_pose.metadata
    for path in flight.photos[:2]:
        live.add(path)
    member = live.members.by_id[2]
    pose = metadata.first(member)
    assert not metadata.loose(member, pose)
    for off in (1.0, 6.0):  # m, of photos that show 72 m
        metadata._misfit.extend([off] * 60)
        assert metadata.loose(member, pose) == (off > 3)
    metadata._misfit.clear()
    assert not metadata.loose(member, pose)
    monkeypatch.setattr(metadata, "_learned", lambda _: np.array([[0.0] * 4, [0, 30, -20, 15], z]))
    for z in ([60, 60, 60, 60], [90, 20, 60, 40]):  # level, at heights badly reported; all over
        assert metadata.loose(member, pose) == (z[0] == 90)
    assert metadata.first(member).map_C[2] == member.prior.map_C[2] + 7.5
    z = [60, 61, 60, 59]
    assert metadata.first(member).map_C[2] == 60
    for turns in ([20, -25, 170, -15], [172, 178, -179, np.nan]):  # headings all over; off by 180
        learned = np.array([turns, [0.0] * 4, z])
        monkeypatch.setattr(metadata, "_learned", lambda _, known=learned: known)
        assert metadata.loose(member, pose) == (turns[0] == 20)
    live.members.by_id[1].tried = 0  # then there is nothing to be linked with
    live.members.by_id[2].tried = 0
    assert not metadata.loose(member, pose)
    live.close()


def test_a_receiver_that_drifts_is_followed(flight, tmp_path):
    """Photos after it are placed as those beside it err, a late one as those of its time did."""
    live = LiveMap(tmp_path / "out", SETTINGS)
    metadata = live.initial_pose.metadata
    for path in flight.photos[:2]:
        live.add(path)
    last = live.members.by_id[2]
    before, began = metadata.first(last).map_C, last.photo.time
    for k in range(10):  # refined in another order than they were taken
        taken = began + timedelta(seconds=4 * (3 * k % 10) - 50)
        drift = np.array([0.5 * (3 * k % 10), 8.0, 0.0])
        pose = replace(last.pose, map_C=last.prior.map_C + drift)
        photo = replace(last.photo, time=taken)
        metadata.learn(replace(last, id=100 + k, photo=photo, pose=pose))
    assert (metadata.first(last).map_C - before)[:2] == pytest.approx([4.5, 8.0], abs=0.5)
    late = replace(last, photo=replace(last.photo, time=began - timedelta(seconds=45)))
    assert (metadata.first(late).map_C - before)[:2] == pytest.approx([0.5, 8.0], abs=0.5)
    live.close()


@pytest.mark.slow
def test_a_photo_without_heading_that_matches_nothing_lies_along_its_line(
    flight, tmp_path, monkeypatch
):
    photos = []
    for path in flight.photos:
        photos.append(tmp_path / path.name)
        shutil.copyfile(path, photos[-1])
        relabel(photos[-1], drop=("xmp",))
    live = LiveMap(tmp_path / "out", SETTINGS)
    honest = live.live_links._compared
    monkeypatch.setattr(
        live.live_links, "_compared", lambda a, b: None if 6 in (a, b) else honest(a, b)
    )
    monkeypatch.setattr(live.initial_pose.metadata, "loose", lambda *_: False)
    for path in photos:
        live.intake.take_file(path, "")
    live.queues.received.extend(live.members.take_up())
    while live._placed():  # all of them before one is refined, as on a busy machine
        pass
    for _ in live.drain_all():
        pass
    member = live.members.by_id[6]
    assert [m.state for m in live.members.by_id.values()] == ["refined"] * 5 + ["placed"]
    headed, true = (
        angles_from_cam_R_map(R)[0]
        for R in (member.pose.cam_R_map, flight.rotation(member.photo.name))
    )
    assert abs(angle_difference_deg(headed, true)) < 15
    live.close()


def test_a_photo_that_matches_nothing_is_drawn_by_its_metadata(flight, tmp_path, monkeypatch):
    live = LiveMap(tmp_path / "out", SETTINGS)
    live.add(flight.photos[0])
    monkeypatch.setattr(live.initial_pose.metadata, "loose", lambda *_: True)
    monkeypatch.setattr(live.live_links, "_compared", lambda a, b: None)
    first = first_drawn(live, flight.photos[1:2])
    assert [*first] == [flight.photos[1].name]
    assert not live.redraw.held
    live.close()
