"""Every contradiction between metadata and pixels is named with both values, and nothing else
is.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.conflicts import conflicts
from skyquilt.alignment.false_heights import outvoted_heights
from tests.alignment.surveys import alignment, photo, prior


def survey(count=8):
    photos = [photo(f"{i}.jpg") for i in range(count)]
    return photos, [prior((0, 15 * i, 60), yaw=10.0) for i in range(count)]


def named(found):
    return [(c.photo, c.field) for c in found]


def test_honest_metadata_with_honest_noise_is_not_accused():
    """Errors of up to two deviations everywhere, and a height datum 12 m off for all."""
    rng = np.random.default_rng(0)
    photos, _ = survey()
    told = [
        prior(
            np.array([0, 15 * i, 72]) + np.clip(rng.normal(0, 1, 3), -1.9, 1.9) * (1.5, 1.5, 1.4),
            yaw=10 + rng.uniform(-9, 9),
        )
        for i in range(8)
    ]
    assert conflicts(photos, told, alignment(focal=740.0)) == []


def test_a_yaw_that_lies():
    photos, told = survey()
    told[3] = prior((0, 45, 60), yaw=-170.0)
    told[5] = prior((0, 75, 60), yaw=np.nan)
    photos[6] = photo("6.jpg", editor="Some Viewer")
    told[6] = prior((0, 90, 60), yaw=-168.0)
    found = conflicts(photos, told, alignment(convergence=2.0))
    assert named(found) == [("3.jpg", "yaw"), ("6.jpg", "yaw")]
    assert (found[0].reported, found[0].estimated) == (-168.0, 12.0)  # true, not grid, headings
    assert "upside down" in found[1].meaning and "upside down" not in found[0].meaning


@pytest.mark.parametrize(("off", "signs"), [(180.0, True), (-170.0, True), (90.0, False)])
def test_headings_that_are_all_half_a_turn_off(off, signs):
    """So are those of positions on the other side of the globe."""
    photos, _ = survey()
    told = [prior((0, 15 * i, 60), yaw=10.0 + off) for i in range(8)]
    found = conflicts(photos, told, alignment())
    assert len(found) == 8 and all(
        ("both have the wrong sign" in c.meaning) == signs for c in found
    )


def test_where_half_of_the_heights_are_not_used_the_other_half_is_not_accused():
    """The map lies by those of one of two take-off points."""
    photos, _ = survey()
    told = [prior((0, 15 * i, 60 if i % 2 else 46), yaw=10.0) for i in range(8)]
    unused = outvoted_heights(
        replace(alignment(), poses={i: raised(p, -7.0) for i, p in alignment().poses.items()}),
        [p.name for p in photos],
        told,
        ["b" if i % 2 else "a" for i in range(8)],
    )
    assert unused is not None
    kept = {i for i, p in enumerate(unused.priors) if np.isfinite(p.map_C[2])}
    base = 60.0 if 1 in kept else 46.0
    poses = {i: raised(p, base - 60) for i, p in alignment().poses.items()}
    found = conflicts(photos, told, replace(alignment(), poses=poses, notes=(unused.note,)))
    assert {c.photo for c in found} == {f"{i}.jpg" for i in range(8)} - {f"{i}.jpg" for i in kept}
    assert {c.estimated for c in found} == {base}


def raised(pose, by_m):
    return replace(pose, map_C=pose.map_C + (0, 0, by_m))


@pytest.mark.parametrize(
    ("off", "sigma", "accused"),
    [(14.0, 5.0, 0), (16.0, 5.0, 1), (40.0, 15.0, 0), (50.0, 15.0, 1), (-16, 5, 1)],
)
def test_how_far_a_yaw_may_be_off(off, sigma, accused):
    photos, told = survey()
    told[2] = prior((0, 30, 60), yaw=10 + off, sigma_yaw=sigma)
    assert len(conflicts(photos, told, alignment())) == accused


def test_a_height_that_drifts():
    photos, told = survey()
    told[6], told[7] = prior((0, 90, 95), yaw=10), prior((0, 105, 52), yaw=10)
    found = conflicts(photos, told, alignment())
    assert named(found) == [("6.jpg", "altitude"), ("7.jpg", "altitude")]
    assert (found[0].reported, found[0].estimated) == (95.0, 60.0) and "35 m lower" in found[
        0
    ].meaning
    assert (found[1].reported, found[1].estimated) == (52.0, 60.0) and "8 m higher" in found[
        1
    ].meaning
    told[6] = prior((0, 90, np.nan), yaw=10)
    assert named(conflicts(photos, told, alignment())) == [("7.jpg", "altitude")]


def test_a_position_that_is_elsewhere():
    photos, told = survey()
    told[1] = prior((30, 15 + 40, 60), yaw=10)
    told[2] = prior((5, 30 + 5, 60), yaw=10)  # 7.07 m: within five deviations
    found = conflicts(photos, told, alignment())
    assert named(found) == [("1.jpg", "position")]
    assert found[0].reported == 50.0 and "50.0 m" in found[0].meaning


@pytest.mark.parametrize(("estimated", "accused"), [(755.0, 0), (765.0, 1), (635.0, 1), (645.0, 0)])
def test_a_focal_length_beyond_three_deviations(estimated, accused):
    photos, told = survey()
    found = conflicts(photos, told, alignment(focal=estimated))
    assert named(found) == [("0.jpg", "focal")] * accused  # once per camera, not per photo
    if accused:
        assert (found[0].reported, found[0].estimated) == (700.0, estimated)


def test_photos_that_nothing_holds_are_not_judged():
    photos, told = survey()
    told[7] = prior((300, 0, 200), yaw=100)
    assert conflicts(photos, told, alignment(block=(tuple(range(7)), (7,)))) == []


def test_without_georeference_only_yaw_and_focal_are_judged():
    photos, told = survey()
    told[1] = prior((500, 500, 200), yaw=80)
    assert named(conflicts(photos, told, alignment(crs=None))) == [("1.jpg", "yaw")]


def test_a_calibration_that_no_lens_has_is_named_once_for_each_camera():
    photos, told = survey()
    photos[2], photos[5] = (
        photo(f"{i}.jpg", unusable_calibration="DewarpData: a focal length of -100, -100 px")
        for i in (2, 5)
    )
    (found,) = conflicts(photos, told, alignment(focal=740.0))
    assert (found.photo, found.field, found.reported) == ("2.jpg", "calibration", None)
    assert found.estimated == 740.0
    assert "DewarpData: a focal length of -100" in found.meaning and "ignored" in found.meaning
