"""Registration as a user meets it: files in, files out, refusals with their exit code."""

import json
import sys
from unittest import mock

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin

from skyquilt.cli.main import run
from skyquilt.coregistration.files import CONTRACT, OVERLAYS
from skyquilt.coregistration.workflow import iter_register, register
from skyquilt.errors import OutputError, RefusedError, UsageError
from tests.coregistration.scenes import error, layout, pair, spectrum, turned
from tests.photos.conftest import with_segment

SHAPE = (240, 288)
TRUTH = turned(0.95, 21.0, SHAPE, SHAPE, (6.0, -9.0))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    a, b = pair(TRUTH, SHAPE, seed=12, shape_a=SHAPE)
    cv2.imwrite(str(folder / "a.jpg"), a, [cv2.IMWRITE_JPEG_QUALITY, 95])
    cv2.imwrite(str(folder / "b.png"), b)
    other = np.clip(spectrum(layout(*SHAPE, seed=77), 5), 0, 255).astype(np.uint8)
    cv2.imwrite(str(folder / "other.png"), other)
    return folder, a, b


@pytest.fixture(scope="module")
def done(files, tmp_path_factory):
    folder, _, _ = files
    output = tmp_path_factory.mktemp("result") / "out"
    return output, register(folder / "a.jpg", folder / "b.png", output).metrics


def command(*words):
    """Exit code and what went to standard error."""
    with (
        mock.patch.object(sys, "argv", ["skyquilt", *map(str, words)]),
        pytest.raises(SystemExit) as end,
    ):
        run()
    return end.value.code


def test_the_record_tells_the_transform(done):
    output, record = done
    assert json.loads((output / "registration.json").read_text()) == record
    assert record["accepted"] and record["model"] == "similarity" and record["reason"] == ""
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    assert record["inliers"] == record["evidence"]["patches_agreeing"] >= 9
    assert 0.2 < record["q"] <= 1 and 0 < record["residual_px"] < 2
    assert (
        error(np.array(record["b_H_a"]), TRUTH, SHAPE) < record["error_px"] < record["tolerance_px"]
    )
    assert max(c[2] for c in record["error_corners"]) == record["error_px"]
    assert record["valid_area"]["share"] == 1 and len(record["valid_area"]["polygon"]) >= 4
    assert sorted(p.name for p in output.iterdir()) == sorted(CONTRACT)


def test_b_lies_on_a(done, files):
    """Against OpenCV's warp by the truth: what is valid is right, and nearly all of the overlap is
    valid.
    """
    output, _ = done
    _, a, b = files
    with rasterio.open(output / "b_on_a.tif") as raster:
        assert raster.shape == a.shape and raster.dtypes == ("uint8",)
        found, valid = raster.read(1).astype(float), raster.read_masks(1) > 0
    size = (a.shape[1], a.shape[0])
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    expected = cv2.warpPerspective(b.astype(np.float32), TRUTH, size, flags=flags)
    inside = cv2.warpPerspective(np.ones(b.shape, np.float32), TRUTH, size, flags=flags) > 0.999
    assert (valid == inside).mean() > 0.99
    assert np.corrcoef(found[valid & inside], expected[valid & inside])[0, 1] > 0.99


def test_the_virtual_raster_shows_b_in_its_place(done, files):
    output, _ = done
    _, _, b = files
    with rasterio.open(output / "b.vrt") as raster:
        assert (raster.read(1) == b).all()
        points, _ = raster.gcps
    assert len(points) == 36
    for p in points[::7]:
        there = TRUTH @ [p.x - 0.5, -p.y - 0.5, 1]
        assert (
            np.hypot(there[0] / there[2] - (p.col - 0.5), there[1] / there[2] - (p.row - 0.5)) < 0.6
        )


def test_pictures_and_page(done):
    output, _ = done
    for name in OVERLAYS:
        picture = cv2.imread(str(output / name))
        assert picture is not None and picture.std() > 10, name
    page = (output / "report.html").read_text()
    assert page.count("<img") == 5 and "accepted" in page and 'src="http' not in page
    assert "b.png on a.jpg" in page


@pytest.mark.slow
def test_a_refusal_is_written_down_and_has_its_exit_code(files, tmp_path, capsys):
    folder, _, _ = files
    output = tmp_path / "out"
    assert command("register", folder / "a.jpg", folder / "other.png", "-o", output, "--quiet") == 7
    said = capsys.readouterr().err
    assert (
        said.startswith("skyquilt: refused: the best position found is not confirmed")
        and said.count("\n") == 1
    )
    record = json.loads((output / "registration.json").read_text())
    assert not record["accepted"] and record["b_H_a"] is None and record["q"] == 0
    assert record["reason"] in said and record["evidence"]["surprise"] < 5
    assert sorted(p.name for p in output.iterdir()) == ["registration.json", "report.html"]
    assert "Refused" in (output / "report.html").read_text()


