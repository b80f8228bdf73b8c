"""Maps of other programs shown below: each the same ground, written in another way."""

import numpy as np
import pytest
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.transform import Affine

from skyquilt.cli.main import run
from skyquilt.errors import UsageError
from skyquilt.raster.map_source import FileSource, picture
from skyquilt.raster.older_map import OlderMap, older_map
from tests.coregistration.scenes import layout

H, W = 260, 300
PLACE = Affine(0.5, 0, 500_000, 0, -0.5, 5_000_000)
LOCAL = rasterio.crs.CRS.from_wkt('LOCAL_CS["site",UNIT["metre",1],AXIS["E",EAST],AXIS["N",NORTH]]')
BOX = (500_020.0, 4_999_890.0, 500_120.0, 4_999_980.0)


def write(path, bands, place=PLACE, crs="EPSG:32633", **more):
    about = {"width": bands.shape[2], "height": bands.shape[1], "count": len(bands)} | more
    if place is not None:
        about["transform"] = place
    with rasterio.open(path, "w", driver="GTiff", dtype=bands.dtype, crs=crs, **about) as raster:
        raster.write(bands)
    return path


@pytest.fixture(scope="module")
def ground():
    """(3, H, W) colours of one ground."""
    labels = layout(H, W, seed=4)
    return (
        np.random.default_rng(4)
        .integers(20, 230, (3, labels.max() + 1))[:, labels]
        .astype(np.uint8)
    )


def seen(source, box=BOX):
    """RGBA of the same 200 x 180 px of ground as `truth`."""
    return picture(source, "EPSG:32633", box, 200, 180)


def truth(ground):
    return np.moveaxis(ground[:, 40:220, 40:240], 0, -1)


def mirrored(ground, which):
    flips = {"south": (slice(None), slice(None, None, -1)), "east": (slice(None),) * 2}
    out = ground[flips[which]]
    return out[:, :, ::-1] if which == "east" else out


PLACES = {"south": PLACE @ Affine(1, 0, 0, 0, -1, H), "east": PLACE @ Affine(-1, 0, W, 0, 1, 0)}


@pytest.mark.parametrize("which", sorted(PLACES))
def test_mirrored_maps_are_shown_upright(tmp_path, ground, which):
    """Nothing of them was shown, without a word."""
    path = write(tmp_path / "m.tif", mirrored(ground, which), PLACES[which])
    found = seen(older_map(path))
    assert (found[..., 3] == 255).all() and (found[..., :3] == truth(ground)).all()


def test_a_turned_map_is_shown_at_its_place(tmp_path, ground):
    """It was shown as if its rows ran from west to east. The map is turned by a quarter, so that
    no pixel is interpolated; at any other angle by the same transform.
    """
    turned = np.rot90(ground, axes=(1, 2)).copy()  # first row: what was the last column
    place = PLACE @ Affine(0, -1, W, 1, 0, 0)
    found = seen(older_map(write(tmp_path / "m.tif", turned, place)))
    assert (found[..., 3] == 255).all() and (found[..., :3] == truth(ground)).all()
    aslant = PLACE @ Affine.rotation(30)
    source = older_map(write(tmp_path / "n.tif", ground, aslant))
    at = np.array([(x, y) for x in (40, 150, 260) for y in (30, 130, 230)], float)
    x, y = aslant @ (at[:, 0], at[:, 1])
    for (column, row), e, n in zip(at.astype(int), x, y, strict=True):
        around = picture(source, "EPSG:32633", (e - 0.25, n - 0.25, e + 0.25, n + 0.25), 3, 3)
        near = ground[:, row - 1 : row + 1, column - 1 : column + 1].reshape(3, -1).astype(int)
        assert (around[1, 1, :3] >= near.min(1) - 1).all()
        assert (around[1, 1, :3] <= near.max(1) + 1).all()
    west, south, east, north = source.bounds()
    beside = picture(source, "EPSG:32633", (east - 1, north - 1, east, north), 4, 4)
    assert beside is None or not beside[..., 3].any()


