"""Propagation of pair correspondences on simulated blocks of known homographies."""

import numpy as np
import pytest

from skyquilt.coregistration.propagation import PairPoints, Propagate, balanced_weights, carried
from skyquilt.geometry.transforms import transfer

rng = np.random.default_rng


def block(seed, count=9, spacing=120.0):
    """Homographies of a 3 x 3 block's photos to their mosaic."""
    r, found = rng(seed), {}
    for k in range(count):
        c, s = np.cos(r.normal(0, 0.05)), np.sin(r.normal(0, 0.05))
        h = np.array([[c, -s, spacing * (k % 3)], [s, c, spacing * (k // 3)], [0, 0, 1.0]])
        h[2, :2] = r.normal(0, 1e-5, 2)
        found[k] = h
    return found


TRUTH = np.array([[0.62, 0.05, 30.0], [-0.04, 0.6, 55.0], [2e-5, -1e-5, 1.0]])
"""Takes the first mosaic's pixels to the second's."""


def pairs_of(a_H, b_H, each, seed=0, noise=0.5, photos=None):
    """Correspondences of photo k with photo k, of points of the first mosaic."""
    r, found = rng(seed), []
    for k in photos if photos is not None else a_H:
        px_a = r.uniform(10, 190, (each, 2))
        there = transfer(TRUTH, transfer(a_H[k], px_a))
        px_b = transfer(np.linalg.inv(b_H[k]), there) + r.normal(0, noise, (each, 2))
        found.append(PairPoints(a=k, b=k, px_a=px_a, px_b=px_b))
    return found


def worst(h):
    x, y = np.meshgrid(np.linspace(0, 400, 5), np.linspace(0, 400, 5))
    px = np.c_[x.ravel(), y.ravel()]
    return np.linalg.norm(transfer(h, px) - transfer(TRUTH, px), axis=1).max()


def test_a_correspondence_of_one_pair_is_one_of_every_other():
    """(5.7): carried into the frames of photos 4 and 4, points of pair (0, 0) obey pair (4, 4)'s
    relation.
    """
    a_H, b_H = block(1), block(2)
    pair = pairs_of(a_H, b_H, 20, noise=0.0)[0]
    to_a4, to_b4 = ({0: np.linalg.inv(h[4]) @ h[0]} for h in (a_H, b_H))
    points = carried([pair], to_a4, to_b4)
    relation = np.linalg.inv(b_H[4]) @ TRUTH @ a_H[4]
    assert np.abs(transfer(relation, points.px_a) - points.px_b).max() < 1e-6


def test_one_registered_pair_registers_the_blocks():
    a_H, b_H = block(1), block(2)
    found = Propagate(model="affine")(pairs_of(a_H, b_H, 40, noise=0.3, photos=[4]), a_H, b_H)
    assert found and found.evidence["pairs_agreeing"] == 1
    middle = np.array([[200.0, 200.0]])
    assert np.linalg.norm(transfer(found.b_H_a, middle) - transfer(TRUTH, middle)) < 1


def test_all_pairs_together_are_better_than_one():
    a_H, b_H = block(1), block(2)
    errors = {n: [] for n in (1, 9)}
    for seed in range(8):
        for n in errors:
            photos = [4] if n == 1 else None
            errors[n].append(
                worst(Propagate()(pairs_of(a_H, b_H, 25, seed, 0.8, photos), a_H, b_H).b_H_a)
            )
    assert np.median(errors[9]) < 0.25 * np.median(errors[1])
    assert np.median(errors[9]) < 1.5


def test_points_seen_in_several_pairs_do_not_count_double():
    """One corner is seen by ten pairs that share an error; balanced, the rest of the block
    outweighs it.
    """
    a_H, b_H = block(1), block(2)
    pairs = pairs_of(a_H, b_H, 30, noise=0.3)
    for k in range(10):
        px_a = rng(0).uniform(20, 60, (30, 2))  # the same places each time
        there = transfer(TRUTH, transfer(a_H[0], px_a)) + 2.5
        pairs.append(
            PairPoints(a=0, b=0, px_a=px_a + 0.01 * k, px_b=transfer(np.linalg.inv(b_H[0]), there))
        )
    balanced = Propagate(model="affine", scale_px=50)(pairs, a_H, b_H)
    counted = Propagate(model="affine", scale_px=50, radius=1e-9)(pairs, a_H, b_H)
    assert worst(balanced.b_H_a) < 0.6 * worst(counted.b_H_a)


def test_a_place_weighs_one_however_often_it_is_seen():
    px = np.concatenate([np.repeat([[5.0, 5.0]], 10, 0), [[100.0, 0.0]], [[0.0, 100.0]]])
    weights = balanced_weights(px, 3.0)
    assert weights[:10].sum() == pytest.approx(1) and weights[10:].tolist() == [1, 1]


def test_wrong_pairs_are_outvoted_and_counted():
    a_H, b_H = block(1), block(2)
    pairs = pairs_of(a_H, b_H, 30, noise=0.4)
    for k in (2, 6):
        wild = rng(k).uniform(0, 200, (30, 2))
        pairs[k] = PairPoints(a=k, b=k, px_a=pairs[k].px_a, px_b=wild)
    found = Propagate()(pairs, a_H, b_H)
    assert found and worst(found.b_H_a) < 2
    assert found.evidence["pairs"] == 9 and 210 <= len(found.px_a) < 225


@pytest.mark.slow
def test_pairs_that_contradict_each_other_are_refused():
    """Each pair has a transform of its own; hundreds of correspondences of one do not agree."""
    x = np.linspace(-200, 200, 18)
    cell = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    here = {k: np.eye(3) for k in range(4)}
    ask = Propagate(model="similarity", least_pairs=3, least_share=0.5)
    shift = np.array([12.0, -7.0])
    for seed in range(5):
        r, pairs = rng(seed), []
        for k in range(4):
            px = r.uniform(100, 900, 2) + cell
            pairs.append(PairPoints(a=k, b=k, px_a=px, px_b=px + r.normal(0, 60, 2)))
        found = ask(pairs, here, here)
        assert not found and "of 4 registered pairs agree" in found.reason
        right = [PairPoints(a=p.a, b=p.b, px_a=p.px_a, px_b=p.px_a + shift) for p in pairs[:3]]
        found = ask([*right, pairs[3]], here, here)
        assert found and found.evidence["pairs_agreeing"] == 3
        assert np.abs(transfer(found.b_H_a, cell + 500) - cell - 500 - shift).max() < 1


def test_refusals():
    a_H, b_H = block(1), block(2)
    pairs = pairs_of(a_H, b_H, 30)
    assert "0 correspondences" in Propagate()(pairs, {}, b_H).reason
    few = Propagate()(pairs_of(a_H, b_H, 8, photos=[0]), a_H, b_H)
    assert not few and "8 correspondences" in few.reason
    wild = [
        PairPoints(
            a=0, b=0, px_a=rng(1).uniform(0, 500, (40, 2)), px_b=rng(2).uniform(0, 500, (40, 2))
        )
    ]
    assert "do not fit a common" in Propagate()(wild, a_H, b_H).reason
