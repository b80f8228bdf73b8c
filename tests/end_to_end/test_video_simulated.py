"""A simulated clip becomes a map: poses against the truth, with positions and without."""

import json
from itertools import pairwise

import numpy as np
import pytest

import skyquilt
from skyquilt import simulate as sim
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Route, Video

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    out = tmp_path_factory.mktemp("film")
    settings = sim.FlightSettings(
        lens=Lens().scaled(480, 360),
        route=Route(photos=6, sidelap=0.4, speed=8.0),
        video=Video(fps=5.0, layout="air2s", gust_blur=7.0, gust_every=6.0),
    )
    for _ in sim.simulate(settings, out):
        pass
    truth = json.loads((out / "truth" / "truth.json").read_text())
    return out, truth["clips"][0]["frames"]


def centres(output, frames):
    """Solved and true centres (n, 3) of the frames of a map."""
    shots = json.loads((output / "shots.geojson").read_text())["features"]
    solved = np.array([s["properties"]["translation"] for s in shots])
    numbers = [int(s["properties"]["filename"].rsplit(".", 1)[1]) for s in shots]
    return solved, np.array([frames[i]["position"] for i in numbers]), numbers


def test_a_clip_with_telemetry(flight, tmp_path):
    folder, frames = flight
    clip = folder / "video" / "FLIGHT.MP4"
    result = skyquilt.mosaic(clip, tmp_path / "map")
    solved, true, numbers = centres(tmp_path / "map", frames)
    told = result.metrics["clips"][0]
    assert result.metrics["photos_used"] == told["frames_chosen"] == len(numbers)
    assert not any(frames[i]["blurred"] for i in numbers)
    assert all(a < b for a, b in pairwise(numbers))
    off = solved - true
    assert np.abs(off[:, :2].mean(axis=0)).max() < 4.0  # of the receiver, 2 m
    assert (off - off.mean(axis=0))[:, :2].std() < 1.0
    assert "found from the flight" in (tmp_path / "map" / "report.html").read_text() or (
        told["clock_offset_source"] != "turns"
    )
    again = skyquilt.mosaic(clip, tmp_path / "map")
    assert again.metrics["seconds"] == result.metrics["seconds"]


def test_a_clip_without_positions(flight, tmp_path):
    folder, frames = flight
    clip = tmp_path / "FLIGHT.MP4"
    clip.symlink_to(folder / "video" / "FLIGHT.MP4")
    settings = skyquilt.MosaicSettings(write_frames=True)
    result = skyquilt.mosaic(clip, tmp_path / "map", settings)
    assert not result.metrics["georeferenced"]
    solved, true, numbers = centres(tmp_path / "map", frames)
    written = sorted(p.name for p in (tmp_path / "map" / "frames").iterdir())
    assert written == [f"FLIGHT.MP4.{i:06d}.jpg" for i in numbers]
    # up to a similarity in the plane, the path of the cameras is the true one
    w, v = ((p[:, :2] - p[:, :2].mean(axis=0)) @ [1, 1j] for p in (solved, true))
    left = v - np.vdot(w, v) / np.vdot(w, w) * w
    assert np.abs(left).mean() < 0.03 * np.abs(v).max()
