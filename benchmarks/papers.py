"""The claims of the thesis (Y) and of the article (A), remade: what is printed beside what comes
out here. docs/papers.md holds the results, with a verdict for each claim.

    python benchmarks/papers.py NAME [--work FOLDER] [--seeds N]

NAME:
    table-6.1     lambda of the four approaches, first 8 photos of a round trip (Y 6.1.2)
    fig-6.4       correlation and distance from the GPS position, photo by photo (Y 6.1.3; needs
                  ../shared/data)
    times         CPU time of aligning 9, 18 and 37 photos (Y 6.1.2, 6.1.3, 6.5)
    fig-6.5       eta along a strip (Y 6.2), and with every other photo (Y Fig. 4.5)
    models        where the similarity keeps the shape better than the homography, and where not;
                  and how well neighbours fit
    fig-6.6       the same on simulated photos instead of simulated points
    brighton      the same on a real survey: baselines by GPS (needs ../shared/data)
    eq-5.1        both readings of sigma in the bimodality, and powers of it
    table-6.3     one heated board: corners against centres (Y Tables 6.2, 6.3)
    mse           registration error before and after undistortion, on pairs of photos (Y 6.3)
    fig-5.12      heights of one pair and of a mosaic of disparities against the truth; with
    fig-5.14      heights of the reconstruction
    table-6.4     registration of real pairs of two spectra by class and method, with truth; with
    table-6.5     the mean Q (needs ../shared/data)
    fig-6.11      inliers and Q by SURF's initial lobe, and (Fig. 6.12) by method, on the same pairs
    spectral-methods  every method of registration by name on the same pairs: accepted, right,
                  wrong, refused, stated errors (needs ../shared/data)
    depth-maps    depth maps of a visual and a thermal flight registered by SURF and RFAE (Y Fig.
                  5.12c, 5.14c)
    eq-5.7        two blocks joined by pairs of photos: homographies as written beside `pairs`
    ste           the article's estimator on real pairs, by what the matches are chosen from (A 2.4,
                  2.5; needs ../shared/data)
    article       time and geolocation of six flight lines (A Tables 1 and 2)

Simulated surveys are kept in the work folder. CPU seconds are those of this machine, which is
named.
"""

import argparse
import itertools
import json
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skyquilt import registry
from skyquilt import simulate as sim
from skyquilt.calibration.assemble import Assemble
from skyquilt.calibration.few_views import FewViews
from skyquilt.calibration.find_board import FindBoard
from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.pictures import Source, open_picture
from skyquilt.coregistration.workflow import outcome_of, within_tolerance
from skyquilt.depth.workflow import depth
from skyquilt.engine.clock import Clock, result_of
from skyquilt.engine.store import Store
from skyquilt.errors import RefusedError
from skyquilt.geometry.camera import undistort
from skyquilt.geometry.transforms import transfer
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.ransac import Ransac
from skyquilt.model.board import Board
from skyquilt.model.event import Result
from skyquilt.papers.aligners import VLFEAT
from skyquilt.papers.baselines import baselines
from skyquilt.papers.best_matches import Best
from skyquilt.papers.compare import CompareSettings, iter_compare
from skyquilt.papers.pair_list import overlap_error, read_pairs
from skyquilt.papers.rfae import LOBES, surf
from skyquilt.papers.spectral_bench import iter_spectral_bench
from skyquilt.papers.ste import RansacSte
from skyquilt.papers.strip_chain import LOOSE_PX, VARIANTS, board_camera, calibrated, chained
from skyquilt.papers.surf import Surf
from skyquilt.quality.registration_quality import mean_squared_error
from skyquilt.settings import MosaicSettings
from skyquilt.simulate.board import Chessboard, Lamp, Sensor, sweep, tilted
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, FlightSettings, Reporting, Route, Thermal
from skyquilt.thermal import by_pairs
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import AlignedPhotos, Scene, align_photos
from skyquilt.workflows.methods import detector_for, methods_for
from skyquilt.workflows.mosaic import make_map, mosaic
from skyquilt.workflows.survey_input import read_input

DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
SMALL = Lens().scaled(1120, 840)


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Prints a table in Markdown."""
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(str(c) for c in row) + " |", flush=True)
    print()


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def simulated(folder: Path, settings: FlightSettings) -> Path:
    """The folder of a simulated survey, made where it is not there yet."""
    if not (folder / "truth" / "truth.json").is_file():
        for _ in sim.simulate(settings, folder, overwrite=True):
            pass
    return folder


def truth_of(folder: Path) -> dict[str, dict[str, Any]]:
    """The truth of each photo by its name."""
    told = json.loads((folder / "truth" / "truth.json").read_text())
    return {p["name"]: p for p in told["photos"]}


def aligned(photos: Sequence[Path], settings: MosaicSettings) -> tuple[AlignedPhotos, float]:
    """Photos placed, and the CPU seconds of placing them (without their features)."""
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock(store=Store(folder=Path(folder), registry=REGISTRY), began=Clock.now())
        given = read_input(list(photos), settings.input)
        found = result_of(align_photos(given, methods_for(settings), settings, clock))
        return found, clock.cpu["align"]


# ---- Y 6.1: position, pose, image, hybrid


def roundtrip(work: Path, seed: int) -> Path:
    settings = replace(sim.preset("roundtrip"), seed=seed, lens=SMALL)
    return simulated(work / f"roundtrip{seed}", settings)


def compared(
    photos: Path, out: Path, variants: tuple[str, ...], gsd_cm: float, **more: Any
) -> dict[str, dict[str, Any]]:
    settings = CompareSettings(mosaic=MosaicSettings(gsd_cm=gsd_cm), variants=variants, **more)
    *_, last = iter_compare(photos, out, settings, overwrite=True)
    assert isinstance(last, Result)
    return dict(last.metrics["methods"])


PRINTED_61 = {
    "position": (95.3, 69.6, 82.4, 1.14),
    "pose": (96.1, 74.5, 85.3, 0.99),
    "image": (94.6, 82.4, 88.5, 0.87),
    "hybrid": (96.9, 86.7, 91.8, 0.65),
}
"""lambda_spat, lambda_corr, lambda in %, and the largest error of the three distances in m."""


def table_61(work: Path, seeds: int) -> None:
    """Surveyed points judge the distances; nothing aligned uses them."""
    found: dict[str, list[tuple[float, ...]]] = {}
    names = ("position", "pose", "image", "image-overview", "hybrid", "hybrid-anneal", "bundle")
    for seed in range(1, seeds + 1):
        folder = roundtrip(work, seed)
        rows = compared(
            folder / "photos", work / "t61", names, 8.0, first=8, known=folder / "gcp_list.txt"
        )
        for name, c in rows.items():
            errors = [abs(d["error_m"]) for d in c.get("distances", ()) if d["error_m"] is not None]
            values = (c["lambda_spat_of_table"], c["lambda_spat"], c["lambda_corr"], c["lambda"])
            found.setdefault(name, []).append(
                (
                    *tuple(np.nan if v is None else v for v in values),
                    max(errors) if errors else np.nan,
                )
            )
    rows_out = []
    for name, values in found.items():
        spat_t, spat, corr, total, worst = np.nanmedian(np.array(values, float), 0)
        p = PRINTED_61.get(name, ("-",) * 4)
        rows_out.append(
            (
                name,
                p[0],
                percent(spat_t),
                percent(spat),
                p[1],
                percent(corr),
                p[2],
                percent(total),
                p[3],
                f"{worst:.2f}",
            )
        )
    head = ("approach", "spat printed", "as printed, here", "(6.1), here", "corr printed", "here")
    table((*head, "lambda printed", "here", "largest error printed, m", "here, m"), rows_out)
    order = ("position", "pose", "image", "hybrid")
    held = sum(
        all(found[a][k][2] < found[b][k][2] for a, b in itertools.pairwise(order))
        for k in range(seeds)
    )
    print(f"order position < pose < image < hybrid of lambda_corr: {held} of {seeds} flights")


def fig_64(work: Path, seeds: int) -> None:
    """A whole survey: does a photo that stays near its GPS position fit better?"""
    if not (DATA / "brighton").is_dir():
        raise SystemExit("brighton is not beside this checkout")
    names = ("position", "pose", "image", "image-overview", "hybrid", "hybrid-anneal")
    rows = []
    for name, c in compared(DATA / "brighton", work / "f64", names, 10.0).items():
        corr = _array(c["correlation_with_last_of_photo"])
        off = _array(c["off_position_over_width"])
        both = np.isfinite(corr) & np.isfinite(off)
        r = np.corrcoef(corr[both], off[both])[0, 1] if off[both].std() > 0 else np.nan
        rows.append((name, f"{np.nanmean(corr):.3f}", f"{off[both].mean():.3f}", f"{r:+.2f}"))
    table(("approach", "CC with the photo before", "distance, widths", "r of both"), rows)


def _array(values: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in values], float)


def times(work: Path, seeds: int) -> None:
    """CPU seconds of placing the photos, features of the photos not counted."""
    photos = sorted((roundtrip(work, 1) / "photos").glob("*.jpg"))
    columns: dict[str, dict[str, Any]] = {
        "position": {"method": "position"},
        "pose": {"method": "pose"},
        "image, chain": {"method": "image"},
        "image, chain by pixels (ncc)": {"method": "image", "estimator": "ncc"},
        "image, overview": {"method": "image", "image_search": "overview"},
        "hybrid, surfaces": {"method": "hybrid"},
        "hybrid, annealing": {"method": "hybrid", "optimiser": "anneal"},
    }
    printed = {"position": "17.3", "pose": "18.3", "image, overview": "459.2"}
    printed["hybrid, annealing"] = "136.3"
    rows, at_37 = [], {}
    for name, more in columns.items():
        spent = [aligned(photos[:n], MosaicSettings(jobs=1, **more))[1] for n in (9, 18, 37)]
        at_37[name] = spent[-1]
        grows = np.log(spent[2] / spent[0]) / np.log(37 / 9)
        rows.append((name, *(f"{s:.2f}" for s in spent), f"{grows:.2f}", printed.get(name, "-")))
    table(("method", "9", "18", "37 photos", "grows as n to the", "printed, 37 photos"), rows)
    saving = 1 - at_37["hybrid, annealing"] / at_37["image, overview"]
    print(f"saving of hybrid (annealing) over image (overview): {100 * saving:.0f} %, printed 70 %")


# ---- Y 4.2, 6.2: strips


def fig_65(work: Path, seeds: int) -> None:
    """The strip test with its default settings; the thesis draws its figures without numbers."""
    ends = np.zeros((seeds, len(VARIANTS)))
    for k in range(seeds):
        settings = sim.StripSettings(seed=k + 1)
        strip = sim.fly_strip(settings)
        cameras = calibrated(strip, settings)
        for j, variant in enumerate(VARIANTS):
            values = chained(strip, settings, cameras[variant.distortion][0], variant)
            ends[k, j] = values[np.isfinite(values)][-1]
    table(
        ("variant", "eta at the end, median", "least", "best"),
        [
            (v.name, f"{np.median(e):.3f}", f"{e.min():.3f}", f"{e.max():.3f}")
            for v, e in zip(VARIANTS, ends.T, strict=True)
        ],
    )


CASES: dict[str, dict[str, Any]] = {
    "as in fig-6.5": {},
    "tilt of 1 degree": {"tilt": 1.0},
    "tilt of 3 degrees": {"tilt": 3.0},
    "noise of 1 px": {"noise": 1.0},
    "overlap 50 %": {"overlap": 0.5},
    "overlap 85 %": {"overlap": 0.85},
    "things up to 4 m": {"relief": 4.0},
    "things up to 4 m on 60 %": {"relief": 4.0, "things": 0.6},
    "things up to 10 m on 60 %": {"relief": 10.0, "things": 0.6},
    "the same, tilt of 3 degrees, overlap 50 %": {
        "relief": 10.0,
        "things": 0.6,
        "tilt": 3.0,
        "overlap": 0.5,
    },
    "lens from 6 views": {"views": 6},
    "lens order 2": {"_order": "2"},
    "noise 1 px, lens order 2": {"noise": 1.0, "_order": "2"},
}


def neighbours_px(strip: Any, settings: Any, camera: Any, model: Any) -> float:
    """Median distance of the points that two neighbours share, in px, each pair registered by
    itself: what looks, as lambda_corr, judge by.
    """
    px = [undistort(camera, p) * camera.focal for p in strip.px]
    estimate, apart = Ransac(model=model, threshold_px=LOOSE_PX, seed=settings.seed), []
    for k in range(1, len(px)):
        _, i, j = np.intersect1d(strip.ids[k], strip.ids[k - 1], return_indices=True)
        a, b = px[k][i], px[k - 1][j]
        found = estimate(a, b)
        if found:
            apart.append(np.median(np.linalg.norm(transfer(found.b_H_a, a) - b, axis=1)))
    return float(np.mean(apart))


def models(work: Path, seeds: int) -> None:
    """eta at the end of 21 photos, and the fit of neighbours, by transformation and by what is
    wrong with the photos.
    """
    ways = {
        "similarity": replace(VARIANTS[6]),
        "affine": replace(VARIANTS[6], model="affine"),
        "homography": replace(VARIANTS[4]),
        "homography, not levelled": replace(VARIANTS[5]),
    }
    rows = []
    for case, more in CASES.items():
        order = more.get("_order", "6t")
        given = {k: v for k, v in more.items() if k != "_order"}
        ends: dict[str, list[float]] = {w: [] for w in ways}
        apart: dict[str, list[float]] = {"similarity": [], "homography": []}
        for seed in range(1, seeds + 1):
            settings = sim.StripSettings(seed=seed, **given)
            strip = sim.fly_strip(settings)
            size = (settings.lens.width, settings.lens.height)
            camera, _ = board_camera(strip.board, strip.views, size, order)
            for name, way in ways.items():
                try:
                    ends[name].append(float(chained(strip, settings, camera, way)[-1]))
                except RefusedError:
                    ends[name].append(np.nan)
            for model, found in apart.items():
                found.append(neighbours_px(strip, settings, camera, model))
        median = {w: float(np.median(e)) for w, e in ends.items()}
        fits = " / ".join(f"{np.median(v):.2f}" for v in apart.values())
        rows.append((case, *(f"{m:.3f}" for m in median.values()), fits))
    table(("strip, eta", *ways, "neighbours apart, px, similarity / homography"), rows)


WAYS_66: dict[str, dict[str, Any]] = {
    "order 2, all features, homography": {
        "distortion": "2",
        "levelled": False,
        "transform": "homography",
    },
    "6t, all features, homography": {"levelled": False, "transform": "homography"},
    "6t, levelled, homography": {"transform": "homography"},
    "6t, levelled, affine": {"transform": "affine"},
    "6t, levelled, similarity": {"transform": "similarity"},
}


def fig_66(work: Path, seeds: int) -> None:
    """27 photos of a landscape with trees and houses, 60 % overlap: eta of each photo's square."""
    import sys

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests.papers.test_claims import eta_of_strip

    rows: dict[str, list[tuple[float, float]]] = {}
    lens = SMALL
    for seed in range(1, seeds + 1):
        settings = FlightSettings(
            seed=seed,
            lens=lens,
            route=Route(pattern="strip", photos=27, overlap=0.60, height=60.0, speed=5.0),
            reporting=Reporting(dewarp=(lens.p1, lens.p2), focal_error=0.0),
            control=Control(points=0, checks=0),
        )
        folder = simulated(work / f"strip{seed}", settings)
        photos, truth = sorted((folder / "photos").glob("*.jpg")), truth_of(folder)
        for name, more in WAYS_66.items():
            placed, _ = aligned(photos, MosaicSettings(method="image", jobs=1, **more))
            rows.setdefault(name, []).append(eta_of_strip(placed, truth))
        for every in (1, 2):
            for model in ("homography", "similarity"):
                if every == 1:
                    continue
                placed, _ = aligned(
                    photos[::every], MosaicSettings(method="image", jobs=1, transform=model)
                )
                rows.setdefault(f"every other photo, {model}", []).append(
                    eta_of_strip(placed, truth)
                )
    table(
        ("mosaic", "eta at the end, median", "least", "photos in the first piece"),
        [
            (
                n,
                f"{np.median([v[0] for v in r]):.3f}",
                f"{min(v[0] for v in r):.3f}",
                " ".join(str(int(v[1])) for v in r),
            )
            for n, r in rows.items()
        ],
    )


