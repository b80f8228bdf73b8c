"""What settled photos teach about the metadata of those to come."""

import re
import shutil

import pytest

from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from tests.end_to_end.conftest import taken_apart
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
