"""Photos of one place: a hover, an exposure bracket, copies of a photo.

They show the same points in the same directions, so errors of lens and matching repeat in all of
them. What k of them tell of a point counts as one observation of it.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import Problem, State
from skyquilt.geometry.neighbours import pairs_within

Array = NDArray[np.float64]
NEAR = 0.02
"""Centres nearer to one another than this share of the height above ground are of one place: a
drone that hovers drifts by so much, and one that maps flies ten times as far between photos.
"""
ALIGNED = np.cos(np.radians(3.0))
"""Cosine of the largest angle between their cameras' axes: turned photos tell of the lens."""


def places(problem: Problem, state: State, height_m: float) -> NDArray[np.int64]:
    """Number (n,) of the place of each photo: that of the first photo of the same camera that was
    taken there in the same direction. `height_m`: usual height above ground.
    """
    reach = NEAR * height_m
    a, b = pairs_within(state.C[:, :2], reach)
    near = np.linalg.norm(state.C[a] - state.C[b], axis=1) < reach
    near &= problem.camera[a] == problem.camera[b]
    near &= ((state.R[a] * state.R[b]).sum(2) > ALIGNED).all(1)
    place = np.arange(len(state.C))
    for i, j in zip(a[near].tolist(), b[near].tolist(), strict=True):  # in order of i, then j
        if place[i] == i and place[j] == j:
            place[j] = i
    return place


def shares(problem: Problem, state: State, height_m: float) -> Array | float:
    """What each observation (N,) counts for beside those of the same point by photos of the same
    place: 1/k of k; 1 where all photos are of different places. `height_m`: usual height above
    ground.
    """
    place = places(problem, state, height_m)
    if (place == np.arange(len(place))).all():
        return 1.0
    seen = problem.point.astype(np.int64) * len(place) + place[problem.photo]
    _, which, count = np.unique(seen, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / count[which])