def brighton(work: Path, seeds: int) -> None:
    """What the transformation does to a real survey: looks, and baselines by GPS."""
    folder = DATA / "brighton"
    if not folder.is_dir():
        raise SystemExit("brighton is not beside this checkout")
    photos = sorted(folder.glob("*.JPG"))
    known = baselines(read_input(folder, MosaicSettings().input).survey.photos, None)
    ways = [
        (model, levelled, "chain")
        for model in ("similarity", "affine", "homography")
        for levelled in (True, False)
    ]
    ways += [("similarity", True, "loop"), ("homography", True, "loop")]
    rows = []
    for model, levelled, search in ways:
        settings = MosaicSettings(
            method="image", transform=model, levelled=levelled, image_search=search, gsd_cm=10
        )
        out = work / f"brighton-{model}-{levelled}-{search}"
        metrics = mosaic(photos, out, settings, overwrite=True).metrics
        shots = json.loads((out / "shots.geojson").read_text())["features"]
        own = [s["properties"] for s in shots]
        place = {o["filename"]: np.array(o["translation"][:2]) for o in own}
        errors = [abs(np.linalg.norm(place[k.a] - place[k.b]) / k.metres - 1) for k in known]
        quality = metrics["quality"]
        looks = [f"{quality[k]:.3f}" for k in ("lambda_corr", "correlation_with_last")]
        off = f"{100 * np.median(errors):.1f}", f"{100 * max(errors):.1f}"
        rows.append((model, search, "yes" if levelled else "no", *looks, *off))
    head = ("transformation", "search", "levelled", "lambda corr", "CC with the photo before")
    table((*head, "baselines off, median %", "largest %"), rows)


