"""How true and how sharp the map is: simulated flights against their true orthophotos.

    python benchmarks/picture.py [--seeds 21,22,23,24,25] [--photos 24] [--work FOLDER]
        [--json FILE] [--no-oracle] [--other FOLDER] [-- --surface dense ...]

Every flight (with control points) is simulated once and kept in the work folder. Two pictures are
compared with its true orthophoto, on that orthophoto's grid:

- `map`: the product's own map; words after `--` go to `skyquilt mosaic`;
- `oracle`: the same renderer with the true poses, the true calibration and the true heights. It is
  the best that better poses and heights alone could reach. It stays below 1, because the true
  orthophoto has no texture on flanks, and because photos are resampled once more.

`--other FOLDER` compares maps of another program as well: FOLDER/<seed>.tif.

Figures: SSIM (Wang et al. 2004; grey, windows of 7 x 7 px, range 255, after one gain and offset for
the whole map) within 1.5 m of a height step of more than 1 m, and elsewhere; local displacement
(phase correlation of windows of 64 px, after one shift of the whole map), median and 90th
percentile in px; gradient energy on open ground over that of the truth; heights against the true
surface, in GSD: NMAD on open ground and on objects 1 m inside their edges (all, and those that
three photos or more show); share of the edges'
length (where the surface crosses half of an object's height) that lie within 4 GSD of the true
ones; share of the cells shown by two photos or more that had a height of their own before gaps
were filled.
"""

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from cost import run_process
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from skyquilt import simulate as sim
from skyquilt.imaging.views import make_views
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Alignment, MapFrame, Pose, no_ties
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Feather
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.exposure import Balance
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo

STEP_M, NEAR_M, OVER_M = 1.0, 1.5, 0.5
"""A height step is a rise of more than STEP_M within OVER_M; near is within NEAR_M of one."""
WINDOW = 64
"""Side in px of the windows whose displacement is measured."""
LEAST_RESPONSE = 0.03
"""Least response of a phase correlation to be counted."""
NEAR_EDGE_GSD = 4.0
"""Largest displacement of an edge that is found."""
COMMAND = """
import sys
import numpy as np
from skyquilt.cli.main import run
from skyquilt.ortho import stereo

whole, kept = stereo.with_coarse, sys.argv.pop(1)

def noted(z, known, rough, cells, side):
    np.savez(kept, known=known)
    return whole(z, known, rough, cells, side)

stereo.with_coarse = noted
sys.argv[0] = "skyquilt"
run()
"""
"""The product's command; which cells had a height of their own is kept in a file."""
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Truth:
    """The truth of one flight."""

    grey: Floats
    """(h, w) grey values of the true orthophoto."""
    height: Floats
    """(h, w) the true surface in m above the sea."""
    near: NDArray[np.bool_]
    """(h, w) within 1.5 m of a height step."""
    inner: NDArray[np.bool_]
    """(h, w) on objects, at least 1 m inside their edges."""
    profile: dict[str, Any]
    """CRS, transform, width and height of the grid."""

    @property
    def gsd(self) -> float:
        return float(self.profile["transform"].a)


def main() -> int:
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="21,22,23,24,25")
    parser.add_argument("--photos", type=int, default=24)
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-picture"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-oracle", action="store_true")
    parser.add_argument("--other", type=Path)
    options = parser.parse_args(words[:cut])
    rows: dict[str, dict[str, float]] = {}
    for seed in (int(s) for s in options.seeds.split(",")):
        flight = flown(seed, options.photos, options.work)
        truth = truth_of(flight)
        if not options.no_oracle:
            rows[f"oracle {seed}"] = picture_figures(oracle(flight, truth, options.work), truth)
        rows[f"map {seed}"] = product(flight, truth, options.work / f"map-{seed}", words[cut + 1 :])
        if options.other:
            rows[f"other {seed}"] = picture_figures(
                on_grid(options.other / f"{seed}.tif", truth), truth
            )
        for name in [n for n in rows if n.endswith(f" {seed}")]:
            show(name, rows[name])
    for kind in dict.fromkeys(name.split()[0] for name in rows):
        every = [row for name, row in rows.items() if name.startswith(kind)]
        show(f"{kind} median", {k: float(np.median([r[k] for r in every])) for k in every[0]})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))
    return 0


