"""SIFT as the article uses it: every keypoint of an image, wherever it lies.

VLFeat, which A uses, keeps all extrema of the scale space unless it is told otherwise. The best
matches by distance [A 2.4] then come from many thousands of keypoints. Taken from few keypoints
that are spread over the image, the best 150 are hardly better than the rest, and RANSAC by the
symmetric transfer error, which needs matches nearly free of outliers, fails.
"""

from skyquilt.matching.sift import Sift

KEYPOINTS = 12000
"""Least number of keypoints kept, the strongest: matching costs as much as its square."""
CONTRAST = 0.003
"""OpenCV's contrast threshold, a fifth of that of `sift`: 12 MP photos of gardens and woods,
reduced to 1500 px, have more keypoints than `KEYPOINTS`.
"""


def sift_all(*, count: int = KEYPOINTS, longest: int = 1500) -> Sift:
    """SIFT with at least `KEYPOINTS` keypoints of an image reduced to `longest` px, not spread."""
    return Sift(count=max(count, KEYPOINTS), longest=longest, contrast=CONTRAST, cells=1, spare=1.0)
