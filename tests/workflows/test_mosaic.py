"""Every file of the contract, read by other libraries and held against the truth and against each
other.
"""

import json
import tomllib

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from skyquilt.model.event import Result, StageFinished, StageStarted
from skyquilt.quality.map_error import map_error
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import iter_mosaic


@pytest.fixture(scope="module")
def truth(flight):
    return json.loads((flight / "truth" / "truth.json").read_text())


@pytest.fixture(scope="module")
def shots(finished):
    return finished.json("shots.geojson")["features"]


def opensfm_px(camera, rotation, translation, points):
    """OpenSfM's `brown` camera, from its documentation: pixels (n, 2), centres at integers."""
    local = points @ cv2.Rodrigues(np.array(rotation))[0].T + translation
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    radial = 1 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
    xd = x * radial + 2 * camera["p1"] * x * y + camera["p2"] * (r2 + 2 * x * x)
    yd = y * radial + camera["p1"] * (r2 + 2 * y * y) + 2 * camera["p2"] * x * y
    unit, w, h = max(camera["width"], camera["height"]), camera["width"], camera["height"]
    u = (camera["focal_x"] * xd + camera["c_x"]) * unit + (w - 1) / 2
    v = (camera["focal_y"] * yd + camera["c_y"]) * unit + (h - 1) / 2
    return np.where(local[:, 2:] > 0, np.column_stack([u, v]), np.nan)


def in_shot(finished, shot, xyz):
    """Pixels of points in the output CRS in a shot of shots.geojson, with its camera of
    cameras.json.
    """
    p = shot["properties"]
    R = cv2.Rodrigues(np.array(p["rotation"]))[0]
    return opensfm_px(
        finished.json("cameras.json")[p["camera"]], p["rotation"], -R @ p["translation"], xyz
    )


# the story


def test_stages_come_in_order_and_end(finished):
    started = [e.stage for e in finished.events if isinstance(e, StageStarted)]
    ended = [e.stage for e in finished.events if isinstance(e, StageFinished)]
    assert started == ended and started[:4] == ["features", "links", "align", "surface"]
    assert isinstance(finished.events[-1], Result)
    assert dict(finished.events[-1].metrics) == finished.metrics


def test_asking_again_makes_nothing_again(flight, finished):
    before = {p.name: p.stat().st_mtime_ns for p in finished.output.iterdir() if p.is_file()}
    settings = MosaicSettings(gcp=next(flight.rglob("gcp_list.txt")), jobs=1)
    events = list(iter_mosaic(flight / "photos", finished.output, settings))
    assert not [e for e in events if isinstance(e, StageStarted)]
    assert before == {
        p.name: p.stat().st_mtime_ns for p in finished.output.iterdir() if p.is_file()
    }


# rasters


def test_mosaic_is_a_cloud_optimised_geotiff_in_local_utm(finished, truth):
    path = finished.output / "mosaic.tif"
    with rasterio.open(path) as source:
        assert source.crs.to_string() == truth["crs"] == "EPSG:32633"
        assert source.count == 3 and source.dtypes == ("uint8",) * 3
        assert source.profile["compress"] == "jpeg" and source.overviews(1)
        mask = source.dataset_mask()
        assert set(np.unique(mask)) == {0, 255} and 0.5 < (mask > 0).mean() < 1
        assert source.res == (finished.metrics["gsd_m"],) * 2
        assert [source.width, source.height] == finished.metrics["size_px"]
    validate = pytest.importorskip("rio_cogeo").cog_validate
    valid, errors, warnings = validate(str(path), strict=True)
    assert valid, (errors, warnings)


def test_every_raster_is_valid_and_lies_on_the_map(finished):
    validate = pytest.importorskip("rio_cogeo").cog_validate
    with rasterio.open(finished.output / "mosaic.tif") as source:
        bounds, crs = source.bounds, source.crs
    for name in ("provenance.tif", "views.tif", "surface.tif"):
        assert validate(str(finished.output / name))[0], name
        with rasterio.open(finished.output / name) as source:
            assert source.crs == crs and source.count == 1
            assert source.bounds.left == pytest.approx(bounds.left, abs=1e-6)
            assert source.bounds.top == pytest.approx(bounds.top, abs=1e-6)
            assert (
                source.bounds.right >= bounds.right - 1e-6
                and source.bounds.bottom <= bounds.bottom + 1e-6
            )


