"""Options and side files that do not fit: refused in one sentence before anything is lost."""

import json
import os
import subprocess
import sys

import pytest
import rasterio
from pyproj import Transformer

from tests.end_to_end.conftest import QUICK, keep, named, relabel, skyquilt

pytestmark = pytest.mark.filterwarnings(
    "error::RuntimeWarning", "error::scipy.linalg.LinAlgWarning"
)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ("--method", "magic"),
            ("--method 'magic'", "auto, bundle, position, pose, image, hybrid, flightline"),
        ),
        (
            ("--transform", "shear"),
            ("--transform 'shear'", "translation, similarity, affine, homography"),
        ),
        (("--image-search", "all"), ("--image-search 'all'", "chain, loop, overview")),
        (("--optimiser", "luck"), ("--optimiser 'luck'", "anneal, surfaces")),
        (("--lines", "eye"), ("--lines 'eye'", "heading, distance")),
        (("--max-view-angle", "91"), ("--max-view-angle 91", "outside 1 to 90")),
        (("--max-view-angle", "0"), ("--max-view-angle 0", "outside 1 to 90")),
        (("--max-view-angle", "-1"), ("--max-view-angle -1", "outside 1 to 90")),
        (("--max-view-angle", "nan"), ("--max-view-angle nan", "outside 1 to 90")),
        (("--shutter", "slow"), ("--shutter 'slow'", "global, rolling")),
        (("--shutter-readout", "0"), ("--shutter-readout 0", "at most 1000 ms")),
        (("--shutter-readout", "-30"), ("--shutter-readout -30", "more than 0")),
        (("--shutter-readout", "10000"), ("--shutter-readout 10000", "at most 1000 ms")),
        (("--shutter-readout", "nan"), ("--shutter-readout nan", "at most 1000 ms")),
        (("--shutter", "global", "--shutter-readout", "30"), ("--shutter global has no readout",)),
        (("--vertical-datum", "moon"), ("--vertical-datum 'moon'", "ellipsoid, egm96, takeoff")),
        (("--lever-arm", "1,2"), ("--lever-arm", "right,forward,up")),
        (("--lever-arm", "1,2,99"), ("--lever-arm 99", "outside -20 to 20")),
        (
            ("--method", "pose", "--vertical-datum", "egm96"),
            ("--vertical-datum is for --method auto or bundle", "pose"),
        ),
        (("--alpha", "1.5"), ("--alpha 1.5", "outside 0 to 1")),
        (("--alpha", "-0.1"), ("--alpha -0.1", "outside 0 to 1")),
        (("--alpha", "nan"), ("--alpha",)),
        (("--method", "image", "--relief", "-1"), ("--relief", "outside")),
        (("--relief", "3"), ("--relief is for --method image", "auto")),
        (
            ("--method", "pose", "--transform", "affine"),
            ("--transform is for --method image or flightline", "pose"),
        ),
        (("--seed", "-1"), ("--seed", "outside")),
        (("--blend", "soft"), ("--blend 'soft'", "feather", "multiband")),
        (("--compress", "zip"), ("--compress 'zip'", "jpeg", "zstd")),
        (("--surface", "lidar"), ("--surface", "auto, dense, sweep, ties")),
        (("--distortion", "9"), ("--distortion", "6t")),
        (("--bounds", "1,2,3"), ("--bounds", "four numbers", "1,2,3")),
        (("--bounds", "a,b,c,d"), ("--bounds", "four numbers")),
        (("--bounds", "nan,2,3,4"), ("--bounds",)),
        (("--bounds", "1,2,inf,4"), ("--bounds",)),
        (("--bounds", "3,2,1,4"), ("--bounds", "west < east")),
        (("--gsd", "0"), ("--gsd", "outside")),
        (("--gsd", "-5"), ("--gsd", "outside")),
        (("--gsd", "0.0001"), ("--gsd", "outside")),
        (("--gsd", "nan"), ("--gsd",)),
        (("--memory", "0.1"), ("--memory", "outside")),
        (("--memory", "nan"), ("--memory",)),
        *(
            (("--max-memory", value), ("--max-memory", "outside 0.1 to"))
            for value in ("nan", "inf", "-inf", "1e308", "0", "-1")
        ),
        (("--jobs", "-1"), ("--jobs", "outside")),
        (("--quality", "0"), ("--quality", "outside")),
        (("--features", "1"), ("--features", "outside")),
        (("--feather", "-3"), ("--feather", "outside")),
        (("--feather", "nan"), ("--feather",)),
        (("--heading", "nan"), ("--heading",)),
        (("--rerun-from", "tea"), ("--rerun-from 'tea'", "links", "report")),
        (("--quiet", "--json"), ("exclude one another",)),
        (("--crs", "nonsense"), ("--crs 'nonsense'", "EPSG:32633")),
        (("--crs", "EPSG:4326"), ("--crs", "WGS 84", "projected in metres")),
        (("--crs", "EPSG:2277"), ("--crs", "projected in metres")),
        (("--crs", "EPSG:32733999"), ("--crs", "coordinate system")),
    ],
)
def test_a_wrong_option(mosaic, flight, options, words):
    told = mosaic(flight / "photos", *options).refused(2, *words)
    assert not told.output.exists()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"focal": "NaN"}, "'focal'"),
        ({"focal": "-0.8"}, "no positive focal length"),
        ({"k1": "1e308"}, "'k1' is 1e+308"),
        ({"k1": "Infinity"}, "'k1'"),
        ({"width": "400", "height": "400"}, "the photos are by"),
    ],
)
def test_a_calibration_that_cannot_be(mosaic, flight, tmp_path, changed, words):
    record = {"width": "1600", "height": "1200", "focal": "0.85"} | changed
    body = ", ".join(f'"{name}": {value}' for name, value in record.items())
    (tmp_path / "cameras.json").write_text(f'{{"all": {{{body}}}}}')
    told = mosaic(flight / "photos", "--cameras", tmp_path / "cameras.json")
    assert not told.refused(6, "cameras.json", words).output.exists()


