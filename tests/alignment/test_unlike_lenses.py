"""Photos of two lenses that files tell to be of one camera: found by what they do to an adjustment,
and calibrated by themselves.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from skyquilt.alignment import unlike_lenses
from skyquilt.alignment.unlike_lenses import Bent, as_of_lenses, bent, lenses_note, named_lenses
from skyquilt.model.poses import TiePoints
from tests.alignment.blocks import LENS
from tests.alignment.surveys import FOCAL, HEIGHT, WIDTH, alignment, photo
from tests.alignment.test_bundle import Flown

CORNER = np.hypot(WIDTH, HEIGHT) / 2 / FOCAL


def bend(flown, photos, k1):
    """These photos as through a lens whose k1 is larger."""
    for i in photos:
        off = flown.features[i].px - LENS[1:3]
        square = (off**2).sum(1, keepdims=True) / LENS[0] ** 2
        px = LENS[1:3] + off * (1 + k1 * square)
        flown.features[i] = replace(flown.features[i], px=px)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("second", "k1"), [(range(0, 24, 2), 0.02), (range(0, 24, 3), -0.03), ((4, 9, 13, 22), 0.03)]
)
def test_photos_of_a_second_lens_are_calibrated_by_themselves(second, k1):
    flown = Flown(1, lines=4, per_line=6, points=900)
    bend(flown, second, k1)
    found = flown.aligned()
    assert sum("through another lens" in n for n in found.notes) == 1
    lenses = {i: found.camera_of[i] for i in range(24)}
    assert {lenses[i] for i in second}.isdisjoint(lenses[i] for i in range(24) if i not in second)
    inside = [c.k1 for c in found.cameras.values()]
    assert abs(inside[0] - inside[1]) == pytest.approx(abs(k1), rel=0.2)
    C = np.array([found.poses[i].map_C for i in range(24)])
    off = C - flown.truth.C
    assert np.linalg.norm(off - off.mean(0), axis=1).max() < 0.5


@pytest.mark.slow
def test_lenses_of_a_rig_are_told_by_names():
    """Three cameras of one model: two groups do not hold them apart."""
    flown = Flown(1, lines=4, per_line=6, points=900)
    letter = ["ABC"[i % 3] for i in range(24)]
    for k, name in enumerate("ABC"):
        bend(flown, [i for i in range(24) if letter[i] == name], 0.03 * k)
    flown.photos = [
        replace(p, name=f"DJI_{a}_{i:04d}.jpg")
        for i, (p, a) in enumerate(zip(flown.photos, letter, strict=True))
    ]
    found = flown.aligned()
    assert sum("through another lens" in n for n in found.notes) == 1
    k1 = {a: found.camera(i).k1 for i, a in enumerate(letter)}
    assert k1["B"] - k1["A"] == pytest.approx(0.03, rel=0.2)
    assert k1["C"] - k1["A"] == pytest.approx(0.06, rel=0.2)
    assert len({found.camera_of[i] for i in range(24)}) == 3


def test_names_and_folders_that_may_tell_lenses():
    names = [f"{a}/DJI_{i:03d}.jpg" for a in ("1", "2") for i in range(3)]
    assert named_lenses(names, ["cam"] * 6, {"cam"}) == dict(enumerate((0, 0, 0, 1, 1, 1)))
    assert named_lenses(names, ["cam"] * 6, ()) == {}
    assert named_lenses([n.split("/")[1] for n in names], ["cam"] * 6, {"cam"}) == {}
    lone = [*names, "3/DJI_004.jpg"]
    assert named_lenses(lone, ["cam"] * 7, {"cam"}) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_photos_of_one_lens_stay_together(seed):
    flown = Flown(seed, lines=4, per_line=6, points=900)
    found = flown.aligned()
    assert len(found.cameras) == 1 and not any("another lens" in n for n in found.notes)


def seen(k1, *, rng, noise=0.3):
    """An alignment in which photos (index) have these errors of k1, shifts, turns and scales."""
    photo, px, off = [], [], []
    for i, k in k1.items():
        at = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (200, 2))
        x = (at - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]) / FOCAL
        scale, turn, *shift = rng.normal(0, 0.002, 4)
        moved = scale * x + turn * x[:, ::-1] * [1, -1] + shift
        moved = FOCAL * (moved + k * (x**2).sum(1, keepdims=True) * x)
        moved += rng.normal(0, noise, moved.shape)
        moved[:5] += rng.normal(0, 40, (5, 2))  # gross
        photo.append(np.full(200, i))
        px.append(at)
        off.append(moved)
    ties = TiePoints(
        xyz=np.zeros((200, 3)), point=np.tile(np.arange(200), len(k1)),
        photo=np.concatenate(photo), px=np.concatenate(px), residual_px=np.concatenate(off),
    )  # fmt: skip
    return replace(alignment(len(k1)), ties=ties)


def test_the_bend_is_told_beside_shifts_scales_and_gross_errors():
    k1 = {0: 0.0, 1: 0.01, 2: -0.02}
    found, least = bent(seen(k1, rng=np.random.default_rng(3)), list(k1))
    assert {i: b.k1 for i, b in found.items()} == pytest.approx(k1, abs=2e-3)
    assert all(b.ties == 200 for b in found.values())
    off = np.hypot(*seen(k1, rng=np.random.default_rng(3)).ties.residual_px.T).mean()
    assert least == pytest.approx(2.5 * off / (FOCAL * CORNER**3))


def test_photos_with_few_tie_points_tell_nothing():
    found = seen({0: 0.01, 1: 0.01}, rng=np.random.default_rng(3))
    few = found.ties.photo == 1
    few[few.nonzero()[0][:19]] = False
    keep = ~few
    ties = replace(found.ties, **{
        k: getattr(found.ties, k)[keep] for k in ("point", "photo", "px", "residual_px")
    })  # fmt: skip
    assert bent(replace(found, ties=ties), [0, 1])[0].keys() == {0}


def groups(values, least=0.0):
    votes = {i: Bent(k1=float(k), ties=100) for i, k in enumerate(values)}
    return unlike_lenses._two_groups(votes, least)


def test_what_scatters_by_chance_forms_no_groups():
    assert groups(norm.ppf((np.arange(100) + 0.5) / 100)) == {}
    two = np.r_[norm.ppf((np.arange(30) + 0.5) / 30), 8 + norm.ppf((np.arange(20) + 0.5) / 20)]
    assert groups(two) == {i: int(i >= 30) for i in range(50)}
    assert groups(two, least=9.0) == {}
    assert groups(two[28:33]) == {}  # three photos each at least


def test_photos_that_were_given_the_other_lens_are_exchanged():
    """Four photos under one lens that belong to the other are bent by the difference of the two."""
    k1 = {i: 0.1 if i in (2, 5, 9, 12) else 0.0 for i in range(20)}
    found = seen(k1, rng=np.random.default_rng(1), noise=0.1)
    before = {i: int(i >= 16) for i in range(20)}
    after = unlike_lenses.unlike_lenses(found, ["cam"] * 20, before)
    assert after == before | dict.fromkeys((2, 5, 9, 12), 1)
    same = seen(dict.fromkeys(range(20), 0.0), rng=np.random.default_rng(1))
    assert unlike_lenses.unlike_lenses(same, ["cam"] * 20, before) == before


def test_photos_of_the_second_lens_have_a_camera_of_their_own():
    photos = [photo(f"{i}.jpg") for i in range(3)]
    assert [p.camera_key for p in as_of_lenses(photos, {0: 0, 2: 1})] == [
        "cam",
        "cam",
        "cam lens 2",
    ]
    note = lenses_note({0: 0, 1: 1, 2: 1}, ["cam"] * 3, [p.name for p in photos])
    assert "2 of 3 of cam (1.jpg, 2.jpg)" in note
