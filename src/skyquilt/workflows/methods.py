"""Names and numbers -> methods: the one place where words on a command line become parts of a
story.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.pose import ByPose, ByPosition
from skyquilt.errors import UsageError
from skyquilt.geometry.transforms import Model
from skyquilt.matching.candidates import Nearest, Retrieval
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import ORDERS
from skyquilt.ortho.blend import Average, Blend, Feather, First, Multiband
from skyquilt.ortho.drift import Drift
from skyquilt.ortho.exposure import Balance
from skyquilt.ortho.sweep import Sweep
from skyquilt.ortho.tie_surface import FromTiePoints

if TYPE_CHECKING:
    from skyquilt.papers.chain import Chain
    from skyquilt.papers.flightline import ByFlightline
    from skyquilt.papers.hybrid import Hybrid
    from skyquilt.papers.overview import ByOverview

METHODS = ("auto", "bundle", "position", "pose", "image", "hybrid", "flightline")
BY_METADATA = ("position", "pose", "hybrid")
"""Methods that place photos by metadata, which links may repair."""
IN_SEQUENCE = ("image", "hybrid", "flightline")
"""Methods that take photos one after the other."""
TRANSFORMS = ("translation", "similarity", "affine", "homography")
IMAGE_SEARCHES = ("chain", "overview")
OPTIMISERS = ("anneal", "surfaces")
LINES = ("heading", "distance")
VLFEAT = 1.5**-0.5
"""Ratio of distances that VLFeat's matcher asks for."""
SECOND_PX2 = 12.0
"""STE of an inlier, px^2 at 1500 px, where the threshold by deviations fails: 5.99 times one px,
both ways.
"""
LEAST_INLIERS = 12
"""Matches that must agree before two photos count as registered."""
BLENDS: dict[str, type[Blend]] = {
    "feather": Feather,
    "first": First,
    "average": Average,
    "multiband": Multiband,
}
COMPRESSIONS = ("auto", "jpeg", "deflate", "zstd", "lzw", "none")
SURFACES = ("sweep", "ties")
THERMAL_UNITS = ("auto", "celsius", "kelvin", "decikelvin", "centikelvin", "counts")
DISTORTIONS = tuple(ORDERS)


