"""Blocks of known similarities: outlier links, half-turn lies, drift, and positions of which many
are wrong.
"""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.alignment import start
from skyquilt.alignment.similarity_graph import (
    PlaneLink,
    against_positions,
    components,
    consistent_blocks,
    fit_similarity,
    solve_block,
    tie_to_positions,
)
from skyquilt.alignment.start import NOMINAL_HEIGHT_M, georeference, ground_of
from skyquilt.model.poses import MapFrame, Prior


def plane(seed=0, lines=4, per_line=6, height=60.0):
    """Factors a = height exp(-i yaw) and translations t of a serpentine block."""
    rng = np.random.default_rng(seed)
    n = lines * per_line
    column, row = np.divmod(np.arange(n), per_line)
    row = np.where(column % 2 == 1, per_line - 1 - row, row)
    t = column * 25 + 1j * row * 15 + rng.normal(0, 0.5, n) + 1j * rng.normal(0, 0.5, n)
    yaw = np.radians(np.where(column % 2 == 1, 180, 0) + rng.normal(0, 3, n))
    return height * np.exp(rng.normal(0, 0.03, n)) * np.exp(-1j * yaw), t


def link(a, t, i, j, rng, scale_noise=0.0, shift_noise=0.0, weight=100.0):
    """The link of photos i and j: what both see in the middle between them."""
    ground = (t[i] + t[j]) / 2 + complex(*rng.normal(0, 3, 2))
    s = a[i] / a[j] * np.exp(complex(*rng.normal(0, scale_noise, 2)))
    p_i, p_j = (ground - t[i]) / a[i], (ground - t[j]) / a[j]
    return PlaneLink(
        a=i, b=j, b_S_a=s, p_a=p_i, p_b=p_j + complex(*rng.normal(0, shift_noise, 2)), weight=weight
    )


def links_of(a, t, rng, reach=34.0, **noise):
    n = len(a)
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n) if abs(t[i] - t[j]) < reach]
    return [link(a, t, i, j, rng, **noise) for i, j in pairs]


def aligned(solution, a, t):
    """The solution moved by the similarity that brings its first photo to the truth."""
    g = a[0] / solution.a[0]
    return solution.a * g, solution.t * g + t[0]


def test_exact_links_give_the_exact_block():
    a, t = plane()
    rng = np.random.default_rng(1)
    found_a, found_t = aligned(solve_block(np.arange(len(a)), links_of(a, t, rng)), a, t)
    assert found_a == pytest.approx(a, abs=1e-6)
    assert found_t == pytest.approx(t, abs=1e-5)


def test_members_need_not_be_numbered_from_zero():
    a, t = plane(lines=2, per_line=3)
    rng = np.random.default_rng(1)
    own = [
        PlaneLink(a=10 + 3 * k.a, b=10 + 3 * k.b, b_S_a=k.b_S_a, p_a=k.p_a, p_b=k.p_b, weight=1.0)
        for k in links_of(a, t, rng)
    ]
    found_a, found_t = aligned(solve_block(10 + 3 * np.arange(6), own), a, t)
    assert found_t == pytest.approx(t, abs=1e-5) and found_a == pytest.approx(a, abs=1e-6)


def test_noisy_links_do_not_shrink_the_map():
    """Least squares of points would: its cost falls with the scale. Mean scale and extent stay
    within 0.1 %...
    """
    scales, extents = [], []
    for seed in range(12):
        a, t = plane(seed, lines=6, per_line=8)
        rng = np.random.default_rng(100 + seed)
        solution = solve_block(
            np.arange(len(a)), links_of(a, t, rng, scale_noise=0.01, shift_noise=0.02)
        )
        mean = np.exp(np.mean(np.log(np.abs(solution.a / a))))
        scales.append(mean / np.abs(solution.a[0] / a[0]) * np.abs(solution.a[0] / a[0]))
        spread = np.sqrt(np.var(solution.t) / np.var(t))
        extents.append(spread / mean)  # extent in units of the block's own mean scale
    assert np.mean(extents) == pytest.approx(1, abs=1e-3)
    assert np.std(extents) < 3e-3


