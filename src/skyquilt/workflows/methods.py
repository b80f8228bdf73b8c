"""The methods of a mosaic: one per stage, made from settings or given by the caller.

Every method is a frozen dataclass with `__call__`. It can be replaced by any object with the same
interface:

    methods = replace(methods_for(settings), detector=MyDetector()) skyquilt.mosaic(photos, output,
    settings, methods=methods)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from skyquilt import registry
from skyquilt.alignment.aligners import Auto, ByLinks, ByReport, by_pose
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.inputs import Aligner
from skyquilt.alignment.pose import ByPosition
from skyquilt.effects import FLIGHTLINE_FEATURES
from skyquilt.engine.kept import Keep
from skyquilt.imaging.nodes import View
from skyquilt.matching.candidates import Nearest, Pair, Retrieval
from skyquilt.matching.matchers import Guided
from skyquilt.matching.through_others import ThroughOthers
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches, RejectedLink
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Average, Blend, Feather, First, Multiband
from skyquilt.ortho.drift import Drift
from skyquilt.ortho.exposure import Balance, Exposure
from skyquilt.ortho.ground import GreyPicture, SurfaceFromPictures, SurfaceFromTies
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.radiometry import BalanceMethod, DriftMethod
from skyquilt.ortho.seam_lines import SeamLines
from skyquilt.ortho.stereo import Level, Stereo
from skyquilt.ortho.sweep import Sweep
from skyquilt.ortho.tie_surface import FromTiePoints
from skyquilt.settings import MosaicSettings


class Detector(Protocol):
    """Interface: finds the features of one photo."""

    @property
    def longest(self) -> int:
        """Longest side in px of the image that is searched."""
        ...

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image (h, w[, bands]) reduced to `longest`, in px of the full photo, whose
        height and width are `full`.
        """
        ...


@runtime_checkable
class Countable(Detector, Protocol):
    """A detector that can be asked for more features."""

    @property
    def count(self) -> int:
        """Number of features at most."""
        ...

    def counted(self, count: int) -> "Countable":
        """The same with another number."""
        ...


class Matcher(Protocol):
    """Interface: finds putative matches of two photos."""

    def __call__(self, a: Features, b: Features) -> Matches:
        """Matches of a and b."""
        ...


class Verifier(Protocol):
    """Interface: selects the matches that agree with one geometry."""

    def __call__(
        self,
        a: int,
        b: int,
        features_a: Features,
        features_b: Features,
        matches: Matches,
        width: int,
        lenses: tuple[Camera, Camera] | None = None,
        /,
    ) -> Link | RejectedLink:
        """The link of photos a and b (numbers), or the reason why there is none; `width` of a in
        px; `lenses` are given where one of them is a fisheye.
        """
        ...


class Neighbours(Protocol):
    """Interface: finds candidate pairs by position."""

    def __call__(self, map_xy: NDArray[Any], reach_m: float | None = None) -> list[Pair]:
        """Pairs (i < j), nearest first, of positions (n, 2) in m, NaN where unknown; `reach_m`
        is the distance beyond which photos hardly overlap.
        """
        ...


class LookAlikes(Protocol):
    """Interface: finds candidate pairs by image content."""

    def __call__(self, features: Sequence[Features], asked: list[int] | None = None) -> list[Pair]:
        """Pairs (i < j) for the requested photos, or for all."""
        ...


