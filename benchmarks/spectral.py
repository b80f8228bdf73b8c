"""`register` with method `auto` on pairs made from known ones: registrations accepted by chance,
and the effect of other rotations, scales and shifts.

    python benchmarks/spectral.py PAIRS.csv [--unrelated 300] [--rounds 3]

Unrelated: image A of one pair with the MIRRORED image B of any pair. No registration of them can be
right, even if two pairs of the list show the same place, and the images have the statistics of the
true pairs. Variations: image B of each pair is rotated, scaled, shifted and darkened; the truth is
known.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.pictures import open_picture
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Picture
from skyquilt.papers.pair_list import Pair, overlap_error, read_pairs

METHOD = registration_method("auto")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs")
    parser.add_argument("--unrelated", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    pairs = read_pairs(Path(asked.pairs))
    rng = np.random.default_rng(asked.seed)
    if asked.unrelated:
        unrelated(pairs, asked.unrelated, rng)
    if asked.rounds:
        variations(pairs, asked.rounds, rng)


def unrelated(pairs: tuple[Pair, ...], count: int, rng: np.random.Generator) -> None:
    every = [(i, j) for i in range(len(pairs)) for j in range(len(pairs))]
    own = [(i, i) for i in range(len(pairs))]
    chosen = (own + [every[k] for k in rng.permutation(len(every)) if every[k][0] != every[k][1]])[
        :count
    ]
    surprises, accepted, spent = [], 0, []
    for i, j in chosen:
        mirrored = Picture(values=np.ascontiguousarray(values(pairs[j].b)[:, ::-1]))
        since = time.process_time()
        outcome = METHOD(Picture(values=values(pairs[i].a)), mirrored)
        spent.append(time.process_time() - since)
        accepted += bool(outcome)
        surprises.append(outcome.evidence.get("surprise", 0.0))
        if surprises[-1] > 3.5:
            print(
                f"  near miss: {pairs[i].source} with mirrored {pairs[j].source}:"
                f" {surprises[-1]:.1f}",
                flush=True,
            )
    steps = " ".join(f"{q}%: {np.percentile(surprises, q):.2f}" for q in (50, 90, 95, 99, 100))
    print(
        f"unrelated: {accepted} of {len(chosen)} accepted; surprise {steps}; CPU"
        f" {np.mean(spent):.2f} s,"
        f" at most {max(spent):.2f} s",
        flush=True,
    )


def variations(pairs: tuple[Pair, ...], rounds: int, rng: np.random.Generator) -> None:
    tally: dict[str, list[tuple[bool, bool]]] = {}
    for k in range(rounds):
        for pair, picture, truth, scale in varied(pairs, rng, 30.0 if k == 0 else 180.0):
            a = values(pair.a)
            outcome = METHOD(Picture(values=a), Picture(values=picture))
            right = False
            if outcome:
                error = overlap_error(outcome.b_H_a, truth, a.shape[:2], picture.shape[:2])
                right = error < pair.tolerance_px * max(scale, 1.0)
                if not right:
                    print(f"  wrong: {pair.source} by {error:.1f} px", flush=True)
            tally.setdefault(pair.kind, []).append((bool(outcome), right))
    for kind, found in tally.items():
        print(
            f"{kind:16} {sum(a for a, _ in found)} accepted, {sum(r for _, r in found)} right of"
            f" {len(found)}"
        )
    every = [f for found in tally.values() for f in found]
    print(
        f"variations: {sum(a for a, _ in every)} accepted, {sum(r for _, r in every)} right of"
        f" {len(every)}"
    )


def varied(
    pairs: tuple[Pair, ...], rng: np.random.Generator, turn_deg: float
) -> Iterator[tuple[Pair, NDArray, NDArray, float]]:
    """Each pair with B turned by up to so many degrees, scaled by 0.8 to 1.25, shifted, its gamma
    changed.
    """
    for pair in pairs:
        b = values(pair.b)
        height, width = b.shape[:2]
        angle, scale = np.radians(rng.uniform(-turn_deg, turn_deg)), rng.uniform(0.8, 1.25)
        shift = rng.uniform(-0.06, 0.06, 2) * (width, height)
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        t = middle + shift - np.array([[c, -s], [s, c]]) @ middle
        change = np.array([[c, -s, t[0]], [s, c, t[1]], [0, 0, 1]])
        gamma = 255 * (b / 255.0) ** rng.uniform(0.6, 1.7)
        moved = cv2.warpPerspective(
            gamma.astype(np.uint8), change, (width, height), flags=cv2.INTER_LINEAR
        )
        yield pair, moved, change @ pair.b_H_a, scale


def values(path: Path) -> NDArray:
    opened = open_picture(path)
    assert not isinstance(opened, RejectedPhoto), opened
    return opened.picture.values


if __name__ == "__main__":
    main()
