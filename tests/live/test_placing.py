"""Single photos among their neighbours: what the adjustment is given."""

import json
import re
from dataclasses import fields, replace

import numpy as np
import pytest

from skyquilt.alignment.priors import photo_prior
from skyquilt.errors import AlignmentError
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.live.live_map import LiveMap
from skyquilt.live.members import Member
from skyquilt.live.settings import LiveSettings


@pytest.fixture(scope="module")
def live(flight, tmp_path_factory):
    """Four photos; the second one's metadata have not been read in the map's frame."""
    settings = LiveSettings(features=600, deterministic=True)
    live = LiveMap(tmp_path_factory.mktemp("live") / "out", settings)
    for path in flight.photos[:4]:
        live.add(path)
    second = live.members.by_id[2]
    second.prior = Member(id=2, photo=second.photo, source="", state="waiting").prior
    yield live
    live.close()


def of_own_photo(live, photos, priors):
    """Each prior belongs to the photo at the same place of the list, and one says nothing."""
    assert len(priors) == len(photos) == 4
    by_name = {m.photo.name: m.prior for m in live.members.by_id.values()}
    assert all(by_name[p.name] is prior for p, prior in zip(photos, priors, strict=True))
    return np.isnan([prior.map_C[0] for prior in priors]).tolist() == [False, True, False, False]


def test_a_window_has_a_prior_for_each_of_its_photos(live):
    local_pose, members = live.refinement.local_pose, live.members
    window = local_pose.window(members.by_id[4], [1, 2, 3, 4], frozenset((1,)), [])
    assert of_own_photo(live, window.photos, window.priors)
    assert local_pose.adjust_locally(window)  # and it is adjusted


def test_a_young_block_has_a_prior_for_each_of_its_photos(live, monkeypatch):
    given = []

    def stop(photos, frame, priors, features, links):
        given.append((photos, priors))
        raise AlignmentError("that is enough")

    monkeypatch.setattr(live.refinement.local_pose, "young", stop)
    live.refinement.local_pose.bundled([1, 2, 3, 4])
    assert of_own_photo(live, *given[0])


def test_a_photo_without_prior_is_one_whose_metadata_say_nothing(live):
    second = live.members.by_id[2]
    silent = replace(second.photo, position=None, attitude=None, flight_yaw_deg=None)
    expected = photo_prior(silent, live.members.frame, None)
    for field in fields(expected):
        np.testing.assert_equal(
            getattr(second.prior, field.name), getattr(expected, field.name), field.name
        )


def test_a_photo_that_tells_no_tilt_is_compared_with_those_beside_it_in_time(live):
    """Where none seems near: taken to look down, photos of an orbit share nothing."""
    neighbours, known = live.refinement.local_pose.neighbours, live.members.by_id
    far = replace(known[1].pose, map_C=known[1].pose.map_C + 5000.0)
    assert sorted(neighbours.of(known[2], far)) == [1, 3]
    assert neighbours.of(known[4], far) == []


def test_a_photo_that_belongs_elsewhere_is_compared_with_those_there(live, monkeypatch):
    """A receiver jumped: few of those near the position that it tells show the same."""
    local_pose, last = live.refinement.local_pose, live.members.by_id[4]
    there = last.pose.map_C[:2].copy()
    jumped = replace(last.pose, map_C=last.pose.map_C + (40.0, 0.0, 0.0))

    def near(_, pose):
        return [1] if pose.map_C[0] > there[0] + 20 else [1, 3, 2]

    monkeypatch.setattr(local_pose.neighbours, "of", near)
    monkeypatch.setattr(last, "pose", jumped)
    change = local_pose.refine(last)
    assert {pair for pair, link in change.links.items() if link} > {(3, 4)}
    assert np.linalg.norm(change.moved[4].map_C[:2] - there) < 5.0


def test_a_photo_whose_position_leaps_is_linked_before_it_is_drawn(live, monkeypatch):
    metadata, last = live.initial_pose.metadata, live.members.by_id[4]
    (recent,) = metadata._recent.values()
    monkeypatch.setitem(recent, 1, live.members.by_id[1])
    second = live.members.by_id[2]
    monkeypatch.setattr(second, "prior", replace(last.prior, map_C=second.pose.map_C))
    assert not metadata.loose(last, last.pose)
    told = replace(last.prior, map_C=last.prior.map_C + (0.0, -60.0, 0.0))
    monkeypatch.setattr(last, "prior", told)
    assert metadata.loose(last, last.pose)


