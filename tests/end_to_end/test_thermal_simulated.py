"""`mosaic --thermal` on two simulated flights over one terrain, drones and hours apart; the truth
is the oracle.
"""

import json

import numpy as np
import pytest
import rasterio

from skyquilt.errors import NoPhotosError, RefusedError
from skyquilt.model.event import Note, Result
from skyquilt.quality.map_error import map_error
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import FlightSettings, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route, Thermal
from skyquilt.simulate.weather import Weather
from skyquilt.thermal import workflow
from skyquilt.thermal.workflow import iter_thermal
from tests.end_to_end.conftest import relabel

SETTINGS = MosaicSettings(jobs=2)
DRIFT_K = 0.4


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """12 visible photos of the morning, thermal ones of the afternoon that drift by 0.4 K."""
    folder = tmp_path_factory.mktemp("flights")
    settings = FlightSettings(
        seed=7,
        lens=Lens().scaled(1200, 900),
        route=Route(photos=12),
        control=Control(points=0, checks=0),
        thermal=Thermal(weather=Weather(hour=15.0), drift=DRIFT_K, overlap=0.75, sidelap=0.6),
    )
    for _ in simulate(settings, folder, overwrite=True):
        pass
    return folder


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """Both maps are made once; the routes join them anew."""
    return tmp_path_factory.mktemp("out") / "out"


def joined(flights, output, route, settings=SETTINGS):
    *events, last = iter_thermal(
        flights / "photos", flights / "thermal", output, settings, route=route
    )
    assert isinstance(last, Result)
    warned = [
        e.text for e in events if isinstance(e, Note) and e.warning and "which roof" in e.text
    ]
    assert len(warned) == (route == "positions")
    return last.metrics["thermal"]


def displacements(raster, truth):
    good = [s for s in map_error(raster, truth, points=300).samples if s.ok]
    return np.array([(s.x, s.y) for s in good]), np.array(
        [(s.error_x_m, s.error_y_m) for s in good]
    )


def plane(places, off):
    """Robust affine function of a place (n, 2) -> displacement (n, 2)."""
    middle, weight = places.mean(0), np.ones(len(places))
    terms = np.c_[np.ones(len(places)), places - middle]
    for _ in range(20):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(terms * root, off * root, rcond=None)[0]
        weight = 1 / (1 + (np.linalg.norm(off - terms @ found, axis=1) / 0.1) ** 2) ** 2
    return lambda at: np.c_[np.ones(len(at)), at - middle] @ found


def error_gsd(flights, output):
    """Median distance between what both maps are off by at one place, in visual GSD."""
    truth = flights / "truth"
    at, off = displacements(output / "thermal.tif", truth / "truth_thermal.tif")
    visual = plane(*displacements(output / "mosaic.tif", truth / "truth_ortho.tif"))
    assert len(at) > 40
    gsd = json.loads((output / "metrics.json").read_text())["native_gsd_m"]
    return float(np.median(np.linalg.norm(off - visual(at), axis=1))) / gsd


@pytest.mark.slow
@pytest.mark.parametrize(
    ("route", "most"),
    [
        ("maps", 2.0),
        *(pytest.param(*r, marks=pytest.mark.long) for r in (("pairs", 2.5), ("heights", 2.0))),
    ],
)
def test_every_route_brings_the_thermal_map_to_its_place(flights, output, route, most):
    told = joined(flights, output, route)
    assert told["route"] == route
    assert 0.1 < error_gsd(flights, output) < most
    report = (output / "report.html").read_text()
    assert report.count('id="thermal"') == 1  # of the last route, not of all before
    for name in ("thermal_checkerboard.png", "thermal_false_colour.png", "thermal_alpha.png"):
        assert (output / name).stat().st_size > 10_000


@pytest.mark.slow
def test_positions_alone_are_a_route_too_and_a_worse_one(flights, output):
    joined(flights, output, "positions")
    assert error_gsd(flights, output) > 5


