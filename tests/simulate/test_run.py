"""A small survey, written whole: same seed same bytes, metadata as reported, pictures as the
orthophoto.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.transform import rowcol
from typer.testing import CliRunner

from skyquilt.cli.main import app
from skyquilt.errors import OutputError
from skyquilt.simulate import preset, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Reporting, Route, Thermal


def settings(**changes):
    thermal = Thermal()
    small = replace(
        preset("default"),
        lens=Lens().scaled(400, 300),
        route=Route(photos=6, overlap=0.6),
        control=Control(points=3, checks=2),
        reporting=Reporting(yaw_lie="turned"),
        thermal=replace(thermal, lens=thermal.lens.scaled(160, 128)),
    )
    return replace(small, **changes)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    out = tmp_path_factory.mktemp("survey") / "out"
    stages = {event.stage for event in simulate(settings(), out)}
    assert stages == {"terrain", "photos", "thermal terrain", "thermal", "truth"}
    return out


@pytest.fixture(scope="module")
def truth(survey):
    return json.loads((survey / "truth" / "truth.json").read_text())


def camera_of(truth, photo) -> Lens:
    c = truth["cameras"][photo["camera"]]
    keys = ("width", "height", "focal", "k1", "k2", "k3", "p1", "p2")
    x, y = c["cx"] - (c["width"] - 1) / 2, c["cy"] - (c["height"] - 1) / 2
    return Lens(offset_x=x, offset_y=y, **{key: c[key] for key in keys})


def project(truth, photo, points):
    return camera_of(truth, photo).project(
        points, np.array(photo["cam_R_map"]), np.array(photo["position"])
    )


@pytest.mark.slow
def test_same_seed_same_bytes(survey, tmp_path):
    list(simulate(settings(), tmp_path / "again"))
    files = [path.relative_to(survey) for path in sorted(survey.rglob("*")) if path.is_file()]
    assert len(files) > 12
    for path in files:
        assert (survey / path).read_bytes() == (tmp_path / "again" / path).read_bytes(), path


def test_files_say_what_was_reported(survey, truth):
    for photo in truth["photos"]:
        reported = photo["reported"]
        image = Image.open(survey / photo["file"])
        exif = image.getexif()
        gps, ifd = exif.get_ifd(0x8825), exif.get_ifd(0x8769)
        degrees = [sum(float(v) / 60**i for i, v in enumerate(gps[tag])) for tag in (2, 4)]
        assert degrees == pytest.approx([reported["latitude"], reported["longitude"]], abs=2e-9)
        assert float(gps[6]) == pytest.approx(reported["sea_level"], abs=1e-3)
        focal = float(ifd[0x920A]) / 10 * float(ifd[0xA20E])
        assert focal == pytest.approx(reported["focal"], abs=0.05)
        assert focal == pytest.approx(1.01 * truth["cameras"][photo["camera"]]["focal"], abs=0.05)
        xmp = image.info.get("xmp") or exif[700]
        for key in ("RelativeAltitude", "GimbalYawDegree", "GpsLatitude"):
            assert f"drone-dji:{key}=".encode() in xmp
        assert f'GimbalPitchDegree="{reported["gimbal"][1]:+.2f}"'.encode() in xmp


def test_photo_colours_are_those_of_the_orthophoto(survey, truth):
    with rasterio.open(survey / "truth" / "truth_ortho.tif") as ortho:
        colours, transform = ortho.read(), ortho.transform
        assert ortho.crs.to_string() == truth["crs"]
    with rasterio.open(survey / "truth" / "truth_surface.tif") as surface:
        heights = surface.read(1)
    rng = np.random.default_rng(0)
    for photo in (p for p in truth["photos"] if p["band"] == "visible"):
        pixels = np.asarray(Image.open(survey / photo["file"])).astype(float)
        xy = np.array(photo["position"][:2]) + rng.uniform(-18, 18, (800, 2))
        rows, cols = (np.array(v) for v in rowcol(transform, xy[:, 0], xy[:, 1]))
        inside = (rows >= 0) & (cols >= 0) & (rows < heights.shape[0]) & (cols < heights.shape[1])
        rows, cols = rows[inside], cols[inside]
        x, y = transform.c + (cols + 0.5) * transform.a, transform.f + (rows + 0.5) * transform.e
        centres = np.column_stack([x, y, heights[rows, cols]])
        at = np.round(project(truth, photo, centres)).astype(int)
        seen = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < 400) & (at[:, 1] < 300)
        radius = ((at[seen] - [199.5, 149.5]) ** 2).sum(axis=1) / (199.5**2 + 149.5**2)
        found = (
            pixels[at[seen, 1], at[seen, 0]] / (photo["exposure"] * (1 - 0.15 * radius))[:, None]
        )
        true = colours[:, rows[seen], cols[seen]].T
        assert seen.sum() > 300
        assert np.median(np.abs(found - true)) < 8
        assert np.corrcoef(found.ravel(), true.ravel())[0, 1] > 0.85


def test_control_points(survey, truth):
    lines = (survey / "gcp_list.txt").read_text().splitlines()
    assert lines[0] == "EPSG:32633"
    by_name = {photo["name"]: photo for photo in truth["photos"]}
    true = {p["name"]: p["true"] for p in truth["control_points"]}
    errors = []
    for line in lines[1:]:
        words = line.split("\t")
        pixel = project(truth, by_name[words[5]], np.array([true[words[6]]]))[0]
        errors.append(pixel - np.array(words[3:5], dtype=float))
        assert (len(words) == 8 and words[7] == "check") == words[6].startswith("chk")
        assert np.abs(np.array(words[:3], dtype=float) - true[words[6]]).max() < 0.1
    assert len(errors) >= 8
    assert 0.15 < np.std(errors) < 0.5


def test_thermal_frames(survey, truth):
    frames = [p for p in truth["photos"] if p["band"] == "thermal"]
    assert len(frames) >= 4
    kelvin = np.asarray(Image.open(survey / frames[0]["file"])) / 100
    assert kelvin.shape == (128, 160)
    assert 278 < kelvin.min() < kelvin.max() < 345
    with rasterio.open(survey / "truth" / "truth_thermal.tif") as raster:
        assert raster.tags()["UNIT"] == "centikelvin"


def test_a_used_folder_is_refused(survey, tmp_path):
    with pytest.raises(OutputError, match="--overwrite"):
        next(simulate(settings(), survey))
    (tmp_path / "photos").mkdir()
    (tmp_path / "mine.txt").write_text("keep")
    list(simulate(settings(thermal=None, route=Route(photos=2)), tmp_path, overwrite=True))
    assert (tmp_path / "mine.txt").exists()
    assert len(list((tmp_path / "photos").iterdir())) == 2
    assert not (tmp_path / ".scratch").exists()


@pytest.mark.parametrize("name", ["a file", "a file/below", "a link", "a link/below"])
def test_a_folder_that_cannot_be_made_is_refused_in_plain_words(tmp_path, name):
    """They were the system's: "File exists", "Not a directory"."""
    (tmp_path / "a file").write_text("mine")
    (tmp_path / "a link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="a (file is a file|link is a link that leads nowhere);"):
        next(simulate(settings(thermal=None, route=Route(photos=2)), tmp_path / name))


@pytest.mark.slow
def test_command_with_every_option(tmp_path):
    words = """--preset demo --photos 6 --overlap 70 --sidelap 50 --height 70 --heading 75
    --size 240x180 --gps-noise 1 --gps-missing 1 --yaw-lie tag --altitude-drift 20 --focal-error 2
    --compass-error 12 --gimbal-error -1
    --tilt-noise 0.5 --relief 3 --season winter --hour 12 --exposure-noise 0.1 --motion-blur 2
    --vignetting 30 --sun-hours 1 --fires 2
    --no-thermal --drones 2 --lose 1 --gcp 2 --checks 1 --seed 4"""
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "out"), *words.split()])
    assert result.exit_code == 0, result.output
    truth = json.loads((tmp_path / "out" / "truth" / "truth.json").read_text())
    assert len(truth["photos"]) == 5
    assert {p["drone"] for p in truth["photos"]} == {0, 1}
    assert truth["seed"] == 4
    assert sum(p["reported"]["latitude"] is None for p in truth["photos"]) == 1
    assert [p["check"] for p in truth["control_points"]] == [False, False, True]


def test_chessboard_and_no_focal(tmp_path):
    words = (
        "--terrain chessboard --relief 0 --photos 2 --size 200x150 --no-focal --gcp 0 --checks"
        " 0 --quiet"
    )
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "out"), *words.split()])
    assert result.exit_code == 0, result.output
    exif = Image.open(tmp_path / "out" / "photos" / "SIM_0001.jpg").getexif()
    assert 0x920A not in exif.get_ifd(0x8769)
    assert not (tmp_path / "out" / "gcp_list.txt").exists()
