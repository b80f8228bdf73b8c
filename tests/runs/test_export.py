"""Exports, read back by GDAL and compared with the run's own rasters."""

import json
import re
import shutil
import sqlite3
import zipfile
from contextlib import closing

import numpy as np
import pytest
import rasterio
from pyproj import Proj, Transformer
from rasterio.warp import Resampling, reproject
from typer.testing import CliRunner

from skyquilt.alignment.priors import distortion
from skyquilt.cli import app as commands
from skyquilt.errors import OutputError, SideFileError, UsageError
from skyquilt.raster import RasterSpec, write_array
from skyquilt.raster.map_source import FileSource
from skyquilt.runs.export import WHAT, Wanted, export
from skyquilt.runs.grid import grid_of
from skyquilt.runs.opened import open_run


@pytest.fixture(scope="module")
def exported(finished, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports")
    tiled = ("mbtiles", "tiles")  # coarser: there are enough of them
    wanted = [Wanted(what=tuple(w for w in WHAT if w not in tiled)), Wanted(what=tiled, gsd_m=0.15)]
    return folder, [done for w in wanted for done in export(finished.output, w, folder)]


def middle(finished, share=0.5):
    with rasterio.open(finished.output / "mosaic.tif") as file:
        b = file.bounds
    w, h = (b.right - b.left) * share / 2, (b.top - b.bottom) * share / 2
    x, y = (b.left + b.right) / 2, (b.bottom + b.top) / 2
    return x - w, y - h, x + w, y + h


def test_every_kind_is_written(exported):
    folder, done = exported
    assert len(done) == len(WHAT) and all(e.path.exists() for e in done)
    assert not list(folder.rglob("*.partial*"))


def test_the_picture_is_the_map_pixel_for_pixel_and_lies_at_its_place(finished, exported):
    folder, _ = exported
    with (
        rasterio.open(folder / "mosaic.png") as png,
        rasterio.open(finished.output / "mosaic.tif") as tif,
    ):
        assert png.crs == tif.crs and png.shape == tif.shape
        assert np.allclose(tuple(png.transform), tuple(tif.transform), atol=1e-6)
        rgba, rgb, mask = png.read(), tif.read(), tif.dataset_mask()
    shown = rgba[3] > 0
    assert np.array_equal(shown, mask > 0)
    assert np.array_equal(rgba[:3][:, shown], rgb[:, shown])


@pytest.mark.parametrize(
    ("crs", "told"),
    [
        ("EPSG:32634", ()),  # the next zone
        ("EPSG:3035", ()),
        ("EPSG:4326", ()),
        ("EPSG:32636", ("metre", "north")),  # three zones to the east
        ("EPSG:32601", ("metre", "north")),  # beyond the pole
        ("EPSG:3857", ("metre",)),
        ("EPSG:2264", ("metre", "north")),  # feet
    ],
)
def test_what_a_system_far_from_the_map_does_to_it_is_told(crs, told):
    place = {"longitude": 14.3, "latitude": 46.6}
    said = distortion(crs, **place)
    assert [w in said for w in ("metre", "north")] == [w in told for w in ("metre", "north")]
    if told:
        factors = Proj(crs).get_factors(**place)  # of Web Mercator as if Earth were a sphere
        metres = float(re.search(r"is ([\d.]+) m\b", said)[1])
        assert metres == pytest.approx(factors.meridional_scale, abs=0.003)
        turned = f"north is {abs(factors.meridian_convergence):.0f} degrees"
        assert (turned in said) == ("north" in told)


def test_a_distorted_export_says_so(finished, tmp_path):
    wanted = Wanted(what=("tif", "kmz"), crs="EPSG:3857", gsd_m=0.5)
    tif, kmz = export(finished.output, wanted, tmp_path)
    assert "a metre on the ground" in tif.note and not kmz.note  # which has a system of its own


def test_a_part_in_another_system_agrees_with_gdal(finished, tmp_path):
    own = middle(finished)
    to = Transformer.from_crs("EPSG:32633", "EPSG:3035", always_xy=True)
    west, south, east, north = to.transform_bounds(*own)
    wanted = Wanted(
        what=("tif", "heights"), bounds=(west, south, east, north), crs="EPSG:3035", gsd_m=0.4
    )
    list(export(finished.output, wanted, tmp_path))
    for name, source, most in (("mosaic", "mosaic.tif", 12), ("heights", "dsm.tif", 0.12)):
        with rasterio.open(tmp_path / f"{name}.tif") as ours:
            assert ours.crs.to_epsg() == 3035 and abs(ours.res[0] - 0.4) < 1e-9
            got, mask = ours.read(1).astype(float), ours.dataset_mask() > 0
            theirs = np.full(ours.shape, np.nan)
            with rasterio.open(finished.output / source) as file:
                values = np.where(file.dataset_mask() > 0, file.read(1).astype(float), np.nan)
                reproject(
                    values, theirs, src_transform=file.transform, src_crs="EPSG:32633",
                    dst_transform=ours.transform, dst_crs="EPSG:3035",
                    resampling=Resampling.average, src_nodata=np.nan, dst_nodata=np.nan,
                )  # fmt: skip
        both = mask & np.isfinite(theirs)
        assert both.mean() > 0.3
        assert np.median(np.abs(got[both] - theirs[both])) < most
        shifted = np.abs(got[:, 3:] - theirs[:, :-3])[both[:, 3:] & both[:, :-3]]
        assert np.median(np.abs(got[both] - theirs[both])) < 0.7 * np.nanmedian(shifted)


def test_web_tiles_and_mbtiles_and_kmz_show_the_same_ground(finished, exported):
    folder, _ = exported
    with rasterio.open(finished.output / "mosaic.tif") as file:
        to = Transformer.from_crs(file.crs, "EPSG:3857", always_xy=True)
        extent = to.transform_bounds(*file.bounds)
    with rasterio.open(folder / "mosaic.mbtiles") as tiles:
        assert tiles.driver == "MBTiles"
        size = 2 * 20037508.34 / 256 / 2 ** int(tiles.tags()["ZOOM_LEVEL"])
        assert np.allclose(tuple(tiles.bounds), extent, atol=3 * size)
        alpha = tiles.read(4)
    assert 0.3 < (alpha > 0).mean() < 1
    about = json.loads((folder / "mosaic-tiles" / "tiles.json").read_text())
    count = len(list((folder / "mosaic-tiles").rglob("*.webp")))
    with closing(sqlite3.connect(folder / "mosaic.mbtiles")) as base:
        assert base.execute("select count(*) from tiles").fetchone()[0] == count > 10
    assert about["maxzoom"] > about["minzoom"]
    with rasterio.open(folder / "mosaic.kmz") as kmz:
        assert kmz.driver == "KMLSUPEROVERLAY" and kmz.crs.to_epsg() == 4326
        west, north = kmz.bounds.left, kmz.bounds.top
    back = Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
    lon, _, _, lat = back.transform_bounds(*extent)
    assert abs(west - lon) < 1e-6 and abs(north - lat) < 1e-6
    with zipfile.ZipFile(folder / "mosaic.kmz") as archive:
        assert archive.testzip() is None and archive.namelist()[0] == "doc.kml"
        assert not any(b".." in archive.read(i) for i in archive.namelist() if i.endswith(".kml"))
        # equal maps give equal files
        assert {i.date_time for i in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_footprints_are_those_of_the_run(finished, exported):
    folder, _ = exported
    with closing(sqlite3.connect(folder / "footprints.gpkg")) as base:
        names = [n for (n,) in base.execute("select filename from footprints")]
        box = base.execute("select min_x, min_y, max_x, max_y from gpkg_contents").fetchone()
    assert len(names) == finished.metrics["photos_used"]
    with rasterio.open(finished.output / "mosaic.tif") as file:
        b = file.bounds
    assert box[0] <= b.left + 1 and box[2] >= b.right - 1 and box[3] > box[1]


@pytest.mark.slow
def test_memory_does_not_grow_with_the_part(finished, tmp_path, monkeypatch):
    """The rows written at a time are bounded, and the result is the same."""
    from skyquilt.runs import grid

    list(export(finished.output, Wanted(what=("png",), gsd_m=0.3), tmp_path / "a"))
    monkeypatch.setattr(grid, "ROWS_BYTES", 1)
    monkeypatch.setattr(grid, "BLOCK", 64)
    list(export(finished.output, Wanted(what=("png",), gsd_m=0.3), tmp_path / "b"))
    pixels = []
    for name in "ab":
        with rasterio.open(tmp_path / name / "mosaic.png") as file:
            pixels.append(file.read().astype(int))
    both = (pixels[0][3] > 0) & (pixels[1][3] > 0)
    assert both.mean() > 0.3 and np.mean(pixels[0][3] != pixels[1][3]) < 0.005
    assert np.mean(np.abs(pixels[0] - pixels[1])[:, both]) < 1.5


@pytest.mark.parametrize(("vertical", "word"), [(4979, "ellipsoidal"), (5773, "EGM96")])
def test_heights_keep_their_place_and_what_they_count_from(vertical, word, tmp_path):
    """A map of heights above the ellipsoid has a coordinate system of three dimensions, which
    pictures cannot state.
    """
    rng = np.random.default_rng(1)
    z = (480 + rng.normal(0, 3, (64, 80))).astype(np.float32)
    place = {"width": 80, "height": 64, "transform": (0.5, 0, 446300, 0, -0.5, 5160900)}
    heights = RasterSpec(
        **place, bands=1, dtype="float32", crs="EPSG:32633", vertical=vertical, nodata=float("nan"),
        band_names=("height",), band_units=("m",),
    )  # fmt: skip
    colours = RasterSpec(**place, bands=3, dtype="uint8", crs="EPSG:32633", mask=True)
    write_array(tmp_path / "dsm.tif", z, heights)
    write_array(tmp_path / "mosaic.tif", np.zeros((64, 80, 3), np.uint8), colours)
    (tmp_path / "metrics.json").write_text(
        json.dumps({"vertical_datum": {4979: "ellipsoid", 5773: "egm96"}[vertical]})
    )
    wanted = Wanted(what=("heights", "png"), layer="heights")
    list(export(tmp_path, wanted, tmp_path / "out"))
    with rasterio.open(tmp_path / "out" / "heights.tif") as ours:
        assert np.array_equal(ours.read(1), z) and word in ours.crs.to_wkt()
        assert tuple(ours.bounds) == (446300, 5160868, 446340, 5160900)
        assert ours.descriptions == ("height",) and ours.units == ("m",)
    with rasterio.open(tmp_path / "out" / "heights.png") as picture:
        assert picture.crs.to_epsg() == 32633


def test_pixels_are_as_large_where_axes_count_in_feet(finished):
    source = FileSource(path=finished.output / "mosaic.tif")
    feet, metres = (
        grid_of(source, None, f"+proj=utm +zone=33 +datum=WGS84 +units={unit}", 0.5)
        for unit in ("us-ft", "m")
    )
    assert feet.step == pytest.approx(0.5 * 3937 / 1200)
    assert abs(feet.width - metres.width) <= 1 and abs(feet.height - metres.height) <= 1


@pytest.mark.parametrize(
    "wanted",
    [{"what": ("gif",)}, {"what": ()}, {"what": ("png",), "gsd_m": 0.0},
     {"what": ("png",), "crs": "EPSG:0"}, {"what": ("png",), "bounds": (1.0, 1.0, 0.0, 2.0)},
     {"what": ("png",), "crs": "EPSG:4979"}, {"what": ("png",), "crs": "EPSG:4978"},
     {"what": ("tif",), "crs": "EPSG:5773"}, {"what": ("tif",), "crs": "EPSG:4326+5773"}],
)  # fmt: skip
def test_what_cannot_be_exported_is_refused(wanted):
    with pytest.raises(UsageError):
        Wanted(**wanted)


def test_what_a_run_does_not_have_is_refused(finished, tmp_path):
    for wanted, words in (
        (Wanted(what=("png",), layer="thermal"), "no layer 'thermal'"),
        (Wanted(what=("png",), bounds=(0.0, 0.0, 1.0, 1.0)), "nothing within"),
        (Wanted(what=("png",), gsd_m=1e-4), "larger --gsd"),
    ):
        with pytest.raises(UsageError, match=words):
            list(export(finished.output, wanted, tmp_path))
    with pytest.raises(UsageError, match="no finished run"):
        list(export(tmp_path, Wanted(what=("png",))))


def test_the_command_and_the_short_cut_of_mosaic_are_one(finished, flight, tmp_path):
    run = CliRunner().invoke
    said = run(
        commands.app,
        ["export", str(finished.output), "--what", "png,kmz", "--gsd", "40", "-o", str(tmp_path)],
    )
    assert said.exit_code == 0 and said.output.count("export: ") == 2
    wrong = run(commands.app, ["mosaic", str(flight), "-o", str(tmp_path / "x"), "--export", "gif"])
    assert isinstance(wrong.exception, UsageError) and not (tmp_path / "x").exists()


@pytest.mark.parametrize("file", ["mosaic.tif", "dsm.tif"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.97])
def test_a_raster_that_was_cut_off_is_told_in_plain_words(finished, tmp_path, file, share):
    run = shutil.copytree(finished.output, tmp_path / "run")
    whole = (run / file).read_bytes()
    (run / file).write_bytes(whole[: int(share * len(whole))])
    what = "heights" if file == "dsm.tif" else "tif"
    with pytest.raises(SideFileError, match=rf"{file} cannot be read as a map: it is damaged, or"):
        list(export(run, Wanted(what=(what,))))
    with pytest.raises(SideFileError, match="cannot be read as a map"):
        open_run(run).raster("heights" if file == "dsm.tif" else "mosaic")


def test_a_surface_model_that_is_rubbish_is_not_replaced_by_the_ground(finished, tmp_path):
    run = shutil.copytree(finished.output, tmp_path / "run")
    (run / "dsm.tif").write_text("rubbish")
    with pytest.raises(UsageError, match="has no heights"):
        list(export(run, Wanted(what=("heights",))))
    (run / "dsm.tif").unlink()  # as runs without one
    assert [e.path.name for e in export(run, Wanted(what=("heights",)))] == ["heights.tif"]


def test_a_map_that_was_changed_after_its_run_is_named(finished, tmp_path):
    """A JPEG tile of zeros is no error for GDAL."""
    run = shutil.copytree(finished.output, tmp_path / "run")
    (done,) = export(run, Wanted(what=("png",), gsd_m=0.5), tmp_path / "before")
    assert done.note == ""
    content = bytearray((run / "mosaic.tif").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 400] = bytes(400)
    (run / "mosaic.tif").write_bytes(content)
    (done,) = export(run, Wanted(what=("png",), gsd_m=0.5), tmp_path / "after")
    assert done.note == "mosaic.tif is not as the run wrote it"


def test_a_file_in_place_of_the_folder_is_told(finished, tmp_path):
    (tmp_path / "taken").write_text("mine")
    for place in (tmp_path / "taken", tmp_path / "taken" / "below"):
        with pytest.raises(OutputError, match="taken is a file; .*choose another output folder"):
            list(export(finished.output, Wanted(what=("png",)), place))
    assert (tmp_path / "taken").read_text() == "mine"