@dataclass(frozen=True, kw_only=True)
class MosaicSettings:
    """Everything a mosaic can be asked for; the defaults are meant to be right."""

    method: str = "auto"
    """One of `METHODS`."""
    gsd_cm: float | None = None
    """Ground size of a map pixel in cm; None = the photos' own."""
    crs: str | None = None
    """Output CRS as PROJ knows it; None = the local UTM zone."""
    gcp: Path | None = None
    """Control points (gcp_list.txt); None = the one in the folder of photos, if any."""
    geo: Path | None = None
    """Positions (geo.txt, CSV, MRK, SRT); None = the geo.txt in the folder of photos, if any."""
    cameras: Path | None = None
    """Calibrations (cameras.json)."""
    bounds: tuple[float, float, float, float] | None = None
    """West, south, east, north in the output CRS."""
    boundary: Path | None = None
    """Polygon that the map is cut to."""
    surface: str = "sweep"
    """One of `SURFACES`: heights from tie points alone, or refined by a plane sweep."""
    blend: str = "auto"
    """One of `BLENDS`; auto = feather, and average for method `flightline`, whose blend it is."""
    feather_px: float = 6.0
    """Width of feathered seams in map pixels."""
    balance: bool = True
    """Bring photos to one brightness: 8-bit pictures; for measured values see `balance_thermal`."""
    balance_thermal: bool | None = None
    """Balance the drift between thermal frames on their overlaps; False leaves values as recorded.
    None = temperatures, if `balance`, but not counts.
    """
    thermal_unit: str | None = None
    """One of `THERMAL_UNITS`: what values of single-band TIFFs mean; None = found out, as is
    whether they are thermal.
    """
    compress: str = "auto"
    """One of `COMPRESSIONS`; auto = JPEG for 8-bit pictures, zstd for measured values."""
    quality: int = 85
    """JPEG quality."""
    distortion: str | None = None
    """One of `DISTORTIONS`: what self-calibration may change of the lens model (None = 4), or, for
    methods that do not calibrate, the order fitted to a calibration that photos bring along (None =
    6t; `flightline` none).
    """
    transform: str | None = None
    """One of `TRANSFORMS`: how two photos may differ, for methods `image` (None = similarity) and
    `flightline` (None = homography).
    """
    levelled: bool = True
    """Method `image` registers by features of the dominant plane only."""
    image_search: str = "chain"
    """One of `IMAGE_SEARCHES`: against the last photo, or against the whole map so far, for method
    `image`.
    """
    relief_m: float | None = None
    """Largest height variation on the ground in m; None = a tenth of the flying height."""
    alpha: float = 0.5
    """Weight of distances against looks in lambda (Y 4.6), for method `hybrid`."""
    optimiser: str = "surfaces"
    """One of `OPTIMISERS`: how `hybrid` maximises lambda."""
    seed: int = 0
    """Of everything random in methods `image`, `hybrid`, `flightline`."""
    sequence: str = "time"
    """Order in which photos are joined: time, name, or a file of names."""
    lines: str = "heading"
    """One of `LINES`: how method `flightline` tells lines apart."""
    distances: Path | None = None
    """AlignmentInputs distances (CSV) by which the map is judged."""
    height_m: float | None = None
    """Height above ground for methods without tie points, where altitudes do not tell it."""
    heading_deg: float | None = None
    """Common heading for method `position`; None = the commonest reported one, north where none is.
    """
    repair: bool = True
    """Treat metadata as measurements that may lie."""
    features: int = 1200
    """Features per photo."""
    jobs: int = 0
    """Threads; 0 = all processors."""
    memory_gb: float | None = None
    """Memory to stay within; None = 1.2."""

    def __post_init__(self) -> None:
        one_of("--method", self.method, METHODS)
        one_of("--surface", self.surface, SURFACES)
        one_of("--blend", self.blend, ("auto", *BLENDS))
        one_of("--compress", self.compress, COMPRESSIONS)
        one_of("--distortion", self.distortion or "4", DISTORTIONS)
        one_of("--transform", self.transform or "similarity", TRANSFORMS)
        one_of("--image-search", self.image_search, IMAGE_SEARCHES)
        one_of("--optimiser", self.optimiser, OPTIMISERS)
        one_of("--lines", self.lines, LINES)
        if self.thermal_unit is not None:
            one_of("--thermal-unit", self.thermal_unit, THERMAL_UNITS)
        for name, value, low, high in (
            ("--gsd", self.gsd_cm, 0.05, 10000),
            ("--quality", self.quality, 1, 100),
            ("--height", self.height_m, 0.5, 1e5),
            ("--memory", self.memory_gb, 0.5, 4096),
            ("--jobs", self.jobs, 0, 1024),
            ("--features", self.features, 100, 50000),
            ("--feather", self.feather_px, 0, 10000),
            ("--heading", self.heading_deg, -360, 360),
            ("--alpha", self.alpha, 0, 1),
            ("--relief", self.relief_m, 0, 1e4),
            ("--seed", self.seed, 0, 2**32 - 1),
        ):
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} {value} lies outside {low} to {high}")
        for name, given, used_by in (
            ("--transform", self.transform, ("image", "flightline")),
            ("--relief", self.relief_m, ("image",)),
        ):
            if given is not None and self.method not in used_by:
                raise UsageError(
                    f"{name} is for --method {' or '.join(used_by)}; the method here is"
                    f" {self.method}"
                )
        if self.bounds and not (
            np.isfinite(self.bounds).all()
            and self.bounds[0] < self.bounds[2]
            and self.bounds[1] < self.bounds[3]
        ):
            raise UsageError(
                "--bounds is west,south,east,north with west < east and south < north, got"
                f" {self.bounds}"
            )

    def as_table(self) -> dict[str, Any]:
        """Names and values as written to run.toml; unset ones left out."""
        table = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: str(v) if isinstance(v, Path) else v for k, v in table.items() if v is not None}


def one_of(option: str, value: str, allowed: Any) -> None:
    """Refuses a word that is none of those allowed."""
    if value not in allowed:
        raise UsageError(f"{option} {value!r} is not one of {', '.join(allowed)}")