def test_photos_taken_next_to_one_are_those_of_other_blocks(live, monkeypatch):
    neighbours, known = live.refinement.local_pose.neighbours, live.members.by_id
    assert [neighbours.taken_next(m) for m in known.values()] == [[], [], [], []]
    monkeypatch.setattr(live.ledger, "compared", lambda *pair: sorted(pair) == [3, 4])
    monkeypatch.setattr(live.members, "block", lambda i: {1, 2} if i < 3 else {3, 4})
    assert [neighbours.taken_next(m) for m in known.values()] == [[], [3], [2], []]
    monkeypatch.setattr(known[3], "state", "superseded")
    assert neighbours.taken_next(known[2]) == [4]


def test_heights_that_some_photos_alone_tell_correct_no_others(live, monkeypatch):
    """The height of a photo that tells none is no error of reported heights, and the other way
    round: photos were placed at the take-off's height, or at twice their own.
    """
    metadata, last = live.initial_pose.metadata, live.members.by_id[4]
    known = last.prior
    unknown = replace(known, map_C=np.r_[known.map_C[:2], np.nan])
    assert metadata.first(replace(last, prior=unknown)).map_C[2] == pytest.approx(60, abs=5)
    for member in live.members.by_id.values():
        monkeypatch.setattr(member, "prior", unknown)
    assert metadata.first(replace(last, prior=known)).map_C[2] == pytest.approx(60, abs=5)


def test_heights_above_take_off_that_stay_at_zero_are_not_used(flight, tmp_path):
    """As on maps of whole flights: photos had no extent on the map, and were linked to none."""
    live = LiveMap(tmp_path / "out", LiveSettings())
    for k, path in enumerate(flight.photos):
        low = re.sub(
            rb'RelativeAltitude="[^"]{7}"', b'RelativeAltitude="+00.000"', path.read_bytes()
        )
        (tmp_path / path.name).write_bytes(low if k < 5 else path.read_bytes())
    for path in flight.photos[:5]:
        live.intake.take_file(tmp_path / path.name, "drone")
    live.queues.received.extend(live.members.take_up())
    while live.queues.received:
        live.initial_pose.place(live.queues.received[0])
    first, *others = live.members.by_id.values()
    assert [m.pose.map_C[2] for m in (first, *others)] == [50.0] * 5
    told = live.ledger.rows("select body from event where kind = 'note'")
    assert [json.loads(body)["text"] for (body,) in told] == [
        "So far: The heights above take-off stay within 2 m of zero and were not used."
    ]
    live.intake.take_file(tmp_path / flight.photos[5].name, "drone")  # it begins to rise
    (last,) = live.members.take_up()
    assert (first.prior.map_C[2], len(live.members.near)) == (0.0, 6)
    assert last.prior.map_C[2] == pytest.approx(60, abs=3)
    live.close()


def test_a_photo_is_refined_by_the_link_for_which_it_is_refined_again(live, monkeypatch):
    """Else it would be found again and again, by a map that never comes to rest."""
    refinement, member, seen = live.refinement, live.members.by_id[4], []
    neighbours = refinement.local_pose.neighbours
    monkeypatch.setattr(neighbours, "of", lambda *_: [])  # as if the nearest were enough
    monkeypatch.setattr(refinement, "_pairs", iter([(member, 3)]))
    monkeypatch.setattr(refinement, "_commit", lambda _, change, __: seen.append(change.links))
    with monkeypatch.context() as apart:
        apart.setattr(live.members, "block", lambda i: {i})  # as if of two blocks
        assert refinement.rejoined() is not None
    assert live.queues.untried[0] is member
    refinement.refine(member)
    assert [link is not None for link in seen[0].values()] == [True] and (3, 4) in seen[0]


def test_a_photo_that_looks_aside_and_tells_no_tilt_is_held_by_those_around_it(live, monkeypatch):
    """It was linked with five that seem near, by where it would look if it looked down: a block of
    photos that look 40 degrees to a side was found 70 degrees off.
    """
    refinement, known = live.refinement, live.members.by_id
    for a, b in live.ledger.rows("select a, b from link where a = 4 or b = 4"):
        if (a, b) != (3, 4):  # as if enough others had been found before
            live.ledger.rows("delete from link where a = ? and b = ?", a, b)
            known[a].links.discard(b)
            known[b].links.discard(a)
    member, before = known[4], live.schedule.since
    assert list(refinement._apart()) == []
    told = member.prior
    monkeypatch.setattr(member, "prior", replace(told, sigma_tilt_deg=6.0))
    assert list(refinement._apart()) == []  # it looks down
    aside = cam_R_map_from_angles(told.yaw_deg, 0.0, 40.0)
    monkeypatch.setattr(member, "pose", replace(member.pose, cam_R_map=aside))
    refinement._pairs = refinement._apart()
    while refinement.rejoined() is not None:
        pass
    linked = {
        a for a, b in live.ledger.rows("select a, b from link where body is not null and b = 4")
    }
    assert linked == member.links == {1, 2, 3}
    assert live.schedule.since == before + 2  # the block is adjusted anew,
    assert not live.queues.untried  # and no photo by itself
