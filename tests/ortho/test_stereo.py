"""A box of known height is found; beyond the photos the surface becomes a plane."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.engine.workers import Threads
from skyquilt.model.camera import Camera
from skyquilt.model.raster import Grid
from skyquilt.ortho import fill, fusion, stereo
from skyquilt.ortho.fill import crowns, filled, lowered, nearest_known, plateaus, settled
from skyquilt.ortho.pair_matching import Footprints, pair_of
from skyquilt.ortho.stereo import Stereo
from skyquilt.ortho.tie_surface import level
from tests.ortho.scenes import FINE_M, textured, view

HEIGHT, BOX = 40.0, 6.0
"""Cameras above ground, and the box's roof above it, m."""
WIDE = Camera(width=800, height=600, focal=700.0, cx=401.0, cy=298.0)
HALF = 5.0
"""Half the side of the box in m; it stands at the origin."""


def picture(shot):
    """The photo of level ground with a box, by casting every ray against its roof and its walls."""
    camera = shot.camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    xy = np.stack(
        [(u - camera.cx) / camera.focal, (v - camera.cy) / camera.focal, np.ones_like(u)], -1
    )
    d = xy.reshape(-1, 3) @ shot.pose.cam_R_map
    cx, cy, cz = shot.pose.map_C
    # the first height at which a ray is inside the box's walls, from the roof downwards
    z = np.zeros(len(d))
    t = -cz / d[:, 2]
    away = np.maximum(np.abs(cx + t * d[:, 0]), np.abs(cy + t * d[:, 1]))
    near = np.flatnonzero(away < HALF + BOX)
    for h in np.linspace(0, BOX, 61):
        t = (h - cz) / d[near, 2]
        inside = (np.abs(cx + t * d[near, 0]) < HALF) & (np.abs(cy + t * d[near, 1]) < HALF)
        z[near[inside]] = h
    t = (z - cz) / d[:, 2]
    x, y = cx + t * d[:, 0], cy + t * d[:, 1]
    ground = textured()
    column = (x / FINE_M + ground.shape[1] / 2 + 37 * z / FINE_M * 0.1).astype(np.float32)
    row = (ground.shape[0] / 2 - y / FINE_M + 29 * z / FINE_M * 0.1).astype(np.float32)
    shape = (camera.height, camera.width)
    out = cv2.remap(
        ground,
        column.reshape(shape),
        row.reshape(shape),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return np.clip(cv2.GaussianBlur(out, (0, 0), 0.7), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def flight():
    places = [(-8.0, -8.0), (0.0, -8.0), (8.0, -8.0), (-8.0, 6.0), (0.0, 6.0), (8.0, 6.0)]
    return flown(
        [view(k, x, y, z=HEIGHT + 0.3 * (k % 2), camera=WIDE) for k, (x, y) in enumerate(places)]
    )


def flown(views):
    """Views of the box, and the source of their pictures."""
    pictures = {v.photo: picture(v) for v in views}

    def grey(photo, longest):
        whole = pictures[photo]
        scale = longest / whole.shape[1]
        return (
            whole
            if scale >= 1
            else cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        )

    return views, grey


GRID = Grid(west=-25.0, north=25.0, gsd=0.06, width=834, height=834)


@pytest.fixture(scope="module")
def heights(flight):
    """As they are usually found."""
    views, grey = flight
    return Stereo()(level(0.0), views, GRID, grey, MADE_NOW)


def test_a_box_stands_up(heights):
    """Roof and ground to 15 cm, and the walls within 60 cm, which is ten map pixels."""
    x, y = np.meshgrid(np.linspace(-14, 14, 113), np.linspace(-14, 14, 113))
    z = heights.at(x, y)
    outside = np.maximum(np.abs(x), np.abs(y)) - HALF
    assert np.median(np.abs(z[outside < -1] - BOX)) < 0.15
    assert (np.abs(z[outside < -1] - BOX) < 0.5).mean() > 0.98
    assert (np.abs(z[outside > 1]) < 0.5).mean() > 0.98
    edge = np.abs(outside) < 1.5
    right = (z[edge] > BOX / 2) == (outside[edge] < 0)
    off = np.abs(outside[edge])[~right]
    assert (off < 0.6).mean() > 0.9 if len(off) else True
    assert 0.0 < np.median(np.abs(z[outside < -1] - BOX))  # found, not given


@pytest.mark.slow
def test_a_box_stands_up_seen_aslant():
    """A row of photos that look 55 degrees away from straight down, 45 m south of the box: pairs
    chosen by their height above ground, in pixels of straight views, gave a tenth of the roof 40 cm
    off and a tenth of the ground 6.4 cm.
    """
    places = [5.0 * (k - 2.5) for k in range(6)]
    shots = [view(k, x, -45, z=HEIGHT, pitch=55, camera=WIDE) for k, x in enumerate(places)]
    views, grey = flown(shots)
    grid = Grid(west=-30.0, north=60.0, gsd=0.08, width=750, height=1000)
    found = Stereo()(level(0.0), views, grid, grey, MADE_NOW)
    roof = found.at(*np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-4, 4, 33)))
    ground = found.at(*np.meshgrid(np.linspace(-20, 20, 81), np.linspace(8, 40, 65)))
    assert np.percentile(np.abs(roof - BOX), 90) < 0.1
    assert np.percentile(np.abs(ground), 90) < 0.055