class SeamMethod(Protocol):
    """Interface: decides which photo is shown where."""

    def __call__(
        self,
        views: Sequence[View],
        surface: Surface,
        grid: Grid,
        grey: GreyPicture,
        exposure: Exposure,
        keep: Keep,
        /,
    ) -> Labels:
        """The photo of each cell of a map's grid, from grey images of the photos; `keep`: for
        methods that resume at a part of their result, and its workers for parts that do not
        depend on one another.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Methods:
    """The methods of a mosaic, in the order of their use."""

    detector: Detector
    """Features."""
    nearest: Neighbours
    """Pairs by position."""
    retrieval: LookAlikes
    """Pairs by image content."""
    through_others: ThroughOthers
    """Pairs by what photos between them show."""
    matcher: Matcher | Guided
    """Matching."""
    verify: Verifier
    """Two-view verification."""
    align: Aligner
    """Alignment."""
    surface: SurfaceFromTies
    """Heights."""
    sweep: SurfaceFromPictures | None
    """Refinement of the heights by image matching; None = none."""
    balance: BalanceMethod
    """Exposure."""
    drift: DriftMethod
    """Offsets of thermal frames."""
    seams: SeamMethod
    """Which photo is shown where."""
    blend: Blend
    """Blending."""


BLENDS: dict[str, type[Blend]] = {"first": First, "average": Average, "multiband": Multiband}
FLIGHTLINE_PX = 1500
"""Longest side of images in px for which the thresholds of method `flightline` are defined."""


def methods_for(settings: MosaicSettings) -> Methods:
    """The methods selected by the settings."""
    return Methods(
        detector=detector_for(settings),
        nearest=Nearest(),
        retrieval=Retrieval(),
        through_others=ThroughOthers(),
        matcher=matcher_for(settings),
        verify=Verify(epipolar=_epipolar(settings)),
        align=registry.load("alignment", settings.method)(settings),
        surface=FromTiePoints(),
        sweep=heights_for(settings),
        balance=Balance(),
        drift=Drift(),
        seams=SeamLines(),
        blend=blend_for(settings),
    )


def heights_for(settings: MosaicSettings) -> SurfaceFromPictures | None:
    """The refinement of heights selected by the settings; None = tie points alone."""
    chosen: dict[str, SurfaceFromPictures] = {
        "auto": Stereo(),
        "dense": Stereo(
            fine=Level(longest=1600, window=3, wanted=4),
            relief=0.0,
            edges=0.2,
            both_ways=True,
            held_mb=320.0,
            cell=1.5,
            cell_px=(2, 8),
        ),
        "sweep": Sweep(),
    }
    return chosen.get(settings.ground.surface)


def detector_for(settings: MosaicSettings) -> Detector:
    """The detector selected by the settings, with their number of features."""
    asked: dict[str, int] = {"count": settings.matching.features}
    if settings.method == "flightline":
        asked = {
            "count": max(settings.matching.features, FLIGHTLINE_FEATURES),
            "longest": FLIGHTLINE_PX,
        }
    made: Detector = registry.load("detector", settings.matching.detector or "sift")(**asked)
    return made


def matcher_for(settings: MosaicSettings) -> Matcher | Guided:
    """The matcher selected by the settings."""
    name = settings.matching.matcher or "mutual"
    options = {"height_m": settings.camera.height_m} if name == "guided" else {}
    made: Matcher | Guided = registry.load("matcher", name)(**options)
    return made


def _epipolar(settings: MosaicSettings) -> str:
    """The estimator of links' epipolar geometry: other methods use theirs elsewhere."""
    asked, takes = settings.matching.estimator, registry.row("alignment", settings.method).takes
    own = "ste" in takes.get("estimator", ())
    return "magsac" if own or asked is None else asked


def blend_for(settings: MosaicSettings) -> Blend:
    """The blending method; `flightline` averages unless another one is selected (A 2.5)."""
    name = settings.picture.blend
    if name == "auto":
        name = "average" if settings.method == "flightline" else "feather"
    if name == "feather":
        return Feather(width_px=settings.picture.feather_px)
    return BLENDS[name]()


def bundle(settings: MosaicSettings) -> ByLinks:
    """Method `bundle`."""
    repair = settings.input.repair
    return ByLinks(bundle=Bundle(distortion=settings.camera.distortion or "full", repair=repair))


def pose(settings: MosaicSettings) -> ByReport:
    """Method `pose`."""
    return by_pose(settings.camera.height_m, settings.input.repair)


def position(settings: MosaicSettings) -> ByReport:
    """Method `position`."""
    camera = settings.camera
    method = ByPosition(height_m=camera.height_m, heading_deg=camera.heading_deg)
    return ByReport(method=method, repair=settings.input.repair)


def auto(settings: MosaicSettings) -> Auto:
    """Chooses between `bundle` and `pose`."""
    return Auto(bundle=bundle(settings), pose=pose(settings))
