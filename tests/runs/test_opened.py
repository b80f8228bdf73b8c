"""A finished run, opened again in Python."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio

import skyquilt
from skyquilt.engine.store import Store
from skyquilt.errors import UsageError
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.finished import NAME, STAGE


@pytest.fixture(scope="module")
def run(finished):
    return skyquilt.open_run(finished.output)


def test_observations_are_explained_by_poses_and_cameras(run, finished):
    """The tie points, projected through the poses and cameras of the run's files, fall where the
    residuals say: every part fits every other.
    """
    seen = run.observations
    assert len(seen.points) == finished.metrics["tie_points"]
    assert len(seen.px) == finished.metrics["sightings"]
    for name in list(run.poses)[:3]:
        chosen = seen.photo == name
        pose, camera = run.poses[name], run.cameras[run.camera_of[name]]
        local = (seen.points[seen.point[chosen]] - pose.map_C) @ pose.cam_R_map.T
        if pose.motion is not None:  # rows are read out one after the other
            s = (seen.px[chosen][:, 1:] - (camera.height - 1) / 2) / (camera.height - 1)
            turned = np.cross(pose.motion.turn_rad, local)
            local = local + s * (turned - pose.cam_R_map @ pose.motion.shift_m)
        x, y = (local[:, :2] / local[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
        u = x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x)
        v = y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y
        px = np.column_stack(
            [camera.focal * u + camera.cx, camera.focal * camera.aspect * v + camera.cy]
        )
        off = px - seen.px[chosen] - seen.residual_px[chosen]
        assert chosen.sum() > 20 and np.abs(off).max() < 0.02


def test_rasters_are_those_of_the_files(run, finished):
    with rasterio.open(finished.output / "dsm.tif") as file:
        whole, b = file.read(1), file.bounds
    found = run.raster("heights")
    assert np.array_equal(found.pixels[..., 0], whole, equal_nan=True)
    assert (found.west, found.north) == (b.left, b.top)
    half = run.raster("heights", gsd_m=2 * found.gsd_m)
    assert half.gsd_m == pytest.approx(2 * found.gsd_m)
    both = half.shown & found.shown[: 2 * half.shown.shape[0] : 2, : 2 * half.shown.shape[1] : 2]
    fine = found.pixels[: 2 * half.shown.shape[0] : 2, : 2 * half.shown.shape[1] : 2, 0]
    assert np.nanmedian(np.abs(half.pixels[..., 0] - fine)[both]) < 0.1
    part = run.raster("mosaic", bounds=(b.left + 10, b.bottom + 10, b.right - 10, b.top - 10))
    assert abs(part.x[0] - (b.left + 10)) < part.gsd_m
    with pytest.raises(UsageError, match="thermal"):
        run.raster("thermal")
    with pytest.raises(UsageError, match="nothing within"):
        run.raster(bounds=(0, 0, 1, 1))


@pytest.mark.slow
def test_xarray_has_coordinates_and_unit(run):
    pytest.importorskip("xarray")
    found = run.xarray("heights")
    assert found.dims == ("y", "x", "band") and found.attrs["crs"] == run.crs
    assert float(found.y[0]) > float(found.y[-1]) and found.attrs["units"].startswith("m ")


def test_without_its_store_a_run_says_what_is_missing(finished, tmp_path):
    for name in ("mosaic.tif", "metrics.json", "shots.geojson", "cameras.json"):
        shutil.copy(finished.output / name, tmp_path)
    opened = skyquilt.open_run(tmp_path)
    assert len(opened.poses) == 9
    with pytest.raises(UsageError, match="make the map again"):
        _ = opened.observations
    with pytest.raises(UsageError, match="no finished run"):
        skyquilt.open_run(tmp_path / "nowhere")


def test_observations_are_those_of_the_map_whatever_the_clock_says(finished, tmp_path):
    """A clock set back between two runs makes an older alignment the newer file."""
    folder = shutil.copytree(finished.output, tmp_path / "run")
    store = Store(folder=folder / ".skyquilt" / "store", registry=REGISTRY)
    made = store.get(STAGE, NAME)
    own = store.get("alignment", made.alignment)
    poses = {i: replace(p, map_C=p.map_C + 7.0) for i, p in own.poses.items()}
    other = replace(own, poses=poses, ties=replace(own.ties, xyz=own.ties.xyz + 7.0))
    store.put("alignment", "f" * 32, other)
    expected = skyquilt.open_run(finished.output).observations
    assert np.array_equal(skyquilt.open_run(folder).observations.points, expected.points)
    store.put(STAGE, NAME, replace(made, alignment="f" * 32))
    with pytest.raises(UsageError, match="not those of the map"):
        _ = skyquilt.open_run(folder).observations


def test_what_notebooks_show_is_short_and_holds_a_map(run, finished, flight):
    result, survey = finished.events[-1], skyquilt.read_survey(flight / "photos")
    for thing in (run, result, survey):
        assert len(repr(thing)) < 300 and "9" in repr(thing)
        html = thing._repr_html_()
        assert html.count("<div") == html.count("</div") == 1 and len(html) < 400_000
    assert "data:image/png" in result._repr_html_() and "<svg" in survey._repr_html_()


def test_other_programs_find_times_and_colours(finished):
    shots, points = (finished.json("reconstruction.json")[0][k] for k in ("shots", "points"))
    times = [s["capture_time"] for s in shots.values()]
    assert len(set(times)) == 9 and min(times) > 1e9
    colours = np.array([p["color"] for p in points.values()])
    assert (colours == 128).all(1).mean() < 0.1 and colours.std(0).min() > 5
    listed = [f["properties"]["capture_time"] for f in finished.json("shots.geojson")["features"]]
    assert sorted(listed) == sorted(times)


def test_notebooks_are_legible_in_light_and_dark(finished, flight):
    """Every colour that is drawn has a contrast of 3 (WCAG 1.4.11) on white and on dark paper;
    text takes the notebook's own colour, and what is not text has a name.
    """
    for thing in (skyquilt.open_run(finished.output), skyquilt.read_survey(flight / "photos")):
        html = thing._repr_html_()
        colours = set(re.findall(r'(?:fill|stroke)="(#[0-9a-f]+)"', html))
        for colour in colours:
            digits = colour[1:] if len(colour) == 7 else "".join(c * 2 for c in colour[1:])
            shares = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
            light = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in shares]
            y = 0.2126 * light[0] + 0.7152 * light[1] + 0.0722 * light[2]
            for paper in (1.0, 0.0056):  # white, and the #111 of dark notebooks
                low, high = sorted((y, paper))
                assert (high + 0.05) / (low + 0.05) >= 3, colour
        assert "color:" not in html and "background" not in html
        pictures = re.findall(r"<(?:img|svg|table)[^>]*>", html)
        assert len(pictures) == 2
        assert all("alt=" in p or "aria-label=" in p for p in pictures)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"gsd_m": 0}, "gsd_m is 0"),
        ({"gsd_m": -1}, "gsd_m is -1"),
        ({"gsd_m": float("nan")}, "gsd_m is nan"),
        ({"gsd_m": "1"}, "gsd_m is '1'"),
        ({"bounds": (1, 2, 3)}, "bounds has 3 values"),
        ({"bounds": (1, 2, float("nan"), 4)}, "bounds are .*nan"),
        ({"bounds": (5, 5, 1, 1)}, "nothing within"),
    ],
)
def test_a_part_that_cannot_be_meant_is_refused(run, asked, words):
    with pytest.raises(UsageError, match=words):
        run.raster(**asked)
