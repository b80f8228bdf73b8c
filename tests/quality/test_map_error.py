"""Map error of rasters displaced by known fields."""

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from skyquilt.quality.map_error import map_error
from tests.texture import texture

GSD = 0.05
WEST, NORTH = 500000.0, 4000000.0


def write(path, grey, *, gsd=GSD, west=WEST, north=NORTH, known=None, crs="EPSG:32615"):
    """A grey (H, W) or colour GeoTIFF, with alpha where `known` is given."""
    bands = [np.clip(grey, 0, 255).astype(np.uint8)] * 3
    if known is not None:
        bands.append(np.uint8(known) * 255)
    height, width = grey.shape
    profile = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": len(bands),
        "dtype": "uint8",
    }
    place = {"crs": crs, "transform": from_origin(west, north, gsd, gsd)}
    with rasterio.open(
        path, "w", **profile, **place, photometric="RGB", alpha="YES" if known is not None else "NO"
    ) as out:
        out.write(np.array(bands))
    return path


@pytest.fixture(scope="module")
def ground():
    return texture(1200, 1600, seed=5)


def displaced(grey, dx, dy):
    """The image whose content lies (dx, dy) px further right and down; arrays or numbers."""
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float32)
    return cv2.remap(
        grey, np.float32(x - dx), np.float32(y - dy), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def test_identical_rasters_have_no_error(tmp_path, ground):
    path = write(tmp_path / "a.tif", ground)
    result = map_error(path, path, points=100)
    assert result.measured == result.attempted > 90
    assert result.absolute.p95_px < 1e-3


@pytest.mark.parametrize(
    "shift",
    [
        (37.3, -61.6),
        *(pytest.param(v, marks=pytest.mark.slow) for v in ((0.5, -0.25), (-150.0, 120.0))),
    ],
)
def test_a_shifted_map_is_all_bias(tmp_path, ground, shift):
    rng = np.random.default_rng(0)
    moved = displaced(ground, *shift) * 0.8 + 20 + rng.normal(0, 2, ground.shape)
    result = map_error(
        write(tmp_path / "m.tif", moved), write(tmp_path / "t.tif", ground), points=100
    )
    assert result.measured > 0.9 * result.attempted > 50
    assert result.bias_x_m == pytest.approx(shift[0] * GSD, abs=0.05 * GSD)
    assert result.bias_y_m == pytest.approx(-shift[1] * GSD, abs=0.05 * GSD)  # rows run south
    assert result.absolute.median_px == pytest.approx(np.hypot(*shift), rel=0.01, abs=0.05)
    assert 0.001 < result.relative.median_px < 0.05


@pytest.mark.slow
def test_a_warped_map_gives_back_its_field(tmp_path, ground):
    y, x = np.mgrid[: ground.shape[0], : ground.shape[1]]
    dx, dy = 30 + 12 * np.sin(x / 250), -10 + 0.012 * (y - 600)
    moved = displaced(ground, dx, dy)
    result = map_error(
        write(tmp_path / "m.tif", moved), write(tmp_path / "t.tif", ground), points=150
    )
    assert result.measured > 0.9 * result.attempted
    inner = [s for s in result.samples if s.ok and WEST + 6 < s.x < WEST + 74]
    column = np.array([(s.x - WEST) / GSD - 0.5 for s in inner])
    row = np.array([(NORTH - s.y) / GSD - 0.5 for s in inner])
    error = np.array([[s.error_x_m, -s.error_y_m] for s in inner]) / GSD
    true = np.stack([30 + 12 * np.sin(column / 250), -10 + 0.012 * (row - 600)], 1)
    # the field was given at places in the mosaic, as the samples' are
    assert np.median(np.hypot(*(error - true).T)) < 0.05
    assert np.percentile(np.hypot(*(error - true).T), 95) < 0.2
    assert result.relative.median_px > 5


def test_grids_may_differ_and_voids_are_left_out(tmp_path, ground):
    known = np.ones(ground.shape, bool)
    known[:, :500] = False
    mosaic = write(tmp_path / "m.tif", np.where(known, ground, 0), known=known)
    half = cv2.resize(ground, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)[40:, 60:]
    truth = write(
        tmp_path / "t.tif", half, gsd=GSD / 2, west=WEST + 30 * GSD, north=NORTH - 20 * GSD
    )
    result = map_error(mosaic, truth, points=100)
    assert 50 < result.attempted < 75
    assert result.measured > 0.95 * result.attempted
    assert result.absolute.median_px < 0.05
    assert min(s.x for s in result.samples) > WEST + 500 * GSD


def test_another_place_altogether_is_not_given_figures(tmp_path, ground):
    result = map_error(
        write(tmp_path / "m.tif", ground[::-1]), write(tmp_path / "t.tif", ground), points=64
    )
    assert result.attempted > 10
    assert result.measured <= 2


def test_rasters_that_cannot_be_compared_are_refused(tmp_path, ground):
    small = ground[:200, :200]
    a = write(tmp_path / "a.tif", small)
    with pytest.raises(ValueError, match="one CRS expected"):
        map_error(a, write(tmp_path / "b.tif", small, crs="EPSG:32616"))
    with pytest.raises(ValueError, match="do not overlap"):
        map_error(a, write(tmp_path / "c.tif", small, west=WEST + 1000))
