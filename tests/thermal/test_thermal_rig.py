"""One drone, two cameras: thermal frames cut from simulated visual ones through a known
rotation.
"""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio
import tifffile

from skyquilt.alignment.nothing_shown import CLOSED
from skyquilt.errors import RefusedError
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import angle_deg, cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.event import Note, Result
from skyquilt.ortho.exposure import NEUTRAL
from skyquilt.settings import MosaicSettings
from skyquilt.thermal import by_rig, workflow
from skyquilt.thermal.partners import partners
from skyquilt.thermal.workflow import iter_thermal

HEAT = replace(Camera.ideal(width=320, height=256, focal=400.0), k1=-0.2)
TURN = cam_R_map_from_angles(2.0, 1.0, -1.5) @ cam_R_map_from_angles(0, 0, 0).T
"""thermal_R_visual."""
SETTINGS = MosaicSettings(gsd_cm=15, jobs=2)


def heat_of(path, lens):
    """A frame in degrees Celsius: the brightness, reversed and rounded off, as the turned camera
    sees it.
    """
    grey = cv2.GaussianBlur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (0, 0), 1.0)
    x, y = np.meshgrid(np.arange(HEAT.width, dtype=float), np.arange(HEAT.height, dtype=float))
    px = project(lens, rays(HEAT, np.c_[x.ravel(), y.ravel()]) @ TURN).astype(np.float32)
    u, v = px.reshape(*x.shape, 2).transpose(2, 0, 1)
    seen = cv2.remap(grey, np.ascontiguousarray(u), np.ascontiguousarray(v), cv2.INTER_LINEAR)
    return (40 - 0.1 * seen.astype(np.float32)).astype(np.float32)


@pytest.fixture(scope="module")
def frames(flight, finished, tmp_path_factory):
    """Frames named like the photos they were taken with, but without any metadata."""
    folder = tmp_path_factory.mktemp("heat")
    table = finished.json("reconstruction.json")[0]
    (lens,) = table["cameras"].values()
    longest = max(lens["width"], lens["height"])
    for path in sorted((flight / "photos").glob("*.jpg")):
        k = [float(lens.get(n, 0)) for n in ("k1", "k2", "k3", "p1", "p2")]
        camera = Camera(
            width=lens["width"],
            height=lens["height"],
            focal=lens.get("focal_x", lens.get("focal")) * longest,
            cx=lens.get("c_x", 0) * longest + (lens["width"] - 1) / 2,
            cy=lens.get("c_y", 0) * longest + (lens["height"] - 1) / 2,
            **dict(zip(("k1", "k2", "k3", "p1", "p2"), k, strict=True)),
        )
        target = folder / f"heat_{path.stem.split('_')[-1]}.tif"
        cv2.imwrite(str(target), heat_of(path, camera))
    return folder


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """The visual map is made once."""
    return tmp_path_factory.mktemp("rig") / "out"


@pytest.mark.slow
def test_the_rig_is_found_and_drawn_on_the_visual_poses(flight, frames, output):
    *_, last = iter_thermal(flight / "photos", frames, output, SETTINGS)
    assert isinstance(last, Result)
    told = last.metrics["thermal"]
    assert told["route"] == "rig" and told["photos_used"] == 9
    assert angle_deg(np.array(told["thermal_R_visual"]), TURN) < 0.05
    assert told["evidence"]["focal_px"] == pytest.approx(HEAT.focal, rel=0.01)
    assert told["evidence"]["k1"] == pytest.approx(HEAT.k1, abs=0.03)  # no file tells it
    assert not (output / "thermal").exists()  # no map of its own was needed
    with rasterio.open(output / "thermal.tif") as out, rasterio.open(output / "mosaic.tif") as m:
        assert (out.transform, out.shape, out.crs) == (m.transform, m.shape, m.crs)
        heat, grey = out.read(1), m.read().mean(0)
        known = np.isfinite(heat) & (m.dataset_mask() > 0)
    assert known.mean() > 0.2
    grey = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1)
    places = {
        (dx, dy): np.corrcoef(heat[known], np.roll(grey, (dy, dx), (0, 1))[known])[0, 1]
        for dx in (-2, 0, 2)
        for dy in (-2, 0, 2)
    }
    assert min(places, key=places.get) == (0, 0) and places[0, 0] < -0.8


