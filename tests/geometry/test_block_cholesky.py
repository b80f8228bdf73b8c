"""The factor of a matrix of blocks against dense linear algebra."""

import resource

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from skyquilt.geometry import block_cholesky
from skyquilt.geometry.block_cholesky import Factor, Matrix, distinct, pattern
from skyquilt.geometry.set_aside import SetAside
from tests.alignment.blocks import dense_matrix


def matrix(places, pairs, *, size=3, border=2, seed=0):
    """A positive definite matrix of blocks coupled along the pairs."""
    rng = np.random.default_rng(seed)
    a, b = (np.array([p[k] for p in pairs], np.int64) for k in (0, 1))
    pat = pattern(np.asarray(places, float), size, border, a, b)
    blocks = rng.normal(0, 0.3, (len(pat.first), size, size))
    own = pat.first == pat.second
    degree = np.bincount(pat.first, minlength=pat.count) + np.bincount(pat.second)
    heavy = np.eye(size) * (1 + size * degree.max())
    blocks[own] = blocks[own] @ np.swapaxes(blocks[own], 1, 2) + heavy
    return Matrix(
        pattern=pat,
        blocks=blocks,
        beside=rng.normal(0, 0.1, (pat.count, size, border)),
        corner=np.eye(border) * (1 + pat.count),
    )


def check(m, *, rel=1e-9):
    dense = dense_matrix(m)
    factor = Factor(m)
    rhs = np.random.default_rng(1).normal(0, 1, (len(dense), 2))
    assert factor.solve(rhs) == pytest.approx(np.linalg.solve(dense, rhs), rel=rel, abs=1e-12)
    assert factor.solve(rhs[:, 0]) == pytest.approx(factor.solve(rhs)[:, 0])
    inverse, found = np.linalg.inv(dense), factor.selected_inverse()
    p = m.pattern.size
    for a, b, block in zip(m.pattern.first, m.pattern.second, found.blocks, strict=True):
        expected = inverse[a * p : a * p + p, b * p : b * p + p]
        assert block == pytest.approx(expected, rel=rel, abs=1e-12)
    photos = m.pattern.count * p
    assert found.beside.reshape(photos, -1) == pytest.approx(
        inverse[:photos, photos:], rel=rel, abs=1e-12
    )
    assert found.corner == pytest.approx(inverse[photos:, photos:], rel=rel, abs=1e-12)


def grid(across, along, reach):
    places = [(x, y) for y in range(along) for x in range(across)]
    pairs = [
        (i, j)
        for i, (x, y) in enumerate(places)
        for j, (u, v) in enumerate(places)
        if i < j and max(abs(x - u), abs(y - v)) <= reach
    ]
    return places, pairs


@pytest.mark.parametrize("plain", [True, False])  # solved by NumPy, and by SciPy
@pytest.mark.parametrize(("across", "along", "reach"), [(12, 12, 1), (40, 3, 2), (12, 6, 2)])
def test_a_grid_is_solved_and_inverted_as_dense_algebra_does(
    monkeypatch, across, along, reach, plain
):
    monkeypatch.setattr(block_cholesky, "LEAF", 8)
    monkeypatch.setattr(block_cholesky, "SMALL", 10_000 if plain else 0)
    m = matrix(*grid(across, along, reach))
    assert len(m.pattern.fronts) > 1
    check(m)


def test_every_block_is_eliminated_once_and_fronts_stay_small():
    """30 x 30 photos that reach 2 neighbours: fronts hold a line or two, not the survey."""
    places, pairs = grid(30, 30, 2)
    m = matrix(places, pairs, size=6, border=10)
    own = np.concatenate([f.own for f in m.pattern.fronts])
    assert sorted(own.tolist()) == list(range(900))
    assert max(len(f.unknowns) for f in m.pattern.fronts) < 6 * 900 / 6


@hypothesis_settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 30),
    st.lists(st.tuples(st.integers(0, 29), st.integers(0, 29)), max_size=60),
    st.integers(0, 3),
    st.integers(0, 10_000),
)
def test_any_graph_is_factored(count, ends, border, seed):
    """Whatever is coupled with what, also in parts without any link and all in one place."""
    pairs = [(a % count, b % count) for a, b in ends]
    places = np.random.default_rng(seed).integers(0, 4, (count, 2))
    before = block_cholesky.LEAF
    block_cholesky.LEAF = 3
    try:
        check(matrix(places, pairs, border=border, seed=seed), rel=1e-7)
    finally:
        block_cholesky.LEAF = before