def test_the_map_lies_where_the_truth_does(finished, flight):
    """With control points of 2 cm: within a pixel, but no better than resampling and JPEG allow."""
    result = map_error(
        finished.output / "mosaic.tif", flight / "truth" / "truth_ortho.tif", points=300
    )
    assert result.measured > 0.6 * result.attempted > 60
    assert 0.02 < result.absolute.median_px < 0.6
    assert result.absolute.p95_px < 4
    assert np.hypot(result.bias_x_m, result.bias_y_m) < 0.05


def test_heights_are_those_of_the_country(finished, flight):
    with (
        rasterio.open(finished.output / "surface.tif") as mine,
        rasterio.open(flight / "truth" / "truth_surface.tif") as true,
    ):
        tags = mine.tags()
        assert mine.units == ("m",)
        z = mine.read(1)
        rows, columns = np.nonzero(np.isfinite(z))
        few = slice(None, None, max(1, len(rows) // 4000))
        rows, columns = rows[few], columns[few]
        x, y = mine.transform * (columns + 0.5, rows + 0.5)
        expected = np.array([v[0] for v in true.sample(np.column_stack([x, y]))])
        inside = (
            (x > true.bounds.left)
            & (x < true.bounds.right)
            & (y > true.bounds.bottom)
            & (y < true.bounds.top)
        )
    assert tags["VERTICAL_DATUM"] == "control" == finished.metrics["vertical_datum"]
    with rasterio.open(finished.output / "views.tif") as source:
        seen = np.array([v[0] for v in source.sample(np.column_stack([x, y]))]) >= 3
    error = (z[rows, columns] - expected)[inside & seen]
    assert len(error) > 1000
    assert abs(np.median(error)) < 0.3 and 0.005 < np.median(np.abs(error)) < 0.4


def test_provenance_names_the_photo_shown(finished, shots):
    """At sampled pixels the named photo really looks there, and mostly none more steeply: seams
    leave the boundaries of the most vertical views by less than half the distance of two cameras.
    """
    with (
        rasterio.open(finished.output / "provenance.tif") as source,
        rasterio.open(finished.output / "surface.tif") as heights,
    ):
        numbers = source.read(1)
        assert numbers.max() <= len(shots)
        rng = np.random.default_rng(0)
        pick = rng.choice(numbers.size, 12000, replace=False)
        rows, columns = np.unravel_index(pick, numbers.shape)
        x, y = source.transform * (columns + 0.5, rows + 0.5)
        z = np.array([v[0] for v in heights.sample(np.column_stack([x, y]))])
    named = numbers[rows, columns]
    xyz = np.column_stack([x, y, z])
    C = np.array([s["properties"]["translation"] for s in shots])
    px = np.stack([in_shot(finished, s, xyz) for s in shots])
    inside = np.stack([(p > -0.5).all(1) & (p[:, 0] < 799.5) & (p[:, 1] < 599.5) for p in px])
    steep = np.hypot(x - C[:, :1], y - C[:, 1:2]) / (C[:, 2:] - z)
    best = np.where(inside, steep, np.inf)
    assert (named > 0).sum() > 6000
    shown = named > 0
    assert inside[named[shown] - 1, np.flatnonzero(shown)].mean() > 0.99
    lost = best.min(0)[shown] - best[named[shown] - 1, np.flatnonzero(shown)]
    assert (np.abs(lost) < 0.02).mean() > 0.85  # provenance pixels are four map pixels wide
    assert (np.abs(lost) < 0.25).mean() > 0.99
    assert (
        np.isfinite(best.min(0)) == shown
    ).mean() > 0.97  # nothing seen is left empty, nothing unseen is shown


def test_views_count_the_photos(finished, shots):
    with (
        rasterio.open(finished.output / "views.tif") as source,
        rasterio.open(finished.output / "surface.tif") as heights,
    ):
        count = source.read(1)
        rows, columns = np.indices(count.shape).reshape(2, -1)
        x, y = source.transform * (columns + 0.5, rows + 0.5)
        z = np.array([v[0] for v in heights.sample(np.column_stack([x, y]))])
    ok = np.isfinite(z)
    px = [in_shot(finished, s, np.column_stack([x, y, z])) for s in shots]
    expected = np.sum(
        [(p > 1.5).all(1) & (p[:, 0] < 797.5) & (p[:, 1] < 597.5) for p in px], axis=0
    )
    off = np.abs(count.ravel().astype(int) - expected)[ok]
    assert (off == 0).mean() > 0.97
    assert (off > 1).mean() < 1e-3 and off.max() <= 3  # where the rims of photos cross in one cell


# vectors and calibration


def test_shots_are_the_photos_in_their_true_places(shots, truth, finished):
    true = {p["name"]: p for p in truth["photos"]}
    assert [s["properties"]["filename"] for s in shots] == sorted(true)
    to_crs = Transformer.from_crs(4326, finished.metrics["crs"], always_xy=True)
    for s in shots:
        p, t = s["properties"], true[s["properties"]["filename"]]
        assert to_crs.transform(*s["geometry"]["coordinates"][:2]) == pytest.approx(
            p["translation"][:2], abs=0.01
        )
        assert p["translation"][:2] == pytest.approx(t["position"][:2], abs=0.8)
        assert p["translation"][2] == pytest.approx(
            t["position"][2], abs=1.2
        )  # 2 % of the flying height
        R, T = cv2.Rodrigues(np.array(p["rotation"]))[0], np.array(t["cam_R_map"])
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(R @ T.T)[0])) < 0.6
        off = (p["yaw"] - t["yaw_deg"] - truth["meridian_convergence_deg"] + 180) % 360 - 180
        assert off == pytest.approx(0, abs=0.6)
        assert (p["pitch"], p["roll"]) == pytest.approx((t["pitch_deg"], t["roll_deg"]), abs=0.8)


