"""Names and numbers -> methods: the one place where words on a command line become parts of a story."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.pose import ByPose, ByPosition
from skyquilt.errors import UsageError
from skyquilt.features.sift import Sift
from skyquilt.features.surf import Surf
from skyquilt.matching.mutual import Mutual
from skyquilt.matching.one_way import OneWay
from skyquilt.metrics.registration_quality import spread_quality
from skyquilt.model.registration import Registers
from skyquilt.pairs.nearest import Nearest
from skyquilt.pairs.retrieval import Retrieval
from skyquilt.render.blend import Average, Blend, Feather, First, Multiband
from skyquilt.render.exposure import Balance
from skyquilt.spectral.auto import Auto
from skyquilt.spectral.by_features import BetterByQ, ByFeatures, Outliers, Rfae
from skyquilt.spectral.structure import Structure, StructureMatches
from skyquilt.surface.sweep import Sweep
from skyquilt.surface.tiepoints import FromTiePoints
from skyquilt.twoview.lmeds import Lmeds
from skyquilt.twoview.ransac import Ransac
from skyquilt.twoview.verify import Verify

METHODS = ("auto", "bundle", "pose", "position")
BLENDS = {"feather": Feather, "first": First, "average": Average, "multiband": Multiband}
COMPRESSIONS = ("auto", "jpeg", "deflate", "zstd", "lzw", "none")
SURFACES = ("sweep", "ties")
REGISTRATIONS = ("auto", "sift", "surf", "usurf", "rfae", "rfae-sift", "surf+rfae", "structure")
"""Ways to register two pictures of different spectra."""
SAMPLES = 1000
"""Most samples drawn for a similarity: enough for 7 % of right matches."""
INLIERS = 9
"""Fewest inliers of an accepted registration by the thesis's methods [Y 6.4.1]."""
DISTORTIONS = ("none", "2", "4", "6", "6t")


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
    blend: str = "feather"
    """One of `BLENDS`."""
    feather_px: float = 6.0
    """Width of feathered seams in map pixels."""
    balance: bool = True
    """Bring photos to one brightness (8-bit pictures only; measured values are never changed)."""
    compress: str = "auto"
    """One of `COMPRESSIONS`; auto = JPEG for 8-bit pictures, zstd for measured values."""
    quality: int = 85
    """JPEG quality."""
    distortion: str = "4"
    """One of `DISTORTIONS`: what self-calibration may change of the lens model."""
    height_m: float | None = None
    """Height above ground for methods without tie points, where altitudes do not tell it."""
    heading_deg: float = 0.0
    """Common heading for method `position`."""
    repair: bool = True
    """Treat metadata as measurements that may lie."""
    features: int = 1500
    """Features per photo."""
    jobs: int = 0
    """Threads; 0 = all processors."""
    memory_gb: float | None = None
    """Memory to stay within; None = 1.2."""

    def __post_init__(self) -> None:
        _one_of("--method", self.method, METHODS)
        _one_of("--surface", self.surface, SURFACES)
        _one_of("--blend", self.blend, BLENDS)
        _one_of("--compress", self.compress, COMPRESSIONS)
        _one_of("--distortion", self.distortion, DISTORTIONS)
        for name, value, low, high in (
            ("--gsd", self.gsd_cm, 0.05, 10000), ("--quality", self.quality, 1, 100),
            ("--height", self.height_m, 0.5, 1e5), ("--memory", self.memory_gb, 0.5, 4096),
            ("--jobs", self.jobs, 0, 1024), ("--features", self.features, 100, 50000),
            ("--feather", self.feather_px, 0, 10000), ("--heading", self.heading_deg, -360, 360),
        ):  # fmt: skip
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} {value} lies outside {low} to {high}")
        if self.bounds and not (
            np.isfinite(self.bounds).all()
            and self.bounds[0] < self.bounds[2]
            and self.bounds[1] < self.bounds[3]
        ):
            raise UsageError(
                f"--bounds is west,south,east,north with west < east and south < north, got {self.bounds}"
            )

    def as_table(self) -> dict[str, Any]:
        """Names and values as written to run.toml; unset ones left out."""
        table = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: str(v) if isinstance(v, Path) else v for k, v in table.items() if v is not None}


@dataclass(frozen=True, kw_only=True)
class RegisterSettings:
    """Everything a registration of two pictures can be asked for."""

    method: str = "auto"
    """One of `REGISTRATIONS`."""
    use_metadata: bool = True
    """Whether metadata and places are tried first; what they say is a guess only."""

    def __post_init__(self) -> None:
        _one_of("--method", self.method, REGISTRATIONS)


def registration_method(name: str) -> Registers:
    """The registration that a word names, with the thesis's parameters [Y 5.2, Fig. 5.8]."""
    _one_of("--method", name, REGISTRATIONS)
    surf, sift = Surf(lobe=1, step=1), Sift(levels=43, root=False, longest=1000, count=3000)
    structure = StructureMatches(
        estimate=Ransac(model="similarity", minimum=INLIERS, threshold_px=4.0, max_iterations=5 * SAMPLES)
    )
    ways: dict[str, Callable[[], Registers]] = {
        "auto": lambda: Auto(propose=structure),
        "sift": lambda: ByFeatures(detect=sift, relate=_outliers()),
        "surf": lambda: ByFeatures(detect=surf, relate=_outliers()),
        "usurf": lambda: ByFeatures(detect=replace(surf, upright=True), relate=_outliers()),
        "rfae": lambda: Rfae(detect=surf, relate=_outliers()),
        "rfae-sift": lambda: Rfae(detect=sift, relate=_outliers()),
        "structure": lambda: Structure(propose=structure),
        "surf+rfae": lambda: BetterByQ(methods=(registration_method("surf"), registration_method("rfae"))),
    }
    return ways[name]()


def _outliers() -> Outliers:
    return Outliers(
        match=OneWay(), quality=spread_quality,
        estimators=(
            Ransac(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
            Lmeds(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
        ),
    )  # fmt: skip


def _one_of(option: str, value: str, allowed: Any) -> None:
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
    surface: FromTiePoints
    """Heights."""
    sweep: Sweep | None
    """Refinement of the heights from the pictures."""
    balance: Balance
    """Exposure."""
    blend: Blend
    """Merge rule."""


def methods(settings: MosaicSettings) -> Methods:
    """The methods that settings name."""
    blend: Blend = (
        Feather(width_px=settings.feather_px) if settings.blend == "feather" else BLENDS[settings.blend]()
    )
    return Methods(
        sift=Sift(count=settings.features), nearest=Nearest(), retrieval=Retrieval(), mutual=Mutual(),
        verify=Verify(),
        bundle=Bundle(distortion=settings.distortion, repair=settings.repair),
        by_pose=ByPose(height_m=settings.height_m),
        by_position=ByPosition(height_m=settings.height_m, heading_deg=settings.heading_deg),
        surface=FromTiePoints(), sweep=Sweep() if settings.surface == "sweep" else None, balance=Balance(),
        blend=blend,
    )  # fmt: skip
