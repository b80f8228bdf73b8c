"""Maps as other programs write them: types, missing data, places; against distortions made here."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.control import GroundControlPoint
from rasterio.transform import Affine

from skyquilt.coregistration.files import overlays
from skyquilt.coregistration.pictures import common_parts, guess_of, open_picture
from skyquilt.coregistration.places import photo_in_map
from skyquilt.coregistration.usable import filled, usable
from skyquilt.coregistration.workflow import iter_register, outcome_of, register
from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.geometry.transforms import transfer
from skyquilt.model.event import StageStarted
from skyquilt.model.photo import Attitude, Photo, RejectedPhoto
from skyquilt.model.registration import ErrorField, Picture, Registration
from skyquilt.raster.read_map import MapFile
from tests.coregistration.scenes import error, layout, pair, spectrum, turned
from tests.coregistration.test_metadata import photo

SHAPE = (240, 288)
TRUTH = turned(0.95, 21.0, SHAPE, SHAPE, (6.0, -9.0))
PLACE_A = Affine(0.5, 0, 500_000, 0, -0.5, 5_000_000)
FLIP = np.array([[1, 0, 0], [0, -1, SHAPE[0] - 1], [0, 0, 1.0]])
"""From the pixels of a picture to those of the same one with the last row first."""
LOCAL = 'LOCAL_CS["site",UNIT["metre",1],AXIS["E",EAST],AXIS["N",NORTH]]'


def corners_of(matrix):
    """The affine in rasterio's pixels (corners at integers) of one whose centres are."""
    half = Affine.translation(0.5, 0.5)
    return half @ Affine(*matrix[:2].ravel()) @ ~half


def place_b(b_H_a=TRUTH):
    """Where b lies on the ground, if a lies at `PLACE_A`."""
    return PLACE_A @ ~corners_of(b_H_a)