# ---- Y 5.1, 6.3: calibration


BOARD, CHESS = Board(columns=7, rows=6, square_m=0.10), Chessboard()
THERMAL = Lens(
    width=640, height=480, focal=690, offset_x=5, offset_y=-4, k1=-0.3, k2=0.12, p1=0.0, p2=0.0
)


def heated(seed: int, pose: Any = None) -> list[np.ndarray]:
    rng = np.random.default_rng([seed, 41])
    turned = rng.normal(0, 4, 3)
    at = pose or tilted(
        22 + turned[0], 10 + turned[1], turned[2], (0.0, 0.0, float(rng.uniform(1.45, 1.65)))
    )
    return list(sweep(THERMAL, CHESS, at, Lamp(), Sensor(), rng)), at


def eq_51(work: Path, seeds: int) -> None:
    """Error of the corners in the assembled picture, for both readings of sigma and powers of
    1 / phi; -1 is (5.3) as printed.
    """
    powers = (-1.0, 0.25, 0.5, 1.0, 2.0)
    rows = []
    for reading in ("deviation", "variance"):
        errors: dict[float, list[float]] = {p: [] for p in powers}
        for seed in range(seeds):
            frames, pose = heated(seed)
            true = (BOARD.corners.reshape(-1, 3) - [0.35, 0.30, 0.0]) @ pose.rotation.T + pose.shift
            true = THERMAL.project(true, np.eye(3), np.zeros(3))
            for power in powers:
                made = Assemble(power=power, variance=reading == "variance")
                view = FindBoard()("", made(frames, BOARD), BOARD)
                off = np.nan
                if view:
                    apart = view.corners.reshape(-1, 1, 2) - true[None]
                    near = np.linalg.norm(apart, axis=2).min(1)
                    off = float(np.sqrt((near**2).mean()))
                errors[power].append(off)
        rows.append((reading, *(_median_of(errors[p]) for p in powers)))
    table(("sigma read as", *("as printed" if p < 0 else f"phi^-{p:g}" for p in powers)), rows)


def _median_of(values: Sequence[float]) -> str:
    found = [v for v in values if np.isfinite(v)]
    lost = len(values) - len(found)
    return (f"{np.median(found):.2f}" if found else "-") + (f" ({lost} not found)" if lost else "")


def table_63(work: Path, seeds: int) -> None:
    """One pose of a board heated by a moving lamp, from corners and from centres."""
    rows, better = [], 0
    for seed in range(seeds):
        frames, _ = heated(seed)
        view = FindBoard()("one", Assemble()(frames, BOARD), BOARD, frames=len(frames))
        if not view:
            rows.append((seed, "not found", *[""] * 5))
            continue
        both = [
            FewViews(marks=m, focal_px=736.0, sigma_px=221.0)([view], BOARD)
            for m in ("corners", "centres")
        ]
        errors = [np.array(b.mean_error_px) for b in both]
        better += bool((errors[1] < errors[0]).all())
        rows.append(
            (
                seed,
                *(f"({e[0]:.3f}, {e[1]:.3f})" for e in errors),
                *tuple(f"{b.camera.focal:.0f} ± {b.sigma('focal'):.0f}" for b in both),
                *tuple(f"{b.camera.k1:.3f} ± {b.sigma('k1'):.3f}" for b in both),
            )
        )
    rows.append(("printed", "(0.487, 0.506)", "(0.360, 0.385)", "1297 ± 559", "1042 ± 491"))
    rows[-1] += ("-0.391 ± 0.337", "-0.270 ± 0.255")
    table(
        (
            "flight",
            "pixel error, corners",
            "centres",
            "focal, corners (690)",
            "centres",
            "k1, corners (-0.3)",
            "centres",
        ),
        rows,
    )
    print(f"centres have the smaller error in both axes in {better} of {seeds} boards")
    print("printed deviations are three sigma, ours one")


