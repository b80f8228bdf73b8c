"""Connected components and spanning trees of small and of large graphs, without SciPy, which takes
half a second to load.
"""

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]


def connected(count: int, a: NDArray[Any], b: NDArray[Any]) -> Index:
    """Component (count,) of each node of a graph with edges a-b, numbered in order of their first
    nodes.

    Each node takes the smallest label among its neighbours; each round then follows the labels to
    their roots (Shiloach and Vishkin 1982).
    """
    label = np.arange(count)
    while (label[a] != label[b]).any():
        least = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], least)
        np.minimum.at(label, label[b], least)
        while (label[label] != label).any():
            label = label[label]
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64)


def spanning_tree(count: int, a: NDArray[Any], b: NDArray[Any], cost: NDArray[Any]) -> list[int]:
    """The edges (their indices) of the cheapest tree, or forest, that spans the nodes (Kruskal
    1956).
    """
    parent = list(range(count))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = node = parent[parent[node]]
        return node

    tree = []
    for edge in np.argsort(cost, kind="stable").tolist():
        i, j = root(int(a[edge])), root(int(b[edge]))
        if i != j:
            parent[i] = j
            tree.append(edge)
    return tree


def outwards(
    count: int, a: NDArray[Any], b: NDArray[Any], edges: list[int]
) -> Iterator[tuple[int, int]]:
    """(parent, node) of a tree's nodes, breadth first from node 0."""
    beside: list[list[int]] = [[] for _ in range(count)]
    for edge in edges:
        i, j = int(a[edge]), int(b[edge])
        beside[i].append(j)
        beside[j].append(i)
    waiting, reached = deque([0]), {0}
    while waiting:
        parent = waiting.popleft()
        for node in beside[parent]:
            if node not in reached:
                reached.add(node)
                waiting.append(node)
                yield parent, node