@pytest.mark.parametrize("words", [("--gsd", "wide"), ("--nonsense",), ("--jobs", "two"), ()])
def test_usage_errors_end_with_2(flight, tmp_path, words):
    code, _, err = skyquilt(
        "mosaic", flight / "photos", *(["-o", tmp_path / "out"] if words else []), *words
    )
    assert code == 2
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_wrong_option_does_not_cost_the_results_it_would_have_replaced(mosaic, flight):
    output = mosaic(flight / "photos").made().output
    before = (output / "mosaic.tif").read_bytes()
    told = mosaic(flight / "photos", "--crs", "nonsense", "--overwrite")
    assert told.code == 2
    assert (output / "mosaic.tif").read_bytes() == before
    told = mosaic(flight / "photos", "--gcp", output / "nowhere.txt", "--overwrite")
    assert told.code == 2
    assert (output / "mosaic.tif").read_bytes() == before


@pytest.mark.slow
def test_gsd_far_finer_than_the_photos(mosaic, flight):
    mosaic(flight / "photos", "--gsd", "0.1").refused(2, "--gsd 0.1", "times finer than the photos")


@pytest.mark.slow
def test_gsd_coarser_than_the_map(mosaic, flight):
    told = mosaic(flight / "photos", "--gsd", "9000").made()
    assert told.metrics["size_px"] == pytest.approx([2, 2], abs=1)


@pytest.mark.slow
def test_bounds_outside_the_map(mosaic, flight):
    told = mosaic(flight / "photos", "--bounds", "1,2,3,4").refused(
        2, "--bounds 1,2,3,4", "outside the photos", "which cover 44"
    )
    assert "EPSG:32633" in told.err


