"""`image`: the chain and the overview, on flights of known truth."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from skyquilt.imaging.views import make_views, on_ground
from skyquilt.matching.levelled import Level
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.ransac import Ransac
from skyquilt.matching.sift import Sift
from skyquilt.ortho.tie_surface import level
from skyquilt.papers.chain import Chain
from skyquilt.papers.overview import ByOverview
from skyquilt.papers.plane_registration import implausible
from tests.alignment.flights import CORNERS, FRAME, fly, line


def chain(model="similarity", **more):
    return Chain(match=Mutual(), estimate=Ransac(model=model, threshold_px=3.0, minimum=12), **more)


def ground_error(flight, found, *, free=True):
    """RMS distance in m of the photos' corners on the map from the truth, after the best similarity
    if `free`.
    """
    views = {v.photo: v for v in make_views(found, level(0.0))}
    a = np.concatenate([on_ground(views[i], CORNERS, level(0.0))[:, :2] for i in sorted(views)])
    b = np.concatenate([flight.map_xy(i, CORNERS) for i in sorted(views)])
    if free:
        z, w = a @ [1, 1j], b @ [1, 1j]
        M = np.column_stack([z, np.ones_like(z)])
        z = M @ np.linalg.lstsq(M, w, rcond=None)[0]
        return float(np.sqrt((np.abs(z - w) ** 2).mean()))
    return float(np.sqrt(((a - b) ** 2).sum(1).mean()))


def run(flight, method=None, order=None, **more):
    n = len(flight.photos)
    return (method or chain(**more))(
        flight.photos, FRAME, flight.priors, flight.features, order or range(n)
    )


@pytest.mark.parametrize("model", ["similarity", "affine", "homography"])
def test_a_strip_over_level_ground_keeps_its_shape(model):
    flight = fly(line(12, heading=40.0), yaw=np.linspace(40, 52, 12))
    found = run(flight, model=model)
    assert found.blocks == (tuple(range(12)),) and len(found.joins) == 11
    # the more freely photos may bend, the more the noise of 0.2 px bends them along the strip
    assert (
        0.001
        < ground_error(flight, found)
        < {"similarity": 0.1, "affine": 0.4, "homography": 2.0}[model]
    )


def test_a_translation_cannot_turn():
    straight, turning = fly(line(8)), fly(line(8), yaw=np.linspace(0, 10, 8))
    model = "translation"
    assert ground_error(straight, run(straight, model=model)) < 0.1
    assert ground_error(turning, run(turning, model=model)) > 1.0


def test_positions_say_where_it_lies_and_nothing_else():
    flight = fly(line(10, heading=110.0), yaw=110.0)
    found = run(flight)
    assert found.frame.metric and ground_error(flight, found, free=False) < 0.15
    shifted = [replace(p, map_C=p.map_C + [100.0, -50.0, 0.0]) for p in flight.priors]
    other = chain()(flight.photos, FRAME, shifted, flight.features, range(10))
    for i in range(10):
        assert np.allclose(other.poses[i].map_C - found.poses[i].map_C, [100, -50, 0], atol=1e-6)


def test_without_positions_the_height_gives_the_scale():
    flight = fly(line(6, heading=75.0), yaw=75.0)
    blind = [replace(p, map_C=np.array([np.nan, np.nan, np.nan])) for p in flight.priors]
    free = replace(FRAME, crs=None)
    found = chain(height_m=60.0)(flight.photos, free, blind, flight.features, range(6))
    step = np.linalg.norm(np.diff([found.poses[i].map_C[:2] for i in range(6)], axis=0), axis=1)
    assert np.allclose(step, 25.0, atol=0.1) and found.frame.metric
    ahead = found.poses[5].map_C[:2] - found.poses[0].map_C[:2]
    assert np.degrees(np.arctan2(*ahead)) == pytest.approx(
        75.0, abs=0.5
    )  # turned as the photos report
    assert not chain()(flight.photos, free, blind, flight.features, range(6)).frame.metric


def test_where_the_sequence_breaks_a_new_piece_begins():
    flight = fly(np.concatenate([line(5), line(5, start=(400.0, 0.0))]))
    found = run(flight)
    assert found.blocks == ((0, 1, 2, 3, 4), (5, 6, 7, 8, 9))
    assert any("P005.jpg does not match P004.jpg" in n and "new piece" in n for n in found.notes)
    assert ground_error(flight, found, free=False) < 0.2  # each piece lies where its positions say


def test_pieces_without_positions_lie_beside_each_other():
    flight = fly(np.concatenate([line(4), line(4, start=(400.0, 0.0))]))
    blind = [replace(p, map_C=np.array([np.nan, np.nan, 60.0])) for p in flight.priors]
    found = chain()(flight.photos, replace(FRAME, crs=None), blind, flight.features, range(8))
    views = make_views(found, level(0.0))
    first = max(v.footprint[:, 0].max() for v in views if v.photo < 4)
    second = min(v.footprint[:, 0].min() for v in views if v.photo >= 4)
    assert second > first


def test_the_sequence_may_be_any_order_of_neighbours():
    flight = fly(line(6))
    found = run(flight, order=[5, 4, 3, 2, 1, 0])
    assert [j.photo for j in found.joins] == [4, 3, 2, 1, 0] and [j.onto for j in found.joins] == [
        5,
        4,
        3,
        2,
        1,
    ]
    assert ground_error(flight, found) < 0.1


def test_levelled_features_are_those_of_the_ground():
    flight = fly(line(8), relief=2.0, noise_px=0.1)
    loose = Ransac(model="similarity", threshold_px=24.0, minimum=12)  # 12.8 px at 800
    plain = replace(chain(), estimate=loose)
    level_ = replace(plain, level=Level(relief_m=1.0, height_m=60.0))
    without, with_ = run(flight, plain), run(flight, level_)
    assert sum((~j.levelled).sum() for j in with_.joins) > 30
    assert all(j.levelled.all() for j in without.joins)
    assert ground_error(flight, with_) < 0.7 * ground_error(flight, without)


def test_joins_tell_how_well_photos_were_joined():
    flight = fly(line(5), noise_px=0.3)
    for join in run(flight).joins:
        # both points err by 0.3 px along both axes, and both ways count: 8 * 0.3^2
        assert join.ste_px2 == pytest.approx(8 * 0.3**2, rel=0.25)
        assert len(join.px) == join.inliers == len(join.d_px) <= join.matches


@dataclass(frozen=True, kw_only=True)
class Counting:
    """SIFT that remembers how large the overviews were."""

    sizes: list
    sift: Sift = field(default_factory=lambda: Sift(longest=10**6))

    def __call__(self, image):
        self.sizes.append(image.size)
        return self.sift(image)

    def counted(self, count):
        return replace(self, sift=self.sift.counted(count))


def overview(flight, sizes=None):
    method = ByOverview(
        detect=Counting(sizes=sizes if sizes is not None else []),
        match=Mutual(),
        longest=400,
        estimate=Ransac(model="similarity", threshold_px=3.0, minimum=12),
    )
    own = [Sift(longest=400)(np.asarray(flight.grey(i, 800))) for i in range(len(flight.photos))]
    return method(flight.photos, FRAME, flight.priors, own, range(len(flight.photos)), flight.grey)


@pytest.mark.slow
def test_the_overview_is_searched_as_a_whole():
    flight, sizes = fly(line(6, heading=30.0), yaw=30.0), []
    found = overview(flight, sizes)
    assert found.blocks == (tuple(range(6)),) and all(j.onto == -1 for j in found.joins)
    assert ground_error(flight, found) < 0.4
    assert sizes == sorted(sizes) and sizes[-1] > 2 * sizes[0]  # its cost grows: that is its nature


@pytest.mark.slow
def test_the_overview_closes_a_loop_that_the_chain_cannot():
    xy = np.concatenate([line(3), line(3, start=(25.0, 50.0), heading=180.0)])
    flight = fly(xy)
    found = overview(flight)
    assert len(found.blocks[0]) == 6 and ground_error(flight, found) < 0.4


@pytest.mark.parametrize(
    ("H", "says"),
    [
        (np.diag([0.3, 0.3, 1.0]), "scale"),
        (np.diag([3.0, 3.0, 1.0]), "scale"),
        (np.diag([-1.0, 1.0, 1.0]), "scale"),
        (np.diag([1.4, 0.7, 1.0]), "shear"),
        (np.eye(3), ""),
    ],
)
def test_what_no_two_aerial_photos_can_be(H, says):
    assert says in implausible(H, np.array([750.0, 560.0])) and bool(
        implausible(H, np.zeros(2))
    ) == bool(says)
