"""Components and spanning trees against SciPy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from skyquilt.alignment.tracks import connected, outwards, spanning_tree

graphs = st.tuples(st.integers(0, 10**6), st.integers(1, 60), st.integers(0, 120))


def edges(seed, count, number):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, count, (2, number))
    pairs = sorted(
        {(min(i, j), max(i, j)) for i, j in zip(a.tolist(), b.tolist(), strict=True) if i != j}
    )
    a, b = np.array(pairs, int).reshape(-1, 2).T
    cost = rng.uniform(1, 2, len(a))
    return a, b, cost, sparse.coo_matrix((cost, (a, b)), (count, count)).tocsr()


@settings(max_examples=150, deadline=None)
@given(graphs)
def test_components_are_scipys_in_number_and_order(graph):
    a, b, _, matrix = edges(*graph)
    label = connected(graph[1], a, b)
    assert label.tolist() == connected_components(matrix, directed=False)[1].tolist()


def test_a_long_chain_is_one_component():
    order = np.random.default_rng(1).permutation(5000)
    assert not connected(5000, order[:-1], order[1:]).any()


@settings(max_examples=150, deadline=None)
@given(graphs)
def test_tree_is_scipys(graph):
    a, b, cost, matrix = edges(*graph)
    tree = spanning_tree(graph[1], a, b, cost)
    i, j = minimum_spanning_tree(matrix).nonzero()
    assert {(a[e], b[e]) for e in tree} == {(min(p), max(p)) for p in zip(i, j, strict=True)}
    walked = list(outwards(graph[1], a, b, tree))
    order, parent = breadth_first_order(minimum_spanning_tree(matrix), 0, directed=False)
    assert {node: p for p, node in walked} == {int(n): int(parent[n]) for n in order[1:]}
    reached = {0}
    for p, node in walked:
        assert p in reached
        reached.add(node)