def test_baselines_are_compared_with_distances():
    """Straight views 5 m apart at 40 m make pairs; those that look 60 degrees aslant, at ground
    twice as far away, need twice that, and their pixels are as large as there.
    """

    def pairs(pitch):
        views = [view(k, 5.0 * k, 0, z=HEIGHT, pitch=pitch, camera=WIDE) for k in range(6)]
        return [(a, b, b.photo - a.photo) for a, b in Stereo().pairs(views, HEIGHT, 3)]

    assert min(steps for *_, steps in pairs(0)) == 1
    aslant = pairs(60)
    assert min(steps for *_, steps in aslant) >= 2
    a, b, _ = aslant[0]
    away = np.hypot(HEIGHT, np.mean([v.middle[1] for v in (a, b)]))
    assert away > 1.7 * HEIGHT
    assert stereo._over(a, b, level(0.0), 0.1).gsd == pytest.approx(0.1 * away / HEIGHT, rel=0.02)


@pytest.mark.slow
def test_threads_and_parts_do_not_change_the_heights(flight, monkeypatch):
    """Three threads and tiles of 64 cells: the same heights; a kept part is not matched again."""
    views, grey = flight
    whole = Stereo()(level(0.0), views, GRID, grey, MADE_NOW)
    monkeypatch.setattr("skyquilt.ortho.stereo.TILE", 64)
    parts = {}

    def held(name, make):
        return parts.setdefault(name, make()) if name not in parts else parts[name]

    keep = Keep(held=held, workers=Threads(3))

    assert np.array_equal(Stereo()(level(0.0), views, GRID, grey, keep).z, whole.z)
    number = len(parts)
    assert number > 4

    def never(*_):
        raise AssertionError("matched again")

    with monkeypatch.context() as patch:
        patch.setattr("skyquilt.ortho.stereo.matched_points", never)
        assert np.array_equal(Stereo()(level(0.0), views, GRID, grey, keep).z, whole.z)
    assert len(parts) == number
    missing = list(parts)[1::3]
    for has in (parts.__contains__, lambda name: True):  # the other: files that cannot be read
        for name in missing:
            del parts[name]
        again = Stereo()(level(0.0), views, GRID, grey, replace(keep, has=has))
        assert np.array_equal(again.z, whole.z)


def test_level_ground_stays_level(flight):
    views, _ = flight
    blank = np.full((600, 800), 90, np.uint8)
    found = Stereo()(level(1.5), views, GRID, lambda photo, side: blank, MADE_NOW)
    assert found.z == pytest.approx(1.5, abs=0.2)
    assert Stereo()(found, views[:1], GRID, lambda photo, side: blank, MADE_NOW) is found


