"""The writer against rasterio (GDAL) as reader and rio-cogeo as validator."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image
from rasterio.enums import MaskFlags
from scipy.ndimage import distance_transform_edt

from skyquilt.errors import UsageError
from skyquilt.raster import CogWriter, RasterSpec, write_array
from skyquilt.raster.codecs import FADED_RIM, KEPT_RIM, smooth_fill

from .raster_cases import PLACE, assert_valid_cog, disc, picture, psnr, read, spec_for

RNG = np.random.default_rng(1)


@pytest.mark.parametrize("compress", ["deflate", "zstd", "lzw", "none"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32", "int16", "float32"])
@pytest.mark.parametrize("bands", [1, 3, 5])
def test_lossless_pixels_come_back_exactly(tmp_path, compress, dtype, bands):
    array = (RNG.normal(size=(70, 101, bands)).cumsum(1) * 1000).astype(dtype)
    spec = spec_for(array, compress=compress, tile=32, overviews="nearest")
    write_array(tmp_path / "a.tif", array, spec)
    np.testing.assert_array_equal(read(tmp_path / "a.tif")[0], array)
    np.testing.assert_array_equal(read(tmp_path / "a.tif", 0)[0], array[::2, ::2])
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.dtypes == (dtype,) * bands


def test_metadata_come_back(tmp_path):
    array = picture(600, 700)
    spec = spec_for(
        array,
        tags={"DATUM": "take-off <&> \"x\" 'y' ]]> ü"},
        band_names=("r & g", "g", "b"),
        band_units=("m", "", "°C"),
    )
    write_array(tmp_path / "a.tif", array, spec)
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.tags().items() >= spec.tags.items()
        assert source.descriptions == spec.band_names
        assert source.units == ("m", None, "°C")
        assert tuple(source.transform)[:6] == PLACE
        assert source.crs.to_epsg() == 32615
        assert source.overviews(1) == [2]
        assert source.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert source.tags()["AREA_OR_POINT"] == "Area"
    assert_valid_cog(tmp_path / "a.tif")


@pytest.mark.parametrize("bands", [1, 3])
def test_jpeg_is_as_good_as_another_encoder_s(tmp_path, bands):
    from io import BytesIO

    from PIL import Image

    noise = RNG.normal(scale=6, size=(1024, 1024, bands))
    array = np.clip(picture(1024, 1024, bands) + noise, 0, 255).astype(np.uint8)
    write_array(tmp_path / "a.tif", array, spec_for(array, compress="jpeg"))
    Image.fromarray(array.squeeze()).save(other := BytesIO(), "JPEG", quality=85, subsampling=2)
    expected = np.asarray(Image.open(other)).reshape(array.shape)
    assert psnr(read(tmp_path / "a.tif")[0], array) > psnr(expected, array) - 0.3
    assert (tmp_path / "a.tif").stat().st_size < 1.6 * len(other.getvalue())  # overviews
    assert_valid_cog(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.profile.get("photometric") == ("ycbcr" if bands == 3 else None)
        assert source.tags(ns="IMAGE_STRUCTURE")["JPEG_QUALITY"] == "85"


@pytest.mark.slow
def test_jpeg_with_mask(tmp_path):
    array, valid = picture(1500, 2100), disc(1500, 2100)
    write_array(tmp_path / "a.tif", array, spec_for(array, compress="jpeg", mask=True), valid)
    pixels, mask = read(tmp_path / "a.tif")
    np.testing.assert_array_equal(mask, valid)
    assert np.abs(pixels[valid].astype(int) - array[valid]).max() < 40
    with rasterio.open(tmp_path / "a.tif") as source:
        assert source.mask_flag_enums == ([MaskFlags.per_dataset],) * 3
        assert source.overviews(1) == [2, 4, 8]
    half = valid.reshape(750, 2, 1050, 2).any((1, 3))
    np.testing.assert_array_equal(read(tmp_path / "a.tif", 0)[1], half)
    assert_valid_cog(tmp_path / "a.tif")


def test_the_rim_keeps_its_colour(tmp_path, monkeypatch):
    """Black beyond the rim would ring into it; what is filled in must be clearly better."""
    array, valid = np.clip(picture(700, 900), 60, 255) // 3 + 120, disc(700, 900)
    rim = valid & ~np.roll(valid, 1, 0)
    write_array(tmp_path / "a.tif", array, spec_for(array, compress="jpeg", mask=True), valid)
    monkeypatch.setattr(
        "skyquilt.raster.codecs.smooth_fill", lambda pixels, v: pixels * v[..., None]
    )
    write_array(tmp_path / "b.tif", array, spec_for(array, compress="jpeg", mask=True), valid)
    filled, black = (psnr(read(tmp_path / name)[0][rim], array[rim]) for name in ("a.tif", "b.tif"))
    assert filled > black + 4


def test_beyond_the_rim_it_fades_without_steps():
    """Programs that ignore masks show neither blocks nor streaks; distances are SciPy's."""
    valid = disc(400, 500)
    array = np.full((400, 500, 3), (250, 130, 60), np.uint8)
    out = smooth_fill(array, valid).astype(int)
    apart = distance_transform_edt(~valid)
    near = apart < 0.94 * KEPT_RIM
    assert (out[near] == array[near]).all()
    assert not out[apart > 1.06 * (KEPT_RIM + FADED_RIM)].any()  # OpenCV's distances err by 5 %
    for axis in (0, 1):
        assert np.abs(np.diff(out, axis=axis)).max() <= 1.3 * 250 / FADED_RIM + 1
    assert not smooth_fill(array, np.zeros_like(valid)).any()
    assert (smooth_fill(array, np.ones_like(valid)) == array).all()