def test_outlier_links_are_outvoted_and_named():
    a, t = plane(2)
    rng = np.random.default_rng(2)
    links = links_of(a, t, rng, scale_noise=0.003, shift_noise=0.003)
    wrong = set(rng.choice(len(links), len(links) // 8, replace=False).tolist())
    for k in wrong:
        i, j = links[k].a, links[k].b
        b_S_a = links[k].b_S_a * np.exp(complex(*rng.uniform(0.3, 0.6, 2)))
        links[k] = PlaneLink(
            a=i, b=j, b_S_a=b_S_a, p_a=links[k].p_a, p_b=links[k].p_b + 0.5, weight=30.0
        )
    solutions, kept = consistent_blocks(len(a), {(k.a, k.b): k for k in links})
    assert len(solutions) == 1
    assert {(links[k].a, links[k].b) for k in range(len(links)) if k not in wrong} == kept
    found_a, found_t = aligned(solutions[0], a, t)
    assert np.abs(found_a / a - 1).max() < 0.02
    assert np.abs(found_t - t).max() < 2.5


@pytest.mark.parametrize("seed", range(10))
def test_lines_join_by_most_links_between_them(seed):
    """Lines over rows that look alike: eight weak links between the two are right, six stronger
    ones are off by the same whole rows.
    """
    a, t = plane(seed, lines=2, per_line=7)
    rng = np.random.default_rng(seed)
    links = [link(a, t, i, i + 1, rng, weight=200.0) for i in range(len(a) - 1) if i != 6]
    pairs = [(i, j) for i in range(7) for j in range(7, 14) if abs(t[i] - t[j]) < 45]
    off = 25 * np.exp(1j * rng.uniform(0, 2 * np.pi))
    for k, n in enumerate(rng.choice(len(pairs), 14, replace=False)):
        i, j = pairs[n]
        right = link(a, t, i, j, rng, shift_noise=0.003, weight=35.0)
        links.append(right if k < 8 else replace(right, p_b=right.p_b + off / a[j], weight=40.0))
    _, kept = consistent_blocks(len(a), {(k.a, k.b): k for k in links})
    assert kept == {(k.a, k.b) for k in links[:-6]}


def lines_and_false_links(seed, false, weight=40.0):
    """Links of two lines that nothing right joins, and as many false ones between them; the
    translations (n,) of the photos in m.
    """
    a, t = plane(seed, lines=2, per_line=7)
    rng = np.random.default_rng(seed)
    links = [link(a, t, i, i + 1, rng, weight=60.0) for i in range(len(a) - 1) if i != 6]
    for k in range(false):  # photos beside each other look like one place, about
        right = link(a, t, 2 * k, 13 - 2 * k, rng)
        off = (t[2 * k] - t[13 - 2 * k] + 2) / a[13 - 2 * k]
        links.append(replace(right, p_b=right.p_b - off, weight=weight))
    return links, t


@pytest.mark.parametrize("seed", range(4))
def test_weak_links_contradict_positions(seed):
    """Those that are false, and no others; none where they are strong or many, or where positions
    lie as links have it.
    """
    links, t = lines_and_false_links(seed, 3)
    rng = np.random.default_rng(seed)
    position = 3.0 * t + 2 * (rng.normal(size=len(t)) + 1j * rng.normal(size=len(t)))
    sigma = np.full(len(t), 2.0)
    assert against_positions(links, position, sigma) == links[-3:]
    assert against_positions(links, np.full(len(t), np.nan + 0j), sigma) == []
    assert against_positions(links[:-3], position, sigma) == []
    strong, _ = lines_and_false_links(seed, 3, weight=90.0)
    assert against_positions(strong, position, sigma) == []
    fewer = [links[k] for k in (0, 2, 4, 6, 8, 10, 11, 12, 13, 14)]  # their photos have others
    assert against_positions(fewer, position, sigma) == links[-3:]
    assert against_positions(links[7:], position, sigma) == []
    more, _ = lines_and_false_links(seed, 4)  # so many would not agree by chance
    assert against_positions(more, position, sigma) == []


@pytest.mark.parametrize("seed", range(3))
def test_all_links_of_a_photo_do_not_contradict_its_position(seed, monkeypatch):
    """It is the position that is wrong, by 90 m: the photo stays where weak links put it."""
    monkeypatch.setattr(start, "plane_link", lambda link, photos, features: link)
    a, t = plane(seed)
    rng = np.random.default_rng(seed)
    links = links_of(a, t, rng, weight=40.0)
    position = t + rng.normal(size=len(t)) + 1j * rng.normal(size=len(t))
    position[9] += 90
    assert against_positions(links, position, np.full(len(t), 1.0)) == []
    found = start.find_start([], priors_at(position, sigma=1.0), [], links)
    assert found.blocks == (tuple(range(24)),)
    assert abs(found.placed[9][1] - t[9]) < 15


@pytest.mark.parametrize("seed", range(3))
def test_lines_that_false_links_alone_join_are_placed_by_positions(seed, monkeypatch):
    monkeypatch.setattr(start, "plane_link", lambda link, photos, features: link)
    links, t = lines_and_false_links(seed, 3)
    rng = np.random.default_rng(seed)
    position = 3.0 * t + rng.normal(size=len(t)) + 1j * rng.normal(size=len(t))
    told = priors_at(position, sigma=1.0)
    found = start.find_start([], told, [], links)
    assert sorted(found.blocks) == [tuple(range(7)), tuple(range(7, 14))]
    assert max(abs(found.placed[i][1] - 3.0 * t[i]) for i in range(14)) < 4
    wrong = np.where(np.arange(14) < 7, position, position + 60)  # another flight's correction
    far = start.find_start([], priors_at(wrong, sigma=1.0), [], links_of(*plane(seed, 2, 7), rng))
    assert len(far.blocks) == 1


def test_separate_groups_are_separate_blocks():
    a, t = plane(3)
    rng = np.random.default_rng(3)
    links = [k for k in links_of(a, t, rng) if (k.a < 14) == (k.b < 14) and 20 not in (k.a, k.b)]
    groups = components(len(a), links)
    assert [g.tolist() for g in groups] == [
        list(range(14)),
        [14, 15, 16, 17, 18, 19, 21, 22, 23],
        [20],
    ]
    solutions, _ = consistent_blocks(len(a), {(k.a, k.b): k for k in links})
    assert [s.members.tolist() for s in solutions] == [g.tolist() for g in groups[:2]]


# positions


def priors_at(position, sigma=1.5, yaw=None, z=np.nan):
    return [
        Prior(
            map_C=np.array([p.real, p.imag, z]),
            sigma_C=np.array([sigma, sigma, 3.0]),
            yaw_deg=np.nan if yaw is None else yaw[i],
            pitch_deg=0.0,
            roll_deg=0.0,
            sigma_yaw_deg=5.0,
            sigma_tilt_deg=1.0,
        )
        for i, p in enumerate(position)
    ]


def solved(seed, **noise):
    a, t = plane(seed)
    links = links_of(a, t, np.random.default_rng(seed + 50), **noise)
    return a, t, links, solve_block(np.arange(len(a)), links)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(8, 40),
    st.floats(0.1, 100),
    st.floats(-3.1, 3.1),
    st.integers(0, 1000),
    st.floats(0, 0.4),
)
def test_a_similarity_survives_two_lies_in_five(count, scale, angle, seed, share):
    rng = np.random.default_rng(seed)
    x = rng.normal(0, 1, count) + 1j * rng.normal(0, 1, count)
    g, c = scale * np.exp(1j * angle), complex(*rng.normal(0, 100, 2))
    y = g * x + c
    lies = rng.choice(count, int(share * count), replace=False)
    y[lies] += (
        20 * scale * np.exp(1j * rng.uniform(0, 6.3, len(lies))) * rng.uniform(1, 3, len(lies))
    )
    found_g, found_c, misfit = fit_similarity(x, y, np.full(count, 0.01 * scale))
    assert found_g == pytest.approx(g, rel=0.01)
    assert found_c == pytest.approx(c, abs=0.02 * scale)
    assert misfit < 0.02 * scale


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_georeferencing_with_wrong_positions(share):
    a, t, links, solution = solved(5, scale_noise=0.002, shift_noise=0.002)
    rng = np.random.default_rng(6)
    position = t + rng.normal(0, 1.5, len(t)) + 1j * rng.normal(0, 1.5, len(t))
    wrong = rng.choice(len(t), int(share * len(t)), replace=False)
    position[wrong] += 80 * np.exp(1j * rng.uniform(0, 6.3, len(wrong)))
    found, spread, metric = georeference(solution, links, priors_at(position))
    assert metric and np.isfinite(spread)
    assert np.abs(found.t - t).max() < 3.0
    assert np.abs(np.median(np.abs(found.a / a)) - 1) < 0.03
    assert np.degrees(np.abs(np.angle(found.a / a))).max() < 3


@pytest.mark.parametrize("apart", [0.0, 1e-9])
@pytest.mark.parametrize("away_m", [50.0, 1.6e7])
def test_two_positions_of_one_place_give_no_scale(apart, away_m):
    """Of all photos two have positions, and show the same place: copies that were given others."""
    a, t, links, solution = solved(7)
    position = np.full(len(a), np.nan + 0j)
    position[3:5] = t[3], t[3] + away_m
    where = solution.t.copy()
    where[4] = where[3] + apart
    found, _, metric = georeference(
        replace(solution, t=where), links, priors_at(position, yaw=-np.degrees(np.angle(a)), z=60.0)
    )
    assert metric and np.isfinite(found.t).all()
    assert np.median(np.abs(found.a)) == pytest.approx(60.0, rel=1e-3)


def test_half_turn_lies_of_the_yaw_do_not_turn_the_block():
    """Positions give the direction; without them the majority of the yaws does."""
    a, t, links, solution = solved(7)
    yaw = -np.degrees(np.angle(a))
    yaw[6:12] += 180
    found, _, _ = georeference(solution, links, priors_at(t, yaw=yaw))
    assert found.a == pytest.approx(a, rel=1e-3)
    found, spread, metric = georeference(
        solution, links, priors_at(np.full(len(a), np.nan), yaw=yaw, z=60.0)
    )
    assert np.isnan(spread) and metric
    assert np.degrees(np.abs(np.angle(found.a / a))).max() < 0.1
    assert np.median(np.abs(found.a)) == pytest.approx(60.0, rel=1e-5)


@pytest.mark.parametrize("z", [60.0, np.nan])
@pytest.mark.parametrize("seed", range(6))
def test_headings_direct_photos_whose_positions_differ_by_their_errors_only(seed, z):
    """A hover: the positions of 24 photos within 2 m tell a direction by chance, and headings that
    differ from it were taken for lies.
    """
    a, t, links, solution = solved(seed)
    hover = replace(solution, t=0.02 * solution.t)
    rng = np.random.default_rng(seed)
    position = 0.02 * t + rng.normal(0, 3.0, len(t)) + 1j * rng.normal(0, 3.0, len(t))
    priors = priors_at(position, yaw=-np.degrees(np.angle(a)), z=z)
    found, _, _ = georeference(hover, links, priors)
    assert np.degrees(np.abs(np.angle(found.a / a))).max() < 3
    if np.isfinite(z):
        assert np.median(np.abs(found.a)) == pytest.approx(60.0, rel=0.05)


def test_no_positions_and_no_height_is_not_metric():
    a, _, links, solution = solved(7)
    found, spread, metric = georeference(solution, links, priors_at(np.full(len(a), np.nan)))
    assert np.isnan(spread) and not metric
    assert np.median(np.abs(found.a)) == pytest.approx(NOMINAL_HEIGHT_M)


def test_heights_above_the_sea_are_no_heights_above_ground():
    """The scale comes from the height above the take-off point, wherever that lies."""
    a, _, links, solution = solved(7)
    nowhere = priors_at(np.full(len(a), np.nan), z=560.0)
    found, _, metric = georeference(solution, links, nowhere, 500.0)
    assert metric and np.median(np.abs(found.a)) == pytest.approx(60.0, rel=1e-4)
    found, _, metric = georeference(solution, links, nowhere, np.nan)
    assert not metric and np.median(np.abs(found.a)) == pytest.approx(NOMINAL_HEIGHT_M)
    frame = MapFrame(crs="EPSG:32632", origin=(0.0, 0.0), vertical_datum="egm96")
    assert np.isnan(ground_of(frame))
    assert ground_of(replace(frame, takeoff_m=500.0)) == 500.0
    assert ground_of(replace(frame, vertical_datum="takeoff")) == 0.0


@pytest.mark.parametrize("known", [[4], list(range(24))])
def test_one_position_or_all_the_same(known):
    """The scale comes from the heights, the direction from the yaws, the place from what there
    is.
    """
    a, t, links, solution = solved(8)
    position = np.full(len(a), np.nan, complex)
    position[known] = 1000 + 2000j
    found, _, metric = georeference(
        solution, links, priors_at(position, yaw=-np.degrees(np.angle(a)), z=60.0)
    )
    assert metric
    shape_a, shape_t = found.a / a, found.t
    assert np.abs(shape_a).mean() == pytest.approx(1, abs=0.02)
    assert np.degrees(np.abs(np.angle(shape_a))).max() < 1.0
    if known == [4]:
        assert shape_t[4] == pytest.approx(1000 + 2000j, abs=1e-3)
        assert np.abs((shape_t - shape_t[4]) - (t - t[4])).max() < 2.0
    else:
        # torn between links and positions that deny them, the block keeps its shape
        assert np.abs(np.mean(shape_t) - (1000 + 2000j)) < 10
        assert 0.95 < np.std(shape_t) / np.std(t) < 1.05


def test_positions_straighten_a_strip_that_links_bend():
    """Forty photos whose links all turn a little: tied to positions, the ends come a third nearer
    at once.
    """
    n, rng = 40, np.random.default_rng(9)
    a, t = 60 * np.ones(n, complex), 15j * np.arange(n) + 0
    links = []
    for i in range(n):
        for j in range(i + 1, min(i + 4, n)):
            k = link(a, t, i, j, rng)
            links.append(
                PlaneLink(
                    a=i,
                    b=j,
                    b_S_a=k.b_S_a * np.exp(0.003j * (j - i)),
                    p_a=k.p_a,
                    p_b=k.p_b,
                    weight=100.0,
                )
            )
    solution = solve_block(np.arange(n), links)
    position = t + rng.normal(0, 1.5, n) + 1j * rng.normal(0, 1.5, n)
    g, c, _ = fit_similarity(solution.t, position, np.full(n, 1.5))
    bent = g * solution.t + c
    found, _, _ = georeference(solution, links, priors_at(position))
    assert np.abs(bent - t).max() > 6
    assert np.abs(found.t - t).max() < 0.75 * np.abs(bent - t).max()


def test_tying_to_exact_positions_of_an_exact_block_changes_nothing():
    a, t, links, solution = solved(10)
    g = a[0] / solution.a[0]
    exact = replace(solution, a=solution.a * g, t=solution.t * g + t[0])
    again = tie_to_positions(exact, links, t, np.full(len(t), 1.5))
    assert again.t == pytest.approx(t, abs=1e-5)
    assert (again.a == exact.a).all()


def test_a_similarity_of_many_positions_needs_no_list_of_all_pairs():
    rng = np.random.default_rng(5)
    x = rng.normal(0, 500, 6000) + 1j * rng.normal(0, 500, 6000)
    g, c = 2 * np.exp(0.3j), 40 - 7j
    y = g * x + c + rng.normal(0, 1, 6000) + 1j * rng.normal(0, 1, 6000)
    y[rng.random(6000) < 0.4] += 700
    tracemalloc.start()
    found = fit_similarity(x, y, np.ones(6000))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert abs(found[0] - g) < 1e-3 and abs(found[1] - c) < 0.2
    assert most < 150e6  # all pairs take 800 MB