def test_points_over_the_plane_lie_in_one_row():
    """Both photos of a pair show a point in the same row, shifted by the stated disparity."""
    a, b = view(0, -5, 0, z=40, pitch=2), view(1, 4, 3, z=41.5, roll=-3)
    pair = pair_of(a, b, 1.0, 0.1)
    normal = np.cross(pair.down, pair.along)
    normal *= np.sign(normal[2])
    for h in (-2.0, 0.0, 7.0):
        foot = pair.places(np.array(20.0), np.array(30.0))
        point = foot + h * normal
        seen = []
        for shot in (a, b):
            c = shot.pose.map_C
            share = ((c - pair.origin) @ normal) / ((c - point) @ normal)
            at = c + (point - c) * share - pair.origin
            seen.append((at @ pair.down / 0.1, at @ pair.along / 0.1))
        assert seen[0][0] == pytest.approx(seen[1][0], abs=1e-6)
        assert seen[0][1] - seen[1][1] == pytest.approx(pair.shift(h), abs=1e-6)


def test_beyond_the_support_lies_the_plane():
    """A slope of one in ten goes on as a plane, and a lone spike at its rim does not."""
    y, x = np.mgrid[:200, :200].astype(np.float32)
    z = 0.1 * x
    support = x < 80
    z[90:94, 76:80] += 8
    noisy = np.where(support, z, 50.0).astype(np.float32)
    out = settled(noisy.copy(), support)
    assert np.array_equal(out[:, :80], noisy[:, :80])
    far = out[20:180, 95:120]
    assert np.abs(far - (0.1 * x)[20:180, 95:120]).max() < 3.5
    assert np.abs(np.diff(out[20:180, 100:], axis=1)).max() < 0.3


@pytest.mark.slow
def test_far_from_the_support_other_heights_are_taken(monkeypatch):
    """The plane of before next to the support, other heights far away, and a plane fitted to these
    where they are worth nothing; never the slope continued to the rim.
    """
    x = np.mgrid[:300, :300][1].astype(np.float32)
    support = x < 40
    z = np.where(support, 0.5 * x, -99).astype(np.float32)
    worth = (x > 60) & (np.mgrid[:300, :300][0] < 200)

    def others(rows):
        return np.full_like(z[rows], 12.0), worth[rows]

    alone = settled(z.copy(), support)
    assert alone[:, 290:].min() > 40  # what it mends
    out = settled(z.copy(), support, others)
    assert np.array_equal(out[support], z[support])
    assert np.abs(out - alone)[20:180, 40:50].max() < 4
    assert np.abs(out - 12)[20:180, 150:].max() < 0.5
    assert np.abs(out - 12)[220:, 150:].max() < 5
    monkeypatch.setattr(fill, "STRIP", 7)
    assert settled(z.copy(), support, others) == pytest.approx(out, abs=1e-3)
    assert settled(z.copy(), support, lambda rows: (z[rows], support[rows] & False)) == (
        pytest.approx(alone, abs=1e-3)
    )


def test_long_baselines_serve_where_no_other_pair_shows_the_ground():
    """Photos of 46 m of ground, 30 m apart (a ratio of 0.75), are pairs until one between them
    shows the same ground from nearer.
    """

    def chosen(*places):
        views = [view(k, x, 0, z=HEIGHT, camera=WIDE) for k, x in enumerate(places)]
        return {(a.photo, b.photo) for a, b in Stereo().pairs(views, HEIGHT, 3)}

    assert chosen(-30, 0, 30) == {(0, 1), (1, 2)}
    assert chosen(-30, 0, 30, -15, 15) >= {(0, 3), (1, 3), (1, 4), (2, 4)}
    assert not chosen(-30, 0, 30, -15, 15) & {(0, 1), (1, 2), (0, 2)}
    assert not chosen(-60, 0, 60)  # 1.5 times the height apart, and nothing in common


