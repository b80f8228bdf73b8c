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

from skyquilt.geometry.transforms import Doubles, fit, inverse
from skyquilt.matching.candidates import Pair
from skyquilt.model.features import Features, Link

GRID = 7
"""Places along each side of a photo that are followed into others."""
TOGETHER = 4096
"""Chains that are followed at once, which bounds the memory."""


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
        chains = sorted(
            {
                (*pair, between)
                for i, own in enumerate(linked)
                if len(own) < self.enough
                for between in own
                for j in linked[between]
                if j != i and (pair := (min(i, j), max(i, j))) not in tried
            }
        )
        maps: dict[Pair, Doubles] = {}

        def mapped(a: int, b: int) -> Doubles:
            """b_H_a of two linked photos; NaN where their matches tell none."""
            if (a, b) not in maps:
                k = linked[a][b]
                H = fit("affine", features[k.a].px[k.index_a], features[k.b].px[k.index_b])
                maps[k.a, k.b] = np.full((3, 3), np.nan) if H is None else H
                maps[k.b, k.a] = inverse(maps[k.a, k.b])
            return maps[a, b]

        shared: dict[Pair, float] = {}
        for low in range(0, len(chains), TOGETHER):
            part = chains[low : low + TOGETHER]
            H = np.array([mapped(m, b) @ mapped(a, m) for a, b, m in part])
            ends = np.array([[sizes[a], sizes[b]] for a, b, _ in part], float)
            shares = np.maximum(_seen(H, ends), _seen(inverse(H), ends[:, ::-1]))
            for (a, b, _), share in zip(part, shares.tolist(), strict=True):
                shared[a, b] = max(share, shared.get((a, b), 0.0))
        count, chosen = [0] * len(sizes), list[Pair]()
        for pair in sorted(shared, key=lambda pair: (-shared[pair], pair)):
            weak = [i for i in pair if len(linked[i]) < self.enough]
            if shared[pair] >= self.overlap and any(count[i] < self.each for i in weak):
                chosen.append(pair)
                for i in pair:
                    count[i] += 1
        return sorted(chosen)


def _seen(b_H_a: Doubles, sizes: Doubles) -> Doubles:
    """(n,) the share of each first photo that the second one shows; `b_H_a` (n, 3, 3), `sizes`
    (n, 2, 2): width and height in px of both.
    """
    along = (np.arange(GRID) + 0.5) / GRID
    places = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    there = (places * sizes[:, :1]) @ np.swapaxes(b_H_a[:, :2, :2], 1, 2) + b_H_a[:, None, :2, 2]
    return np.asarray(((there >= 0) & (there < sizes[:, 1:])).all(2).mean(1))
