"""Claims of the thesis that hold here (docs/papers.md), each on simulated strips of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.geometry.camera import undistort
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.matching.ransac import Ransac
from skyquilt.papers.strip_chain import VARIANTS, board_camera, chained
from skyquilt.quality.registration_quality import mean_squared_error
from skyquilt.simulate import StripSettings, fly_strip

HOMOGRAPHY, NOT_LEVELLED, SIMILARITY = VARIANTS[4:7]


def ends(variants, order="6t", seeds=(1, 2, 3), **more):
    """Median eta at the end of the strip, by variant."""
    found = np.zeros((len(seeds), len(variants)))
    for k, seed in enumerate(seeds):
        settings = StripSettings(seed=seed, **more)
        strip = fly_strip(settings)
        size = (settings.lens.width, settings.lens.height)
        camera, _ = board_camera(strip.board, strip.views, size, order)
        for j, variant in enumerate(variants):
            found[k, j] = chained(strip, settings, camera, variant)[-1]
    return np.median(found, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "more", [{}, {"tilt": 1.0}, {"noise": 1.0}, {"overlap": 0.5}, {"relief": 4.0}]
)
def test_similarities_keep_the_shape_of_a_strip_better_than_homographies(more):
    """Y 4.2.2, 6.2, 7: 'a good substitution for projective transformation if we have almost a
    nadir-view'.
    """
    similarity, homography = ends([SIMILARITY, HOMOGRAPHY], **more)
    assert 1 > similarity > homography > 0.9


@pytest.mark.slow
def test_with_tilted_cameras_an_affine_transformation_is_better_than_both():
    """Where the claim ends: 3 degrees of tilt are no nadir-view."""
    affine = replace(SIMILARITY, model="affine")
    similarity, middle, homography = ends([SIMILARITY, affine, HOMOGRAPHY], tilt=3.0)
    assert middle > similarity + 0.02 and middle > homography + 0.05


@pytest.mark.slow
@pytest.mark.long
def test_levelled_features_matter_where_the_lens_model_is_too_simple():
    """Y 4.2.2: with the full model they change nothing in the median, with order 2 very much."""
    level, flat = ends([HOMOGRAPHY, NOT_LEVELLED], order="2")
    assert level > flat + 0.2
    level, flat = ends([HOMOGRAPHY, NOT_LEVELLED])
    assert abs(level - flat) < 0.01


def test_undistorted_pairs_register_better():
    """Y 6.3, (6.2): the reduction is printed as 17 % on average."""
    settings = StripSettings(photos=6, tilt=1.0, relief=0.0, things=0.0)
    strip, lens = fly_strip(settings), settings.lens
    camera, _ = board_camera(strip.board, strip.views, (lens.width, lens.height), "6t")
    for k in range(1, len(strip.px)):
        _, i, j = np.intersect1d(strip.ids[k], strip.ids[k - 1], return_indices=True)
        raw = strip.px[k][i], strip.px[k - 1][j]
        errors = []
        for a, b in (raw, tuple(undistort(camera, p) * camera.focal for p in raw)):
            # loose: it removes only points beyond the lens's fold, which lie 100s of px off
            found = Ransac(model="homography", threshold_px=30.0)(a, b)
            a, b = a[found.inliers], b[found.inliers]
            errors.append(mean_squared_error(transfer(fit("homography", a, b), a), b))
        assert errors[1] < 0.83 * errors[0]
        # what is left is noise of 0.3 px per axis in both photos
        assert errors[1] == pytest.approx(4 * 0.3**2, rel=0.2)
