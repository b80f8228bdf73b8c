"""Candidate pairs: neighbours by position (and by view or camera), neighbours in time, and photos
of similar content.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.features import Features, Link

Pair = tuple[int, int]
FAR_M = 1e5
"""Distance in m at which photos of two cameras count that are not to be paired."""
MOST_SAMPLED = 100_000
"""Descriptors from which a vocabulary is learnt, about; those of all photos may fill the memory."""


@dataclass(frozen=True, kw_only=True)
class Nearest:
    """Photos whose footprints can overlap by the measured positions.

    Altitudes are unreliable (A2 of the methods), so footprints are not computed from them. The
    caller gives the ground distance within which photos overlap, estimated from links already
    found, or None to use the number of neighbours only.
    """

    neighbours: int = 12
    """Largest number of nearest photos paired with each photo."""
    version: ClassVar[int] = 1

    def __call__(self, map_xy: NDArray[Any], reach_m: float | None = None) -> list[Pair]:
        """Pairs i < j of photos with positions (n, 2) in m (NaN where unknown), nearest first; or
        with places (n, 3 or 4) that tell the camera or the view, too (`by_camera`,
        `alignment.oblique.looked_at`).
        """
        known = np.flatnonzero(np.isfinite(map_xy).all(1))
        if len(known) < 2:
            return []
        distance, index = nearest(
            map_xy[known], map_xy[known], min(self.neighbours + 1, len(known))
        )
        found: dict[Pair, float] = {}
        for row, (ds, js) in enumerate(zip(distance, index, strict=True)):
            for d, j in zip(ds, js, strict=True):
                if j != row and (reach_m is None or d <= reach_m):
                    i, k = sorted((int(known[row]), int(known[j])))
                    found[i, k] = float(d)
        return sorted(found, key=lambda pair: (found[pair], pair))


def closest(pairs: Sequence[Pair], count: int, each: int) -> list[Pair]:
    """From pairs sorted by distance, those that are among the `each` closest pairs of one of their
    photos.
    """
    degree = np.zeros(count, int)
    kept = []
    for i, j in pairs:
        if degree[i] < each or degree[j] < each:
            kept.append((i, j))
            degree[[i, j]] += 1
    return kept


def by_camera(cameras: Sequence[str], map_xy: NDArray[Any]) -> NDArray[np.float64] | None:
    """Places (n, 3) by which photos are near to those of their own camera only, where several
    cameras are carried by one drone: most photos lie beside one of another camera, nearer than half
    way to the next of their own. None otherwise.

    Where such cameras look to different sides, photos of one place have nothing in common.
    `cameras`: name of each photo's; positions (n, 2) in m, NaN where unknown.
    """
    names, number = np.unique(np.asarray(cameras), return_inverse=True)
    known = np.isfinite(map_xy).all(1)
    beside = 0
    for k in range(len(names)):
        own, others = map_xy[known & (number == k)], map_xy[known & (number != k)]
        if len(own) > 1 and len(others):
            next_own = nearest(own, own, 2)[0][:, 1]
            beside += int((nearest(others, own, 1)[0][:, 0] < next_own / 2).sum())
    if 2 * beside <= known.sum() or not beside:
        return None
    return np.column_stack([map_xy, FAR_M * number])


def overlap_reach_m(
    links: Sequence[Link],
    features: Sequence[Features],
    sizes: Sequence[tuple[int, int]],
    map_xy: NDArray[Any],
) -> float | None:
    """Distance in m of positions (n, 2) beyond which photos hardly overlap, estimated from links;
    None if there are too few. `sizes`: width and height in px of each photo.

    A link gives the image shift in px, and the positions give it in m. Altitudes are not used.
    """
    metres_per_px = []
    for link in links:
        pa = features[link.a].px[link.index_a].mean(0)
        pb = features[link.b].px[link.index_b].mean(0)
        a, b = pa - np.array(sizes[link.a]) / 2, pb - np.array(sizes[link.b]) / 2
        moved = abs(link.b_S_a * complex(a[0], -a[1]) - complex(b[0], -b[1]))
        apart = float(np.hypot(*(map_xy[link.a] - map_xy[link.b])))
        if moved > 0.1 * sizes[link.a][0] and np.isfinite(apart) and apart > 0:
            metres_per_px.append(apart / moved)
    if len(metres_per_px) < 5:
        return None
    return float(np.median(metres_per_px)) * 0.75 * max(sizes[0])


def sequence(count: int, step: int = 1) -> list[Pair]:
    """Each photo with the next `step` photos in order of capture."""
    return [(i, i + k) for k in range(1, step + 1) for i in range(count - k)]


@dataclass(frozen=True, kw_only=True)
class Retrieval:
    """VLAD vectors (Jegou et al. 2010) over a vocabulary learnt from the survey itself."""

    words: int = 64
    """Size of the vocabulary."""
    neighbours: int = 12
    """Number of most similar photos paired with each requested photo."""
    exhaustive_below: int = 25
    """In surveys of fewer photos all pairs are candidates, since retrieval could only lose
    pairs.
    """
    sample: int = 400
    """Descriptors per photo, the largest keypoints first."""
    seed: int = 0
    """Seed of the vocabulary."""
    version: ClassVar[int] = 1

    def __call__(self, features: Sequence[Features], asked: list[int] | None = None) -> list[Pair]:
        """Pairs i < j for the requested photos (all by default)."""
        n = len(features)
        rows = list(range(n)) if asked is None else asked
        if n < self.exhaustive_below:
            return sorted({(min(i, j), max(i, j)) for i in rows for j in range(n) if i != j})
        vectors = self._vectors(features)
        pairs: set[Pair] = set()
        for i in rows:
            similarity = vectors @ vectors[i]
            similarity[i] = -2
            for j in np.argsort(-similarity)[: self.neighbours]:
                pairs.add((min(i, int(j)), max(i, int(j))))
        return sorted(pairs)

    def _vectors(self, features: Sequence[Features]) -> NDArray[np.float32]:
        def chosen(f: Features) -> NDArray[np.float32]:
            return f.unit[np.argsort(-f.size)[: self.sample]]

        every = max(1, len(features) * self.sample // MOST_SAMPLED)
        words = self._vocabulary(np.concatenate([chosen(f) for f in features[::every]]))
        return np.stack([_vlad(chosen(f), words) for f in features])

    def _vocabulary(self, descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
        """k-means centres on at most 20,000 descriptors, on the unit sphere."""
        rng = np.random.default_rng(self.seed)
        data = descriptors[rng.permutation(len(descriptors))[:20000]]
        words = data[: self.words].copy()
        for _ in range(8):
            nearest = (data @ words.T).argmax(1)
            for w in range(len(words)):
                members = data[nearest == w]
                if len(members):
                    words[w] = members.mean(0)
            words /= np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-9)
        return words


def _vlad(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Residuals to the nearest words, summed, normalised per word and as a whole: unit
    vector (words * D,).
    """
    total = np.zeros_like(words)
    if len(descriptors):
        nearest = (descriptors @ words.T).argmax(1)
        np.add.at(total, nearest, descriptors - words[nearest])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    flat = total.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-9)
