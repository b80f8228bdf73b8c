"""The thermal map on the visual one: routes, refusals, and the transform against known truth."""

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter, map_coordinates

from skyquilt.coregistration.files import resample_onto
from skyquilt.errors import RefusedError, UsageError
from skyquilt.thermal.routes import heights_on, join, opened
from skyquilt.thermal.workflow import iter_thermal

GSD_A, GSD_B = 0.1, 0.2
TRUE_SHIFT = (1.4, -0.8)
"""m by which the thermal map's own positions are off, east and north."""


def ground(seed):
    """Fields and roads: (height, width) brightness at 0.1 m, with edges."""
    rng = np.random.default_rng(seed)
    parts = gaussian_filter(rng.standard_normal((900, 900)), 25)
    levels = np.digitize(parts, np.quantile(parts, [0.2, 0.4, 0.6, 0.8])).astype(np.float32)
    return levels + gaussian_filter(rng.standard_normal((900, 900)), 2).astype(np.float32)


def write(path, values, gsd, west, north, unit=None):
    height, width = values.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=height,
        width=width,
        count=1,
        dtype=values.dtype,
        crs="EPSG:32633",
        transform=from_origin(west, north, gsd, gsd),
        nodata=np.nan if values.dtype.kind == "f" else None,
    ) as out:
        out.write(values, 1)
        if unit:
            out.set_band_unit(1, unit)
    return path


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A visual map of 80 m at 0.1 m, and a thermal one of other contrast at 0.2 m, misplaced by
    TRUE_SHIFT.
    """
    folder = tmp_path_factory.mktemp("maps")
    truth = ground(1)
    visual = np.clip(40 * truth[50:850, 50:850] + 20, 0, 255).astype(np.uint8)
    heat = np.float32(300) - 2 * truth + 3 * np.float32(truth > 2.5)  # reversed in part
    y, x = np.mgrid[0:380, 0:380] * 2.0 + 70.5
    thermal = map_coordinates(heat, [y, x], order=1).astype(np.float32)
    west, north = 500000.0, 5000000.0
    a = write(folder / "visual.tif", visual, GSD_A, west, north)
    b = write(
        folder / "thermal.tif",
        thermal,
        GSD_B,
        west + 2.0 + TRUE_SHIFT[0],
        north - 2.0 + TRUE_SHIFT[1],
        "celsius",
    )
    return opened(a), opened(b)


def where(matrix, px):
    moved = np.c_[px, np.ones(len(px))] @ matrix.T
    return moved[:, :2] / moved[:, 2:]


PX = np.array([[150.0, 150.0], [650.0, 150.0], [150.0, 650.0], [400.0, 400.0]])
THERE = (PX - 20.0 - 0.5) / 2  # px of the thermal map: its content begins 20 px into the visual map


@pytest.mark.slow
def test_the_join_closes_what_positions_leave_open(maps, tmp_path):
    a, b = maps
    joined = join(a, b, (tmp_path / "no", tmp_path / "no"), "maps")
    assert joined.route == "maps"
    off = np.linalg.norm(where(joined.thermal_H_visual, PX) - THERE, axis=1) * GSD_B / GSD_A
    assert np.median(off) < 1.0  # px of the visual map
    placed = join(a, b, (tmp_path / "no", tmp_path / "no"), "positions")
    off = np.linalg.norm(where(placed.thermal_H_visual, PX) - THERE, axis=1) * GSD_B
    assert off == pytest.approx(np.hypot(*TRUE_SHIFT), abs=0.05)


def test_values_are_resampled_only(maps, tmp_path):
    a, b = maps
    joined = join(a, b, (tmp_path / "no", tmp_path / "no"), "positions")
    resample_onto(tmp_path / "thermal.tif", a, b, joined.thermal_H_visual)
    with rasterio.open(tmp_path / "thermal.tif") as out, rasterio.open(a.path) as grid:
        assert (out.transform, out.shape, out.crs) == (grid.transform, grid.shape, grid.crs)
        values = out.read(1)
        assert out.units == ("celsius",)
    known = np.isfinite(values)
    assert 0.7 < known.mean() < 1.0
    original = b.picture.values
    assert np.nanmin(values) >= original.min() - 1e-3
    assert np.nanmax(values) <= original.max() + 1e-3
    assert np.nanmedian(values) == pytest.approx(np.median(original), abs=0.3)


@pytest.mark.slow
def test_maps_that_state_too_large_an_error_are_not_joined(maps, tmp_path, monkeypatch):
    """This registration states 0.0002 to 0.0005 of the diagonal of 537 px."""
    a, b = maps
    folders = (tmp_path / "no", tmp_path / "no")
    monkeypatch.setattr("skyquilt.thermal.routes.MOST_STATED", 0.001)
    assert join(a, b, folders, "maps").route == "maps"
    monkeypatch.setattr("skyquilt.thermal.routes.MOST_STATED", 0.0001)
    with pytest.raises(RefusedError, match="may lie 0 px apart elsewhere"):
        join(a, b, folders, "maps")
    told = join(a, b, folders, "auto")
    assert told.route == "positions" and told.refused[0][0] == "maps"


@pytest.mark.slow
def test_maps_of_other_places_are_not_joined(maps, tmp_path):
    a, _ = maps
    other = write(
        tmp_path / "other.tif", np.float32(280) + ground(9)[:400, :400], GSD_B, 500002.0, 4999998.0
    )
    with pytest.raises(RefusedError, match="both maps are in the output"):
        join(a, opened(other), (tmp_path / "no", tmp_path / "no"), "maps")


def test_heights_lie_on_the_grid_of_the_map_without_their_slope(maps, tmp_path):
    a, _ = maps
    y, x = np.mgrid[0:80, 0:80].astype(np.float32)
    bump = 5 * np.exp(-((x - 40) ** 2 + (y - 20) ** 2) / 50)
    path = write(
        tmp_path / "surface.tif",
        np.float32(100 + 0.3 * x - 0.1 * y + bump),
        1.0,
        500000.0,
        5000000.0,
    )
    picture = heights_on(a, path)
    assert picture.values.shape == a.picture.shape
    row, column = np.unravel_index(np.nanargmax(picture.values), picture.values.shape)
    assert (column, row) == pytest.approx((405, 205), abs=6)
    assert np.nanmedian(picture.values[500:]) == pytest.approx(0, abs=0.8)


def test_wrong_words(tmp_path):
    with pytest.raises(UsageError, match="thermal-route"):
        list(iter_thermal(tmp_path, tmp_path, tmp_path / "out", route="guess"))
    with pytest.raises(UsageError, match="not a folder"):
        list(iter_thermal(tmp_path, tmp_path / "none", tmp_path / "out"))
