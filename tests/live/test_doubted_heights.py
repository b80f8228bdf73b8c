"""Heights above sea level that some photos of a flight tell falsely: of zero, or of the other
sign. On maps of whole flights these are not used, or turned round; the growing map learns it.
"""

import json
import re

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.live.initial_pose import FALSE
from skyquilt.live.live_map import LiveMap
from skyquilt.live.members import GROUNDED
from skyquilt.live.settings import LiveSettings
from tests.live.conftest import fed

QUICK = LiveSettings(features=600)


def told(photo, folder, height):
    """A copy of a photo that tells this height above sea level in m, and none above take-off."""
    data = photo.read_bytes()
    for name in (b"RelativeAltitude", b"AbsoluteAltitude"):
        data = data.replace(name, b"X" + name[1:])
    exif = piexif.load(data)
    exif["GPS"][piexif.GPSIFD.GPSAltitude] = round(1000 * abs(height)), 1000
    exif["GPS"][piexif.GPSIFD.GPSAltitudeRef] = int(height < 0)
    folder.mkdir(exist_ok=True)
    piexif.insert(piexif.dump(exif), data, str(folder / photo.name))
    return folder / photo.name


def falsely(flight, folder, factors):
    """Copies whose heights above sea level are the true ones times these numbers."""
    pairs = zip(flight.photos, factors, strict=True)
    return [told(p, folder, flight.centre(p.name)[2] * k) for p, k in pairs]


def notes(live):
    rows = live.ledger.rows("select body from event where kind='note'")
    return [json.loads(body)["text"] for (body,) in rows]


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ((0, 0, 1, 1, 0, 1), "exactly 0"),
        ((-1, -1, 1, 1, -1, 1), "the sign of the"),
        ((1, 1, -1, 0, 1, 1), "the sign of the"),
    ],
)
def test_false_heights_are_not_believed_once_others_tell_so(flight, tmp_path, factors, words):
    live = LiveMap(tmp_path / "out", QUICK)
    for k, path in enumerate(falsely(flight, tmp_path / "told", factors)):
        live.intake.take_file(path, "drone")
        live.queues.received.extend(live.members.take_up())
        while live.queues.received:
            live._placed()
        if k == 0:
            began = float(live.ledger.meta("ground"))
    true = [flight.centre(m.photo.name)[2] for m in live.members.by_id.values()]
    prior = np.array([m.prior.map_C[2] for m in live.members.by_id.values()])
    unknown = np.array(factors) == 0
    assert np.isnan(prior[unknown]).all()
    assert prior[~unknown] == pytest.approx(np.array(true)[~unknown], abs=1e-3)
    poses = [m.pose.map_C[2] for m in live.members.by_id.values()]
    assert poses == pytest.approx(true, abs=12.0)  # 50 m above take-off are assumed
    ground = float(live.ledger.meta("ground"))
    assert ground == pytest.approx(true[0] - 50, abs=5.0)
    assert (notes(live).count(f"{FALSE}.") == 1) is (abs(began - ground) > 9) is (factors[0] != 1)
    assert any(n.startswith("So far: In ") and words in n for n in notes(live))
    live.close()


@pytest.mark.slow
def test_a_map_with_heights_of_zero_first_lies_at_the_height_of_the_others(flight, tmp_path):
    live = fed(
        LiveMap(tmp_path / "out", QUICK), falsely(flight, tmp_path / "told", (0, 0, 1, 1, 1, 1))
    )
    assert live.ledger.counts() == {"refined": 6, "refused": 0}
    origin = np.array([*live.members.frame.origin, 0.0])
    off = [m.pose.map_C + origin - flight.centre(m.photo.name) for m in live.members.by_id.values()]
    assert np.abs(np.median(off, axis=0)).max() < 3.0
    assert notes(live).count(f"{FALSE}.") == 1
    live.close()


def at_takeoff(photo, folder, height_m, *, shows=None):
    """A copy of a photo that tells this height above take-off, and perhaps shows other ground."""
    picture = Image.open(photo)
    told = re.sub(
        rb'(RelativeAltitude=")\+?[0-9.]+', rb"\g<1>%+.2f" % height_m, picture.info["xmp"]
    )
    assert told != picture.info["xmp"]
    folder.mkdir(exist_ok=True)
    seen = picture if shows is None else Image.fromarray(shows).resize(picture.size, Image.BICUBIC)
    seen.save(folder / photo.name, exif=picture.info["exif"], xmp=told, quality=95)
    return folder / photo.name


def noise(seed):
    return np.random.default_rng(seed).integers(60, 200, (60, 80, 3), dtype=np.uint8)


def placed(live, paths):
    """Hands photos in and places them one after the other."""
    for path in paths:
        live.intake.take_file(path, "drone")
        live.queues.received.extend(live.members.take_up())
        while live.queues.received:
            live._placed()


@pytest.mark.parametrize("first", [0, 1], ids=["first", "later"])
def test_a_photo_of_the_take_off_is_not_drawn_as_if_from_the_air(flight, tmp_path, first):
    grounded = at_takeoff(flight.photos[0], tmp_path / "told", 0.2, shows=noise(1))
    live = LiveMap(tmp_path / "out", QUICK)
    flown = flight.photos[1:3]
    placed(live, [*flown[:first], grounded])
    member = next(m for m in live.members.by_id.values() if m.photo.name == grounded.name)
    # alone it may be of a flight whose files tell heights of zero
    assert member.state == ("waiting" if first else "placed")
    placed(live, flown[first:])
    assert member.state == "waiting" and member.pose is None
    assert member not in live.members.on_map() and not live.canvas.tiles_of(member.id)
    states = live.ledger.rows("select name, state, reason from photo")
    assert (grounded.name, "waiting", GROUNDED) in [tuple(row) for row in states]
    live.close()


def test_heights_of_zero_alone_keep_no_photo_off_the_map(flight, tmp_path):
    live = LiveMap(tmp_path / "out", QUICK)
    placed(live, [at_takeoff(p, tmp_path / "told", 0.0) for p in flight.photos[:3]])
    assert {m.state for m in live.members.by_id.values()} == {"placed"}
    live.close()


@pytest.mark.slow
def test_a_photo_as_high_as_the_take_off_that_shows_the_flight_is_drawn(flight, tmp_path):
    told = at_takeoff(flight.photos[2], tmp_path / "told", 0.4)
    grounded = at_takeoff(flight.photos[0], tmp_path / "told", 0.2, shows=noise(1))
    live = fed(LiveMap(tmp_path / "out", QUICK), [grounded, flight.photos[1], told])
    live = fed(live, flight.photos[3:])
    states = dict(live.ledger.rows("select name, state from photo"))
    assert states.pop(grounded.name) == "waiting" and set(states.values()) == {"refined"}
    live.close()
    again = LiveMap(tmp_path / "out", QUICK)
    assert dict(again.ledger.rows("select name, state from photo")) == {
        **states, grounded.name: "waiting",
    }  # fmt: skip
    again.close()