@pytest.mark.slow
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.integers(1, 1500), st.integers(1, 700), st.sampled_from(["jpeg", "deflate"]), st.booleans()
)
@example(256, 513, "deflate", False)
@example(511, 1025, "jpeg", True)
def test_any_size(tmp_path, width, height, compress, mask):
    array, valid = picture(height, width), disc(height, width) if mask else None
    write_array(
        tmp_path / "a.tif", array, spec_for(array, compress=compress, mask=mask, tile=256), valid
    )
    pixels, seen = read(tmp_path / "a.tif")
    inside = np.ones((height, width), bool) if valid is None else valid
    np.testing.assert_array_equal(seen, inside)
    worst = np.abs(pixels[inside].astype(int) - array[inside]).max(initial=0)
    assert worst <= (60 if compress == "jpeg" else 0)
    if width > 1:  # the validator's decimation is a ratio of widths
        assert_valid_cog(tmp_path / "a.tif")


def test_overviews_are_the_mean_of_the_valid(tmp_path):
    array = RNG.uniform(-5, 60, (1301, 1103)).astype(np.float32)
    array[~disc(1301, 1103)] = np.nan
    write_array(tmp_path / "a.tif", array, spec_for(array, nodata=np.nan))
    level = array
    for number in range(2):
        level = np.pad(level, ((0, level.shape[0] % 2), (0, level.shape[1] % 2)), mode="edge")
        quads = (
            level.reshape(level.shape[0] // 2, 2, -1, 2)
            .swapaxes(1, 2)
            .reshape(-1, level.shape[1] // 2, 4)
        )
        count = np.isfinite(quads).sum(-1)
        level = np.where(count, np.nansum(quads, -1) / np.maximum(count, 1), np.nan).astype(
            np.float32
        )
        got, mask = read(tmp_path / "a.tif", number)
        np.testing.assert_allclose(got[..., 0], level, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(mask, np.isfinite(level))
    assert_valid_cog(tmp_path / "a.tif")


def test_gdal_s_own_average_agrees(tmp_path):
    array = RNG.integers(0, 255, (1024, 1536, 3), dtype=np.uint8)
    write_array(tmp_path / "ours.tif", array, spec_for(array))
    options = {
        "driver": "COG",
        "blocksize": 512,
        "overview_resampling": "average",
        "crs": "EPSG:32615",
    }
    shape = {
        "width": 1536,
        "height": 1024,
        "count": 3,
        "dtype": "uint8",
        "transform": rasterio.Affine(*PLACE),
    }
    with rasterio.open(tmp_path / "gdal.tif", "w", **options, **shape) as sink:
        sink.write(np.moveaxis(array, 2, 0))
    ours, theirs = read(tmp_path / "ours.tif", 0)[0], read(tmp_path / "gdal.tif", 0)[0]
    assert np.abs(ours.astype(int) - theirs).max() <= 1


@pytest.mark.parametrize(
    "kind", [{"compress": "jpeg", "mask": True}, {"compress": "lzw", "nodata": 9}]
)
def test_tiles_without_a_valid_pixel_open_in_programs_that_know_no_missing_ones(tmp_path, kind):
    """Pillow, like most, reads through libtiff, which refuses tiles of no bytes."""
    array, valid = picture(1500, 1100), disc(1500, 1100)
    valid[:520, :520] = False
    write_array(tmp_path / "a.tif", array, spec_for(array, tile=256, **kind), valid)
    with Image.open(tmp_path / "a.tif") as file:
        seen = np.asarray(file)
    pixels, mask = read(tmp_path / "a.tif")
    np.testing.assert_array_equal(mask, valid)
    np.testing.assert_array_equal(pixels[:512, :512], kind.get("nodata", 0))
    # decoders of JPEG draw colours out in ways of their own
    assert np.abs(seen.astype(int) - pixels).max() <= (16 if kind["compress"] == "jpeg" else 0)
    assert_valid_cog(tmp_path / "a.tif")


@pytest.mark.slow
def test_empty_tiles_that_would_double_the_file_take_no_room(tmp_path):
    array = np.full((4096, 4096, 3), 77, np.uint8)
    valid = np.zeros((4096, 4096), bool)
    valid[2100:2200, 2100:2200] = True
    for compress in ("jpeg", "deflate"):
        spec = spec_for(array, compress=compress, mask=True)
        write_array(tmp_path / "a.tif", array, spec, valid)
        pixels, mask = read(tmp_path / "a.tif")
        np.testing.assert_array_equal(mask, valid)
        assert np.abs(pixels[valid].astype(int) - 77).max() <= (compress == "jpeg")
        assert not pixels[:2048].any()
        assert (tmp_path / "a.tif").stat().st_size < 30_000
        assert_valid_cog(tmp_path / "a.tif")


def test_nothing_valid_at_all(tmp_path):
    array = np.full((700, 900), np.nan, np.float32)
    write_array(tmp_path / "a.tif", array, spec_for(array, nodata=np.nan))
    assert np.isnan(read(tmp_path / "a.tif")[0]).all()
    assert_valid_cog(tmp_path / "a.tif")


def test_bigtiff(tmp_path):
    array, valid = picture(1300, 900), disc(1300, 900)
    with CogWriter(
        tmp_path / "a.tif", spec_for(array, compress="jpeg", mask=True), bigtiff=True
    ) as writer:
        for block in writer.blocks():
            writer.write_block(block, array, valid)
    assert (tmp_path / "a.tif").read_bytes()[:4] == b"II\x2b\0"
    pixels, mask = read(tmp_path / "a.tif")
    np.testing.assert_array_equal(mask, valid)
    assert np.abs(pixels[valid].astype(int) - array[valid]).max() < 40
    assert_valid_cog(tmp_path / "a.tif")


def test_large_files_become_bigtiff(tmp_path, monkeypatch):
    monkeypatch.setattr("skyquilt.raster.assemble.BIG", 1000)
    array = RNG.integers(0, 255, (64, 64), dtype=np.uint8)
    write_array(tmp_path / "a.tif", array, spec_for(array))
    assert (tmp_path / "a.tif").read_bytes()[:4] == b"II\x2b\0"
    np.testing.assert_array_equal(read(tmp_path / "a.tif")[0][..., 0], array)


def test_mistakes_state_both_sides(tmp_path):
    array = picture(100, 100)
    with pytest.raises(ValueError, match="JPEG takes 1 or 3 bands of uint8, got 3 of uint16"):
        spec_for(array.astype(np.uint16), compress="jpeg")
    with pytest.raises(ValueError, match="JPEG does not keep a nodata value"):
        spec_for(array, compress="jpeg", nodata=0)
    for nodata in (np.nan, -1, 256, 0.5):
        with pytest.raises(ValueError, match="uint8 cannot hold the nodata value"):
            spec_for(array, nodata=nodata)
    with pytest.raises(
        ValueError, match=r"is \(100, 100, 3\) of uint8, got \(99, 100, 3\) of uint8"
    ):
        write_array(tmp_path / "a.tif", array[1:], spec_for(array))
    with CogWriter(tmp_path / "b.tif", spec_for(array)) as writer:
        writer.write_tile(0, 0, array)
        with pytest.raises(ValueError, match="already written"):
            writer.write_tile(0, 0, array)
        with pytest.raises(ValueError, match="outside the raster's 1 x 1 tiles"):
            writer.write_tile(0, 1, array)
        with pytest.raises(ValueError, match=r"1 of 1 blocks of b\.tif were never finished"):
            writer.close()
        writer.finish_block(next(writer.blocks()))
    assert not (tmp_path / "a.tif").exists()
    assert [path.name for path in Path(tmp_path).iterdir()] == ["b.tif"]


WAVES = picture(60, 50, 1)[..., 0]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize(
    "laid",
    [
        np.asfortranarray,
        lambda a: np.repeat(a, 2, 1)[:, ::2],
        lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
        lambda a: a.astype(a.dtype.newbyteorder(">")),
        lambda a: a[..., None],
        lambda a: np.ma.array(a),
        np.ndarray.tolist,
    ],
    ids=["columns first", "every other", "backwards", "big endian", "a band", "unmasked", "lists"],
)
def test_arrays_of_any_layout_give_the_same_file(tmp_path, laid, dtype):
    array = WAVES.astype(dtype)
    array.flags.writeable = False
    known = laid(array)
    known = np.array(known, dtype) if isinstance(known, list) else known
    write_array(tmp_path / "a.tif", array, spec_for(array))
    write_array(tmp_path / "b.tif", known, spec_for(array))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    with rasterio.open(tmp_path / "b.tif") as source:
        assert np.array_equal(source.read(1), array)


@pytest.mark.parametrize(
    ("array", "valid", "words"),
    [
        (np.ones((120, 100), np.uint8), None, "array is"),  # it had been cropped
        (WAVES.T, None, "array is"),
        (WAVES[:0], None, "array is"),
        (WAVES.ravel(), None, "array is"),
        (np.dstack([WAVES] * 3), None, "array is"),
        (WAVES.astype(float), None, "array is"),
        (WAVES.astype(np.int64), None, "array is"),
        (WAVES > 9, None, "array is"),
        (WAVES.astype(object), None, "array is"),
        (None, None, "array is"),
        (np.ma.array(WAVES, mask=WAVES > 99), None, "array has masked"),
        (WAVES, np.ones((5, 5), bool), "valid is"),
        (WAVES, np.ones((120, 100), bool), "valid is"),
        (WAVES, WAVES, "valid is"),
        (WAVES, True, "valid is"),
    ],
)
def test_arrays_that_are_not_as_the_specification_are_refused(tmp_path, array, valid, words):
    with pytest.raises(ValueError, match=words):
        write_array(tmp_path / "a.tif", array, spec_for(WAVES), valid)
    assert not list(tmp_path.iterdir())


NOT_MEANT = {
    "width": [0, -1, 1.5, "40", None, np.nan, True],
    "height": [0, 10.5, np.array([3, 4])],
    "bands": [0, 1.5, "x"],
    "dtype": ["float64", "nonsense", None, np.float32],
    "transform": [None, (1, 2, 3), (0,) * 6, (np.nan,) * 6, "abcdef", (1, 1, 0, 1, 1, 0), 5],
    "crs": ["EPSG:0", "", "nonsense", 5, "x" * 10_000],
    "vertical": ["EPSG:5773", -1, 0, 1.5],
    "nodata": ["x", [1]],
    "compress": ["zip", None, "JPEG"],
    "quality": [0, -1, 101, 1e9, "x", 1.5, np.inf],
    "overviews": ["sum", None],
    "tile": [0, 15, 2**20, "x", 512.5],
    "band_names": ["a", [1], 5, ("a", "b")],
    "band_units": ["m", ("m", "m")],
    "mask": ["yes", 5, None],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, vs in NOT_MEANT.items() for v in vs])
def test_specifications_that_cannot_be_meant_are_refused_by_name(name, value):
    """Such a `quality` or `transform` had made a file."""
    known = {"width": 40, "height": 30, "bands": 1, "dtype": "uint8", "transform": PLACE}
    with pytest.raises((ValueError, UsageError), match=name) as refused:
        RasterSpec(**known | {name: value})
    assert len(str(refused.value)) < 300
