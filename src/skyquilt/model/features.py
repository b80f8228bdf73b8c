"""Keypoints of one photo, and what two photos have in common."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

DESCRIPTOR_UNIT = 400
"""Integer that stands for a component of 1; components of a RootSIFT vector rarely exceed 0.6."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Keypoints and descriptors of one photo."""

    px: NDArray[np.float64]
    """(N, 2) in px of the full sensor image, centres at integers."""
    size: NDArray[np.float32]
    """(N,) diameter in px of the full sensor image."""
    descriptors: NDArray[np.uint8 | np.int8 | np.float32]
    """(N, D), each row a multiple of a unit vector: scaled by DESCRIPTOR_UNIT as uint8 (signed:
    int8), which takes a quarter of the memory of floats, or as floats. Where `binary`, uint8 whose
    bits are the descriptor.
    """
    scale: float
    """Full-resolution px per px of the image the keypoints were found in."""
    binary: bool = False
    """True where descriptors are bit strings, compared by the number of bits that differ (Hamming
    distance).
    """

    def __len__(self) -> int:
        return len(self.px)

    @property
    def places(self) -> "Features":
        """The same without descriptors, which take most of the memory."""
        return replace(self, descriptors=np.zeros((len(self), 0), self.descriptors.dtype))

    def followed_by(self, more: "Features") -> "Features":
        """These, then others of the same kind in the same photo."""
        return replace(
            self,
            px=np.concatenate([self.px, more.px]),
            size=np.concatenate([self.size, more.size]),
            descriptors=np.concatenate([self.descriptors, more.descriptors]),
        )

    @property
    def unit(self) -> NDArray[np.float32]:
        """(N, D) descriptors of unit length: the dot product of two is their similarity.

        Bits 0 and 1 become -1 and 1, (N, 8 D), so that 1 - similarity is twice the share of bits
        that differ.
        """
        if self.binary:
            signs = (
                np.unpackbits(np.asarray(self.descriptors, np.uint8), axis=1).astype(np.float32) * 2
                - 1
            )
            return signs / np.float32(np.sqrt(max(signs.shape[1], 1)))
        d = self.descriptors.astype(np.float32)
        return np.asarray(
            d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), np.float32(1e-6))
        )

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return int(self.px.nbytes + self.size.nbytes + self.descriptors.nbytes)


def numbers(index: NDArray[Any]) -> NDArray[np.integer[Any]]:
    """Numbers of keypoints (M,) as the smallest type that has room for them: links of thousands of
    photos stay in memory.
    """
    largest = int(index.max(initial=0))
    return index.astype(np.uint16 if largest < 2**16 else np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Putative correspondences of two photos."""

    index_a: NDArray[np.int64]
    """(M,) keypoints of a."""
    index_b: NDArray[np.int64]
    """(M,) keypoints of b."""

    def __len__(self) -> int:
        return len(self.index_a)


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """Two photos with verified matches: they show the same ground."""

    a: int
    """Index of the first photo."""
    b: int
    """Index of the second photo."""
    index_a: NDArray[np.integer[Any]]
    """(M,) keypoints of a among its features, as `numbers` gives them."""
    index_b: NDArray[np.integer[Any]]
    """(M,) keypoints of b."""
    b_S_a: complex
    """Scale and rotation from a to b: p_b = b_S_a * p_a + t for image points as x - iy (y up)."""

    def other(self, photo: int) -> int:
        """The other one of its two photos."""
        return self.b if self.a == photo else self.a

    def __len__(self) -> int:
        return len(self.index_a)


@dataclass(frozen=True, kw_only=True, eq=False)
class RejectedLink:
    """A pair whose matches failed verification: false in `if`, carries the reason."""

    a: int
    """Index of the first photo."""
    b: int
    """Index of the second photo."""
    reason: str
    """`too few matches`, `weak inliers`, `implausible scale`, ..."""

    def __bool__(self) -> bool:
        return False
