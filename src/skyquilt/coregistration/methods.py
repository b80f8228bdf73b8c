"""Ways to register two pictures of different spectra, by name."""

from dataclasses import dataclass, replace

from skyquilt import registry
from skyquilt.coregistration.auto import Auto
from skyquilt.coregistration.marks import WithoutMarks
from skyquilt.coregistration.points import PointMatches
from skyquilt.coregistration.shapes import ShapeMatches
from skyquilt.coregistration.structure import Structure, StructureMatches
from skyquilt.errors import UsageError
from skyquilt.matching.ransac import Ransac
from skyquilt.model.registration import Registers
from skyquilt.settings import one_of
from skyquilt.typed import typed

SAMPLES = 1000
"""Most samples drawn for a similarity: enough for 7 % of right matches."""
INLIERS = 9
"""Fewest inliers of an accepted registration by the thesis's methods [Y 6.4.1]."""


POINTS = 6
"""The same of a place by points of one spectrum, which is then tried like any other."""


STATING = ("auto", "structure", "shapes", "rfae-refined")
"""Methods that state their error over the picture."""


@dataclass(frozen=True, kw_only=True)
class RegisterSettings:
    """All settings of a registration of two pictures."""

    method: str = "auto"
    """A registered way of registration."""
    use_metadata: bool = True
    """Whether metadata and places are tried first; what they say is a guess only."""
    tolerance_px: float | None = None
    """Largest tolerated error over the picture, px of b; None: a share of its diagonal
    (`stated_error.TOLERANCE`).
    """

    def __post_init__(self) -> None:
        typed(self)
        one_of("--method", self.method, registry.names("registration"))
        if self.tolerance_px is None:
            return
        if not 0 < self.tolerance_px <= 1e6:  # beyond any picture; nan is refused too
            raise UsageError(
                f"--tolerance is {self.tolerance_px:g}; give a number of px above 0, at most 1e6"
            )
        if self.method not in STATING:
            raise UsageError(
                f"--tolerance: method {self.method} does not state its error;"
                f" {', '.join(STATING)} do"
            )


def registration_method(name: str) -> Registers:
    """The registration that a word names.

    Raises:
        UsageError: it names none.
    """
    one_of("--method", name, registry.names("registration"))
    made: Registers = registry.load("registration", name)()
    return made


def auto() -> WithoutMarks:
    """Orientation correlation, helped by structure matches, verified by patches."""
    return WithoutMarks(method=Auto(propose=_proposals(), points=_points()))


def near_guess() -> WithoutMarks:
    """The same near a guess only, for pictures that are known to lie within its reach."""
    return WithoutMarks(method=Auto(propose=_proposals(), points=_points(), beyond=False))


def structure() -> WithoutMarks:
    """A structure descriptor alone, verified by patches."""
    return WithoutMarks(method=Structure(propose=_proposals()))


def shapes() -> WithoutMarks:
    """Areas and objects as shapes, verified by patches."""
    return WithoutMarks(method=Structure(propose=ShapeMatches()))


def _points() -> PointMatches:
    return PointMatches(
        estimate=Ransac(
            model="similarity", minimum=POINTS, threshold_px=4.0, max_iterations=5 * SAMPLES
        )
    )


def _proposals() -> StructureMatches:
    similar = Ransac(
        model="similarity", minimum=INLIERS, threshold_px=4.0, max_iterations=5 * SAMPLES
    )
    return StructureMatches(estimate=similar, stretch=replace(similar, model="affine"))