def test_photos_that_see_a_place_are_counted():
    """As points inside convex outlines are, but for a cell at their rims."""
    views = [view(k, 9.0 * k, 4.0 * (k % 2), z=HEIGHT, yaw=20.0 * k, camera=WIDE) for k in range(4)]
    seen = Footprints.of(views, HEIGHT)
    x, y = np.linspace(-60, 90, 151), np.linspace(-50, 50, 101)
    wanted, rim = np.zeros((101, 151), int), np.zeros((101, 151), bool)
    at = np.stack(np.meshgrid(x, y), -1)
    for v in views:
        along = np.roll(v.footprint, -1, 0) - v.footprint
        off = at[:, :, None] - v.footprint
        away = (along[:, 0] * off[..., 1] - along[:, 1] * off[..., 0]) / np.hypot(*along.T)
        away = (away * np.sign(np.median(away[50, 75]))).min(-1)
        wanted += away > 0
        rim |= np.abs(away) < 3.0
    assert np.array_equal(seen.at(x, y)[~rim], wanted[~rim])
    assert (wanted[~rim] > 1).sum() > 500
    (rows, columns), both = seen.common(0, 1)
    counts = seen.at(
        seen.corner[0] + (np.arange(columns.start, columns.stop) + 0.5) * seen.side,
        seen.corner[1] + (np.arange(rows.start, rows.stop) + 0.5) * seen.side,
    )
    assert both.any() and counts[both].min() >= 2