def write(path, values, place, crs="EPSG:32633", mask=None, nodata=None, **more):
    bands = values if values.ndim == 3 else values[None]
    about = {"width": bands.shape[2], "height": bands.shape[1], "count": len(bands)} | more
    about = {"driver": "GTiff", "dtype": bands.dtype, "crs": crs, "nodata": nodata} | about
    if place is not None:
        about["transform"] = place
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", **about) as raster:
        raster.write(bands)
        if mask is not None:
            raster.write_mask(mask)
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Path of a map, and b: 8 bits, 0 where a ends."""
    folder = tmp_path_factory.mktemp("maps")
    a, b = pair(TRUTH, SHAPE, seed=12, shape_a=SHAPE)
    rest = cv2.warpPerspective(np.ones(SHAPE, np.uint8), TRUTH, SHAPE[::-1]) == 0
    b = np.maximum(b, 1)
    b[cv2.dilate(rest.astype(np.uint8), np.ones((5, 5))) > 0] = 0
    return write(folder / "a.tif", a, PLACE_A), b


def typed(b, kind):
    """b as values of a type, and what they mean (NaN: nothing); fills as other programs do."""
    degrees = np.where(b == 0, np.nan, 10 + b / 10)
    fill = {"float32": -9999, "float64": -3.4028234663852886e38, "int16": -32768, "uint32": 0}
    fill |= {"int32": -99999}
    factor = {"int16": 100, "int32": 100, "uint32": 1000}.get(kind, 1)
    stored = np.where(b == 0, fill[kind], np.round(degrees * factor, 6)).astype(kind)
    return stored, fill[kind], degrees * factor


@pytest.mark.parametrize(
    "kind", ["int16", *(pytest.param(k, marks=pytest.mark.slow) for k in ("float64", "uint32"))]
)
def test_values_of_any_type_with_stated_fillings(scene, tmp_path, kind):
    """int16 and others ended in a traceback, and -9999 and -3.4e38 ran into what lies beside."""
    path, b = scene
    stored, fill, meant = typed(b, kind)
    write(tmp_path / "b.tif", stored, place_b(), nodata=fill)
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        found = raster.read(1)
    lies = np.array(record["b_H_a"])
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    expected = cv2.warpPerspective(
        meant.astype(np.float32), lies, SHAPE[::-1], flags=flags, borderValue=float("nan")
    )
    both = np.isfinite(found) & np.isfinite(expected)
    assert np.isfinite(found).sum() > 0.97 * np.isfinite(expected).sum()
    # the grid of OpenCV's interpolation has steps of 1/32 px
    assert np.percentile(np.abs(found - expected)[both], 99) < 0.05 * np.nanstd(expected)
    with rasterio.open(tmp_path / "out" / "b.vrt") as raster:  # as stored
        assert raster.dtypes == (kind,) and raster.nodata == fill
        assert (raster.read(1) == stored).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["float32", "int16"])
def test_fillings_that_the_file_does_not_state(scene, tmp_path, kind):
    path, b = scene
    stored, _, meant = typed(b, kind)
    write(tmp_path / "b.tif", stored, place_b())
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        found = raster.read(1)
    assert np.nanmin(meant) <= np.nanmin(found) and np.nanmax(found) <= np.nanmax(meant)


@pytest.mark.slow
def test_stored_numbers_with_a_scale_become_values(scene, tmp_path):
    """They were written as they are stored, with the unit of the values."""
    path, b = scene
    write(tmp_path / "b.tif", b.astype(np.uint16) * 50, place_b(), nodata=0)
    with rasterio.open(tmp_path / "b.tif", "r+") as raster:
        raster.scales, raster.offsets = (0.02,), (-100.0,)
        raster.set_band_unit(1, "degC")
    register(path, tmp_path / "b.tif", tmp_path / "out")
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        found = raster.read(1)
        assert raster.units == ("degC",) and raster.scales == (1.0,)
    assert -100 < np.nanmin(found) and np.nanmax(found) <= 155
    assert np.nanpercentile(found, 95) == pytest.approx(np.percentile(b[b > 0], 95) - 100, abs=10)
    with rasterio.open(tmp_path / "out" / "b.vrt") as raster:
        assert (raster.scales, raster.offsets, raster.units) == ((0.02,), (-100.0,), ("degC",))


def test_a_palette_is_read_as_its_colours(scene, tmp_path):
    """Numbers of colours were interpolated."""
    path, b = scene
    order = np.random.default_rng(0).permutation(256)
    write(tmp_path / "b.tif", order[b].astype(np.uint8), place_b())
    colours = {int(order[k]): (k, 255 - k, k, 255 if k else 0) for k in range(256)}
    with rasterio.open(tmp_path / "b.tif", "r+") as raster:
        raster.write_colormap(1, colours)
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        red, green, blue = raster.read().astype(int)
        seen = raster.dataset_mask() > 0
    assert (np.abs(red + green - 255)[seen] <= 1).all() and (red == blue).all()
    assert 0.5 < seen.mean() < 0.95
    with rasterio.open(tmp_path / "out" / "b.vrt") as raster:
        assert raster.colormap(1)[int(order[9])] == (9, 246, 9, 255)


@pytest.mark.parametrize("how", ["mask", pytest.param("alpha", marks=pytest.mark.slow)])
def test_masks_reach_both_outputs(scene, tmp_path, how):
    path, b = scene
    colours, seen = np.stack([b, b // 2 + 60, 255 - b]), np.where(b > 0, 255, 0).astype(np.uint8)
    if how == "mask":
        write(tmp_path / "b.tif", colours, place_b(), mask=seen)
    else:
        bands = np.concatenate([colours, seen[None]])
        write(tmp_path / "b.tif", bands, place_b(), photometric="RGB", alpha="YES")
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    with rasterio.open(tmp_path / "out" / "b.vrt") as raster:
        assert raster.count == 3 and (raster.dataset_mask() == seen).all()
    with rasterio.open(tmp_path / "out" / "b_on_a.tif") as raster:
        values, mask = raster.read(), raster.dataset_mask() > 0
    assert 0.5 < mask.mean() < 0.9 and values[2][mask].min() >= 255 - b.max()


def test_complex_pixels_are_refused_in_a_sentence(scene, tmp_path):
    path, b = scene
    write(tmp_path / "b.tif", b.astype(np.complex64), place_b())
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert "complex numbers" in record["reason"] and record["b_H_a"] is None


def mirrored(values):
    return np.ascontiguousarray(values[::-1])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["a", "b"])
def test_rows_from_south_to_north(scene, tmp_path, which):
    """A map whose first row is its most southern one had been compared in the mirror."""
    path, b = scene
    truth, end, place = TRUTH, path, place_b()
    upside_down = corners_of(FLIP)
    if which != "b":
        with rasterio.open(path) as raster:
            values = raster.read(1)
        end = write(tmp_path / "a.tif", mirrored(values), PLACE_A @ upside_down)
        truth = truth @ FLIP
    if which != "a":
        b, place, truth = mirrored(b), place @ upside_down, FLIP @ truth
    write(tmp_path / "b.tif", b, place, nodata=0)
    record = register(end, tmp_path / "b.tif", tmp_path / "out").metrics
    assert record["guess"] == "the places of both maps"
    assert error(np.array(record["b_H_a"]), truth, SHAPE) < 0.3
    with rasterio.open(end) as raster, rasterio.open(tmp_path / "out" / "b_on_a.tif") as moved:
        assert moved.transform == raster.transform
    with rasterio.open(tmp_path / "out" / "b.vrt") as raster:
        points, _ = raster.gcps
    for p in points[::7]:  # on the ground as the file itself places it
        x, y = place @ (p.col, p.row)
        assert np.hypot(p.x - x, p.y - y) < 0.3


def ground_pair(crs, place, shape, b_H_a=None, seed=21):
    """b (240, 288) of one ground as a map in another CRS, whose pixels may be longer than wide, and
    b_H_a at nine points of a.
    """
    labels = layout(*SHAPE, seed=seed)
    change = Transformer.from_crs(crs, "EPSG:32633", always_xy=True)
    column, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = change.transform(*(place @ (column, row)))
    u, v = ~PLACE_A @ (x, y)
    fine = cv2.GaussianBlur(spectrum(labels, seed + 1), (0, 0), 0.7)
    b = cv2.remap(
        fine, (u - 0.5).astype(np.float32), (v - 0.5).astype(np.float32), cv2.INTER_LINEAR
    )
    return np.clip(spectrum(labels, seed), 1, 255).astype(np.uint8), b


def places_of(crs, place):
    """Nine pixels of a, and where they lie in a map of another CRS."""
    px = np.stack(np.meshgrid([40, 144, 248], [40, 120, 200]), -1).reshape(-1, 2).astype(float)
    x, y = PLACE_A @ (px[:, 0] + 0.5, px[:, 1] + 0.5)
    x, y = Transformer.from_crs("EPSG:32633", crs, always_xy=True).transform(x, y)
    return px, np.stack(~place @ (np.asarray(x), np.asarray(y)), 1) - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.02, 0.0])
def test_degrees_of_equal_size_are_not_as_wide_as_high(tmp_path, shift):
    """What QGIS and gdalwarp write in EPSG:4326: at 45 degrees a pixel is 1.4 times as high as it
    is wide. Where the place was no guess, nothing was found.
    """
    step = 0.5 / 95_000
    lon, lat = Transformer.from_crs("EPSG:32633", 4326, always_xy=True).transform(
        500_000, 5_000_000
    )
    place = Affine(step, 0, lon, 0, -step, lat)
    shape = (int(120 / (111_195 * step)), int(144 / (78_850 * step)))
    a, b = ground_pair("EPSG:4326", place, shape)
    write(tmp_path / "a.tif", a, PLACE_A)
    write(tmp_path / "b.tif", b, Affine.translation(shift, 0) @ place, "EPSG:4326")
    record = register(tmp_path / "a.tif", tmp_path / "b.tif", tmp_path / "out").metrics
    assert (record["guess"] is None) == bool(shift)
    assert record["model"] == "affine"
    assert record["beside_m"] == pytest.approx(shift * 78_640, abs=1.0)
    assert ("1.6 km apart" in record["reason"]) == bool(shift)
    px, there = places_of("EPSG:4326", place)
    found = np.c_[px, np.ones(9)] @ np.array(record["b_H_a"]).T
    assert np.abs(found[:, :2] / found[:, 2:] - there).max() < 0.6


@pytest.mark.slow
def test_maps_of_a_local_system_or_of_none(scene, tmp_path):
    """A local system beside one of the Earth ended in a traceback; one beside none is its own."""
    path, b = scene
    for crs, told in ((CRS.from_wkt(LOCAL).to_wkt(), False), (None, True)):
        write(tmp_path / "b.tif", b, place_b(), crs, nodata=0)
        record = register(path, tmp_path / "b.tif", tmp_path / "out", overwrite=True).metrics
        assert (record["guess"] is not None) == told
        assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3


@pytest.mark.slow
def test_control_points_in_the_file_are_its_place(scene, tmp_path):
    path, b = scene
    points = [
        GroundControlPoint(row=r, col=c, x=x, y=y)
        for r in (0, 120, 240)
        for c in (0, 288)
        for x, y in [place_b() @ (c, r)]
    ]
    write(tmp_path / "b.tif", b, None, gcps=points)
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert record["guess"] == "the places of both maps"
    assert error(np.array(record["b_H_a"]), TRUTH, SHAPE) < 0.3
    opened = open_picture(tmp_path / "b.tif")
    assert np.allclose(opened.place.affine, tuple(place_b())[:6], atol=1e-4)
    points[2] = GroundControlPoint(row=0, col=288, x=points[2].x + 3, y=points[2].y)
    write(tmp_path / "bent.tif", b, None, gcps=points)
    assert open_picture(tmp_path / "bent.tif").place is None  # a plane would misplace it


@pytest.mark.parametrize("name", ["b.png", "b.jp2", "b.img", "noname"])
def test_maps_of_any_format_keep_their_place(scene, tmp_path, name):
    path, b = scene
    driver = {"b.png": "PNG", "b.jp2": "JP2OpenJPEG", "b.img": "HFA"}.get(name, "GTiff")
    more = {"b.png": {"worldfile": "YES"}, "b.jp2": {"reversible": "YES", "quality": 100}}
    step = Affine(0.5, 0, 500_003, 0, -0.5, 4_999_998)
    write(tmp_path / name, b, step, driver=driver, **more.get(name, {}))
    opened = open_picture(tmp_path / name)
    assert opened.place is not None and opened.place.affine == tuple(step)[:6]
    back = open_picture(path)
    assert guess_of(back, opened).b_H_a == pytest.approx(
        np.array([[1, 0, -6], [0, 1, -4], [0, 0, 1.0]])
    )


def test_a_world_file_and_the_projection_beside_it(scene, tmp_path):
    """What most programs write beside a picture that they export."""
    _, b = scene
    cv2.imwrite(str(tmp_path / "b.jpg"), b)
    (tmp_path / "b.jgw").write_text("0.5\n0\n0\n-0.5\n500003.25\n4999997.75\n")
    opened = open_picture(tmp_path / "b.jpg")
    assert opened.place.affine == (0.5, 0, 500_003, 0, -0.5, 4_999_998) and not opened.place.crs
    (tmp_path / "b.prj").write_text(CRS("EPSG:32633").to_wkt("WKT1_ESRI"))
    assert CRS(open_picture(tmp_path / "b.jpg").place.crs).equals(CRS("EPSG:32633"))


@pytest.mark.slow
def test_a_small_map_in_a_large_one_is_compared_at_its_own_size(tmp_path):
    """A map of 6000 px was reduced to 2048, and the small one with it to a third. One of 2200 px
    would be as well, by a little.
    """
    labels = layout(900, 1000, seed=5)
    a = np.full((2200, 1300), 90, np.uint8)
    a[700:1600, 200:1200] = np.clip(spectrum(labels, 1), 1, 255)
    truth = np.array([[0.5, 0, -0.25 - 100 - 50], [0, 0.5, -0.25 - 350 - 30], [0, 0, 1.0]])
    size = (400, 380)
    b = spectrum(labels, 2)
    inside = truth @ np.array([[1, 0, 200], [0, 1, 700], [0, 0, 1.0]])
    b = cv2.warpPerspective(cv2.GaussianBlur(b, (0, 0), 0.7), inside, size)
    write(tmp_path / "a.tif", a, PLACE_A, tiled=True, compress="deflate")
    place = Affine.translation(3, -2) @ place_b(truth)  # 3.6 m off
    write(tmp_path / "b.tif", b, place)
    one, other = open_picture(tmp_path / "a.tif"), open_picture(tmp_path / "b.tif")
    parts = common_parts(one, other)
    assert parts[0].picture.shape[0] < 1100 and parts[1].picture.shape == (380, 400)
    middle = parts[0].full_S_picture @ [100, 100, 1]
    x, y = (round(v) for v in middle[:2])
    assert parts[0].picture.values[100, 100] == a[y, x]
    record = register(tmp_path / "a.tif", tmp_path / "b.tif", tmp_path / "out").metrics
    px = np.array([[400, 900, 1], [1000, 1000, 1], [500, 1400, 1.0]])
    found, right = px @ np.array(record["b_H_a"]).T, px @ truth.T
    assert np.abs(found[:, :2] / found[:, 2:] - right[:, :2]).max() < 0.4


def test_what_was_not_measured_has_the_nearest_value():
    grey = np.add.outer(np.arange(8.0), 10 * np.arange(9.0)).astype(np.float32)
    given = np.ones((8, 9), bool)
    given[:, 5:] = given[6:] = False
    found = filled(np.where(given, grey, np.float32(-3.4e38)), given)
    assert (found[given] == grey[given]).all()
    assert (found[:6, 5:] == grey[:6, 4:5]).all() and (found[6:, :5] == grey[5, :5]).all()
    assert (filled(grey, np.zeros((8, 9), bool)) == 0).all()
    band = np.where(np.arange(200) < 150, 20 + np.arange(200) % 37, -9999.0)
    picture = Picture(values=np.tile(band, (100, 1)).astype(np.float32))
    seen = usable(Picture(values=picture.values, valid=picture.values > -9999))
    assert seen.grey.min() >= 20 and not seen.valid[:, 150:].any()


def test_an_error_is_the_same_in_other_pixels():
    """Mirrored, and with pixels half as wide: what is stated of a place is that of the same place,
    in the new pixels: along x twice as much, along y as much.
    """
    rng = np.random.default_rng(3)
    half = rng.normal(size=(8, 8))
    field = ErrorField(centre=np.array([50.0, 40]), unit=60.0, covariance=half @ half.T, shared=0.2)
    px = rng.uniform(0, 100, (40, 2))
    other = field.seen_in(np.array([[1, 0, 0], [0, -1, 99], [0, 0, 1.0]]))
    assert other.bound_px(px * [1, -1] + [0, 99]) == pytest.approx(field.bound_px(px))
    scaled = field.moved(3.0, np.array([7.0, -2]))
    assert scaled.bound_px(3 * px + [7, -2]) == pytest.approx(3 * field.bound_px(px))
    wide = field.seen_in(np.diag([2.0, 1, 1])).bound_px(px * [2, 1])
    assert (wide >= field.bound_px(px) - 1e-9).all()
    assert (wide <= 2 * field.bound_px(px) + 1e-9).all()


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326", "EPSG:32634"])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (75.0, 12.0, -8.0), (-130.0, -4.0, 15.0)])
def test_what_a_photo_shows_of_a_map(crs, angles):
    """Against rays from its camera to places of the map, by PROJ's topocentric frame."""
    lon, lat, height, focal = 14.3, 46.6, 80.0, 700.0
    yaw, pitch, roll = angles
    of = photo(0, 0, height, yaw, focal, 640, 512)
    of = replace(
        of,
        position=replace(of.position, latitude_deg=lat, longitude_deg=lon),
        attitude=Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll),
    )
    change = Transformer.from_crs(4326, crs, always_xy=True)
    x, y = change.transform(lon, lat)
    step = 0.2 / 111_195 if crs == "EPSG:4326" else 0.2
    place = Affine(step, 0, x - 900 * step, 0, -step, y + 800 * step)
    target = MapFile(
        path=Path("m.tif"), width=1800, height=1600, bands=3, affine=tuple(place)[:6], crs=crs
    )
    lies = photo_in_map(of, target, 0.3)
    px = np.array([[100.0, 60], [600, 100], [320, 250], [50, 480], [610, 500]])
    there = transfer(lies.b_H_a, px) + 0.5
    mx, my = place @ (there[:, 0], there[:, 1])
    glon, glat = Transformer.from_crs(crs, 4326, always_xy=True).transform(mx, my)
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart"
        " +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
        f" +lon_0={lon} +lat_0={lat} +h_0={height}"
    )
    east, north, up = Transformer.from_pipeline(pipeline).transform(glon, glat, np.zeros(5))
    rays = cam_R_map_from_angles(yaw, pitch, roll) @ np.stack([east, north, up])
    seen = np.stack([focal * rays[0] / rays[2] + 319.5, focal * rays[1] / rays[2] + 255.5], 1)
    # a sphere's radius for an ellipsoid's: 0.3 % of the way from the middle
    assert np.abs(seen - px).max() < 0.004 * 400 + 0.2
    back = lies.inverse()
    assert back.off_px == 0.3 * 640
    # pixels of the ground: 80 m / 700 px, longer where it is seen aslant, and degrees are no m
    assert back.off_a_px * 0.2 == pytest.approx(0.3 * 640 * 80 / 700, rel=0.3)