def test_an_error_larger_than_tolerated_is_a_refusal(files, tmp_path, capsys):
    folder, _, _ = files
    output = tmp_path / "out"
    words = (folder / "a.jpg", folder / "b.png", "-o", output, "--quiet", "--tolerance", "0.2")
    assert command("register", *words) == 7
    said = capsys.readouterr().err
    record = json.loads((output / "registration.json").read_text())
    assert "0.2 px are tolerated" in said and record["reason"] in said
    assert not record["accepted"] and record["error_px"] > 0.2 == record["tolerance_px"]
    assert record["valid_area"]["share"] < 1 and sorted(p.name for p in output.iterdir()) == [
        "registration.json",
        "report.html",
    ]


def test_the_error_map_lies_on_a(done, files):
    output, record = done
    _, a, _ = files
    with rasterio.open(output / "error.tif") as raster:
        bound = raster.read(1)
        assert np.isnan(raster.nodata) and max(raster.shape) == 128
        assert raster.transform.a * raster.width == pytest.approx(a.shape[1], rel=0.01)
    inside = np.isfinite(bound)
    assert 0.5 < inside.mean() < 1
    assert 0 < bound[inside].min() < bound[inside].max() <= record["error_px"]


@pytest.mark.slow
def test_a_picture_on_itself_is_the_identity_and_said_so(files, tmp_path):
    folder, _, _ = files
    record = register(folder / "b.png", folder / "b.png", tmp_path / "out").metrics
    assert record["accepted"] and record["model"] == "identity"
    assert record["b_H_a"] == np.eye(3).tolist() and record["error_px"] == 0
    assert "same picture" in record["reason"]


def test_a_blank_picture_on_itself_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "x.png"), np.full(SHAPE, 128, np.uint8))
    record = register(tmp_path / "x.png", tmp_path / "x.png", tmp_path / "out").metrics
    assert not record["accepted"] and "blank or saturated" in record["reason"]


def dji_jpeg(path, counts, cut=0):
    """A DJI radiometric JPEG: counts in APP3 segments; the last `cut` bytes of them are lost."""
    import piexif
    from PIL import Image

    from tests.photos.conftest import jpeg_bytes

    grey = cv2.normalize(counts, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    exif = {
        "0th": {piexif.ImageIFD.Make: "DJI", piexif.ImageIFD.Model: "MAVIC2-ENTERPRISE-ADVANCED"}
    }
    data = jpeg_bytes(np.asarray(Image.fromarray(grey).convert("RGB")), exif)
    raw = counts.astype("<u2").tobytes()
    raw = raw[: len(raw) - cut]
    for start in reversed(range(0, len(raw), 60000)):
        data = with_segment(data, 0xE3, raw[start : start + 60000])
    path.write_bytes(data)


@pytest.mark.slow
def test_radiometric_photos_are_registered_by_their_counts(tmp_path):
    truth = turned(1.0, 30.0, (512, 640), (512, 640))
    labels = layout(512, 640, seed=3)
    a = np.clip(spectrum(labels, 1), 0, 255).astype(np.uint8)
    b = cv2.warpPerspective(20000 + 10 * spectrum(labels, 2), truth, (640, 512), borderValue=20000)
    cv2.imwrite(str(tmp_path / "a.png"), a)
    dji_jpeg(tmp_path / "b.jpg", b)
    record = register(tmp_path / "a.png", tmp_path / "b.jpg", tmp_path / "out").metrics
    assert record["accepted"] and error(np.array(record["b_H_a"]), truth, (512, 640)) < 0.5
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        values = raster.read(1)
        assert raster.dtypes == ("float32",) and np.isnan(raster.nodata)
    assert 19_900 < np.nanmin(values) < np.nanmax(values) < 22_700  # counts, not the palette
    assert not (tmp_path / "out" / "b.vrt").exists()  # it would show the palette


def test_corrupt_files_are_refused_with_their_reason(files, tmp_path):
    folder, _, _ = files
    dji_jpeg(tmp_path / "cut.jpg", np.full((512, 640), 9000.0), cut=5000)
    data = (tmp_path / "cut.jpg").read_bytes()
    (tmp_path / "torn.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.jpg").write_text("no picture")
    cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((16, 20), np.uint8))
    for name in ("cut.jpg", "torn.jpg", "text.jpg", "tiny.png"):
        record = register(folder / "a.jpg", tmp_path / name, tmp_path / f"out-{name}").metrics
        assert not record["accepted"] and record["reason"], name
        assert "picture B" in record["reason"], name


def write_map(path, values, transform, crs="EPSG:32633"):
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=values.shape[1],
        height=values.shape[0],
        count=1,
        dtype=values.dtype,
        transform=transform,
        crs=crs,
    ) as raster:
        raster.write(values, 1)


