"""The least CPU time that a mosaic can cost, and the CPU time of `skyquilt mosaic` for comparison.

The lower limit is (a) decoding every JPEG once at full resolution plus (b) encoding the finished
COG from memory, overviews included. `--run` also measures the whole command, with an empty store,
in a separate process; then (b) is that of its own map, of whatever ground size.

    python benchmarks/floor.py PHOTOS --run 3 -- --gsd 2
    python benchmarks/floor.py PHOTOS --mosaic OUT/mosaic.tif

Words after `--` are passed to skyquilt mosaic.
"""

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import simplejpeg
from cost import Cost, machine, measure, run_process

from skyquilt.raster import RasterSpec, write_array

COMMAND = "import sys; from skyquilt.cli.main import run; sys.argv[0] = 'skyquilt'; run()"
PLACE = (0.02, 0.0, 500_000.0, 0.0, -0.02, 4_500_000.0)
SYNTHETIC_SIDE = 9000


def decode_all(files: list[Path], fast_upsample: bool) -> None:
    """Decode every photo, reading the file included."""
    for file in files:
        simplejpeg.decode_jpeg(file.read_bytes(), fastdct=True, fastupsample=fast_upsample)


def run_mosaic(photos: Path, out: Path, arguments: list[str]) -> tuple[float, float, float]:
    """(CPU s, wall s, peak MB) of one `skyquilt mosaic` into an empty folder, so from a cold
    store.
    """
    shutil.rmtree(out, ignore_errors=True)
    words = ["mosaic", str(photos), "-o", str(out), "--quiet", *arguments]
    return run_process([sys.executable, "-c", COMMAND, *words])


def load_mosaic(path: Path | None, files: list[Path]) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels (h, w, 3) and validity, of a mosaic or, without one, of photos laid side by side."""
    if path is None:
        return tiled_photos(files), None
    with rasterio.open(path) as source:
        pixels = np.ascontiguousarray(np.moveaxis(source.read((1, 2, 3)), 0, 2))
        valid = source.dataset_mask() > 0
    return pixels, None if valid.all() else valid


def tiled_photos(files: list[Path]) -> np.ndarray:
    canvas = np.zeros((SYNTHETIC_SIDE, SYNTHETIC_SIDE, 3), np.uint8)
    row = number = 0
    while row < SYNTHETIC_SIDE:
        col, step = 0, SYNTHETIC_SIDE
        while col < SYNTHETIC_SIDE:
            photo = simplejpeg.decode_jpeg(files[number % len(files)].read_bytes())
            part = photo[: SYNTHETIC_SIDE - row, : SYNTHETIC_SIDE - col]
            canvas[row : row + part.shape[0], col : col + part.shape[1]] = part
            col, step, number = col + photo.shape[1], min(step, photo.shape[0]), number + 1
        row += step
    return canvas


def write_ours(path: Path, pixels: np.ndarray, valid: np.ndarray | None, quality: int) -> None:
    height, width, bands = pixels.shape
    spec = RasterSpec(
        width=width,
        height=height,
        bands=bands,
        dtype="uint8",
        transform=PLACE,
        crs="EPSG:32615",
        compress="jpeg",
        quality=quality,
        mask=valid is not None,
    )
    write_array(path, pixels, spec, valid)


def write_gdal(path: Path, pixels: np.ndarray, valid: np.ndarray | None, quality: int) -> None:
    """GDAL's COG driver at the same quality, overviews averaged."""
    height, width, bands = pixels.shape
    shape = {"width": width, "height": height, "count": bands, "dtype": "uint8"}
    options = {
        "compress": "JPEG",
        "quality": quality,
        "blocksize": 512,
        "overview_resampling": "average",
    }
    place = {"crs": "EPSG:32615", "transform": rasterio.Affine(*PLACE)}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_NUM_THREADS=1),
        rasterio.open(path, "w", driver="COG", **shape, **options, **place) as sink,
    ):
        sink.write(np.moveaxis(pixels, 2, 0))
        if valid is not None:
            sink.write_mask(valid)


def measure_floor(options: argparse.Namespace) -> dict[str, Cost | float]:
    files = sorted(
        path for path in options.photos.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg")
    )
    if not files:
        sys.exit(f"no JPEG in {options.photos}")
    results: dict[str, Cost | float] = {"photos": len(files)}
    for name, fast in (("decode_fast_upsample", True), ("decode", False)):
        results[name] = measure(lambda fast=fast: decode_all(files, fast), options.repeat)
    pixels, valid = load_mosaic(options.mosaic, files)
    results["megapixels"] = pixels.shape[0] * pixels.shape[1] / 1e6
    results["valid_share"] = 1.0 if valid is None else float(valid.mean())
    with tempfile.TemporaryDirectory() as folder:
        ours, gdal = Path(folder) / "ours.tif", Path(folder) / "gdal.tif"
        results["encode"] = measure(
            lambda: write_ours(ours, pixels, valid, options.quality), options.repeat
        )
        gdal_runs = 1 if options.repeat < 4 else 2
        results["encode_gdal"] = measure(
            lambda: write_gdal(gdal, pixels, valid, options.quality), gdal_runs
        )
        results["file_mb"], results["file_gdal_mb"] = (
            path.stat().st_size / 1e6 for path in (ours, gdal)
        )
    costs: dict[str, Any] = results
    decode = min(costs[name].cpu_median for name in ("decode", "decode_fast_upsample"))
    costs["floor"] = decode + costs["encode"].cpu_median
    return results


def main() -> None:
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    own, further = words[:cut], words[cut + 1 :]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, help="folder of JPEGs")
    parser.add_argument(
        "--mosaic",
        type=Path,
        help="RGB GeoTIFF to encode; default: that of --run, else 81 MP of photos side by side",
    )
    parser.add_argument("--quality", type=int, default=85, help="JPEG quality")
    parser.add_argument(
        "--repeat", type=int, default=5, help="runs of each measurement after one warm-up"
    )
    parser.add_argument(
        "--run", type=int, default=0, metavar="N", help="also run skyquilt mosaic N times"
    )
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    options = parser.parse_args(own)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        runs = [run_mosaic(options.photos, out, further) for _ in range(options.run)]
        if runs and options.mosaic is None:
            options.mosaic = out / "mosaic.tif"
        results = measure_floor(options)
    if runs:
        cpu, wall, peak = zip(*runs, strict=True)
        costs: dict[str, Any] = results
        results["run"] = Cost.of(list(cpu), list(wall), max(peak))
        costs["ratio"] = costs["run"].cpu_median / costs["floor"]
    report = {"machine": machine()} | {
        key: asdict(value) if isinstance(value, Cost) else value for key, value in results.items()
    }
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    show(report["machine"], results)


def show(where: dict, results: dict[str, Cost | float]) -> None:
    print(", ".join(f"{key} {value}" for key, value in where.items()))
    print(f"{'':24}{'CPU s':>8}{'min':>8}{'max':>8}{'wall s':>8}{'runs':>6}{'peak MB':>9}")
    for name, value in results.items():
        if isinstance(value, Cost):
            figures = (value.cpu_median, value.cpu_min, value.cpu_max, value.wall_median)
            peak = f"{value.peak_mb:9.0f}" if value.peak_mb is not None else ""
            print(
                f"{name:24}"
                + "".join(f"{figure:8.2f}" for figure in figures)
                + f"{value.runs:6}{peak}"
            )
        else:
            print(f"{name:24}{value:8.2f}")


if __name__ == "__main__":
    main()
