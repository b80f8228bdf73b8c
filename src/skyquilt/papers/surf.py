"""Our implementation of SURF and upright SURF (Bay, Ess, Tuytelaars and Van Gool 2008)."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import full_px, shrink, to_grey8
from skyquilt.matching.keypoints import spread
from skyquilt.model.features import Features
from skyquilt.papers.surf_blobs import blobs
from skyquilt.papers.surf_descriptors import Means, descriptors, orientations

_SIGNED_UNIT = 160
"""Integer that represents a component of 1; components of SURF vectors hardly exceed 0.7."""


@dataclass(frozen=True, kw_only=True)
class Surf:
    """Blobs of a box-filtered Hessian, described by Haar wavelets."""

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    lobe: int = 3
    """Initial lobe in px, odd: the first filter's side is three times it. 3 is Bay's, 1 finds
    smaller blobs.
    """
    step: int = 1
    """Sampling step of the first octave in px; it doubles from octave to octave."""
    octaves: int = 4
    """Octaves of scale."""
    threshold: float = 50.0
    """Least determinant of a blob, grey levels (of 255) squared."""
    upright: bool = False
    """Whether keypoints have no orientation: faster and more distinctive if photos are hardly
    rotated against each other.
    """
    length: Literal[64, 128] = 64
    """Length of the descriptor; 128 separates the sums by the sign of the other direction."""
    cells: int = 10
    """The image is divided into cells x cells; each keeps its strongest keypoints."""
    version: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if self.lobe < 1 or self.lobe % 2 == 0 or self.step < 1 or self.octaves < 1:
            raise ValueError(f"an odd lobe, a step and octaves of at least 1 expected, got {self}")
        if self.length not in (64, 128):
            raise ValueError(f"a length of 64 or 128 expected, got {self.length}")

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def counted(self, count: int) -> "Surf":
        """The same with another number of keypoints at most."""
        return replace(self, count=count)

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        grey = to_grey8(small)
        found = blobs(
            grey, octaves=self.octaves, lobe=self.lobe, step=self.step, threshold=self.threshold
        )
        keep = spread(found.xy, found.response, grey.shape, self.count, self.cells)
        xy, sigma = found.xy[keep], found.sigma[keep]
        means = Means(grey)
        angle = np.zeros(len(xy)) if self.upright else orientations(means, xy, sigma)
        vectors = descriptors(means, xy, sigma, angle, extended=self.length == 128)
        scale = full[1] / grey.shape[1]
        return Features(
            px=full_px(xy, grey.shape, full),
            size=(20 * sigma * scale).astype(np.float32),
            scale=scale,
            descriptors=signed_bytes(vectors),
        )


def upright_surf(**fields: Any) -> Surf:
    """SURF without orientation."""
    return Surf(upright=True, **fields)


def signed_bytes(vectors: NDArray[np.float32]) -> NDArray[np.int8]:
    """(N, D) vectors of unit length in 8 bits (see Features)."""
    return np.clip(np.rint(_SIGNED_UNIT * vectors), -127, 127).astype(np.int8)
