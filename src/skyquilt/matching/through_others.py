"""Candidate pairs through other photos: two that overlap a third one may overlap each other.

Positions tell which photos overlap where they all look alike. Photos from a hand or a kite look to
all sides: neighbours may have nothing in common, and photos from far apart much. Each link tells
where a photo's content lies in another one; from one link to the next this predicts the overlap of
photos that were not compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.transforms import fit, inverse, transfer
from skyquilt.matching.candidates import Pair
from skyquilt.model.features import Features, Link

GRID = 7
"""Places along each side of a photo that are followed into others."""


@dataclass(frozen=True, kw_only=True)
class ThroughOthers:
    """Pairs of photos with few links, by where a photo that both are linked with shows them."""

    enough: int = 8
    """Photos with as many links need no more: those of usual surveys have them by positions."""
    overlap: float = 0.3
    """Least predicted share of one of the photos that the other one shows, too."""
    each: int = 8
    """Most pairs that are asked of each photo in one round, the largest overlaps first."""
    rounds: int = 4
    """Rounds, each with the links of those before."""
    version: ClassVar[int] = 1

    def __call__(
        self,
        links: Sequence[Link],
        features: Sequence[Features],
        sizes: Sequence[tuple[int, int]],
        tried: set[Pair],
    ) -> list[Pair]:
        """Pairs i < j that were not tried; `sizes`: width and height in px of each photo."""
        linked: list[dict[int, Link]] = [{} for _ in sizes]
        for k in links:
            linked[k.a][k.b] = linked[k.b][k.a] = k
        asked = {
            (min(i, j), max(i, j), between)
            for i, own in enumerate(linked)
            if len(own) < self.enough
            for between in own
            for j in linked[between]
            if j != i
        }
        asked = {chain for chain in asked if chain[:2] not in tried}
        shared: dict[Pair, float] = {}
        maps: dict[Pair, NDArray[np.float64] | None] = {}

        def mapped(a: int, b: int) -> NDArray[np.float64] | None:
            """b_H_a of two linked photos."""
            if (a, b) not in maps:
                k = linked[a][b]
                pa, pb = features[k.a].px[k.index_a], features[k.b].px[k.index_b]
                H = fit("affine", pa, pb)
                maps[k.a, k.b] = H
                maps[k.b, k.a] = None if H is None else inverse(H)
            return maps[a, b]

        for a, b, between in sorted(asked):
            first, second = mapped(a, between), mapped(between, b)
            if first is not None and second is not None:
                share = _share(second @ first, sizes[a], sizes[b])
                shared[a, b] = max(share, shared.get((a, b), 0.0))
        count, chosen = [0] * len(sizes), list[Pair]()
        for pair in sorted(shared, key=lambda pair: (-shared[pair], pair)):
            weak = [i for i in pair if len(linked[i]) < self.enough]
            if shared[pair] >= self.overlap and any(count[i] < self.each for i in weak):
                chosen.append(pair)
                for i in pair:
                    count[i] += 1
        return sorted(chosen)


def _share(b_H_a: NDArray[np.float64], a: tuple[int, int], b: tuple[int, int]) -> float:
    """The larger one of the shares of photos a and b (width, height in px) that the other shows."""
    return max(_seen(b_H_a, a, b), _seen(inverse(b_H_a), b, a))


def _seen(b_H_a: NDArray[np.float64], a: tuple[int, int], b: tuple[int, int]) -> float:
    sides = [(np.arange(GRID) + 0.5) / GRID * side for side in a]
    places = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    return float(((transfer(b_H_a, places) >= 0) & (transfer(b_H_a, places) < b)).all(1).mean())
