"""Single photos among their neighbours: what the adjustment is given."""

from dataclasses import fields, replace

import numpy as np
import pytest

from skyquilt.alignment.priors import photo_prior
from skyquilt.errors import AlignmentError
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
