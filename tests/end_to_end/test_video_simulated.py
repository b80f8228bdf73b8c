"""A simulated clip becomes a map: poses against the truth, with positions and without."""

import json
from dataclasses import replace
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


def test_telemetry_in_the_clip_places_it(tmp_path):
    """Messages of frames, as newer drones write them, and no file beside the clip."""
    settings = sim.FlightSettings(
        lens=Lens().scaled(480, 360),
        route=Route(photos=6, sidelap=0.4, speed=8.0),
        video=Video(fps=5.0, layout="mini4"),
    )
    for _ in sim.simulate(settings, tmp_path / "flight"):
        pass
    assert [p.name for p in (tmp_path / "flight" / "video").iterdir()] == ["FLIGHT.MP4"]
    truth = json.loads((tmp_path / "flight" / "truth" / "truth.json").read_text())
    result = skyquilt.mosaic(tmp_path / "flight" / "video", tmp_path / "map")
    assert result.metrics["georeferenced"] and result.metrics["vertical_datum"] == "takeoff"
    solved, true, numbers = centres(tmp_path / "map", truth["clips"][0]["frames"])
    assert len(numbers) > 5
    off = solved - true
    assert np.abs(off[:, :2].mean(axis=0)).max() < 4.0  # of the receiver, 2 m
    assert (off - off.mean(axis=0))[:, :2].std() < 1.0


def test_what_is_said_of_frames_is_asked_when_they_are_known(flight, tmp_path):
    """Calibrations by name of the frames' camera, and a zero that their positions must allow."""
    clip = flight[0] / "video" / "FLIGHT.MP4"
    quick = skyquilt.MosaicSettings(surface="ties", gsd_cm=30.0)
    skyquilt.mosaic(clip, tmp_path / "first", quick)
    calibrated = tmp_path / "first" / "cameras.json"
    asked = quick.changed(cameras=calibrated, vertical_datum="egm96")
    told = skyquilt.mosaic(clip, tmp_path / "map", asked).metrics
    assert told["vertical_datum"] == "egm96"
    assert {c["focal"]["source"] for c in told["cameras"].values()} == {"calibrated"}


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


@pytest.fixture(scope="module")
def mixed(flight, tmp_path_factory):
    """The clip and the photos of the flight in one folder."""
    folder = tmp_path_factory.mktemp("mixed")
    for path in [*(flight[0] / "photos").glob("*.jpg"), *(flight[0] / "video").iterdir()]:
        (folder / path.name).symlink_to(path)
    return folder


def test_a_folder_of_videos_and_photos_is_one_map(flight, mixed, tmp_path):
    result = skyquilt.mosaic(mixed, tmp_path / "map")
    metrics = result.metrics
    frames = metrics["clips"][0]["frames_chosen"]
    assert frames > 4
    assert metrics["photos_used"] == metrics["photos_total"] == 6 + frames
    assert len(metrics["blocks"]) == 1
    assert metrics["seam_disparity_px"]["median"] < 0.3
    truth = json.loads((flight[0] / "truth" / "truth.json").read_text())
    true = {p["name"]: p["position"] for p in truth["photos"]}
    true |= {f"FLIGHT.MP4.{i:06d}": f["position"] for i, f in enumerate(flight[1])}
    shots = json.loads((tmp_path / "map" / "shots.geojson").read_text())["features"]
    solved = np.array([s["properties"]["translation"] for s in shots])
    known = np.array([true[s["properties"]["filename"]] for s in shots])
    # frames and photos lie together as they were flown, up to a similarity in the plane
    w, v = ((p[:, :2] - p[:, :2].mean(axis=0)) @ [1, 1j] for p in (solved, known))
    left = v - np.vdot(w, v) / np.vdot(w, w) * w
    assert np.abs(left).max() < 0.01 * np.abs(v).max()


def test_other_maps_take_videos_or_say_that_they_do_not(flight, mixed, tmp_path):
    from skyquilt.depth.workflow import depth
    from skyquilt.errors import UsageError
    from skyquilt.papers.compare import CompareSettings, iter_compare
    from skyquilt.thermal.workflow import iter_thermal

    clip = flight[0] / "video" / "FLIGHT.MP4"
    heights = depth(mixed, tmp_path / "depth").metrics
    assert heights["photos_used"] == heights["photos_total"] > 10
    asked = CompareSettings(mosaic=skyquilt.MosaicSettings(), variants=("position", "bundle"))
    *_, last = iter_compare(clip, tmp_path / "compare", asked)
    placed = [m["placed"] for m in last.metrics["methods"].values()]
    assert placed == 2 * [len(last.metrics["photos"])]
    assert len(last.metrics["photos"]) > 4
    with pytest.raises(UsageError, match="holds only videos"):
        list(iter_thermal(flight[0] / "photos", flight[0] / "video", tmp_path / "thermal"))


def test_a_clip_with_a_rolling_shutter(tmp_path):
    """Rows are exposed over 25 ms while the drone flies and its camera sways: the map is as that of
    a clip without, and the readout is found from a guess.
    """
    settings = sim.FlightSettings(
        lens=replace(Lens().scaled(480, 360), readout=0.025),
        route=Route(photos=6, sidelap=0.4, speed=8.0),
        video=Video(fps=5.0),
    )
    for _ in sim.simulate(settings, tmp_path / "flight"):
        pass
    truth = json.loads((tmp_path / "flight" / "truth" / "truth.json").read_text())
    frames = truth["clips"][0]["frames"]
    result = skyquilt.mosaic(tmp_path / "flight" / "video" / "FLIGHT.MP4", tmp_path / "map")
    solved, true, numbers = centres(tmp_path / "map", frames)
    off = solved - true
    assert result.metrics["photos_used"] == len(numbers)
    assert (off - off.mean(axis=0))[:, :2].std() < 1.0
    assert result.metrics["seam_disparity_px"]["median"] < 0.3
    (told,) = result.metrics["shutter"].values()
    assert told["source"] == "guess"
    assert abs(told["readout_ms"] - 25) < 2 * told["sigma_ms"] < 25