@pytest.mark.slow
def test_a_boundary_narrower_than_a_pixel(mosaic, flight, finished, tmp_path):
    """Else the map would be empty."""
    with rasterio.open(finished / "mosaic.tif") as whole:
        (x, y), crs = whole.xy(whole.height // 2, whole.width // 2), whole.crs
    ring = Transformer.from_crs(crs, 4326, always_xy=True)
    area = square(*ring.transform(x, y), *ring.transform(x + 0.003, y + 4.0))
    (tmp_path / "area.geojson").write_text(area)
    told = mosaic(flight / "photos", "--boundary", tmp_path / "area.geojson")
    told.refused(6, "--boundary", "narrower than one pixel")


@pytest.mark.slow
def test_bounds_that_cut_the_map(mosaic, flight, finished):
    with rasterio.open(finished / "mosaic.tif") as whole:
        west, south, east, north = whole.bounds
    x, y = (west + east) / 2, (south + north) / 2
    told = mosaic(flight / "photos", "--bounds", f"{x - 15},{y - 15},{x + 15},{y + 15}").made()
    assert told.metrics["size_px"] == pytest.approx([100, 100], abs=2)


@pytest.mark.slow
@pytest.mark.parametrize("side", [0.1, 1.0])
def test_bounds_of_some_pixels(mosaic, flight, finished, side):
    """Most photos show none of so small a map."""
    with rasterio.open(finished / "mosaic.tif") as whole:
        x, y = (round(v) for v in whole.xy(whole.height // 2, whole.width // 2))
    told = mosaic(flight / "photos", "--bounds", f"{x},{y},{x + side},{y + side}", "--gsd", "10")
    wanted = [round(side / 0.1)] * 2
    assert told.made().metrics["size_px"] == pytest.approx(wanted, abs=1)


@pytest.mark.slow
def test_little_memory_is_enough(mosaic, flight):
    told = mosaic(flight / "photos", "--memory", "0.5").made()
    assert told.metrics["photos_used"] == 9


# side files


def line(text, number, new):
    lines = text.splitlines()
    lines[number] = new
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda t: "", ("gcp.txt has 0 lines", "coordinate system")),
        (lambda t: line(t, 0, "Middle Earth"), ("gcp.txt", "coordinate system", "Middle Earth")),
        (lambda t: line(t, 2, "1 2 three"), ("gcp.txt, line 3", "expected", "1 2 three")),
        (lambda t: t.replace("SIM_", "DJI_"), ("gcp.txt", "no photo of the survey", "DJI_")),
        (lambda t: "\0\1\2" * 50, ("gcp.txt", "not a text file")),
    ],
)
def test_a_malformed_gcp_list(mosaic, flight, tmp_path, spoil, words):
    (tmp_path / "gcp.txt").write_text(spoil((flight / "gcp_list.txt").read_text()))
    told = mosaic(flight / "photos", "--gcp", tmp_path / "gcp.txt").refused(6, *words)
    assert not told.output.exists()


@pytest.mark.slow
def test_a_gcp_list_that_names_some_unknown_photos(mosaic, flight, tmp_path):
    text = (flight / "gcp_list.txt").read_text()
    (tmp_path / "gcp.txt").write_text(text.replace("SIM_0005.jpg", "DJI_0777.JPG"))
    told = mosaic(flight / "photos", "--gcp", tmp_path / "gcp.txt").made()
    assert "DJI_0777.JPG" in told.notes


@pytest.mark.parametrize("option", ["--gcp", "--geo", "--cameras", "--boundary"])
def test_a_side_file_that_does_not_exist(mosaic, flight, tmp_path, option):
    told = mosaic(flight / "photos", option, tmp_path / "nowhere.json").refused(2, "nowhere.json")
    assert not told.output.exists()


def test_a_malformed_geo_txt(mosaic, flight, tmp_path):
    (tmp_path / "geo.txt").write_text("EPSG:4326\nSIM_0001.jpg fourteen 46.6\n")
    mosaic(flight / "photos", "--geo", tmp_path / "geo.txt").refused(
        6, "geo.txt, line 2", "expected"
    )
    (tmp_path / "geo.txt").write_text("EPSG:4326\nDJI_0001.jpg 14.3 46.6\n")
    mosaic(flight / "photos", "--geo", tmp_path / "geo.txt").refused(6, "geo.txt")


