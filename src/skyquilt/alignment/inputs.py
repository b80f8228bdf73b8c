"""Inputs and interface of the alignment methods."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.free_memory import give_back
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import Alignment, MapFrame, Prior

GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image of a photo (index), with at most the given px on its longest side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignmentInputs:
    """All data of a survey's photos before they are aligned."""

    photos: Sequence[Photo]
    """Photos; all indices below refer to them."""
    features: Sequence[Features]
    """One per photo."""
    frame: MapFrame
    """The map's frame."""
    priors: Sequence[Prior]
    """Priors from the metadata, one per photo."""
    links: Sequence[Link]
    """Verified links; empty for a method that does not need them."""
    control: Sequence[ControlPoint]
    """Control and check points."""
    order: Sequence[int]
    """Photos in the order in which they are joined; photos not listed are left out."""
    grey: GreyPicture
    """Gives grey images."""
    keep: Keep = MADE_NOW
    """Keeps parts of large adjustments, and shares them out."""
    make_room: Callable[[], None] = give_back
    """Gives memory back: what was read of features, or of grey images, is not needed any more."""
    former: Alignment | None = None
    """An alignment of some of these photos that the others are added to; None = all are aligned
    anew. Methods that cannot add photos align all anew.
    """


class Aligner(Protocol):
    """Interface of an alignment method: a frozen dataclass whose value is part of the
    store's keys.
    """

    @property
    def needs_links(self) -> bool:
        """Whether the photos must be linked before."""
        ...

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Poses and calibration; `why` gives the reason for the method."""
        ...
