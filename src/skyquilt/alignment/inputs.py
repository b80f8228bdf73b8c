"""What a method of alignment may use, and what it is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.features import Features, Link
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import Alignment, MapFrame, Prior

GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Grey picture of a photo (index), its longest side at most the px given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignmentInputs:
    """Everything that is known of a survey's photos before they are aligned."""

    photos: Sequence[Photo]
    """Photos; all indices below refer to them."""
    features: Sequence[Features]
    """One per photo."""
    frame: MapFrame
    """The map's frame."""
    priors: Sequence[Prior]
    """What the metadata say, one per photo."""
    links: Sequence[Link]
    """Verified links; none for a method that needs none."""
    control: Sequence[ControlPoint]
    """Control and check points."""
    order: Sequence[int]
    """Photos in the order they are joined in; photos that the sequence does not name are left out.
    """
    grey: GreyPicture
    """Grey pictures."""


class Aligner(Protocol):
    """A method of alignment: a frozen dataclass, whose value is part of the store's keys."""

    @property
    def needs_links(self) -> bool:
        """Whether photos are linked first."""
        ...

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Poses and calibration; `why` says why this method was used."""
        ...