def test_numbers_of_colours_and_deep_colours(tmp_path, ground):
    flat = np.repeat(ground[1:2], 3, 0)
    order = np.random.default_rng(1).permutation(256)
    path = write(tmp_path / "p.tif", order[ground[1:2]].astype(np.uint8))
    with rasterio.open(path, "r+") as raster:
        raster.write_colormap(1, {int(order[k]): (k, k, k, 255) for k in range(256)})
    assert (seen(older_map(path))[..., :3] == truth(flat)).all()
    deep = seen(older_map(write(tmp_path / "d.tif", ground.astype(np.uint16) * 40)))
    for k in range(3):  # one stretch for all bands, so that hues stay
        fit = np.polyfit(truth(ground)[..., k].ravel(), deep[..., k].ravel().astype(float), 1)
        assert fit[0] == pytest.approx(255 / 200, rel=0.1)


def test_values_without_a_word_about_what_is_none(tmp_path, ground):
    """The scale of colours began at -9999."""
    values = ground[1:2].astype(np.float32)
    values[:, 60:90] = -9999
    source = older_map(write(tmp_path / "v.tif", values))
    part = source.part(BOX, 0.5)
    assert part.pixels[part.shown].min() >= 20
    assert part.shown[:20].all() and not part.shown[21:49].any()
    colours = seen(source)
    assert len(np.unique(colours[..., 0][colours[..., 3] > 0])) > 20
    scaled = write(tmp_path / "s.tif", ground[1:2].astype(np.uint16) * 100)
    with rasterio.open(scaled, "r+") as raster:
        raster.scales, raster.offsets = (0.01,), (-50.0,)
    part = older_map(scaled).part(BOX, 0.5)
    assert part.pixels[..., 0] == pytest.approx(truth(ground)[..., 1] - 50.0, abs=1e-3)


def test_coarser_parts_are_averages(tmp_path, ground):
    """Against the same map the right way up, which GDAL reduces."""
    upright = FileSource(path=write(tmp_path / "u.tif", ground))
    source = older_map(write(tmp_path / "m.tif", mirrored(ground, "south"), PLACES["south"]))
    assert isinstance(source, OlderMap) and source.about().crs == "EPSG:32633"
    assert source.bounds() == pytest.approx(upright.bounds())
    part = source.part(source.bounds(), 4.0)
    means = ground.reshape(3, H, W)[:, : H // 8 * 8, : W // 8 * 8]
    means = means.reshape(3, H // 8, 8, W // 8, 8).mean((2, 4))
    inner = np.moveaxis(part.pixels, -1, 0)[:, 2:30, 2:34].astype(float)
    assert np.abs(inner - means[:, 2:30, 2:34]).mean() < 12


def test_control_points_place_a_map(tmp_path, ground):
    points = [
        GroundControlPoint(row=r, col=c, x=x, y=y)
        for r in (0, H)
        for c in (0, W)
        for x, y in [PLACE @ (c, r)]
    ]
    path = write(tmp_path / "g.tif", ground, None, gcps=points)
    assert (seen(older_map(path))[..., :3] == truth(ground)).all()


def test_what_cannot_be_shown_is_told_before_anything_else(tmp_path, ground, monkeypatch, capsys):
    local = write(tmp_path / "l.tif", ground, crs=LOCAL)
    with pytest.raises(UsageError, match="local coordinate system"):
        older_map(local)
    with pytest.raises(UsageError, match="complex"):
        older_map(write(tmp_path / "c.tif", ground[:1].astype(np.complex64)))
    with pytest.raises(UsageError, match="not a georeferenced map"):
        older_map(write(tmp_path / "n.tif", ground, crs=None))
    area = tmp_path / "area.geojson"
    ring = [[15.0, 45.15], [15.001, 45.15], [15.001, 45.151], [15.0, 45.15]]
    area.write_text('{"type":"Polygon","coordinates":[' + str(ring) + "]}")
    words = ["skyquilt", "plan", str(area), "-o", str(tmp_path / "out"), "--base", str(local)]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit) as end:
        run()
    assert end.value.code == 2 and "local coordinate system" in capsys.readouterr().err
