"""Photos added to an adjusted block: where they come to lie, and what stays."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.addition import added
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.ortho.earlier import same_pose
from skyquilt.workflows.finished import renumbered
from tests.alignment.test_bundle import FRAME, Flown
from tests.alignment.test_bundle import relative_error as off

NEW = (52, 53, 54, 55)
"""The last photos of the last line."""


def no_pictures(photo, longest):
    raise AssertionError("this adjustment needs no pictures")


def inputs(flown, former=None, links=None):
    return AlignmentInputs(
        photos=flown.photos,
        features=flown.features,
        frame=FRAME,
        priors=flown.priors,
        links=flown.links if links is None else links,
        control=(),
        order=range(len(flown.photos)),
        grey=no_pictures,
        former=former,
    )


METHOD = Bundle(match_observations=None, many=20)


def without(flown, gone):
    """The alignment of all photos but these, by the numbers of all."""
    kept = [i for i in range(len(flown.photos)) if i not in gone]
    where = {i: k for k, i in enumerate(kept)}
    links = [
        replace(k, a=where[k.a], b=where[k.b]) for k in flown.links if not {k.a, k.b} & set(gone)
    ]
    found = METHOD(
        [flown.photos[i] for i in kept],
        FRAME,
        [flown.priors[i] for i in kept],
        [flown.features[i] for i in kept],
        links,
    )
    return renumbered(found, dict(enumerate(kept)))


@pytest.fixture(scope="module")
def flown():
    return Flown(1, lines=7, per_line=8, points=1500)


@pytest.fixture(scope="module")
def former(flown):
    return without(flown, NEW)


@pytest.fixture(scope="module")
def grown(flown, former):
    return added(inputs(flown, former), METHOD)


@pytest.mark.slow
def test_new_photos_lie_where_a_new_adjustment_would_put_them(flown, former, grown):
    whole = METHOD(flown.photos, FRAME, flown.priors, flown.features, flown.links)
    assert sorted(grown.poses) == sorted(whole.poses) == list(range(56))
    assert grown.blocks == (tuple(range(56)),)
    apart = np.array([grown.poses[i].map_C - whole.poses[i].map_C for i in NEW])
    sigma = np.array([whole.poses[i].sigma_m for i in NEW])
    assert np.sqrt(((apart / sigma) ** 2).mean()) < 0.5
    assert off(flown, grown) < 1.1 * max(off(flown, whole), off(flown, former))
    residual, usual = (np.linalg.norm(a.ties.residual_px, axis=1).mean() for a in (grown, whole))
    assert residual == pytest.approx(usual, abs=0.02)


@pytest.mark.slow
def test_photos_far_from_the_new_ones_stay(flown, former, grown):
    stayed = {i for i, p in former.poses.items() if same_pose(p, grown.poses[i])}
    linked = {i: set() for i in range(56)}
    for k in flown.links:
        linked[k.a].add(k.b)
        linked[k.b].add(k.a)
    near = set(NEW)
    for _ in range(2):
        near |= {o for i in near for o in linked[i]}
    assert stayed >= former.poses.keys() - near
    assert len(former.poses.keys() - near) > 20
    assert grown.cameras == former.cameras


def test_tie_points_name_their_photos(flown, grown):
    """Each observation is one of the photo's own keypoints."""
    for i in (0, 40, *NEW):
        mine = grown.ties.px[grown.ties.photo == i]
        there = {tuple(p) for p in flown.features[i].px.astype(mine.dtype).tolist()}
        assert len(mine) > 20 and all(tuple(p) in there for p in mine.tolist())
    assert (np.bincount(grown.ties.point, minlength=len(grown.ties.xyz)) >= 2).all()


def test_a_new_photo_says_how_well_it_is_known(former, grown):
    known = np.median([p.sigma_m for p in former.poses.values()], axis=0)
    for i in NEW:
        assert (grown.poses[i].sigma_m > 0.8 * known).all()
        assert (grown.poses[i].sigma_m < 4 * known).all()


@pytest.mark.slow
def test_the_accuracy_is_told_alike_of_all_parts(flown, grown):
    """Of the part that was adjusted, no more places than of as much ground elsewhere."""
    whole = METHOD(flown.photos, FRAME, flown.priors, flown.features, flown.links)
    centre = np.mean([whole.poses[i].map_C[:2] for i in NEW], axis=0)
    reach = np.ptp([p.map_C[:2] for p in whole.poses.values()], axis=0).max() / 3
    near = [np.hypot(*(a.accuracy.xyz[:, :2] - centre).T) < reach for a in (grown, whole)]
    assert near[0].mean() == pytest.approx(near[1].mean(), rel=0.25)


@pytest.mark.slow
def test_nothing_new_changes_nothing(flown):
    whole = METHOD(flown.photos, FRAME, flown.priors, flown.features, flown.links)
    again = added(inputs(flown, whole), METHOD)
    assert all(same_pose(p, again.poses[i]) for i, p in whole.poses.items())


@pytest.mark.slow
def test_photos_that_join_two_blocks_need_all_of_them(flown):
    """Two lines on either side of one that is not there yet are blocks of their own."""
    bridge = tuple(range(16, 24))
    apart = [k for k in flown.links if not (min(k.a, k.b) < 16 and max(k.a, k.b) >= 24)]
    halves = Flown(1, lines=7, per_line=8, points=1500)
    halves.links = apart
    former = without(halves, bridge)
    assert len([b for b in former.blocks if len(b) > 1]) == 2
    assert added(inputs(halves, former), METHOD) is None


@pytest.mark.slow
def test_many_new_photos_need_a_new_adjustment(flown):
    gone = tuple(range(26, 56))
    assert added(inputs(flown, without(flown, gone)), METHOD) is None


def test_new_photos_that_only_know_one_another_need_a_new_adjustment(flown, former):
    alone = [k for k in flown.links if (k.a in NEW) == (k.b in NEW)]
    assert added(inputs(flown, former, alone), METHOD) is None


def test_a_new_photo_without_links_is_left_to_its_metadata(flown, former):
    links = [k for k in flown.links if not {k.a, k.b} & set(NEW)]
    found = added(inputs(flown, former, links), METHOD)
    assert sorted(found.poses) == sorted(former.poses)


@pytest.mark.slow
def test_photos_of_another_focus_do_not_fit_on_the_block(flown, former):
    """Their pictures are 5 % larger than the block's calibration says: the block has to change."""
    other = Flown(1, lines=7, per_line=8, points=1500)
    for i in NEW:
        centre = np.array([[(other.photos[i].width - 1) / 2, (other.photos[i].height - 1) / 2]])
        px = other.features[i].px
        out = centre + 1.05 * (px - centre) + 40 * ((px - centre) / 400) ** 3
        other.features[i] = replace(other.features[i], px=out)
    assert added(inputs(other, former), METHOD) is None
