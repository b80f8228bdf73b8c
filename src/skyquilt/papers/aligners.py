"""The alignment methods of the papers as aligners of the workflow: `image`, `hybrid`,
`flightline`.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np

from skyquilt import registry
from skyquilt.alignment.aligners import REQUESTED, ByReport, by_pose, placed_by_metadata
from skyquilt.alignment.crowded_positions import without_heights
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.repair import repaired_metadata
from skyquilt.alignment.start import OWN_ZERO
from skyquilt.errors import UsageError
from skyquilt.geometry.transforms import Model
from skyquilt.matching.levelled import Level
from skyquilt.model.poses import Alignment
from skyquilt.papers.best_matches import Best
from skyquilt.papers.chain import Chain, DirectChain
from skyquilt.papers.flightline import ByFlightline
from skyquilt.papers.hybrid import Hybrid
from skyquilt.papers.hybrid_search import Anneal, Surfaces
from skyquilt.papers.lens_order import WORKING_WIDTH
from skyquilt.papers.overview import ByOverview
from skyquilt.papers.plane_registration import Estimator
from skyquilt.papers.ste import RansacSte, Rescued
from skyquilt.settings import MosaicSettings

VLFEAT = 1.5**-0.5
"""Ratio of distances required by VLFeat's matcher."""
SECOND_PX2 = 12.0
"""STE of an inlier, px^2 at 1500 px, used if the threshold from deviations fails: 5.99 times one
px^2, in both directions.
"""
LEAST_INLIERS = 12
"""Fewest inliers for two photos to count as registered."""
DIRECT = {
    "ncc": ("similarity", "translation"),
    "phase": ("similarity", "translation"),
    "ecc": ("homography", "affine", "translation"),
    "mi": ("similarity", "translation"),
}
"""Estimators that register pixels instead of features, and the transformations that each can
estimate.
"""
CHAIN_PX, OVERVIEW_PX = 6.0, 3.0
"""Largest transfer error of an inlier in px of the working image, and of the overview."""
OVERVIEW_WIDTH = 640
"""Width in px of a photo in the overview."""


@dataclass(frozen=True, kw_only=True)
class ByImage:
    """`image`: photos are registered one after the other, to the previous one or to the map
    so far.
    """

    method: Chain | DirectChain | ByOverview
    """The search method."""
    version: ClassVar[int] = 3
    needs_links: ClassVar[bool] = False

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Registers the photos in their order.

        Raises:
            UsageError: a relief is given, but nothing tells the height that it is divided by (4.9).
        """
        method, inputs = self.method, on_plain_ground(inputs)
        if not isinstance(method, DirectChain):
            level = method.level
            if isinstance(level, Level) and level.height_m is None:
                height = _least_height(inputs)
                if height is None and level.relief_m is not None:
                    height = _height_by_scale(replace(method, level=None), inputs)
                method = replace(method, level=replace(level, height_m=height))
        return _outside_named(replace(_placed(method, inputs), why=REQUESTED), inputs)


def on_plain_ground(inputs: AlignmentInputs) -> AlignmentInputs:
    """The inputs for methods that lay photos on a plane at zero: heights above the sea or the
    ellipsoid are none above it.
    """
    if inputs.frame.vertical_datum in OWN_ZERO:
        return inputs
    frame = replace(inputs.frame, vertical_datum="unknown", takeoff_m=None)
    return replace(inputs, frame=frame, priors=without_heights(inputs.priors))


def _placed(method: Chain | DirectChain | ByOverview, inputs: AlignmentInputs) -> Alignment:
    known = (inputs.photos, inputs.frame, inputs.priors)
    if isinstance(method, Chain):
        return method(*known, inputs.features, inputs.order)
    if isinstance(method, DirectChain):
        return method(*known, inputs.order, inputs.grey)
    return method(*known, inputs.features, inputs.order, inputs.grey)


@dataclass(frozen=True, kw_only=True)
class Corrected:
    """`hybrid`: photos are placed by metadata, then each is corrected by image correlation."""

    pose: ByReport
    """First placement."""
    hybrid: Hybrid
    """Correction."""
    version: ClassVar[int] = 2

    @property
    def needs_links(self) -> bool:
        """Links are needed only to correct metadata."""
        return self.pose.repair

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Places the photos in their order.

        Raises:
            AlignmentError: positions or heights above ground are missing.
        """
        repaired = repaired_metadata(inputs) if self.pose.repair else None
        placed = placed_by_metadata(self.pose.method, inputs, repaired)
        priors = inputs.priors if repaired is None else repaired.priors
        zero, ground = np.zeros(3), np.array([0.0, 0.0, placed.ground_m])
        low = placed.carried(np.eye(3), 1.0, ground, zero)  # its ground lies at zero
        found = self.hybrid(low, inputs.photos, priors, inputs.order, inputs.grey)
        found = found.carried(np.eye(3), 1.0, zero, ground)
        return _outside_named(replace(found, why=REQUESTED), inputs)


