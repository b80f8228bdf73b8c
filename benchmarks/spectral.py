"""`register` with method `auto` on pairs made from known ones: registrations accepted by chance,
the effect of other rotations, scales and shifts, and whether stated errors hold.

    python benchmarks/spectral.py PAIRS.csv [--unrelated 300] [--rounds 3] [--stated 300] [--marks]

Unrelated: image A of one pair with the MIRRORED image B of any pair. No registration of them can be
right, even if two pairs of the list show the same place, and the images have the statistics of the
true pairs. Variations: image B of each pair is rotated, scaled, shifted and darkened; the truth is
known.

Marks: text, a scale and a logo, or all that a drone's screen shows besides, are written over both
pictures, of unrelated pairs (image B mirrored and resized to A's size) and of true ones.

Stated errors: the same variations, but a part of one picture is blank (no data, black, noise, or
blurred beyond recognition), so that patches confirm the registration in the rest only. The search
starts at the similarity nearest to the truth, since not the search is tested. The 95 % bound at the
worst corner of the overlap is compared with the distance from the truth there. `--corners 0.01`
also moves B's corners by up to 1 % of its longer side each, which no similarity can follow.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.orientation import Pyramid
from skyquilt.coregistration.pictures import open_picture
from skyquilt.coregistration.refine_registration import stiff
from skyquilt.coregistration.stated_error import state_error
from skyquilt.coregistration.structure import sharpened
from skyquilt.coregistration.usable import both_usable
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Picture, RefusedRegistration, Registration
from skyquilt.papers.pair_list import Pair, overlap_error, read_pairs
from skyquilt.papers.spectral_bench import corner_error

METHOD = registration_method("auto")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs")
    parser.add_argument("--unrelated", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stated", type=int, default=0)
    parser.add_argument("--corners", type=float, default=0.0)
    parser.add_argument("--marks", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    pairs = read_pairs(Path(asked.pairs))
    rng = np.random.default_rng(asked.seed)
    if asked.unrelated:
        unrelated(pairs, asked.unrelated, rng)
    if asked.rounds:
        variations(pairs, asked.rounds, rng)
    if asked.stated:
        stated(pairs, asked.stated, asked.corners, rng)
    if asked.marks:
        marked_pairs(pairs, rng)


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


Row = tuple[str, float, float, bool, str]
"""Class, stated and actual error in px, whether the stated one is tolerated, what is beside it."""


def stated(pairs: tuple[Pair, ...], count: int, corners: float, rng: np.random.Generator) -> None:
    """Prints how far stated errors hold."""
    rows = stated_errors(pairs, count, corners, rng)
    for kind in dict.fromkeys(r[0] for r in rows):
        print(f"  {kind:16} {held([r for r in rows if r[0] == kind])}")
    for how in dict.fromkeys(r[4] for r in rows):
        print(f"  {how:16} {held([r for r in rows if r[4] == how])}")
    print(f"stated: {held(rows)}")
    print(f"of these within the default tolerance: {held([r for r in rows if r[3]])}")


def stated_errors(
    pairs: tuple[Pair, ...], count: int, corners: float, rng: np.random.Generator
) -> list[Row]:
    """Stated errors of `count` accepted registrations of pictures that are blank in part."""
    rows: list[Row] = []
    tried = 0
    while len(rows) < count:
        for pair, picture, truth, _ in varied(pairs, rng, 30.0):
            if len(rows) == count:
                break
            a, (b, truth) = values(pair.a), bent(picture, truth, corners, rng)
            tried += 1
            one, other, how = parted(a, b, rng)
            found = near_truth(one, other, truth)
            if not isinstance(found, Registration):
                continue
            told = state_error(found, a.shape[:2], b.shape[:2], None)
            assert told is not None
            actual = corner_error(found.b_H_a, truth, a.shape[:2], b.shape[:2])
            rows.append((pair.kind, told.error_px, actual, told.error_px <= told.tolerance_px, how))
        print(f"  {len(rows)} of {tried} accepted", flush=True)
    return rows


def held(rows: list[Row]) -> str:
    told, actual = np.array([r[1] for r in rows]), np.array([r[2] for r in rows])
    if not len(rows):
        return "none"
    return (
        f"{len(rows):3} registrations, {np.mean(actual <= told):.1%} within the bound, stated /"
        f" actual {np.median(told / actual):.2f}; actual {np.median(actual):.2f} px, 90 %"
        f" {np.percentile(actual, 90):.2f} px"
    )


def near_truth(a: Picture, b: Picture, truth: NDArray) -> Registration | RefusedRegistration:
    """The decision of `auto` on the similarity nearest to the truth, refined as usual."""
    usable = both_usable(a, b)
    if isinstance(usable, RefusedRegistration):
        return usable
    pyramid = Pyramid(a=usable[0], b=usable[1], sides=METHOD.method.sides[-2:])
    return METHOD.method.decide(pyramid, [sharpened(pyramid, stiff(truth, a.shape), 0)])


def bent(
    picture: NDArray, truth: NDArray, corners: float, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """B with its corners moved by up to a share of its longer side, and the truth."""
    height, width = picture.shape[:2]
    ends = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
    reach = corners * max(height, width)
    moved = ends + rng.uniform(-reach, reach, (4, 2)).astype(np.float32)
    change = cv2.getPerspectiveTransform(ends, moved) if corners else np.eye(3)
    return cv2.warpPerspective(picture, change, (width, height)), change @ truth


def parted(a: NDArray, b: NDArray, rng: np.random.Generator) -> tuple[Picture, Picture, str]:
    """Both pictures, one of them blank but for a half, a rectangle or a disc."""
    first, how = rng.random() < 0.5, str(rng.choice(["no data", "black", "noise", "blurred"]))
    changed = a if first else b
    kept = part(changed.shape[:2], rng)
    valid = None
    if how == "no data":
        valid = kept
    else:
        changed = blanked(changed, kept, how, rng)
    new = Picture(values=changed, valid=valid)
    return (new, Picture(values=b), how) if first else (Picture(values=a), new, how)


def part(shape: tuple[int, int], rng: np.random.Generator) -> NDArray:
    """A mask (H, W) of a quarter to four fifths of a picture."""
    height, width = shape
    y, x = np.mgrid[:height, :width].astype(float)
    kind = rng.choice(["half", "rectangle", "disc"])
    if kind == "half":
        turn = rng.uniform(0, 2 * np.pi)
        across = (x / width - 0.5) * np.cos(turn) + (y / height - 0.5) * np.sin(turn)
        return across > rng.uniform(-0.15, 0.1)
    if kind == "rectangle":
        w, h = rng.uniform(0.45, 0.9, 2) * (width, height)
        left, top = rng.uniform(0, 1, 2) * (width - w, height - h)
        return (x >= left) & (x < left + w) & (y >= top) & (y < top + h)
    radius = rng.uniform(0.31, 0.5) * np.sqrt(height * width)
    cx, cy = rng.uniform(0.25, 0.75, 2) * (width, height)
    return np.hypot(x - cx, y - cy) < radius


def blanked(picture: NDArray, kept: NDArray, how: str, rng: np.random.Generator) -> NDArray:
    """The picture with black, noise or a blurred copy of itself outside the part that is kept."""
    grain = cv2.GaussianBlur(rng.normal(0, 7, picture.shape).astype(np.float32), (0, 0), 1.1)
    rest = np.zeros_like(grain)
    if how == "noise":
        rest = picture.mean() + grain
    elif how == "blurred":
        far = 0.06 * np.sqrt(kept.size)
        rest = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), far) + grain
    soft = cv2.GaussianBlur(kept.astype(np.float32), (0, 0), 2) if how != "black" else kept
    share = soft.reshape(*kept.shape, *[1] * (picture.ndim - 2)).astype(np.float32)
    return np.clip(picture * share + rest * (1 - share), 0, 255).astype(np.uint8)


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


def marked_pairs(pairs: tuple[Pair, ...], rng: np.random.Generator) -> None:
    for screen in (False, True):
        accepted = 0
        for pair in pairs:
            a, other = values(pair.a), values(pairs[int(rng.integers(len(pairs)))].b)
            size = (a.shape[1], a.shape[0])
            b = cv2.resize(np.ascontiguousarray(other[:, ::-1]), size, interpolation=cv2.INTER_AREA)
            accepted += bool(METHOD(*(Picture(values=marked(v, screen)) for v in (a, b))))
        right = []
        for pair in pairs:
            a, b = values(pair.a), values(pair.b)
            outcome = METHOD(*(Picture(values=marked(v, screen)) for v in (a, b)))
            if outcome:
                error = overlap_error(outcome.b_H_a, pair.b_H_a, a.shape[:2], b.shape[:2])
                right.append(error < pair.tolerance_px)
        what = "a drone's screen" if screen else "text, scale and logo"
        print(
            f"{what}: {accepted} of {len(pairs)} unrelated pairs accepted;"
            f" of the true ones {len(right)}, {sum(right)} right",
            flush=True,
        )


def marked(picture: NDArray, screen: bool) -> NDArray:
    """The picture with marks written over it, places in shares of its sides, kept as JPEG."""
    out = np.ascontiguousarray(picture).copy()
    height, width = out.shape[:2]
    scale = min(height, width) / 480
    thick = max(1, round(1.5 * scale))

    def at(x: float, y: float) -> tuple[int, int]:
        return int(x * width), int(y * height)

    def ink(level: int) -> tuple[int, ...]:
        return (level,) * (1 if out.ndim == 2 else out.shape[2])

    def text(x: float, y: float, words: str, size: float = 0.6) -> None:
        font = cv2.FONT_HERSHEY_SIMPLEX
        if screen:
            cv2.putText(out, words, at(x, y), font, size * scale, ink(0), 3 * thick, cv2.LINE_AA)
        cv2.putText(out, words, at(x, y), font, size * scale, ink(255), thick, cv2.LINE_AA)

    text(0.03, 0.06, "2026-11-24 14:20:15")
    text(0.03, 0.97, "N51.50374 W0.01234 120m")
    text(0.86, 0.18, "38.2")
    text(0.86, 0.86, "12.4")
    text(0.76, 0.97, "IR", 0.9)
    middle, arm = at(0.5, 0.5), int(0.05 * width)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        ends = [(middle[0] + dx * r, middle[1] + dy * r) for r in (arm // 3, arm)]
        cv2.line(out, *ends, ink(255), thick, cv2.LINE_AA)
    bar = int(0.6 * height)
    for k in range(bar):
        out[int(0.2 * height) + k, int(0.94 * width) : int(0.97 * width)] = 255 - int(255 * k / bar)
    cv2.rectangle(out, at(0.94, 0.2), at(0.97, 0.8), ink(255), thick)
    if screen:
        for k in range(9):
            y = 0.2 + 0.07 * k
            cv2.line(out, at(0.06, y), at(0.1 if k % 2 else 0.13, y), ink(255), thick)
            text(0.14, y + 0.01, str(40 + 10 * k), 0.4)
        for k in range(13):
            x = 0.2 + 0.05 * k
            cv2.line(out, at(x, 0.09), at(x, 0.11 if k % 3 else 0.13), ink(255), thick)
        text(0.6, 0.06, "REC 00:12:44 ISO100")
        text(0.3, 0.9, "D 243m H 120m HS 8.2m/s VS 0.1", 0.5)
        cv2.rectangle(out, at(0.35, 0.35), at(0.65, 0.65), ink(255), thick)
    _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE if out.ndim == 2 else cv2.IMREAD_COLOR)


def values(path: Path) -> NDArray:
    opened = open_picture(path)
    assert not isinstance(opened, RejectedPhoto), opened
    return opened.picture.values


if __name__ == "__main__":
    main()