def mse(work: Path, seeds: int) -> None:
    """(6.2) of pairs of neighbouring photos registered by a homography through SURF features, raw
    and undistorted by the true lens.
    """
    rows = []
    reach2 = (SMALL.width**2 + SMALL.height**2) / 4 / SMALL.focal**2
    for name, share in (("6 % at the corners", 0.061), ("12 %", 0.122)):
        gains, raws, flats, better = [], [], [], 0
        for seed in range(1, seeds + 1):
            lens = replace(SMALL, k1=-share / reach2, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
            settings = FlightSettings(
                seed=seed,
                lens=lens,
                route=Route(pattern="strip", photos=5, overlap=0.7, height=90.0),
                control=Control(points=0, checks=0),
            )
            folder = simulated(work / f"mse{100 * share:.0f}-{seed}", settings)
            camera = _camera_of(lens)
            pictures = [cv2.imread(str(p), 0) for p in sorted((folder / "photos").glob("*.jpg"))]
            features = [Surf(longest=1120, count=1500)(p) for p in pictures]
            for a, b in itertools.pairwise(features):
                matches = Mutual()(a, b)
                pa, pb = a.px[matches.index_a], b.px[matches.index_b]
                pair = []
                for one, two in (
                    (pa, pb),
                    tuple(undistort(camera, p) * camera.focal for p in (pa, pb)),
                ):
                    found = Ransac(model="homography", threshold_px=6.0)(one, two)
                    if found:
                        inner = found.inliers
                        moved = transfer(found.b_H_a, one[inner])
                        pair.append(mean_squared_error(moved, two[inner]))
                if len(pair) == 2:
                    raws.append(pair[0])
                    flats.append(pair[1])
                    gains.append(1 - pair[1] / pair[0])
                    better += pair[1] < pair[0]
        rows.append((name, len(gains), f"{np.mean(raws):.2f}", f"{np.mean(flats):.2f}"))
        rows[-1] += (f"{100 * np.mean(gains):.0f}", f"{better} of {len(gains)}")
    rows.append(("printed (4 pairs, 5 sets)", "20", "13.2 (one pair)", "11.7", "17", "-"))
    table(("lens", "pairs", "MSE raw, px²", "undistorted", "reduction, %", "better"), rows)


def _camera_of(lens: Lens) -> Any:
    from skyquilt.model.camera import Camera

    names = ("width", "height", "focal", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
    return Camera(**{n: getattr(lens, n) for n in names})


# ---- Y 5.2.3: heights


def heights(work: Path, seeds: int) -> None:
    """r and slope against the true heights where both fit best by a similarity on the ground, and
    what this is: heights are one claim, where their map lies is another.
    """
    import sys

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from tests.depth.test_depth import agreement, fits_best, maps, placed

    rows: dict[str, list[tuple[float, ...]]] = {}
    chosen = MosaicSettings(gsd_cm=25, features=3000, jobs=1)
    for seed, noise in itertools.product(range(3, 3 + seeds), (2.0, 0.05)):
        settings = FlightSettings(
            seed=seed,
            lens=Lens().scaled(800, 600),
            route=Route(photos=9),
            reporting=Reporting(gps_noise=noise),
            control=Control(points=5, checks=3),
        )
        folder = simulated(work / f"heights{seed}-{noise:g}", settings)
        every = sorted((folder / "photos").glob("*.jpg"))
        asked = [("one pair (Fig. 5.12)", every[k : k + 2], "pair") for k in (0, 3, 6)]
        asked += [("one pair, features", every[k : k + 2], "disparities") for k in (0, 3, 6)]
        asked += [(f"{r} of nine photos", every, r) for r in ("disparities", "reconstruction")]
        for name, photos, route in asked:
            result = depth(photos, work / "depth", chosen, route=route, overwrite=True)
            z, true = maps(work / "depth", folder)
            dx, dy, turn, scale = fits_best(z, true)
            r, slope = agreement(z, placed(true, dx, dy, turn, scale))
            there = agreement(z, true)[0]
            shift = 0.25 * float(np.hypot(dx, dy))
            told = rows.setdefault(f"{name}, positions good to {noise:g} m", [])
            spent = result.metrics["cpu_seconds"]
            seen = np.isfinite(z).mean()
            told.append((r, slope, there, shift, abs(turn), 100 * abs(scale), seen, spent))
    head = ("heights by", "n", "r, median (least, best)", "slope", "both within 0.9 to 1.1")
    rest = (
        "r where placed",
        "off by, m",
        "turned by, degrees",
        "scale, %",
        "share of the map",
        "CPU s",
    )
    table(
        (*head, *rest),
        [
            (n, len(r), *(_spread(v) for v in np.array(r).T[:2]), _good(r), *_medians(r))
            for n, r in rows.items()
        ],
    )


def _good(rows: Sequence[tuple[float, ...]]) -> str:
    return f"{sum(r >= 0.9 and 0.9 <= slope <= 1.1 for r, slope, *_ in rows)} of {len(rows)}"


def _spread(values: np.ndarray) -> str:
    return f"{np.median(values):.2f} ({values.min():.2f}, {values.max():.2f})"


def _medians(rows: Sequence[tuple[float, ...]]) -> list[str]:
    return [f"{v:.2f}" for v in np.median(np.array(rows)[:, 2:], 0)]


# ---- Y 6.4: two spectra, pair by pair

PRINTED_64 = {
    "satellite-low": ("24/24, 24/24, 24/24, 24/24, 24/24", "72, 66, 71, 53, 68"),
    "satellite-high": ("7/10, 6/10, 9/10, 10/10, 10/10", "45, 41, 49, 46, 52"),
    "human": ("0/16, 0/16, 2/16, 12/16, 12/16", "0, 0, 1, 8, 8"),
    "surveillance": ("1/14, 2/14, 4/14, 12/14, 12/14", "1, 3, 4, 18, 19"),
    "uav": ("13/20, 14/20, 2/20, 13/20, 17/20", "9, 10, 1, 6, 11"),
}
"""Accepted of all pairs, and mean Q in %, by SIFT, SURF, upright SURF, RFAE, SURF + RFAE."""


def table_64(work: Path, seeds: int) -> None:
    """Accepted is not right: the thesis had no truth."""
    listed = DATA / "spectral" / "pairs.csv"
    if not listed.is_file():
        raise SystemExit("the pairs of images are not beside this checkout")
    methods = ("sift", "surf", "usurf", "rfae", "surf+rfae", "rfae-refined", "auto")
    *_, last = iter_spectral_bench(listed, work / "t64", methods, overwrite=True)
    assert isinstance(last, Result)
    told = last.metrics["pairs"]
    head = ("class", "pairs", *methods)
    for title, cell in (
        ("right / wrong; printed: accepted", _right_wrong),
        ("mean Q, %", _mean_q),
        ("CPU s a pair", lambda of: f"{np.mean([r['seconds'] for r in of]):.2f}"),
    ):
        print(title + "\n")
        rows = []
        for kind in (*dict.fromkeys(r["class"] for r in told), None):
            of = [r for r in told if kind in (None, r["class"])]
            cells = [cell([r for r in of if r["method"] == m]) for m in methods]
            rows.append((kind or "all", len(of) // len(methods), *cells))
            if kind in PRINTED_64 and cell in (_right_wrong, _mean_q):
                printed = PRINTED_64[kind][0 if cell is _right_wrong else 1].split(", ")
                rows.append(("printed", "", *printed, "", ""))
        table(head, rows)


PRINTED_611 = {"lobe 5": (22, 17.2), "lobe 3": (38, 8.0), "lobe 1": (62, 16.6)}
PRINTED_612 = {"sift": (102, 22.0), "surf": (31, 23.0), "rfae": (59, 12.0)}
"""Inliers and Q in % of one pair each."""


def fig_611(work: Path, seeds: int) -> None:
    """Do more inliers raise Q? SURF by its initial lobe, and three methods, on the real pairs."""
    listed = DATA / "spectral" / "pairs.csv"
    if not listed.is_file():
        raise SystemExit("the pairs of images are not beside this checkout")
    one = surf()
    lobes = {f"lobe {k}": replace(one, detect=replace(one.detect, lobe=k)) for k in LOBES}
    methods = {m: registration_method(m) for m in PRINTED_612}
    for title, ways, printed in (
        ("Fig. 6.11", lobes, PRINTED_611),
        ("Fig. 6.12", methods, PRINTED_612),
    ):
        print(title + ": inliers / Q in % of the accepted, the highest Q in bold\n")
        rows, several, differ = [], 0, 0
        for pair in read_pairs(listed):
            a, b = (open_picture(path) for path in (pair.a, pair.b))
            assert isinstance(a, Source) and isinstance(b, Source)
            found = {n: w(a.picture, b.picture) for n, w in ways.items()}
            told = {n: (len(o.px_a), 100 * o.q) for n, o in found.items() if o}
            if len(told) < 2:
                continue
            highest, most = (max(told, key=lambda n, k=k: told[n][k]) for k in (1, 0))
            several, differ = several + 1, differ + (highest != most)
            cells = {n: f"{c} / {q:.0f}" for n, (c, q) in told.items()}
            cells[highest] = f"**{cells[highest]}**"
            rows.append((pair.source, *(cells.get(n, "refused") for n in ways)))
        rows.append(
            ("printed", *("{} / {:.0f}".format(*printed[n]) if n in printed else "" for n in ways))
        )
        table(("pair", *ways), rows)
        print(f"most inliers, but not the highest Q: {differ} of {several} pairs\n")


def spectral_methods(work: Path, seeds: int) -> None:
    """Every registered method on the real pairs, with truth and, where it states one, its error."""
    listed = DATA / "spectral" / "pairs.csv"
    if not listed.is_file():
        raise SystemExit("the pairs of images are not beside this checkout")
    methods = registry.names("registration")
    *_, last = iter_spectral_bench(listed, work / "all", methods, overwrite=True)
    assert isinstance(last, Result)
    rows = []
    for method in methods:
        of = [r for r in last.metrics["pairs"] if r["method"] == method]
        taken, right = [r for r in of if r["accepted"]], [r for r in of if r["right"]]
        stated = [r for r in taken if r["stated_px"] is not None]
        held = sum(r["corner_px"] <= r["stated_px"] for r in stated)
        counts = len(taken), len(right), len(taken) - len(right), len(of) - len(taken)
        off = f"{np.median([r['error_px'] for r in right]):.1f}" if right else "-"
        seconds = f"{np.mean([r['seconds'] for r in of]):.2f}"
        told = f"{held} of {len(stated)}" if stated else "states none"
        rows.append((method, *counts, off, told, _mean_q(of), seconds))
    head = ("method", "accepted", "right", "wrong", "refused", "right ones off, px, median")
    table((*head, "stated error holds", "mean Q, %", "CPU s a pair"), rows)


def _right_wrong(of: Sequence[dict[str, Any]]) -> str:
    right = sum(r["right"] for r in of)
    return f"{right} / {sum(r['accepted'] for r in of) - right}"


def _mean_q(of: Sequence[dict[str, Any]]) -> str:
    return f"{100 * np.mean([r['q'] for r in of]):.0f}"


# ---- Y 5.2.3: two spectra by depth maps and by carried pairs


def two_flights(work: Path, seed: int, gps_noise: float) -> Path:
    """A visual and a thermal flight over the same small site, at midday and in the afternoon."""
    settings = FlightSettings(
        seed=seed,
        lens=Lens().scaled(800, 600),
        route=Route(photos=6),
        reporting=Reporting(gps_noise=gps_noise),
        control=Control(points=0, checks=0),
        thermal=Thermal(overlap=0.75, sidelap=0.5),
    )
    return simulated(work / f"two{seed}-{gps_noise:g}", settings)


def depth_maps(work: Path, seeds: int) -> None:
    """Errors over the overlap by the georeferences of both maps, whose positions are good to 5 cm;
    no guess is given.
    """
    chosen = MosaicSettings(gsd_cm=25, features=3000, jobs=1)
    methods = ("surf", "surf-lobe", "rfae", "rfae-refined", "auto")
    found: dict[str, dict[str, list[str]]] = {}
    for seed in range(3, 3 + seeds):
        folder = two_flights(work, seed, 0.05)
        visual, thermal = (sorted((folder / n).iterdir()) for n in ("photos", "thermal"))
        at = {k: np.array(p["position"][:2]) for k, p in truth_of(folder).items()}
        one = visual[3:5]
        there = (at[one[0].name] + at[one[1].name]) / 2
        ends = [(at[a.name], at[b.name]) for a, b in itertools.pairwise(thermal)]
        middles = [
            np.linalg.norm((a + b) / 2 - there) + (99 if np.linalg.norm(a - b) > 30 else 0)
            for a, b in ends
        ]
        k = int(np.argmin(middles))
        other = thermal[k : k + 2]
        for name, photos, route in (
            ("one pair each, features (Fig. 5.12c)", (one, other), "disparities"),
            ("one pair each, every pixel", (one, other), "pair"),
            ("reconstructions (Fig. 5.14c)", (visual, thermal), "reconstruction"),
        ):
            sources = []
            for side, chosen_photos in zip("ab", photos, strict=True):
                out = work / f"depth-{side}"
                depth(chosen_photos, out, chosen, route=route, overwrite=True)
                source = open_picture(out / "depth.tif")
                assert isinstance(source, Source) and source.place is not None
                sources.append(source)
            a, b = sources
            g, h = a.place.affine, b.place.affine  # type: ignore[union-attr]
            truth = np.eye(3)
            truth[:2, 2] = (g[2] - h[2]) / h[0], (g[5] - h[5]) / h[4]
            row = found.setdefault(name, {})
            for method in methods:
                outcome, _ = within_tolerance(outcome_of(a, b, method, None), a, b, None)
                shapes = (a.height, a.width), (b.height, b.width)
                off = (
                    f"{0.25 * overlap_error(outcome.b_H_a, truth, *shapes):.1f}"
                    if outcome
                    else "refused"
                )
                row.setdefault(method, []).append(off)
    table(
        ("depth maps of", *(f"{m}, off by m" for m in methods)),
        [(n, *(", ".join(row[m]) for m in methods)) for n, row in found.items()],
    )


# ---- A


def ste(work: Path, seeds: int) -> None:
    """RANSAC by the symmetric transfer error on neighbouring photos of the first line of brighton,
    with the matches of `flightline`, by its detector.
    """
    if not (DATA / "brighton").is_dir():
        raise SystemExit("brighton is not beside this checkout")
    photos = sorted((DATA / "brighton").glob("*.JPG"))[:8]
    rows = []
    for detector in ("sift", "sift-all"):
        settings = MosaicSettings(method="flightline", detector=detector)
        detect = detector_for(settings)
        began = time.process_time()
        features = [detect(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) for p in photos]
        counts, errors, first = [], [], 0
        for a, b in itertools.pairwise(features):
            matches = Best(count=150, ratio=VLFEAT)(a, b)
            pa, pb = a.px[matches.index_a] / a.scale, b.px[matches.index_b] / b.scale
            found = RansacSte()(pa, pb)
            counts.append(len(matches))
            errors.append(found.ste_per_inlier if found else np.inf)
            first += bool(found) and found.method == "RANSAC-1-OPT"
        spent = (time.process_time() - began) / len(photos)
        clean = sum(e < 3 for e in errors)
        ends = f"{min(errors):.2g}, {max(errors):.2g}"
        rows.append((detector, len(features[0]), f"{min(counts)} to {max(counts)}", ends))
        rows[-1] += (f"{clean} of {len(errors)}", f"{first} of {len(errors)}", f"{spent:.1f}")
    head = ("detector", "keypoints", "of the 150 best matches", "STE per inlier, px², least, most")
    table((*head, "below 3 px²", "accepted at once (RANSAC-1-OPT)", "CPU s a photo"), rows)


def article(work: Path, seeds: int) -> None:
    """Six lines, 73 photos of 640 x 480 px: time, and geolocation against the TRUE places."""
    import sys

    sys.path.insert(0, str(Path(__file__).resolve().parent))
    from methods import six

    found = six(73, work)
    rows = [("A, flight 1, proposed", "10 min 36 s", "1.23, 3.43", "1.59, 4.02")]
    rows += [("A, flight 1, Pix4Dmapper", "10 min 29 s", "0.93, 3.77", "1.52, 4.90")]
    for name in ("flightline", "flightline-sift-all", "flightline-similarity", "bundle"):
        f = found[name]
        if "refused" in f:
            rows.append((name, f"refused: {f['refused']}", "", ""))
            continue
        mae, rms = (", ".join(f"{v:.2f}" for v in f[k]) for k in ("mae_xy_m", "rms_xy_m"))
        rows.append((f"{name} ({f['placed']} placed)", f"{f['cpu_seconds']} s CPU", mae, rms))
    table(("method", "time, 73 photos", "MAE x, y, m", "RMS x, y, m"), rows)


def eq_57(work: Path, seeds: int) -> None:
    """Blocks joined by (5.7) as written and by `pairs`: error at four places of the map."""
    rows = []
    for seed in range(1, seeds + 1):
        lens, route = Lens().scaled(1200, 900), Route(photos=24, overlap=0.85)
        flight = simulated(
            work / f"joined-{seed}", FlightSettings(seed=seed, lens=lens, route=route)
        )
        settings = MosaicSettings(gsd_cm=10)
        given = read_input(flight / "photos", settings.input)
        with tempfile.TemporaryDirectory() as folder:
            scene = result_of(make_map(given, Path(folder) / "out", settings)).scene()
            rows += [(seed, *row) for row in _joined(scene)]
    table(("seed", "method", "pairs", "error, px of 10 cm: median", "largest"), rows)


def _joined(scene: Scene) -> list[tuple[str, str, str, str]]:
    """Every other photo of a flight against those between, in negative and their frame 2.4 m
    aside.
    """
    pixels, frame = scene.aligned.pixels, scene.aligned.alignment.frame
    x, y = frame.origin
    scene, other = _of_photos(scene, 0), _of_photos(scene, 1)
    aside = replace(other.aligned.alignment, frame=replace(frame, origin=(x + 2.1, y - 1.2)))
    negative = replace(other.aligned, alignment=aside, pixels=lambda i: 255 - pixels(i))
    other = replace(other, aligned=negative)
    size = scene.ground.grid.width, scene.ground.grid.height
    px = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.6, 0.6]]) * size
    usual, rows = by_pairs.MOST_PAIRS, []
    for name, join in (("pairs", by_pairs.by_pairs), ("homographies", by_pairs.by_homographies)):
        for most in (usual, 5, 3, 1):
            by_pairs.MOST_PAIRS = most
            found = join(scene, other)
            if not found:
                rows.append((name, str(most), "refused", ""))
                continue
            # both maps have the same grid about their origins: right places are equal pixels
            off = np.linalg.norm(transfer(found.b_H_a, px) - px, axis=1)
            registered = str(found.evidence["pairs_registered"])
            rows.append((name, registered, f"{np.median(off):.2f}", f"{off.max():.2f}"))
    by_pairs.MOST_PAIRS = usual
    return rows


def _of_photos(scene: Scene, odd: int) -> Scene:
    """The scene with the photos of even or odd number."""
    alignment = scene.aligned.alignment
    poses = {i: pose for i, pose in alignment.poses.items() if i % 2 == odd}
    views = tuple(v for v in scene.ground.views if v.photo in poses)
    return replace(
        scene,
        aligned=replace(scene.aligned, alignment=replace(alignment, poses=poses)),
        ground=replace(scene.ground, views=views),
    )


NAMES: dict[str, tuple[Callable[[Path, int], None], int]] = {
    "table-6.1": (table_61, 1),
    "fig-6.4": (fig_64, 1),
    "times": (times, 1),
    "fig-6.5": (fig_65, 5),
    "fig-4.5": (fig_65, 5),
    "models": (models, 3),
    "fig-6.6": (fig_66, 1),
    "brighton": (brighton, 1),
    "eq-5.1": (eq_51, 1),
    "table-6.2": (table_63, 5),
    "table-6.3": (table_63, 5),
    "mse": (mse, 2),
    "fig-6.10": (mse, 2),
    "fig-5.12": (heights, 5),
    "fig-5.14": (heights, 5),
    "table-6.4": (table_64, 1),
    "table-6.5": (table_64, 1),
    "fig-6.11": (fig_611, 1),
    "fig-6.12": (fig_611, 1),
    "spectral-methods": (spectral_methods, 1),
    "depth-maps": (depth_maps, 3),
    "fig-5.12c": (depth_maps, 3),
    "fig-5.14c": (depth_maps, 3),
    "eq-5.7": (eq_57, 3),
    "ste": (ste, 1),
    "article": (article, 1),
}
"""Name -> what is run, and its usual number of seeds."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=sorted(NAMES), metavar="NAME")
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-papers"
    )
    parser.add_argument("--seeds", type=int)
    args = parser.parse_args()
    run, usual = NAMES[args.name]
    args.work.mkdir(parents=True, exist_ok=True)
    print(f"{args.name}: {platform.machine()}, {platform.python_implementation()}, OpenCV", end=" ")
    print(f"{cv2.__version__}, {args.seeds or usual} seeds\n", flush=True)
    run(args.work, args.seeds or usual)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main()