@dataclass(frozen=True, kw_only=True)
class Methods:
    """The parts of the mosaic story."""

    sift: Sift
    """Features."""
    nearest: Nearest
    """Pairs by position."""
    retrieval: Retrieval
    """Pairs by picture."""
    mutual: Mutual
    """Matching."""
    verify: Verify
    """Two-view verification."""
    bundle: Bundle
    """Alignment from links."""
    by_pose: ByPose
    """Alignment from metadata."""
    by_position: ByPosition
    """Alignment from positions."""
    by_image: "Chain | ByOverview | None"
    """Alignment from pixels alone; like the next two, made (and loaded) only where it is asked for.
    """
    hybrid: "Hybrid | None"
    """Alignment from metadata, corrected by pixels."""
    by_flightline: "ByFlightline | None"
    """Alignment of flight lines."""
    surface: FromTiePoints
    """Heights."""
    sweep: Sweep | None
    """Refinement of the heights from the pictures."""
    balance: Balance
    """Exposure."""
    drift: Drift
    """Offsets of thermal frames."""
    blend: Blend
    """Merge rule."""


def methods(settings: MosaicSettings) -> Methods:
    """The methods that settings name."""
    flightline = settings.method == "flightline"
    blend = ("average" if flightline else "feather") if settings.blend == "auto" else settings.blend
    # the thresholds of flight lines are meant for pictures of 1500 px
    sift = (
        Sift(count=max(settings.features, 4000), longest=1500)
        if flightline
        else Sift(count=settings.features)
    )
    return Methods(
        sift=sift,
        nearest=Nearest(),
        retrieval=Retrieval(),
        mutual=Mutual(),
        verify=Verify(),
        bundle=Bundle(distortion=settings.distortion or "4", repair=settings.repair),
        by_pose=ByPose(height_m=settings.height_m),
        by_position=ByPosition(height_m=settings.height_m, heading_deg=settings.heading_deg),
        by_image=_by_image(settings) if settings.method == "image" else None,
        hybrid=_hybrid(settings) if settings.method == "hybrid" else None,
        by_flightline=_by_flightline(settings) if flightline else None,
        surface=FromTiePoints(),
        sweep=Sweep() if settings.surface == "sweep" else None,
        balance=Balance(),
        drift=Drift(),
        blend=Feather(width_px=settings.feather_px) if blend == "feather" else BLENDS[blend](),
    )


def _by_image(settings: MosaicSettings) -> "Chain | ByOverview":
    from skyquilt.matching.levelled import Level
    from skyquilt.matching.ransac import Ransac
    from skyquilt.papers.chain import Chain
    from skyquilt.papers.overview import ByOverview

    model = cast(Model, settings.transform or "similarity")
    order, height = settings.distortion or "6t", settings.height_m
    if settings.image_search == "overview":
        estimate = Ransac(model=model, threshold_px=3.0, minimum=LEAST_INLIERS, seed=settings.seed)
        level = (
            Level(relief_m=settings.relief_m, height_m=height, width=640)
            if settings.levelled
            else None
        )
        return ByOverview(
            detect=Sift(longest=1_000_000),
            match=Mutual(),
            estimate=estimate,
            level=level,
            distortion=order,
            height_m=height,
        )
    estimate = Ransac(model=model, threshold_px=6.0, minimum=LEAST_INLIERS, seed=settings.seed)
    level = Level(relief_m=settings.relief_m, height_m=height) if settings.levelled else None
    return Chain(match=Mutual(), estimate=estimate, level=level, distortion=order, height_m=height)


def _hybrid(settings: MosaicSettings) -> "Hybrid":
    from skyquilt.papers.hybrid import Hybrid
    from skyquilt.papers.hybrid_search import Anneal, Surfaces

    optimise = Anneal() if settings.optimiser == "anneal" else Surfaces()
    return Hybrid(optimise=optimise, alpha=settings.alpha, seed=settings.seed)


def _by_flightline(settings: MosaicSettings) -> "ByFlightline":
    from skyquilt.papers.best_matches import Best
    from skyquilt.papers.flightline import ByFlightline
    from skyquilt.papers.rescued import Rescued
    from skyquilt.papers.ste import RansacSte

    model = cast(Model, settings.transform or "homography")
    estimate = Rescued(
        first=RansacSte(model=model, seed=settings.seed),
        second=RansacSte(
            model=model, threshold_px2=SECOND_PX2, minimum=LEAST_INLIERS, seed=settings.seed
        ),
    )
    return ByFlightline(
        within=Best(count=150, ratio=VLFEAT),
        across=Best(count=50, ratio=VLFEAT),
        estimate=estimate,
        split="distance" if settings.lines == "distance" else "heading",
        distortion=settings.distortion or "none",
    )