@pytest.fixture
def maps(tmp_path):
    """Two maps of one place: A of 0.5 m a pixel, B of 0.8 m, whose georeference is 6 m off."""
    labels = layout(400, 480, seed=21)
    a = np.clip(spectrum(labels, 1), 1, 255).astype(np.uint8)
    size_b = (300, 250)
    b_H_a = np.array([[0.625, 0, (0.625 - 1) / 2], [0, 0.625, (0.625 - 1) / 2], [0, 0, 1.0]])
    b = cv2.warpPerspective(spectrum(labels, 2), b_H_a, size_b, flags=cv2.INTER_AREA).astype(
        np.float32
    )
    write_map(tmp_path / "a.tif", a, from_origin(500_000, 5_000_000, 0.5, 0.5))
    write_map(tmp_path / "b.tif", b, from_origin(500_006, 4_999_998, 0.8, 0.8))
    return tmp_path, a, b, b_H_a


@pytest.mark.slow
def test_maps_are_registered_by_their_places_and_stay_georeferenced(maps):
    folder, a, _, b_H_a = maps
    result = register(folder / "a.tif", folder / "b.tif", folder / "out").metrics
    assert result["accepted"] and result["guess"] == "the places of both maps"
    assert error(np.array(result["b_H_a"]), b_H_a, a.shape) < 0.5
    with (
        rasterio.open(folder / "out" / "b_on_a.tif") as raster,
        rasterio.open(folder / "a.tif") as reference,
    ):
        assert raster.crs == reference.crs and raster.transform == reference.transform
        assert raster.shape == reference.shape
    with rasterio.open(folder / "out" / "b.vrt") as raster:
        points, crs = raster.gcps
        assert crs.to_epsg() == 32633
        first = next(p for p in points if p.col < 1 and p.row < 1)
        place = Affine(0.5, 0, 500_000, 0, -0.5, 5_000_000) @ (
            0.8,
            0.8,
        )  # b's first pixel's middle, on a
        assert np.hypot(first.x - place[0], first.y - place[1]) < 0.7


@pytest.mark.slow
def test_maps_in_other_systems_meet(maps):
    from rasterio.warp import calculate_default_transform, reproject

    folder, a, b, b_H_a = maps
    with rasterio.open(folder / "b.tif") as raster:
        transform, width, height = calculate_default_transform(
            raster.crs, "EPSG:32632", raster.width, raster.height, *raster.bounds
        )
        moved = np.full((height, width), np.nan, np.float32)
        reproject(
            raster.read(1),
            moved,
            src_transform=raster.transform,
            src_crs=raster.crs,
            dst_transform=transform,
            dst_crs="EPSG:32632",
            dst_nodata=np.nan,
            init_dest_nodata=True,
        )
    write_map(folder / "b32.tif", moved, transform, "EPSG:32632")
    result = register(folder / "a.tif", folder / "b32.tif", folder / "out").metrics
    assert result["accepted"] and result["guess"] == "the places of both maps"


def test_what_the_output_may_be(files, tmp_path):
    folder, _, _ = files
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "letter.txt").write_text("mine")
    (tmp_path / "out" / "b_on_a.tif").write_text("old")
    cv2.imwrite(str(tmp_path / "blank.png"), np.zeros(SHAPE, np.uint8))
    words = (folder / "a.jpg", tmp_path / "blank.png", tmp_path / "out")
    with pytest.raises(OutputError, match="already holds"):
        register(*words)
    register(*words, overwrite=True)
    assert (tmp_path / "out" / "letter.txt").read_text() == "mine"
    assert not (tmp_path / "out" / "b_on_a.tif").exists()


def test_missing_files_and_words_that_are_none(files, tmp_path):
    folder, _, _ = files
    with pytest.raises(UsageError, match=r"is not a file"):
        register(folder / "none.jpg", folder / "b.png", tmp_path / "out")
    output = tmp_path / "out"
    assert (
        command("register", folder / "a.jpg", folder / "b.png", "-o", output, "--method", "magic")
        == 2
    )


@pytest.mark.slow
def test_events(files, tmp_path):
    folder, _, _ = files
    cv2.imwrite(str(tmp_path / "blank.png"), np.zeros(SHAPE, np.uint8))
    told = []
    with pytest.raises(RefusedError, match="blank"):
        for event in iter_register(folder / "a.jpg", tmp_path / "blank.png", tmp_path / "out"):
            told.append(type(event).__name__)
    assert told == ["StageStarted", "StageFinished", "Result"]
    events = iter_register(folder / "a.jpg", folder / "b.png", tmp_path / "out2")
    names = [type(e).__name__ for e in events]
    assert names == ["StageStarted", "StageFinished"] * 2 + ["Result"]


def test_help_names_every_method():
    from typer.testing import CliRunner

    from skyquilt import registry
    from skyquilt.cli.app import app

    told = (
        CliRunner(env={"COLUMNS": "400", "TERM": "dumb"}).invoke(app, ["register", "--help"]).output
    )
    assert [name for name in registry.names("registration") if name not in told] == []
    assert "Exit codes" in told
