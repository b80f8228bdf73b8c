"""Cameras that are one lens behind different digital zooms, or with pictures of different sizes,
share what the zoom, or the size, leaves as it is.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from skyquilt.alignment.control import fit_similarity_3d
from skyquilt.alignment.problem import CAMERA
from skyquilt.alignment.robust import prior_terms
from skyquilt.alignment.same_lens import (
    DEVIATION,
    MOST_SIZES,
    as_of_sizes,
    lenses_of_sizes,
    same_lens,
    unlike,
)
from skyquilt.model.camera import PARAMETERS
from skyquilt.model.photo import Zoom
from tests.alignment.blocks import FOCAL, HEIGHT, LENS, WIDTH, make_block
from tests.alignment.surveys import photo
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


def sized(name, factor, *, key="cam", zoom=None, down=None, **more):
    """A photo whose picture has another size: of all of it, or (`down`) of fewer rows."""
    width, height = round(WIDTH * factor), down or round(HEIGHT * factor)
    full = f"{key} {width}x{height} 4.0mm"
    own = zoom and Zoom(camera=full, factor=zoom, sigma=0.01)
    key = f"{full} zoom {zoom}" if zoom else full
    return replace(photo(name, key=key, **more), width=width, height=height, zoom=own)


def test_sizes_of_one_lens_count_as_zooms_of_the_most_frequent_one():
    photos = [sized("a", 1.0), sized("b", 0.5), sized("c", 0.5), sized("d", 0.5, zoom=2.0)]
    photos += [sized("e", 1.0, key="other"), sized("f", 1.0, down=WIDTH // 2), sized("g", 2.0)]
    found = lenses_of_sizes(photos)
    assert {p.name: found[p.camera_key].factor for p in photos if p.camera_key in found} == {
        "a": 2.0, "b": 1.0, "c": 1.0, "d": 2.0, "f": 2.0, "g": 4.0,
    }  # fmt: skip
    assert {z.camera for z in found.values()} == {"cam 4.0mm"}
    assert {z.sigma for z in found.values()} == {0.0, 0.01}


def test_sizes_that_are_parts_count_as_they_are():
    photos = [sized("a", 1.0), sized("b", 0.5), sized("c", 0.5, zoom=2.0)]
    found = lenses_of_sizes(photos, cut=True)
    assert [found[p.camera_key].factor for p in photos] == [1.0, 1.0, 2.0]
    own = as_of_sizes(photos, found)  # what the largest tells
    assert [p.focal.px for p in own] == [FOCAL, FOCAL, 2 * FOCAL]
    tied = common(list(found.values()))
    K = np.array([seen_through(LENS, z.factor) for z in found.values()])
    K[1, 1:3] -= 60.0  # the middle of the lens is anywhere in a part
    assert np.abs(tied.rows @ K.ravel() - tied.zero).max() < 1e-8


def test_one_size_is_no_lens_of_several_nor_are_upright_pictures_of_wide_ones():
    upright = replace(sized("b", 1.0), width=HEIGHT, height=WIDTH, camera_key="cam 600x800 4.0mm")
    assert lenses_of_sizes([sized("a", 1.0), upright, sized("c", 1.0, zoom=2.0)]) == {}


def test_hundreds_of_sizes_are_left_as_they_are():
    many = [sized(f"{k}", 1.0 - k / 1000) for k in range(MOST_SIZES + 1)]
    assert lenses_of_sizes(many) == {}
    assert len(lenses_of_sizes(many[1:])) == MOST_SIZES


def test_metadata_of_the_most_frequent_size_are_believed_once():
    """Programs that reduce pictures leave a focal plane's resolution as it was."""
    photos = [sized("a", 1.0), sized("b", 1.0), sized("c", 0.5, focal=700.0, sigma_focal=5.0)]
    found = as_of_sizes(photos, lenses_of_sizes(photos))
    assert [p.focal.px for p in found] == [FOCAL, FOCAL, FOCAL / 2]
    # two priors of twice the variance weigh as much as one
    assert [p.focal.sigma_px for p in found] == pytest.approx(np.array([20, 20, 10]) * 2**0.5)
    assert as_of_sizes(photos, {}) == photos


@pytest.mark.slow
def test_reduced_pictures_have_the_lens_of_the_others():
    flown = reduced(flown_with_tilts())
    found = flown.aligned()
    focals = [found.camera(i).focal / p.width for i, p in enumerate(flown.photos)]
    assert np.ptp(focals) < 3e-3 * np.mean(focals)
    assert any("the same lens" in note for note in found.notes)
    apart = reduced(flown_with_tilts(), told=False)
    assert off_m(found, flown) < 0.7 * off_m(apart.aligned(), apart)


def off_m(found, flown):
    """Deviation of the centres from the truth after a similarity."""
    C = np.array([found.poses[i].map_C for i in range(len(flown.photos))])
    s, R, t = fit_similarity_3d(C, flown.truth.C)
    return np.sqrt(((s * C @ R.T + t - flown.truth.C) ** 2).sum(1).mean())


def flown_with_tilts():
    return Flown(3, lines=3, per_line=4, points=500, gps=1.0, tilt_deg=3.0)


@pytest.mark.slow
def test_parts_that_were_cut_out_are_no_smaller_pictures():
    flown = reduced(Flown(3, lines=3, per_line=4, points=500, gps=1.0), cut=True)
    found = flown.aligned()
    assert any("parts of what the same lens took" in note for note in found.notes)
    whole, part = (found.cameras[f"cam {WIDTH // k}x{HEIGHT // k}"] for k in (1, 2))
    assert part.focal == pytest.approx(whole.focal, rel=3e-3)
    assert part.cx == pytest.approx(whole.cx - WIDTH / 4, abs=5)
    assert part.cy == pytest.approx(whole.cy - HEIGHT / 4, abs=5)
    zooms = lenses_of_sizes(flown.photos)
    cameras = [p.camera_key for p in flown.photos]
    assert unlike(found, cameras, zooms, flown.priors)


def reduced(flown, *, cut=False, told=True):
    """The flight with two of twelve photos at half the size, or with their middle `cut` out; as of
    one camera, or of cameras that nobody `told` to be alike.
    """
    for i in range(len(flown.photos)):
        small = i in {5, 10}
        key = "cam" if told or not small else "small"
        flown.photos[i] = replace(flown.photos[i], camera_key=f"{key} {WIDTH}x{HEIGHT}")
        if small:
            found = flown.features[i]
            px = found.px - [WIDTH / 4, HEIGHT / 4] if cut else (found.px + 0.5) / 2 - 0.5
            flown.features[i] = replace(found, px=px)
            flown.photos[i] = replace(
                flown.photos[i],
                width=WIDTH // 2,
                height=HEIGHT // 2,
                camera_key=f"{key} {WIDTH // 2}x{HEIGHT // 2}",
                focal=replace(flown.photos[i].focal, px=FOCAL if cut else FOCAL / 2, sigma_px=10.0),
            )
    return flown
