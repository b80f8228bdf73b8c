"""Which photos show the same ground: candidate pairs, matches, verified links."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skyquilt.config import Methods
from skyquilt.model.features import Link, RejectedLink
from skyquilt.model.poses import Prior
from skyquilt.pairs.nearest import Pair, sequence
from skyquilt.pipelines.intake import Intake, features_recipe
from skyquilt.run.clock import Steps
from skyquilt.run.executor import in_order
from skyquilt.run.store import Store, digest

BATCH = 64
"""Pairs per stored artefact: what a kill can cost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """Verified links and refused pairs."""

    links: tuple[Link, ...]
    """Pairs that show the same ground."""
    rejected: tuple[RejectedLink, ...]
    """Pairs that do not, with reasons."""


def link_up(
    intake: Intake, priors: Sequence[Prior], methods: Methods, store: Store, jobs: int
) -> Steps[Links]:
    """Neighbours first; what they overlap tells how far the other candidates may lie apart."""
    n = len(intake.photos)
    xy = np.array([p.map_C[:2] for p in priors]).reshape(-1, 2)
    lost = [i for i in range(n) if not np.isfinite(xy[i]).all()]
    close = methods.nearest(xy)
    first = list(dict.fromkeys([*sequence(n), *_closest(close, n, 2)]))
    found: list[Link | RejectedLink] = []
    for batch in _batches(first):
        found += _verified(batch, intake, methods, store, jobs)
        yield len(found), 2 * len(first)
    reach = overlap_reach_m([k for k in found if isinstance(k, Link)], intake, xy)
    rest = [p for p in methods.nearest(xy, reach) if p not in set(first)] if n > 2 else []
    if lost and n > 2:
        asked = None if len(lost) == n else lost
        rest += methods.retrieval(intake.features, asked)
    rest = [p for p in dict.fromkeys(rest) if p not in set(first)]
    for batch in _batches(rest):
        found += _verified(batch, intake, methods, store, jobs)
        yield len(found), len(first) + len(rest)
    return Links(
        links=tuple(k for k in found if isinstance(k, Link)),
        rejected=tuple(k for k in found if isinstance(k, RejectedLink)),
    )


def _closest(pairs: Sequence[Pair], count: int, each: int) -> list[Pair]:
    """Of pairs sorted by distance, those that are among the `each` closest of one of their
    photos.
    """
    degree = np.zeros(count, int)
    kept = []
    for i, j in pairs:
        if degree[i] < each or degree[j] < each:
            kept.append((i, j))
            degree[[i, j]] += 1
    return kept


def overlap_reach_m(links: Sequence[Link], intake: Intake, xy: np.ndarray) -> float | None:
    """Distance in m of positions beyond which photos hardly overlap, learnt from links; None if too
    few tell.

    A link gives the shift of the picture in px and the positions give it in m. Nothing here trusts
    altitudes.
    """
    metres_per_px = []
    for link in links:
        pa = intake.features[link.a].px[link.index_a].mean(0)
        pb = intake.features[link.b].px[link.index_b].mean(0)
        size = np.array([intake.photos[link.a].width, intake.photos[link.a].height])
        a, b = pa - size / 2, pb - size / 2
        moved = abs(link.b_S_a * complex(a[0], -a[1]) - complex(b[0], -b[1]))
        apart = float(np.hypot(*(xy[link.a] - xy[link.b])))
        if moved > 0.1 * size[0] and np.isfinite(apart) and apart > 0:
            metres_per_px.append(apart / moved)
    if len(metres_per_px) < 5:
        return None
    photo = intake.photos[0]
    return float(np.median(metres_per_px)) * 0.75 * max(photo.width, photo.height)


def _batches(pairs: Sequence[Pair]) -> list[Sequence[Pair]]:
    return [pairs[k : k + BATCH] for k in range(0, len(pairs), BATCH)]


def _verified(
    pairs: Sequence[Pair], intake: Intake, methods: Methods, store: Store, jobs: int
) -> list[Link | RejectedLink]:
    """Links of a batch, stored under the photos' digests and the methods; indices are those of this
    run.
    """
    photos, features = intake.photos, intake.features

    def one(pair: Pair) -> Link | RejectedLink:
        a, b = pair
        matches = methods.mutual(features[a], features[b])
        return methods.verify(a, b, features[a], features[b], matches, photos[a].width)

    names = [(i, j, photos[i].digest, photos[j].digest) for i, j in pairs]
    key = digest(names, features_recipe(methods), methods.mutual, methods.verify)
    return store.get_or("links", key, lambda: list(in_order(one, pairs, jobs=jobs)))