@pytest.mark.slow
def test_the_same_command_again_joins_nothing(flights, output, monkeypatch):
    told = joined(flights, output, "maps")
    before = {p: p.stat().st_mtime_ns for p in output.glob("[!.]*.*")}

    def again(*_args, **_more):
        raise AssertionError("the maps are joined again")

    monkeypatch.setattr(workflow, "_joined", again)
    assert joined(flights, output, "maps") == told
    assert {p: p.stat().st_mtime_ns for p in output.glob("[!.]*.*")} == before
    (output / "thermal.tif").write_bytes(b"")
    with pytest.raises(AssertionError, match="joined again"):
        joined(flights, output, "maps")


@pytest.mark.slow
def test_values_are_degrees_and_their_drift_is_balanced(flights, output):
    """Against the true temperatures of the ground, and against the offsets that frames were
    given.
    """
    told = joined(flights, output, "auto")["thermal_values"]
    truth = json.loads((flights / "truth" / "truth.json").read_text())
    true = {
        p["file"].split("/")[-1]: p["exposure"] for p in truth["photos"] if p["band"] == "thermal"
    }
    assert told["balanced"] and told["unit"] == "celsius" and len(told["offsets"]) == len(true)
    left = np.array([told["offsets"][n] + true[n] for n in told["offsets"]])
    assert np.std(list(true.values())) > 0.25
    assert np.std(left) < 0.06
    with rasterio.open(output / "thermal.tif") as out, rasterio.open(output / "mosaic.tif") as grid:
        assert (out.transform, out.shape, out.crs) == (grid.transform, grid.shape, grid.crs)
        assert out.units == ("celsius",) and out.tags()["DRIFT"] == "balanced on overlaps"
        values = out.read(1)
    with rasterio.open(flights / "truth" / "truth_thermal.tif") as raster:
        celsius = raster.read(1) / 100.0 - 273.15
    levels = [np.percentile(v[np.isfinite(v) & (v > -200)], [20, 50]) for v in (values, celsius)]
    assert np.abs(levels[0] - levels[1]).max() < 1.0


@pytest.mark.slow
def test_raw_values_on_request(flights, tmp_path):
    raw = SETTINGS.changed(balance_thermal=False, gsd_cm=30.0, features=500, surface="ties")
    told = joined(flights, tmp_path / "out", "positions", raw)
    assert not told["thermal_values"]["balanced"] and told["thermal_values"]["offsets"] == {}
    with rasterio.open(tmp_path / "out" / "thermal.tif") as out:
        assert out.tags()["DRIFT"] == "as recorded"


def test_a_folder_without_photos_is_refused_before_anything_is_made(flight, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(NoPhotosError, match="no photo"):
        list(iter_thermal(flight / "photos", empty, tmp_path / "out", SETTINGS))
    (empty / "a.tif").write_bytes(b"II*\x00 and nothing more")
    with pytest.raises(NoPhotosError, match=r"a\.tif"):
        list(iter_thermal(flight / "photos", empty, tmp_path / "out", SETTINGS))
    assert not (tmp_path / "out").exists()


def test_flights_over_different_places_are_refused(flight, photos, tmp_path):
    for k, path in enumerate(sorted(photos.glob("*.jpg"))):
        relabel(path, place=(47.5 + 1e-4 * k, 9.0))
    with pytest.raises(RefusedError, match="km from the visual ones"):
        list(iter_thermal(flight / "photos", photos, tmp_path / "out", SETTINGS))
    assert not (tmp_path / "out").exists()


def test_pictures_that_are_not_known_to_be_thermal_are_told(flight, photos, tmp_path):
    for path in photos.glob("*.jpg"):
        path.write_bytes(path.read_bytes() + b"\0")  # the same photos twice are refused
    events = iter_thermal(flight / "photos", photos, tmp_path / "out", SETTINGS)
    first = next(events)
    assert isinstance(first, Note) and first.warning and "says that it is thermal" in first.text
