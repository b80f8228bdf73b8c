"""Robust estimators on synthetic matches: error and success rate for 0 to 80 % outliers.

    python benchmarks/estimators.py [-o FILE] [--trials 10] [--noise 0.2] [--matches 150]

Two photos of 1500 x 1000 px differ by a homography that is typical of neighbours in a flight line:
a shift by a third of the photo, a small rotation, scale and tilt. Right matches have errors of
`noise` px per axis, wrong ones are anywhere in the frame. The error is the RMS transfer error
against the true homography over the frame; a trial succeeds with an error of at most 3 px.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.geometry.transforms import transfer
from skyquilt.matching.ransac import Ransac
from skyquilt.papers.lmeds import Lmeds
from skyquilt.papers.magsac import Magsac
from skyquilt.papers.ste import RansacSte

GRID = np.stack(np.meshgrid(np.linspace(0, 1499, 13), np.linspace(0, 999, 9)), -1).reshape(-1, 2)
SUCCESS_PX = 3.0


def opencv(method):
    """OpenCV's homography with a threshold of 3 px, as (3, 3) or None."""

    def estimate(a, b):
        return cv2.findHomography(a, b, method, 3.0, maxIters=5000, confidence=0.99)[0]

    return estimate


def ours(method):
    """Its homography, (3, 3) or None."""

    def estimate(a, b):
        found = method(a, b)
        return found.b_H_a if found else None

    return estimate


METHODS = {
    "RANSAC-STE (A)": ours(RansacSte()),
    "word for word": ours(RansacSte(literal=True)),
    "RANSAC-STE, t fixed": ours(RansacSte(threshold_px2=4.0)),
    "cv2 RANSAC": opencv(cv2.RANSAC),
    "cv2 MAGSAC": opencv(cv2.USAC_MAGSAC),
    "Ransac": ours(Ransac()),
    "Magsac": ours(Magsac()),
    "Lmeds": ours(Lmeds()),
}


def matches(rng, count, noise, outliers):
    """Points a, b (N, 2) px and the true b_H_a."""
    angle, scale = np.radians(rng.normal(0, 5)), np.exp(rng.normal(0, 0.03))
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    H = np.array(
        [[c, -s, rng.normal(0, 40)], [s, c, rng.normal(330, 40)], [*rng.normal(0, 2e-5, 2), 1]]
    )
    a = rng.uniform((0, 0), (1500, 670), (count, 2))
    b = transfer(H, a) + rng.normal(0, noise, (count, 2))
    wrong = rng.permutation(count)[: round(outliers * count)]
    b[wrong] = rng.uniform((0, 0), (1500, 1000), (len(wrong), 2))
    return a, b, H


def trial(estimate, a, b, H):
    """(RMS error in px over the frame, CPU s); infinite where nothing was found."""
    start = time.process_time()
    found = estimate(a, b)
    spent = time.process_time() - start
    if found is None:
        return np.inf, spent
    with np.errstate(all="ignore"):
        off = transfer(found, GRID) - transfer(H, GRID)
    error = np.sqrt((off**2).sum(1).mean())
    return (error if np.isfinite(error) else np.inf), spent


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--noise", type=float, default=0.2)
    parser.add_argument("--matches", type=int, default=150)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    lines = [
        f"{arguments.trials} trials of {arguments.matches} matches, noise {arguments.noise:g} px"
        " per axis."
        f" Median error in px / success (at most {SUCCESS_PX:g} px) in % / mean CPU ms.",
        "",
        "| outliers | " + " | ".join(METHODS) + " |",
        "|---" * (len(METHODS) + 1) + "|",
    ]
    print("\n".join(lines), flush=True)
    for percent in range(0, 81, 10):
        cells = []
        for estimate in METHODS.values():
            rng = np.random.default_rng(percent)  # the same matches for every method
            made = [
                matches(rng, arguments.matches, arguments.noise, percent / 100)
                for _ in range(arguments.trials)
            ]
            errors, spent = np.array([trial(estimate, *m) for m in made]).T
            median = f"{np.median(errors):.2f}" if np.isfinite(np.median(errors)) else "none"
            cells.append(
                f"{median} / {100 * np.mean(errors <= SUCCESS_PX):.0f} / {1000 * spent.mean():.0f}"
            )
        lines.append(f"| {percent} % | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    if arguments.output:
        arguments.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
