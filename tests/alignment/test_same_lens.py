"""Cameras that are one lens behind different digital zooms share what the zoom leaves as it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from skyquilt.alignment.problem import CAMERA
from skyquilt.alignment.robust import prior_terms
from skyquilt.alignment.same_lens import DEVIATION, same_lens
from skyquilt.model.camera import PARAMETERS
from skyquilt.model.photo import Zoom
from tests.alignment.blocks import FOCAL, HEIGHT, LENS, WIDTH, make_block
from tests.alignment.test_bundle import Flown

MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
FREE = np.array([name in {"focal", "cx", "cy", *DEVIATION} for name in PARAMETERS] + [True])


def zoom(factor=1.0, lens="cam"):
    return Zoom(camera=lens, factor=factor)


def common(zooms, free=FREE):
    K0 = np.array([seen_through(LENS, z.factor) for z in zooms])
    size = np.tile([float(WIDTH), HEIGHT], (len(zooms), 1))
    return same_lens(zooms, K0, size, np.tile(free, (len(zooms), 1)))


def seen_through(lens, factor):
    """The intrinsics of a picture of a lens (11,) whose middle is enlarged."""
    out = lens.copy()
    out[0] *= factor
    out[1:3] = MIDDLE + factor * (lens[1:3] - MIDDLE)
    return out


def test_a_lens_behind_two_zooms_has_nothing_apart_but_what_is_changed():
    found = common([zoom(), zoom(1.5), zoom(2.0), zoom(lens="another")])
    K = np.array([seen_through(LENS, f) for f in (1.0, 1.5, 2.0)] + [2 * LENS])
    assert np.abs(found.rows @ K.ravel() - found.zero).max() < 1e-8
    other = K.copy()
    other[1, PARAMETERS.index("k1")] += 3 * DEVIATION["k1"]
    off = found.rows @ other.ravel() - found.zero
    # three values that scatter about their mean: 3 - 1 and 1, 1 deviations
    assert off @ off == pytest.approx(2**2 + 1 + 1)


def test_cameras_of_their_own_have_nothing_in_common():
    assert common([zoom(), zoom(2.0, lens="another")]) is None
    assert common([zoom(), zoom(2.0)], np.zeros(CAMERA, bool)) is None


def test_the_gradient_is_that_of_the_cost():
    block = make_block(0, points=30, cameras=2)
    found = common([zoom(), zoom(1.5)], block.problem.free[0])
    problem, state = replace(block.problem, common=found), block.start

    def cost(K):
        return prior_terms(problem, replace(state, K=K.reshape(state.K.shape))).cost

    found = prior_terms(problem, state).camera_gradient.ravel()
    free = problem.free.ravel()
    numeric = approx_fprime(state.K.ravel(), cost, 1e-7) / 2
    assert found[free] == pytest.approx(numeric[free], rel=1e-3, abs=1e-2 * np.abs(found).max())
    assert not found[~free].any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_photos_of_many_zooms_have_one_lens(seed):
    """Calibrated each by itself, focal lengths take up heights."""
    flown = Flown(seed, lines=3, per_line=5, points=500, gps=1.0)
    factors = np.random.default_rng(seed).uniform(1.05, 1.8, len(flown.photos)).round(2)
    for i, f in enumerate(factors):
        px = MIDDLE + f * (flown.features[i].px - MIDDLE)
        flown.features[i] = replace(flown.features[i], px=px)
    off = []
    for told in (True, False):
        flown.photos = [
            replace(
                p,
                camera_key=f"cam zoom {f:g}",
                focal=replace(p.focal, px=FOCAL * f),
                zoom=zoom(f) if told else None,
            )
            for p, f in zip(flown.photos, factors, strict=True)
        ]
        found = flown.aligned()
        number = range(len(factors))
        focal = np.array([found.camera(i).focal for i in number]) / factors
        up = np.array([found.poses[i].map_C[2] for i in number]) - flown.truth.C[:, 2]
        off.append([np.abs(focal / FOCAL - 1).max(), up.std()])
    (focal, up), (focal_apart, up_apart) = off
    assert focal < 2e-3 < 4e-3 < focal_apart
    assert up < 0.5 * up_apart