def test_the_camera_is_the_true_one(finished, truth):
    (camera,) = finished.json("cameras.json").values()
    true = truth["cameras"]["visible"]
    assert camera["projection_type"] == "brown" and (camera["width"], camera["height"]) == (
        800,
        600,
    )
    assert camera["focal_x"] * 800 == pytest.approx(true["focal"], rel=0.02)


def test_the_focal_length_errs_as_its_deviation_says(finished, truth):
    true = truth["cameras"]["visible"]
    (told,) = finished.metrics["cameras"].values()
    assert abs(told["focal"]["value"] - true["focal"]) < 4 * told["focal"]["sigma"]


def test_the_reconstruction_is_our_model(finished, shots):
    """OpenSfM's reading of reconstruction.json puts points where shots.geojson and cameras.json put
    them.
    """
    (record,) = finished.json("reconstruction.json")
    assert sorted(record["shots"]) == [s["properties"]["filename"] for s in shots]
    enu = np.array([p["coordinates"] for p in record["points"].values()])
    assert len(enu) > 500
    ref = record["reference_lla"]
    topocentric = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={ref['longitude']}"
        f" +lat_0={ref['latitude']}"
        f" +h_0={ref['altitude']} +step +inv +proj=cart +ellps=WGS84"
    )
    lon, lat, h = topocentric.transform(*enu.T)
    x, y = Transformer.from_crs(4326, finished.metrics["crs"], always_xy=True).transform(lon, lat)
    worst = []
    for s in shots:
        shot = record["shots"][s["properties"]["filename"]]
        theirs = opensfm_px(
            record["cameras"][shot["camera"]], shot["rotation"], np.array(shot["translation"]), enu
        )
        mine = in_shot(finished, s, np.column_stack([x, y, h]))
        inside = (mine > 0).all(1) & (mine[:, 0] < 799) & (mine[:, 1] < 599)
        assert inside.sum() > 100
        worst.append(np.abs(theirs - mine)[inside].max())
    # UTM's scale of 0.9996 is in our horizontal distances and not in the heights: 4e-4 of the
    # distance from the centre
    assert max(worst) < 5e-4 * 500