def show(name: str, row: dict[str, float]) -> None:
    print(f"{name:14s} " + "  ".join(f"{k} {v:.3f}" for k, v in row.items()), flush=True)


def flown(seed: int, photos: int, work: Path) -> Path:
    """A simulated flight with control points; from the work folder if it is there."""
    from dataclasses import replace

    flight = work / f"flight-{photos}-{seed}"
    if not (flight / "truth" / "truth.json").is_file():
        base = sim.preset("default")
        asked = replace(base, seed=seed, route=replace(base.route, photos=photos))
        for _ in sim.simulate(asked, flight, overwrite=True):
            pass
    return flight


def truth_of(flight: Path) -> Truth:
    with rasterio.open(flight / "truth" / "truth_ortho.tif") as source:
        rgb = np.moveaxis(source.read(), 0, 2)
        profile = {k: source.profile[k] for k in ("crs", "transform", "width", "height")}
    with rasterio.open(flight / "truth" / "truth_surface.tif") as source:
        height = source.read(1)
    gsd = float(profile["transform"].a)
    side = 2 * round(OVER_M / gsd / 2) + 1
    box = np.ones((side, side), np.uint8)
    steep = cv2.dilate(height, box) - cv2.erode(height, box) > STEP_M
    near = cv2.dilate(steep.astype(np.uint8), disc(NEAR_M / gsd)) > 0
    ground = cv2.morphologyEx(
        cv2.resize(height, None, fx=0.1, fy=0.1, interpolation=cv2.INTER_AREA),
        cv2.MORPH_OPEN,
        disc(12 / (10 * gsd)),
    )
    ground = cv2.resize(ground, height.shape[::-1], interpolation=cv2.INTER_LINEAR)
    raised = (height - ground > STEP_M).astype(np.uint8)
    return Truth(
        grey=cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32),
        height=height,
        near=near,
        inner=cv2.erode(raised, disc(1.0 / gsd)) > 0,
        profile=profile,
    )


def disc(radius: float) -> NDArray[np.uint8]:
    side = 2 * round(radius) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def product(flight: Path, truth: Truth, out: Path, words: list[str]) -> dict[str, float]:
    """The figures of the product's map, its heights and its cost."""
    shutil.rmtree(out, ignore_errors=True)
    control = ["--gcp", str(flight / "gcp_list.txt")]
    told = ["mosaic", str(flight / "photos"), "-o", str(out), *control, "--quiet", *words]
    kept = out.with_suffix(".npz")
    kept.unlink(missing_ok=True)
    cpu, _, peak = run_process([sys.executable, "-c", COMMAND, str(kept), *told])
    figures = picture_figures(on_grid(out / "mosaic.tif", truth), truth)
    heights = out / "dsm.tif" if (out / "dsm.tif").is_file() else out / "surface.tif"
    found = {**figures, **height_figures(heights, out / "views.tif", truth)}
    if kept.is_file():
        found["measured"] = measured_share(kept, out / "views.tif")
    return {**found, "cpu_s": cpu, "peak_mb": peak}


def measured_share(kept: Path, views: Path) -> float:
    """Share of the cells that two photos or more show which had a height of their own; cells begin
    at the corner of the map, of which `views` gives the number of photos per place.
    """
    known = np.load(kept)["known"]
    with rasterio.open(views) as source:
        number = source.read(1, out_shape=known.shape, resampling=Resampling.nearest)
    return float(known[number >= 2].mean())