def test_a_malformed_cameras_json(mosaic, flight, tmp_path):
    (tmp_path / "cameras.json").write_text("{ not json")
    mosaic(flight / "photos", "--cameras", tmp_path / "cameras.json").refused(6, "cameras.json")


def square(west, south, east, north):
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return json.dumps({"type": "Polygon", "coordinates": [ring]})


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("area.geojson", "{ nonsense", ("area.geojson", "not a readable")),
        (
            "area.geojson",
            '{"type": "Point", "coordinates": [14.3, 46.6]}',
            ("at least one polygon", "Point"),
        ),
        ("area.docx", "hello", ("a boundary is one of", ".geojson")),
        pytest.param(
            "area.geojson",
            square(10, 40, 11, 41),
            ("--boundary", "outside the photos", "which cover"),
            marks=pytest.mark.slow,
            id="elsewhere",
        ),
    ],
)
def test_a_boundary_that_cannot_be_used(mosaic, flight, tmp_path, name, content, words):
    (tmp_path / name).write_text(content)
    mosaic(flight / "photos", "--boundary", tmp_path / name).refused(6, *words)


def test_a_boundary_without_positions(mosaic, photos, tmp_path):
    for path in named(photos):
        relabel(path, strip=True)
    (tmp_path / "area.geojson").write_text(square(14, 46, 15, 47))
    mosaic(photos, "--boundary", tmp_path / "area.geojson").refused(2, "--boundary", "no positions")


# ways of telling


@pytest.mark.slow
def test_json_is_one_object_per_line(mosaic, photos):
    keep(photos, 0, 1, 2)
    told = mosaic(photos, "--json").made()
    names = [e["event"] for e in told.events]
    assert names[-1] == "Result"
    assert {"StageStarted", "StageProgress", "StageFinished"} <= set(names)
    stages = [e["stage"] for e in told.events if e["event"] == "StageFinished"]
    assert stages == [
        "features",
        "links",
        "align",
        "surface",
        "balance",
        "seams",
        "mosaic",
        "measure",
        "report",
    ]
    assert told.events[-1]["metrics"]["photos_used"] == 3
    assert told.err == ""


@pytest.mark.slow
def test_json_has_no_values_that_json_does_not_know(mosaic, photos):
    for path in named(photos):
        relabel(path, strip=True)
    told = mosaic(photos, "--json").made()
    for text in told.out.splitlines():
        json.loads(text, parse_constant=lambda word: pytest.fail(word))


@pytest.mark.slow
def test_quiet_is_silent(mosaic, photos):
    for path in keep(photos, 0, 1, 2):
        relabel(path, strip=True)
    told = mosaic(photos, "--quiet").made()
    assert (told.out, told.err) == ("", "")


def test_an_error_in_json_mode_goes_to_standard_error(mosaic, tmp_path):
    told = mosaic(tmp_path / "nowhere", "--json").refused(2, "does not exist")
    assert told.out == ""


@pytest.mark.slow
def test_paths_are_never_broken_over_lines(mosaic, flight, tmp_path):
    output = tmp_path / ("very " * 20 + "long name")
    told = mosaic(flight / "photos", output=output).made()
    assert f"map:    {output / 'mosaic.tif'}" in told.out.splitlines()


@pytest.mark.slow
def test_the_module_runs_and_a_reader_that_leaves_is_no_error(flight, tmp_path):
    """`skyquilt mosaic --json | head -1`."""
    words = [
        sys.executable,
        "-m",
        "skyquilt",
        "mosaic",
        str(flight / "photos"),
        "-o",
        str(tmp_path / "out"),
        "--json",
        *QUICK,
    ]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=dict(os.environ)
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.readline()
    process.stdout.close()
    err = process.stderr.read().decode()
    process.wait(60)
    assert "Traceback" not in err


@pytest.mark.slow
def test_a_mistake_of_the_program_is_not_hidden(mosaic, flight, monkeypatch):
    from skyquilt.workflows import mosaic as workflow

    def broken(*args, **words):
        raise ZeroDivisionError("by nobody")

    monkeypatch.setattr(workflow, "figures", broken)
    with pytest.raises(ZeroDivisionError):
        mosaic(flight / "photos")