@pytest.mark.slow
def test_frames_of_other_ground_are_refused(flight, frames, output, tmp_path):
    (tmp_path / "wrong").mkdir()
    rng = np.random.default_rng(0)
    for path in sorted(frames.glob("*.tif"))[:4]:
        noise = cv2.GaussianBlur(rng.normal(20, 5, (256, 320)).astype(np.float32), (0, 0), 3)
        cv2.imwrite(str(tmp_path / "wrong" / path.name), noise)
    with pytest.raises(RefusedError, match="0 pairs taken together could be registered"):
        list(iter_thermal(flight / "photos", tmp_path / "wrong", output, SETTINGS, route="rig"))


@pytest.mark.slow
def test_frames_that_are_not_drawn_are_named(flight, frames, output, tmp_path):
    """One is damaged behind a whole header, so this is met only when its values are read; one has
    another size, as a reduced copy, for which all were placed by their own map; another has no
    visual photo beside it; one shows the camera's closed shutter.
    """
    shutil.copytree(frames, tmp_path / "heat")
    bad, small, shut = sorted((tmp_path / "heat").glob("*.tif"))[2:5]
    noise = np.random.default_rng(0).normal(25, 0.05, (256, 320)).astype(np.float32)
    tifffile.imwrite(shut, noise)
    tifffile.imwrite(small, tifffile.imread(small)[::2, ::2])
    tifffile.imwrite(tmp_path / "heat" / "heat_9999.tif", tifffile.imread(bad)[::-1])
    tifffile.imwrite(bad, tifffile.imread(bad), compression="zlib")
    whole = bad.read_bytes()
    bad.write_bytes(whole[:2000] + bytes(len(whole) // 2) + whole[2000 + len(whole) // 2 :])
    *before, last = iter_thermal(flight / "photos", tmp_path / "heat", output, SETTINGS)
    assert isinstance(last, Result)
    told = last.metrics["thermal"]
    assert told["route"] == "rig" and told["photos_used"] == 6 and told["photos_total"] == 10
    assert list(told["photos_rejected"]) == [bad.name, small.name, "heat_9999.tif", shut.name]
    assert told["photos_rejected"][shut.name] == CLOSED
    assert "of another camera or format" in told["photos_rejected"][small.name]
    alone = "no visual photo was taken together with it"
    assert told["photos_rejected"]["heat_9999.tif"] == alone
    assert Note(text=f"heat_9999.tif is left out: {alone}") in before
    # that the unit is a guess was told only where the thermal map is one of its own
    assert any("no unit is stated" in n.text for n in before if isinstance(n, Note))


@pytest.mark.slow
@pytest.mark.long
def test_a_frame_that_is_lost_before_it_is_drawn_is_left_out(flight, frames, tmp_path, monkeypatch):
    shutil.copytree(frames, tmp_path / "heat")
    gone = sorted((tmp_path / "heat").glob("*.tif"))[2]

    def drift(*_):
        gone.unlink(missing_ok=True)
        return NEUTRAL

    monkeypatch.setattr(workflow, "drift_of_rigged", drift)
    *before, last = iter_thermal(
        flight / "photos", tmp_path / "heat", tmp_path / "out", SETTINGS
    )  # not where the same frames were mapped, and are not drawn again
    told = last.metrics["thermal"]
    assert told["route"] == "rig" and told["photos_used"] == 8
    assert told["photos_rejected"] == {gone.name: "its file is gone"}
    assert f"{gone.name} is left out: its file is gone" in [
        event.text for event in before if isinstance(event, Note)
    ]


@pytest.mark.slow
def test_frames_that_only_the_pattern_of_times_pairs_tell_where_they_were_taken(
    flight, frames, tmp_path, monkeypatch
):
    """They were taken at once in truth, so the rig is the same."""

    def by_pattern(*both):
        return replace(partners(*both), by_pattern=True, apart_s=3600.0)

    monkeypatch.setattr(by_rig, "partners", by_pattern)
    *before, last = iter_thermal(flight / "photos", frames, tmp_path / "out", SETTINGS)
    told = last.metrics["thermal"]
    assert told["route"] == "rig" and told["photos_used"] == 9
    assert angle_deg(np.array(told["thermal_R_visual"]), TURN) < 0.1
    said = [n.text for n in before if isinstance(n, Note)]
    assert any("3600.0 s before them" in text and "9 of 9" in text for text in said)