def test_a_photo_without_height_or_angles_lies_nowhere(scene):
    path, _ = scene
    place = open_picture(path).place
    lon, lat = Transformer.from_crs(32633, 4326, always_xy=True).transform(500_120, 4_999_900)
    of = photo(0, 0, 80.0, 0.0, 700.0, 640, 512)
    of = replace(of, position=replace(of.position, latitude_deg=lat, longitude_deg=lon))
    assert photo_in_map(of, place, 0.3) is not None
    for less in (
        {"attitude": None},
        {"position": None},
        {"position": replace(of.position, takeoff_m=None)},
        {"focal": replace(of.focal, source="guess")},
        {"attitude": Attitude(yaw_deg=0, pitch_deg=50, roll_deg=0)},
        {"position": replace(of.position, latitude_deg=lat + 1)},
    ):
        assert photo_in_map(replace(of, **less), place, 0.3) is None


@pytest.mark.slow
def test_a_photo_of_a_tenth_of_a_map_is_found(tmp_path):
    """It was refused: a photo shows too small a part of a map to be found without its position."""
    labels = layout(1000, 1100, seed=31)
    a = np.clip(spectrum(labels, 1), 1, 255).astype(np.uint8)
    write(tmp_path / "a.tif", a, PLACE_A)
    yaw, height, focal, size = 200.0, 60.0, 300.0, (400, 320)
    x, y = PLACE_A @ (420.0, 610.0)
    lon, lat = Transformer.from_crs(32633, 4326, always_xy=True).transform(x, y)
    scale = 0.5 * focal / height
    # the photo's top looks along the yaw: a's pixels turn by its negative
    truth = turned(scale, -yaw, (1, 1), (320, 400))
    truth = truth @ np.array([[1, 0, -419.5], [0, 1, -609.5], [0, 0, 1.0]])
    fine = cv2.GaussianBlur(spectrum(labels, 2), (0, 0), 0.5)
    b = np.clip(cv2.warpPerspective(fine, truth, size), 0, 255).astype(np.uint8)
    of = photo(0, 0, height, yaw, focal, *size)
    wrong = replace(of.position, latitude_deg=lat + 3 / 111_000, longitude_deg=lon - 4 / 78_000)
    one = open_picture(tmp_path / "a.tif")
    place = write(tmp_path / "b.tif", b, None, crs=None)
    other = replace(open_picture(place), photo=replace(of, position=wrong))
    assert isinstance(other.photo, Photo) and other.place is None
    found = outcome_of(one, other, "auto", guess_of(one, other))
    assert isinstance(found, Registration)
    px = np.array([[420, 610, 1], [460, 580, 1], [400, 650, 1.0]])
    there, right = px @ found.b_H_a.T, px @ truth.T
    assert np.abs(there[:, :2] / there[:, 2:] - right[:, :2]).max() < 0.8


