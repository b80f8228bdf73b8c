"""Flights with a fisheye whose metadata do not tell its kind, from the folder to the map."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Reporting, Route
from tests.end_to_end.conftest import Told, named, skyquilt
from tests.once import flown_once

pytestmark = pytest.mark.slow


@pytest.fixture(scope="session")
def wide(tmp_path_factory):
    """Twelve photos of 130 degrees; their files state a focal length 15 % off."""
    settings = FlightSettings(
        seed=611,
        lens=Lens(fisheye=True).scaled(960, 720).seeing(130.0),
        route=Route(photos=12, height=50.0, overlap=0.75, sidelap=0.65),
        reporting=Reporting(focal_error=0.15),
        control=Control(points=5, checks=6),
    )
    return flown_once(tmp_path_factory, "fisheye", settings)


@pytest.fixture(scope="module")
def mapped(wide, tmp_path_factory):
    """Their map, with heights from pictures and control points."""
    output = tmp_path_factory.mktemp("mapped") / "out"
    full = (*PLACED, "--gsd", "12", "--surface", "sweep", "--jobs", "2")
    gcp = wide / "gcp_list.txt"
    code, out, err = skyquilt("mosaic", wide / "photos", "-o", output, *full, "--gcp", gcp)
    return Told(code=code, out=out, err=err, output=output).made()


PLACED = ("--features", "1500")
"""Photos are placed as in `mapped`; their map is a coarse one over points."""


def placed_off_m(output, wide):
    """(n,) m: distances of photos, as placed, from where they were, heights aside."""
    truth = json.loads((wide / "truth" / "truth.json").read_text())
    where = {p["name"]: p["position"] for p in truth["photos"]}
    shots = json.loads((output / "shots.geojson").read_text())["features"]
    return np.array(
        [
            math.dist(s["properties"]["translation"][:2], where[s["properties"]["filename"]][:2])
            for s in shots
        ]
    )


def test_a_fisheye_is_found_and_calibrated(mapped, wide):
    m = mapped.metrics
    assert m["blocks"] == [12]
    assert any("fisheye" in w for w in m["warnings"])
    assert m["reprojection_error_px"]["rms"] < 0.4
    truth = json.loads((wide / "truth" / "truth.json").read_text())["cameras"]["visible"]
    (camera,) = m["cameras"].values()
    assert camera["projection"] == "fisheye"
    for name in ("focal", "cx", "cy", "k1", "k2"):
        found = camera[name]
        assert abs(found["value"] - truth[name]) < 3 * found["sigma"], name
    assert camera["focal"]["sigma"] < 0.01 * truth["focal"]
    checks = np.array([(r["dx_m"], r["dy_m"], r["dz_m"]) for r in m["control"] if r["check"]])
    gsd = 50 / truth["focal"]
    rms = np.sqrt((checks**2).mean(0))
    assert len(checks) >= 4 and max(rms[:2]) < gsd and rms[2] < 2 * gsd
    (record,) = json.loads((mapped.output / "cameras.json").read_text()).values()
    assert record["projection_type"] == "fisheye62"


def test_its_own_cameras_json_tells_the_kind_beforehand(mosaic, mapped, wide):
    told = mosaic(wide / "photos", *PLACED, "--cameras", mapped.output / "cameras.json").made()
    assert not any("fisheye" in w for w in told.metrics["warnings"])
    (camera,) = told.metrics["cameras"].values()
    assert camera["projection"] == "fisheye" and told.metrics["blocks"] == [12]
    assert np.median(placed_off_m(told.output, wide)) < 2.5  # positions of 2 m


def test_photos_are_added_to_its_map(mosaic, wide, tmp_path):
    folder = Path(shutil.copytree(wide / "photos", tmp_path / "photos"))
    late = named(folder)[9:]
    aside = [path.rename(tmp_path / path.name) for path in late]
    mosaic(folder, *PLACED).made()
    for path in aside:
        path.rename(folder / path.name)
    m = mosaic(folder, *PLACED, "--add").made().metrics
    assert m["blocks"] == [12] and m["added"]["photos"] == 3
    (camera,) = m["cameras"].values()
    assert camera["projection"] == "fisheye"
    assert [c["field"] for c in m["metadata_conflicts"]] == ["focal"]  # stated 15 % off


@pytest.mark.parametrize("method", ["image", pytest.param("flightline", marks=pytest.mark.long)])
def test_mosaics_in_the_plane_find_it_too(mosaic, wide, method):
    run = mosaic(wide / "photos", "--method", method).made()
    assert sum(run.metrics["blocks"]) == 12
    assert any("fisheye" in w for w in run.metrics["warnings"])
    assert np.median(placed_off_m(run.output, wide)) < 3.5  # positions of 2 m