def test_gaps_of_tall_rasters_are_filled_in_bands_as_in_one(monkeypatch):
    """Exactly as the whole raster within the rows that a band looks beyond; from roughly there
    further away, and where nothing is known at all for many bands.
    """
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(120.0), np.arange(900.0))
    z = (0.05 * y + np.sin(x / 9)).astype(np.float32)
    known = rng.random(z.shape) < 0.03
    known[300:560] = False
    spoilt = np.where(known, z, -99).astype(np.float32)
    whole = nearest_known(spoilt.copy(), known)
    monkeypatch.setattr(fill, "WHOLE", 128)
    monkeypatch.setattr(fill, "BEYOND", 40)
    bands = nearest_known(spoilt, known)
    away = cv2.distanceTransform((~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    assert np.array_equal(bands[away <= 40], whole[away <= 40])
    assert (away > 40).sum() > 10_000
    assert bands.min() >= z[known].min()
    apart = np.abs(bands - whole)[away > 40]  # the gap's sides differ by 13 m
    assert np.median(apart) < 1 and np.mean(apart < 2.5) > 0.95


def test_gaps_are_filled_from_their_sides():
    z = np.zeros((40, 40), np.float32)
    z[:, 20:] = 10
    known = np.ones(z.shape, bool)
    known[10:30, 15:25] = False
    steep = nearest_known(np.where(known, z, -99), known)
    assert set(np.unique(steep)) == {0.0, 10.0}
    soft = filled(np.where(known, z, 0), known)
    assert soft.min() >= 0 and soft.max() <= 10 and 3 < soft[20, 19] < 7
    assert plateaus(z, 7, 0.0, 10.0) == pytest.approx(z, abs=0.04)


def test_heights_joined_in_bands_are_those_joined_at_once(monkeypatch):
    rng = np.random.default_rng(1)
    cells = Grid(west=0.0, north=60.0, gsd=0.2, width=150, height=300)
    z = rng.normal(5, 1, (300, 150)).astype(np.float32)
    known = rng.random(z.shape) < np.linspace(0, 0.6, 300)[:, None]
    rough = fusion.surface_of(np.full((60, 30), 2.0, np.float32), cells.coarser(5))
    whole = fusion.with_coarse(z, known, rough, cells, 15)
    monkeypatch.setattr(fill, "BAND", 37)
    bands = fusion.with_coarse(z, known, rough, cells, 15)
    assert np.array_equal(whole, bands)
    share = (whole == 2.0).mean(1)
    assert share[:60].min() > 0.9 and share[240:].max() < 0.1


def test_specks_found_in_bands_are_those_found_at_once(monkeypatch):
    """Patches of all sizes about the least one, across the borders of bands."""
    rng = np.random.default_rng(12)
    z = np.round(rng.normal(0, 0.6, (200, 90))).astype(np.float32)
    z[rng.random(z.shape) < 0.35] = np.nan
    for least in (3, 6, 12):
        monkeypatch.setattr(fill, "BAND", 1000)
        whole = fusion.without_specks(z, 0.5, least)
        monkeypatch.setattr(fill, "BAND", 7)
        assert np.array_equal(fusion.without_specks(z, 0.5, least), whole)
        number, label = cv2.connectedComponents((z == 0).astype(np.uint8), connectivity=4)
        size = np.bincount(label.ravel())
        assert {s for s in size if least - 2 < s < least + 3}  # some just large enough, some not
        assert np.array_equal(whole[z == 0], (size > least)[label[z == 0]])


@pytest.mark.slow
def test_crowns_levelled_in_bands_are_those_levelled_at_once(monkeypatch):
    """And leaves of which little is known become level, up to the cliff at their rim."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:400, :160]
    leaves = np.hypot(x - 80, y - 200) < 50
    z = np.where(leaves, 12 + rng.normal(0, 1.5, x.shape), 0.02 * x).astype(np.float32)
    known = rng.random(z.shape) < np.where(leaves, 0.1, 0.9)
    z = nearest_known(np.where(known, z, -99).astype(np.float32), known)
    whole = crowns(z.copy(), known, 11, 1.0)
    monkeypatch.setattr(fill, "BAND", 37)
    bands = crowns(z.copy(), known, 11, 1.0)
    assert bands == pytest.approx(whole, abs=2e-3)
    inner = np.hypot(x - 80, y - 200) < 35
    assert np.std(z[inner]) > 1.2 and np.std(whole[inner]) < 0.7
    beyond = np.hypot(x - 80, y - 200) > 60
    assert whole[beyond] == pytest.approx((0.02 * x)[beyond], abs=0.1)


def test_the_plane_beyond_is_the_one_fitted_to_all(monkeypatch):
    """In strips as at once; means of cells are those of OpenCV's reduction by area."""
    rng = np.random.default_rng(5)
    z = rng.normal(20, 3, (301, 170)).astype(np.float32)
    support = np.zeros(z.shape, bool)
    support[40:220, 30:100] = True
    shares = fill._shares(301, 64) @ z @ fill._shares(170, 36).T
    assert shares == pytest.approx(cv2.resize(z, (36, 64), interpolation=cv2.INTER_AREA), abs=1e-3)
    wide = fill._between(301, 64) @ shares @ fill._between(170, 36).T
    assert wide == pytest.approx(cv2.resize(shares, (170, 301)), abs=1e-3)
    whole = settled(z.copy(), support)
    monkeypatch.setattr(fill, "STRIP", 7)
    assert settled(z.copy(), support) == pytest.approx(whole, abs=1e-3)


def _crown():
    """Heights of a crown of 8 m on ground that rises, and what is known of them: not a ring of
    three to five cells around it, nor single cells anywhere.
    """
    y, x = np.mgrid[:120, :140].astype(np.float32)
    away = np.hypot(x - 70, y - 60)
    truth = (0.02 * x + np.where(away < 25, 8 - 0.05 * away, 0)).astype(np.float32)
    lost = np.random.default_rng(2).random(truth.shape) < 0.1
    lost |= (away >= 25) & (away < np.where(x > 70, 30, 28))
    return truth, ~lost, away


def test_hidden_ground_beside_a_crown_is_filled_from_the_ground():
    """Every place of the ring becomes ground; the crown keeps its own heights, holes and all."""
    truth, known, away = _crown()
    z = np.where(known, truth, -99).astype(np.float32)
    nearest = nearest_known(z.copy(), known)
    out = lowered(nearest.copy(), known, 30, 1.0)
    assert np.array_equal(out[known], truth[known])
    ring = (away >= 25) & (away < 30)
    wrong = np.abs(out - truth) > 0.5
    assert (np.abs(nearest - truth) > 0.5)[ring].mean() > 0.3  # what it mends
    assert wrong[ring].mean() < 0.01
    assert wrong[away < 23].mean() == 0
    short = lowered(nearest.copy(), known, 1, 1.0)
    assert np.array_equal(short[ring & ~known], nearest[ring & ~known])


def test_hidden_ground_is_filled_in_bands_as_at_once(monkeypatch):
    truth, known, _ = _crown()
    nearest = nearest_known(np.where(known, truth, -99).astype(np.float32), known)
    whole = lowered(nearest.copy(), known, 12, 1.0)
    monkeypatch.setattr(fill, "AT_ONCE", 140 * 17)
    assert np.array_equal(lowered(nearest.copy(), known, 12, 1.0), whole)
    turned = (np.ascontiguousarray(a[::-1, ::-1].T) for a in (nearest, known))
    assert np.array_equal(lowered(*turned, 12, 1.0).T[::-1, ::-1], whole)


@pytest.mark.slow
def test_edges_are_sought_where_they_are_asked_for(flight, heights):
    """The walls of the box move closer to their place, and its roof and the ground stay."""
    views, grey = flight
    sharper = Stereo(edges=0.2)(level(0.0), views, GRID, grey, MADE_NOW)
    x, y = np.meshgrid(np.linspace(-9, 9, 361), np.linspace(-9, 9, 361))
    outside = np.maximum(np.abs(x), np.abs(y)) - HALF
    off = []
    for found in (heights, sharper):
        z = found.at(x, y)
        assert np.median(np.abs(z[outside < -1] - BOX)) < 0.15
        assert (np.abs(z[outside > 1]) < 0.5).mean() > 0.98
        off.append(np.mean((z > BOX / 2) != (outside < 0)))
    assert off[1] < 0.95 * off[0]


def test_a_pair_is_matched_both_ways_where_that_is_asked(flight, monkeypatch):
    """Two photos: more cells have a height of their own, and these are as true."""
    views, grey = flight
    two, known, given, whole = [views[0], views[2]], [], [], stereo._fused

    def fused(round_, pairs, name, keep):
        z = whole(round_, pairs, name, keep)
        if name == "fine":
            given.append([(p.a.photo, p.b.photo) for p, _ in pairs])
            x = round_.cells.x(np.arange(z.shape[1]))
            y = round_.cells.y(np.arange(z.shape[0]))
            outside = np.maximum(np.abs(x), np.abs(y[:, None])) - HALF
            off = np.abs(z - np.where(outside < 0, BOX, 0.0))[np.abs(outside) > 0.6]
            assert (off[np.isfinite(off)] < 0.5).mean() > 0.98
            known.append(np.isfinite(z).sum())
        return z

    monkeypatch.setattr(stereo, "_fused", fused)
    for both in (False, True):
        Stereo(both_ways=both)(level(0.0), two, GRID, grey, MADE_NOW)
    assert given == [[(0, 2)], [(0, 2), (2, 0)]]
    assert known[1] > known[0]


@pytest.mark.parametrize(("asked", "wide"), [(1.5, 2), (3.0, 3), (9.0, 4)])
def test_cells_are_as_fine_as_asked(flight, asked, wide):
    """Pixels of the finest pictures are 0.062 m wide, the map's 0.06 m."""
    views, grey = flight
    method = Stereo(finest=800, cell=asked, cell_px=(2, 4))
    found = method(level(0.0), [views[0], views[2]], GRID, grey, MADE_NOW)
    assert found.cell == pytest.approx(wide * GRID.gsd)


@pytest.mark.parametrize("room", [0, 30, 1_000])
def test_heights_of_pairs_wait_for_later_tiles_as_far_as_there_is_room(room):
    near = [[0, 1], [1, 2], [2, 3], [0, 1, 3], [], [1, 2]]
    stays = stereo._staying(near, [10, 20, 10, 40], room)
    matched, before = [0] * 4, list[int]()
    for pairs, stay in zip(near, stays, strict=True):
        for k in set(pairs) - set(before):
            matched[k] += 1
        assert set(stay) <= {*pairs, *before}
        before = stay
    assert matched == {0: [2, 3, 2, 1], 30: [1, 2, 2, 1], 1_000: [1, 1, 1, 1]}[room]
