"""Features of your own, all the way to camera poses.

A method is a frozen dataclass: its fields are its parameters, `__call__` does the work. Whatever
returns `Features` can take SIFT's place; here it is Harris corners with upright SIFT descriptors.
They are blind to photos of the way back, which are turned by 180 degrees: it shows in the number of
links.

python examples/03_your_own_features.py PHOTOS
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

import skyquilt
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.imaging.grey import full_px, shrink, to_grey8
from skyquilt.matching.candidates import Nearest
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.matching.verify import Verify
from skyquilt.model.features import Features
from skyquilt.photos.pixels import read_color


@dataclass(frozen=True, kw_only=True)
class UprightHarris:
    """Harris corners, described by SIFT without its orientation: for flights in one heading."""

    count: int = 1500
    """Most corners per photo."""
    longest: int = 1000
    """Longest side in px of the image searched."""
    size: float = 12.0
    """Diameter in px of the patch described."""
    version: ClassVar[int] = 1

    def __call__(self, image: NDArray) -> Features:
        """Features of pixels (H, W[, C])."""
        grey = to_grey8(shrink(image, self.longest)[0])
        corners = cv2.goodFeaturesToTrack(grey, self.count, 0.001, 5, useHarrisDetector=True)
        points = [
            cv2.KeyPoint(float(x), float(y), self.size, 0.0) for x, y in corners.reshape(-1, 2)
        ]
        points, described = cv2.SIFT_create().compute(grey, points)
        unit = described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)
        xy = np.array([p.pt for p in points])
        scale = image.shape[1] / grey.shape[1]
        return Features(
            px=full_px(xy, grey.shape, image.shape[:2]),
            size=np.full(len(xy), self.size * scale, np.float32),
            descriptors=unit.astype(np.float32),
            scale=scale,
        )


def align(survey: skyquilt.Survey, detect: Callable[[NDArray], Features]) -> skyquilt.Alignment:
    """The story's first half by hand: features, pairs, links, poses."""
    photos = survey.photos
    features = [detect(read_color(photo)) for photo in photos]
    frame = choose_frame(photos, None)
    prior = priors(photos, frame)
    match, verify = Mutual(), Verify()
    tried = [
        verify(a, b, features[a], features[b], match(features[a], features[b]), photos[a].width)
        for a, b in Nearest(neighbours=8)(np.array([p.map_C[:2] for p in prior]))
    ]
    links = [link for link in tried if link]
    print(
        f"{len(tried)} pairs, {len(links)} links, {np.mean([len(k) for k in links]):.0f} matches"
        " each"
    )
    return Bundle()(photos, frame, prior, features, links)


def main(folder: Path) -> None:
    survey = skyquilt.read_survey(folder)
    for name, detect in (("SIFT", Sift()), ("upright Harris", UprightHarris())):
        print(f"{name}:")
        alignment = align(survey, detect)
        error = np.linalg.norm(alignment.ties.residual_px, axis=1)
        print(f"{len(alignment.poses)} of {len(survey.photos)} photos placed,", end=" ")
        print(f"{len(alignment.ties.xyz)} tie points,", end=" ")
        print(f"reprojection error {error.mean():.2f} px")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
