"""Words -> ways to register two pictures of different spectra; apart from `config`, since a mosaic
needs none of it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from skyquilt.coregistration.auto import Auto
from skyquilt.coregistration.structure import Structure, StructureMatches
from skyquilt.matching.matchers import OneWay
from skyquilt.matching.ransac import Ransac
from skyquilt.matching.sift import Sift
from skyquilt.model.registration import Registers
from skyquilt.papers.lmeds import Lmeds
from skyquilt.papers.rfae import BetterByQ, ByFeatures, Outliers, Rfae
from skyquilt.papers.surf import Surf
from skyquilt.quality.registration_quality import spread_quality
from skyquilt.workflows.methods import one_of

REGISTRATIONS = ("auto", "sift", "surf", "usurf", "rfae", "rfae-sift", "surf+rfae", "structure")
"""Ways to register two pictures of different spectra."""
SAMPLES = 1000
"""Most samples drawn for a similarity: enough for 7 % of right matches."""
INLIERS = 9
"""Fewest inliers of an accepted registration by the thesis's methods [Y 6.4.1]."""


@dataclass(frozen=True, kw_only=True)
class RegisterSettings:
    """Everything a registration of two pictures can be asked for."""

    method: str = "auto"
    """One of `REGISTRATIONS`."""
    use_metadata: bool = True
    """Whether metadata and places are tried first; what they say is a guess only."""

    def __post_init__(self) -> None:
        one_of("--method", self.method, REGISTRATIONS)


def registration_method(name: str) -> Registers:
    """The registration that a word names, with the thesis's parameters [Y 5.2, Fig. 5.8]."""
    one_of("--method", name, REGISTRATIONS)
    surf, sift = Surf(lobe=1, step=1), Sift(levels=43, root=False, longest=1000, count=3000)
    structure = StructureMatches(
        estimate=Ransac(
            model="similarity", minimum=INLIERS, threshold_px=4.0, max_iterations=5 * SAMPLES
        )
    )
    ways: dict[str, Callable[[], Registers]] = {
        "auto": lambda: Auto(propose=structure),
        "sift": lambda: ByFeatures(detect=sift, relate=_outliers()),
        "surf": lambda: ByFeatures(detect=surf, relate=_outliers()),
        "usurf": lambda: ByFeatures(detect=replace(surf, upright=True), relate=_outliers()),
        "rfae": lambda: Rfae(detect=surf, relate=_outliers()),
        "rfae-sift": lambda: Rfae(detect=sift, relate=_outliers()),
        "structure": lambda: Structure(propose=structure),
        "surf+rfae": lambda: BetterByQ(
            methods=(registration_method("surf"), registration_method("rfae"))
        ),
    }
    return ways[name]()


def _outliers() -> Outliers:
    return Outliers(
        match=OneWay(),
        quality=spread_quality,
        estimators=(
            Ransac(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
            Lmeds(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
        ),
    )