@given(st.lists(st.integers(0, 40)))
def test_different_numbers_are_numpys(numbers):
    values = np.array(numbers, np.int64)
    assert distinct(values).tolist() == np.unique(values).tolist()


def test_what_is_not_positive_definite_is_refused():
    m = matrix(*grid(5, 4, 1))
    m.blocks[:] *= -1
    with pytest.raises(np.linalg.LinAlgError):
        Factor(m)


def test_a_factor_in_a_file_is_the_one_in_memory(monkeypatch):
    m = matrix(*grid(14, 14, 2))
    rhs = np.random.default_rng(2).normal(0, 1, 14 * 14 * 3 + 2)
    held = Factor(m)
    b = held.selected_inverse()
    monkeypatch.setattr(block_cholesky, "HELD", 0)
    monkeypatch.setattr(block_cholesky, "WAITING", 0)
    aside, filed_parts = SetAside.__init__, []

    def counted(self, value, *, large):
        aside(self, value, large=large)
        filed_parts.append(self._value is None)

    monkeypatch.setattr(SetAside, "__init__", counted)
    filed = Factor(m)
    assert filed._parts._file is not None and not filed._parts._held
    assert np.array_equal(filed.solve(rhs), held.solve(rhs))
    a = filed.selected_inverse()
    assert sum(filed_parts) > len(m.pattern.fronts)  # of the factor and of its inverse
    assert np.array_equal(a.blocks, b.blocks) and np.array_equal(a.corner, b.corner)


@pytest.fixture
def most_bytes():
    """Sets how many bytes a file of this process may have, as a disk that fills up does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda n: resource.setrlimit(resource.RLIMIT_FSIZE, (n, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room", [0, 1, 0.3, 0.7, -1])
def test_a_factor_for_which_the_disk_is_too_full_stays_in_memory(monkeypatch, most_bytes, room):
    """`room`: bytes, or the share of the factor's; -1 = all but one byte."""
    m = matrix(*grid(14, 14, 2))
    rhs = np.ones(14 * 14 * 3 + 2)
    held = Factor(m)
    size = held._parts._starts[-1]
    monkeypatch.setattr(block_cholesky, "HELD", 0)
    most_bytes(size - 1 if room < 0 else int(room * size) if room < 1 else room)
    factor = Factor(m)
    assert factor._parts._file is None and len(factor._parts._held) == len(m.pattern.fronts) > 4
    assert np.array_equal(factor.solve(rhs), held.solve(rhs))
    most_bytes(size)
    filed = Factor(m)
    assert filed._parts._file is not None
    assert np.array_equal(filed.solve(rhs), held.solve(rhs))


def test_a_factor_without_a_folder_for_its_file_stays_in_memory(monkeypatch, tmp_path):
    m = matrix(*grid(14, 14, 2))
    rhs = np.ones(14 * 14 * 3 + 2)
    held = Factor(m).solve(rhs)
    monkeypatch.setattr(block_cholesky, "HELD", 0)
    monkeypatch.setattr(block_cholesky, "folder_on_disk", lambda: str(tmp_path / "none"))
    factor = Factor(m)
    assert factor._parts._file is None and len(factor._parts._held) == len(m.pattern.fronts)
    assert np.array_equal(factor.solve(rhs), held)


@pytest.mark.parametrize("border", [0, 2])
def test_the_product_is_that_of_the_dense_matrix(border):
    m = matrix(*grid(9, 7, 2), border=border)
    x = np.random.default_rng(3).normal(size=9 * 7 * 3 + border)
    assert m.times()(x) == pytest.approx(dense_matrix(m) @ x, rel=1e-12)


@pytest.mark.parametrize("heading", [20, pytest.param(45, marks=pytest.mark.slow)])
def test_lines_of_any_heading_are_divided_as_well(heading):
    """The work of factoring a survey does not depend on the direction of its flight lines."""
    places, pairs = grid(40, 40, 2)
    turn = np.radians(heading)
    turned = np.array(places) @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]

    def work(places):
        a, b = np.array(pairs).T
        fronts = pattern(np.asarray(places, float), 6, 10, a, b).fronts
        return sum(f.eliminated * len(f.unknowns) ** 2 for f in fronts)

    assert work(turned) < 1.25 * work(places)