def on_grid(path: Path, truth: Truth) -> Floats:
    """(h, w) grey values of a map on the truth's grid, NaN where it shows nothing."""
    with (
        rasterio.open(path) as source,
        WarpedVRT(
            source, resampling=Resampling.cubic, add_alpha=source.count == 3, **truth.profile
        ) as vrt,
    ):
        bands = vrt.read()
    grey = cv2.cvtColor(np.ascontiguousarray(np.moveaxis(bands[:3], 0, 2)), cv2.COLOR_RGB2GRAY)
    return np.where(bands[3] > 127, grey, np.nan).astype(np.float32)


def oracle(flight: Path, truth: Truth, work: Path) -> Floats:
    """(h, w) grey values of our renderer's picture with true poses, calibration and heights."""
    record = json.loads((flight / "truth" / "truth.json").read_text())
    shots = [p for p in record["photos"] if p["band"] == "visible"]
    photos = [read_photo(flight / p["file"]) for p in shots]
    east, north = record["origin"]
    names = ("width", "height", "focal", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
    alignment = Alignment(
        method="truth",
        why="",
        frame=MapFrame(crs=record["crs"], origin=(east, north), vertical_datum="sea_level"),
        poses={
            i: Pose(
                cam_R_map=np.array(p["cam_R_map"]),
                map_C=np.array(p["position"]) - (east, north, 0.0),
            )
            for i, p in enumerate(shots)
        },
        cameras={
            k: Camera(**{n: v for n, v in c.items() if n in names})
            for k, c in record["cameras"].items()
        },
        camera_of={i: p["camera"] for i, p in enumerate(shots)},
        blocks=(tuple(range(len(shots))),),
        ties=no_ties(),
    )
    at = truth.profile["transform"]
    surface = Surface(
        z=np.ascontiguousarray(truth.height[::-1]),
        x0=at.c - east + at.a / 2,
        y0=at.f - north - at.a * (truth.profile["height"] - 0.5),
        cell=at.a,
        source="truth",
    )
    views = make_views(alignment, surface)
    west, top = at.c - east, at.f - north
    # not `grid_of`, which would move the grid by a part of a pixel
    size = {k: int(truth.profile[k]) for k in ("width", "height")}
    grid = Grid(west=west, north=top, gsd=at.a, **size)
    kept: dict[int, Any] = {}

    def pixels(photo: int) -> Any:
        return kept.setdefault(photo, read_color(photos[photo]))

    thumbnails = {i: cv2.resize(pixels(i), None, fx=0.16, fy=0.16) for i in range(len(shots))}
    compose = Composer(
        grid=grid,
        views=views,
        surface=surface,
        blend=Feather(),
        pixels=pixels,
        bands=3,
        dtype=np.dtype(np.uint8),
        detailed=True,
        exposure=Balance()(views, thumbnails, surface, grid.bounds),
    )
    height, width = truth.grey.shape
    drawn = compose(Window(row=0, column=0, height=height, width=width))
    return np.where(
        drawn.photo >= 0, cv2.cvtColor(drawn.pixels, cv2.COLOR_RGB2GRAY), np.nan
    ).astype(np.float32)


def picture_figures(grey: Floats, truth: Truth) -> dict[str, float]:
    """The figures of a picture (h, w) on the truth's grid."""
    known = np.isfinite(grey)
    picture = fitted(grey, truth.grey, known)
    whole = cv2.erode(known.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    similar = ssim(picture, truth.grey)
    moved = displacements(picture, truth.grey, whole)
    length = np.hypot(*(moved - np.median(moved, axis=0)).T)
    energy = [
        cv2.Sobel(g, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(g, cv2.CV_32F, 0, 1) ** 2
        for g in (picture, truth.grey)
    ]
    open_ = whole & ~truth.near
    return {
        "near": float(similar[whole & truth.near].mean()),
        "away": float(similar[open_].mean()),
        "moved_p50_px": float(np.percentile(length, 50)),
        "moved_p90_px": float(np.percentile(length, 90)),
        "energy": float(energy[0][open_].mean() / energy[1][open_].mean()),
    }


def fitted(grey: Floats, truth: Floats, known: NDArray[np.bool_]) -> Floats:
    """The picture with one gain and one offset, by least squares; the truth where it is unknown."""
    a, b = np.polyfit(grey[known].astype(np.float64), truth[known].astype(np.float64), 1)
    return np.where(known, np.float32(a) * grey + np.float32(b), truth).astype(np.float32)


def ssim(a: Floats, b: Floats) -> Floats:
    """(h, w) structural similarity in windows of 7 x 7 px."""
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2

    def mean(x: Floats) -> Floats:
        return np.asarray(cv2.blur(x, (7, 7)), np.float32)

    ma, mb = mean(a), mean(b)
    va, vb, vab = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    return (2 * ma * mb + c1) * (2 * vab + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))


def displacements(a: Floats, b: Floats, known: NDArray[np.bool_]) -> Floats:
    """(n, 2) displacements in px of windows that are known completely."""
    window = cv2.createHanningWindow((WINDOW, WINDOW), cv2.CV_32F)
    out = []
    for row in range(0, a.shape[0] - WINDOW, WINDOW // 2):
        for column in range(0, a.shape[1] - WINDOW, WINDOW // 2):
            part = (slice(row, row + WINDOW), slice(column, column + WINDOW))
            if not known[part].all():
                continue
            shift, response = cv2.phaseCorrelate(b[part].copy(), a[part].copy(), window)
            if response > LEAST_RESPONSE:
                out.append(shift)
    return np.array(out, np.float32).reshape(-1, 2)


def height_figures(path: Path, views: Path, truth: Truth) -> dict[str, float]:
    """Errors of heights in GSD after one shift, on open ground and on objects; `views`: number of
    photos per place.
    """
    with (
        rasterio.open(path) as source,
        WarpedVRT(source, resampling=Resampling.bilinear, nodata=np.nan, **truth.profile) as vrt,
    ):
        z = vrt.read(1)
    with (
        rasterio.open(views) as source,
        WarpedVRT(source, resampling=Resampling.nearest, **truth.profile) as vrt,
    ):
        number = vrt.read(1)
    known = np.isfinite(z - truth.height) & (z > -1e4)
    error = np.where(known, z - truth.height, np.nan)
    raised = cv2.dilate(truth.inner.astype(np.uint8), disc(4.0 / truth.gsd)) > 0
    open_ = known & ~truth.near & ~raised
    error = error - np.nanmedian(error[open_])

    def nmad(where: NDArray[np.bool_]) -> float:
        e = error[where & known]
        return float(1.4826 * np.median(np.abs(e - np.median(e))) / truth.gsd) if e.size else np.nan

    inner = error[truth.inner & known]
    return {
        "z_open_gsd": nmad(open_),
        "z_inner_gsd": nmad(truth.inner),
        "z_inner_3_gsd": nmad(truth.inner & (number >= 3)),
        "z_inner_bias_m": float(np.median(inner)) if inner.size else float("nan"),
        "edges": edges_found(truth.height + error, known, truth),
    }


def edges_found(z: Floats, known: NDArray[np.bool_], truth: Truth) -> float:
    """Share of the length of objects' edges near which the surface `z` (h, w) has one too."""
    side = disc(2.0 / truth.gsd)
    low, high = cv2.erode(truth.height, side), cv2.dilate(truth.height, side)
    half = (low + high) / 2
    objects = cv2.dilate(truth.inner.astype(np.uint8), disc(1.5 / truth.gsd)) > 0
    tall = objects & (high - low > 2 * STEP_M) & (cv2.erode(known.astype(np.uint8), side) > 0)
    cross = np.ones((3, 3), np.uint8)

    def edge(surface: Floats) -> NDArray[np.bool_]:
        above = (np.nan_to_num(surface) > half).astype(np.uint8)
        return (above > 0) & (cv2.erode(above, cross) == 0)

    found = cv2.distanceTransform((~edge(z)).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    at = edge(truth.height) & tall
    return float((found[at] <= NEAR_EDGE_GSD).mean())


if __name__ == "__main__":
    sys.exit(main())