def test_a_map_whose_name_is_no_text_is_refused_for_it(scene, tmp_path):
    """GDAL cannot be asked for it. It was registered as a photo, without its place and a word."""
    _, b = scene
    named = tmp_path / os.fsdecode(b"b\xff.tif")
    plain = tmp_path / os.fsdecode(b"plain\xff.tif")
    try:
        write(tmp_path / "b.tif", b, place_b()).rename(named)
    except OSError:
        pytest.skip("this file system wants names to be text")
    found = open_picture(named)
    assert isinstance(found, RejectedPhoto) and "no UTF-8 text; rename it" in found.reason
    cv2.imwrite(str(tmp_path / "plain.tif"), b)
    (tmp_path / "plain.tif").rename(plain)
    assert open_picture(plain).photo is not None


def test_a_map_that_is_damaged_or_gone_at_full_size_is_told(scene, tmp_path):
    """Its overview is enough for the registration; the drawing ended in a traceback."""
    path, b = scene
    torn = write(tmp_path / "b.tif", b, place_b(), nodata=0)
    opened = open_picture(torn)
    values, valid = opened.window(0, 0, 9, 7)
    assert (values == b[:9, :7]).all() and (valid == (b[:9, :7] > 0)).all()
    torn.write_bytes(torn.read_bytes()[:2000])
    with pytest.raises(SideFileError, match=r"b\.tif cannot be read at full size"):
        opened.window(100, 0, 120, 200)
    events = iter_register(path, write(tmp_path / "c.tif", b, place_b(), nodata=0), tmp_path / "o")
    with pytest.raises(SideFileError, match=r"c\.tif cannot be read at full size"):
        for event in events:
            if isinstance(event, StageStarted) and event.stage == "draw":
                (tmp_path / "c.tif").unlink()


