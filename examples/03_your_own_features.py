"""Your own features in the whole workflow: another detector replaces SIFT, all else is unchanged.

A method is a frozen dataclass: its fields are its parameters, `version` changes when its results
change, and both are part of the keys under which a run stores its artefacts. A detector has
`longest`, the longest side of the images it works on, and `of_shrunken`, which finds `Features`.

The detector here finds Harris corners and describes them by upright SIFT. These features cannot be
matched with photos of the opposite flight direction, which are turned by 180 degrees: the numbers
of links and blocks show it.

python examples/03_your_own_features.py PHOTOS OUT
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

import skyquilt
from skyquilt.imaging.grey import full_px, to_grey8
from skyquilt.model.features import Features
from skyquilt.workflows.methods import methods_for


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

    def of_shrunken(self, small: NDArray, full: tuple[int, int]) -> Features:
        """Features of a picture (h, w[, bands]), in px of the photo of height and width `full`."""
        grey = to_grey8(small)
        corners = cv2.goodFeaturesToTrack(grey, self.count, 0.001, 5, useHarrisDetector=True)
        points = [
            cv2.KeyPoint(float(x), float(y), self.size, 0.0) for x, y in corners.reshape(-1, 2)
        ]
        points, described = cv2.SIFT_create().compute(grey, points)
        unit = described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-9)
        xy, scale = np.array([p.pt for p in points]), full[1] / grey.shape[1]
        return Features(
            px=full_px(xy, grey.shape, full),
            size=np.full(len(xy), self.size * scale, np.float32),
            descriptors=unit.astype(np.float32),
            scale=scale,
        )


def main(photos: Path, output: Path) -> None:
    settings = skyquilt.MosaicSettings(surface="ties")
    usual = methods_for(settings)
    own = replace(usual, detector=UprightHarris())
    for name, methods in (("SIFT", usual), ("upright Harris", own)):
        folder = output / name.replace(" ", "-").lower()
        m = skyquilt.mosaic(photos, folder, settings, methods=methods, overwrite=True).metrics
        print(f"{name}: {m['photos_used']} of {m['photos_total']} photos,", end=" ")
        print(f"{m['links']} links, blocks of {m['blocks']} photos, {m['tie_points']} tie points,")
        print(f"  reprojection error {m['reprojection_error_px']['mean']:.2f} px: {folder}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