@dataclass(frozen=True, kw_only=True)
class ByLines:
    """`flightline`: flight lines are mosaicked separately, then joined (A)."""

    method: ByFlightline
    """The article's method."""
    version: ClassVar[int] = 2
    needs_links: ClassVar[bool] = False

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Joins the photos.

        Raises:
            AlignmentError: lines cannot be separated, or do not match.
        """
        inputs = on_plain_ground(inputs)
        found = self.method(
            inputs.photos, inputs.frame, inputs.priors, inputs.features, inputs.order
        )
        return _outside_named(replace(found, why=REQUESTED), inputs)


def image(settings: MosaicSettings) -> ByImage:
    """Method `image`."""
    if settings.matching.estimator in DIRECT:
        return ByImage(method=_direct_chain(settings))
    order, height = settings.camera.distortion or "6t", settings.camera.height_m
    match = registry.load("matcher", settings.matching.matcher or "mutual")()
    if settings.image.image_search != "overview":
        chain = Chain(
            match=match,
            estimate=_estimator(settings, CHAIN_PX, "similarity"),
            level=_level(settings, WORKING_WIDTH),
            distortion=order,
            height_m=height,
            loop=settings.image.image_search == "loop",
        )
        return ByImage(method=chain)
    detect = registry.load("detector", settings.matching.detector or "sift")
    overview = ByOverview(
        detect=detect(longest=1_000_000),
        match=match,
        estimate=_estimator(settings, OVERVIEW_PX, "similarity"),
        level=_level(settings, OVERVIEW_WIDTH),
        distortion=order,
        height_m=height,
    )
    return ByImage(method=overview)


def _direct_chain(settings: MosaicSettings) -> DirectChain:
    """`image` by pixels."""
    name, asked = str(settings.matching.estimator), settings.matching
    if settings.image.image_search != "chain":
        raise UsageError(f"--estimator {name} registers two photos: --image-search is chain")
    model = asked.transform or DIRECT[name][0]
    if model not in DIRECT[name]:
        raise UsageError(
            f"--estimator {name} finds {' or '.join(DIRECT[name])}; --transform is {model}"
        )
    return DirectChain(
        register=registry.load("estimator", name)(model),
        distortion=settings.camera.distortion or "6t",
        height_m=settings.camera.height_m,
    )


def _estimator(settings: MosaicSettings, threshold_px: float, model: str) -> Estimator:
    """The estimator selected by the settings, RANSAC by default, with the thresholds of its
    method.
    """
    name, asked = settings.matching.estimator or "ransac", settings.matching.transform or model
    options: dict[str, Any] = (
        {} if name in ("lmeds", "ste", "ste-printed") else {"threshold_px": threshold_px}
    )
    made: Estimator = registry.load("estimator", name)(
        model=asked, minimum=LEAST_INLIERS, seed=settings.running.seed, **options
    )
    return made


def _level(settings: MosaicSettings, width: int) -> Level | None:
    if not settings.image.levelled:
        return None
    return Level(relief_m=settings.image.relief_m, height_m=settings.camera.height_m, width=width)


def hybrid(settings: MosaicSettings) -> Corrected:
    """Method `hybrid`."""
    search = Anneal() if settings.hybrid.optimiser == "anneal" else Surfaces()
    method = Hybrid(optimise=search, alpha=settings.hybrid.alpha, seed=settings.running.seed)
    return Corrected(pose=by_pose(settings.camera.height_m, settings.input.repair), hybrid=method)


def flightline(settings: MosaicSettings) -> ByLines:
    """Method `flightline`; its default estimator is A's, with a second one if its threshold
    fails.
    """
    method = ByFlightline(
        within=Best(count=150, ratio=VLFEAT),
        across=Best(count=50, ratio=VLFEAT),
        estimate=_lines_estimator(settings),
        split="distance" if settings.flightline.lines == "distance" else "heading",
        distortion=settings.camera.distortion or "none",
    )
    return ByLines(method=method)


def _lines_estimator(settings: MosaicSettings) -> Estimator:
    """A's estimator, first as published and then with a fixed threshold, unless another one is
    selected.
    """
    if settings.matching.estimator not in (None, "ste"):
        return _estimator(settings, CHAIN_PX, "homography")
    model = cast(Model, settings.matching.transform or "homography")
    seed = settings.running.seed
    return Rescued(
        first=RansacSte(model=model, seed=seed),
        second=RansacSte(model=model, threshold_px2=SECOND_PX2, minimum=LEAST_INLIERS, seed=seed),
    )


def _least_height(inputs: AlignmentInputs) -> float | None:
    """Smallest height above take-off in m, used as height above ground in (4.9); None if none is
    reported.
    """
    heights = np.array([p.map_C[2] for p in inputs.priors])
    plausible = heights[np.isfinite(heights) & (heights > 1)]
    takeoff = inputs.frame.vertical_datum == "takeoff"
    return float(plausible.min()) if takeoff and len(plausible) else None


def _height_by_scale(method: Chain | ByOverview, inputs: AlignmentInputs) -> float:
    """Median height in m above the ground from the scale of the mosaic, made without levelling and
    laid on the positions.

    Raises:
        UsageError: there are no positions that give the scale.
    """
    rough = _placed(method, inputs)
    if not rough.frame.metric or not rough.poses:
        raise UsageError(
            "--relief is compared with the height above ground (Y 4.9), which neither heights above"
            " take-off nor positions of these photos give; add --height"
        )
    return float(np.median([pose.map_C[2] for pose in rough.poses.values()]))


def _outside_named(alignment: Alignment, inputs: AlignmentInputs) -> Alignment:
    """The alignment, with a reason for photos that are not listed in the sequence."""
    missing = set(range(len(inputs.photos))) - set(inputs.order)
    reasons = dict.fromkeys(missing, "it is not listed in the sequence")
    return replace(alignment, rejected={**alignment.rejected, **reasons})