def test_a_map_too_large_to_be_reduced_is_refused_at_once(scene, tmp_path):
    """Its pixels would be read for many minutes. The file itself is small: it holds no tile."""
    path, _ = scene
    about = {"width": 400_000, "height": 300_000, "count": 1, "crs": "EPSG:32633"}
    about |= {"tiled": True, "blockxsize": 8192, "blockysize": 8192, "sparse_ok": True}
    about |= {"transform": PLACE_A, "dtype": "float32", "bigtiff": "YES"}
    with rasterio.open(tmp_path / "b.tif", "w", driver="GTiff", **about):
        pass
    assert (tmp_path / "b.tif").stat().st_size < 100_000
    record = register(path, tmp_path / "b.tif", tmp_path / "out").metrics
    assert "400000 x 300000 px and no overviews" in record["reason"]


def test_what_b_does_not_show_hides_nothing_of_a(scene, tmp_path):
    """Where b had no data, the pictures for display were black."""
    path, b = scene
    b = b.copy()
    b[:, 120:198] = 0
    one, other = open_picture(path), open_picture(write(tmp_path / "b.tif", b, place_b(), nodata=0))
    none = np.zeros((0, 2))
    found = Registration(model="similarity", b_H_a=TRUTH, px_a=none, px_b=none)
    _, checks, _, mixed = overlays(one, other, found)
    hole = cv2.warpPerspective(
        np.where(b == 0, 255, 0).astype(np.uint8),
        TRUTH,
        SHAPE[::-1],
        flags=cv2.WARP_INVERSE_MAP | cv2.INTER_NEAREST,
        borderValue=255,
    )
    inside = cv2.erode(hole, np.ones((5, 5))) > 0
    assert inside.mean() > 0.3
    for picture in (checks, mixed):
        grey = picture[..., 0].astype(int)
        shown = one.picture.values[inside].astype(int)
        assert np.corrcoef(grey[inside], shown)[0, 1] > 0.95