def test_footprints_are_the_rims_of_the_photos(finished, shots):
    features = finished.json("footprints.geojson")["features"]
    assert [f["properties"]["filename"] for f in features] == [
        s["properties"]["filename"] for s in shots
    ]
    to_crs = Transformer.from_crs(4326, finished.metrics["crs"], always_xy=True)
    with rasterio.open(finished.output / "surface.tif") as heights:
        for f, s in zip(features, shots, strict=True):
            ring = np.array(f["geometry"]["coordinates"][0])
            x, y = to_crs.transform(ring[:, 0], ring[:, 1])
            z = np.array([v[0] for v in heights.sample(np.column_stack([x, y]))])
            ok = np.isfinite(z)
            px = in_shot(finished, s, np.column_stack([x, y, z]))[ok]
            rim = np.min(
                [
                    np.abs(px[:, 0]),
                    np.abs(px[:, 1]),
                    np.abs(px[:, 0] - 799),
                    np.abs(px[:, 1] - 599),
                ],
                axis=0,
            )
            assert ok.sum() > 10 and np.median(rim) < 2


# figures

KEYS = (
    "method",
    "photos_total",
    "photos_used",
    "photos_rejected",
    "gsd_m",
    "crs",
    "blocks",
    "gps_residual_rms_m",
    "gps_leave_one_out_rms_m",
    "reprojection_error_px",
    "tie_points",
    "seam_disparity_px",
    "metadata_conflicts",
    "warnings",
    "seconds",
    "cpu_seconds",
    "peak_memory_mb",
    "cpu_seconds_of_stage",
    "peak_memory_mb_of_stage",
)


def test_metrics_hold_every_figure_of_the_contract(finished):
    m = finished.metrics
    assert [k for k in KEYS if k not in m] == []
    assert (
        m["method"] == "bundle"
        and m["photos_total"] == m["photos_used"] == 9
        and m["blocks"] == [9]
    )
    assert m["photos_rejected"] == {} and m["metadata_conflicts"] == []
    assert set(m["gps_residual_rms_m"]) == set("xyz") == set(m["gps_leave_one_out_rms_m"])
    assert {"mean", "rms"} <= set(m["reprojection_error_px"])
    assert {"median", "p95", "measured", "attempted"} <= set(m["seam_disparity_px"])
    assert (
        m["seconds"]["total"] >= 0.9 * sum(v for k, v in m["seconds"].items() if k != "total") > 0
    )
    assert m["cpu_seconds"] > 0 and m["peak_memory_mb"] > 50
    json.dumps(m, allow_nan=False)


def test_the_figures_are_plausible(finished):
    """Two sides: GPS noise is 2 m, observations err by some tenths of a pixel, seams hardly
    show.
    """
    m = finished.metrics
    for axis in "xy":
        assert 0.8 < m["gps_residual_rms_m"][axis] < 3.5
    assert (
        m["gps_residual_rms_m"]["z"] < 5
    )  # not the offset between the control points' heights and take-off
    assert 0.03 < m["reprojection_error_px"]["mean"] < 0.5
    assert m["seam_disparity_px"]["measured"] > 0.6 * m["seam_disparity_px"]["attempted"]
    assert m["seam_disparity_px"]["median"] < 0.5


def test_check_points_are_judged_and_control_points_held(finished):
    control = finished.metrics["control"]
    assert sorted(c["name"] for c in control if c["check"]) == ["chk06", "chk07", "chk08"]
    assert len([c for c in control if not c["check"]]) == 5
    for c in control:
        assert (
            np.hypot(c["dx_m"], c["dy_m"]) < 0.15 and abs(c["dz_m"]) < 0.4 and c["sightings"] >= 2
        )


def test_run_toml_tells_how(finished, flight):
    told = tomllib.loads((finished.output / "run.toml").read_text())
    assert told["version"] and "commit" in told and told["photos"] == str(flight / "photos")
    assert told["settings"]["method"] == "auto" and told["settings"]["jobs"] == 2
    names = {k: v for k, v in told["settings"].items() if k != "gcp"}
    assert MosaicSettings(**names) == MosaicSettings(jobs=2)


def test_the_report_is_one_page(finished):
    page = (finished.output / "report.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html") and "SIM_0001.jpg" in page
    assert 'src="http' not in page
