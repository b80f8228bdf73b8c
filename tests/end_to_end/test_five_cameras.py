"""A drone with five cameras, one that looks down and four that look aslant to its sides: their
photos of one place show the ground from other sides and have nothing in common.
"""

import json
from dataclasses import replace

import numpy as np
import piexif
import pytest

from skyquilt.simulate import FlightSettings, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.flight import plan
from skyquilt.simulate.settings import Control, Route
from tests.end_to_end.conftest import named, skyquilt

pytestmark = pytest.mark.slow
PLACES, SIDES = 12, (0, 90, 180, 270)
MAP = ("--features", "1500", "--surface", "ties", "--gsd", "40", "--jobs", "2")


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """60 photos of 480 x 360."""
    lens = Lens(focal=800.0, width=800, height=600).scaled(480, 360)
    route = Route(photos=PLACES, height=60.0, overlap=0.7, sidelap=0.6)
    settings = FlightSettings(seed=61, lens=lens, route=route, control=Control(points=0, checks=0))
    rig = [
        replace(p, drone=k, heading=(p.heading + turn + 180) % 360 - 180, pitch=pitch)
        for p in plan(route, lens)
        for k, (turn, pitch) in enumerate([(0, 0.0), *((side, 45.0) for side in SIDES)])
    ]
    settings = replace(settings, route=replace(route, photos=len(rig), drones=5))
    folder = tmp_path_factory.mktemp("rig")
    for _ in simulate(settings, folder, overwrite=True, waypoints=rig):
        pass
    return folder


def of_a_simple_rig(photos, target):
    """The photos in a folder for each camera, as simple rigs write them: without XMP, where cameras
    tell their angles and height above take-off, and without the cameras' serial numbers.
    """
    for path in photos:
        data, at = path.read_bytes(), 2
        out = data[:2]
        while data[at + 1] != 0xDA:
            end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if not data[at + 4 : end].startswith(b"http://ns.adobe.com/xap"):
                out += data[at:end]
            at = end
        exif = piexif.load(out + data[at:])
        del exif["Exif"][piexif.ExifIFD.BodySerialNumber]
        folder = target / path.name[4]
        folder.mkdir(parents=True, exist_ok=True)
        piexif.insert(piexif.dump(exif), out + data[at:], str(folder / path.name))


def off_m(output, flight):
    """(n, 3) m: centres of photos from the truth, after the best similarity (Umeyama 1991)."""
    truth = json.loads((flight / "truth" / "truth.json").read_text())
    where = {p["name"]: p["position"] for p in truth["photos"]}
    shots = [
        s["properties"] for s in json.loads((output / "shots.geojson").read_text())["features"]
    ]
    found = np.array([s["translation"] for s in shots])
    true = np.array([where[s["filename"].split("/")[-1]] for s in shots])
    a, b = found - found.mean(0), true - true.mean(0)
    u, stretch, v = np.linalg.svd(a.T @ b)
    return stretch.sum() / (a**2).sum() * a @ (u @ v) - b


@pytest.mark.parametrize(
    "told", [True, pytest.param(False, marks=pytest.mark.long)], ids=["angles", "no angles"]
)
def test_all_photos_of_five_cameras_are_placed_in_one_block(flight, told, tmp_path):
    """Compared with the nearest photos only, 17 and 4 of the 60 lay in the largest block."""
    photos = flight / "photos"
    if not told:
        photos = tmp_path / "photos"
        of_a_simple_rig(named(flight / "photos"), photos)
    code, _, err = skyquilt("mosaic", photos, "-o", tmp_path / "out", *MAP)
    assert code == 0, err
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["blocks"] == [5 * PLACES]
    off = off_m(tmp_path / "out", flight)
    assert np.sqrt((off**2).mean(0)).max() < 0.25  # pixels of 12 cm on the ground
    says = " ".join(figures["warnings"])
    assert ("--max-view-angle 40" in says) == told
    assert ("none reports its camera angles" in says) != told
