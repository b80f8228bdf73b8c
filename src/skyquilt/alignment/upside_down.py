"""Files that another program turned upside down, told by the lens alone.

A viewer that turns a file by 180 degrees turns the image of the lens with it: its principal point
and its decentring lie on the other side. Where no heading is reported, nothing else tells. So the
files that a program rewrote are adjusted both ways, against the others of their camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import Adjusted, adjust
from skyquilt.alignment.problem import Problem, State
from skyquilt.alignment.setup import HALF_TURN, Setup, turned_px
from skyquilt.alignment.tracks import Tracks
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.photos.side_rows import sentence_of

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]
LEAST_GAIN = 10.0
"""Robust cost that turning files must save: it makes them more likely by a factor of 150."""
ASKED = 80
"""Rewritten photos of a large survey that are asked, and as many others of their camera."""
MANY = 4 * ASKED
"""All photos of smaller surveys are asked."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Unturned:
    """An adjustment with files that were turned upside down as their sensors saw them."""

    problem: Problem
    """Observations in sensor pixels."""
    state: State
    """The adjusted state."""
    setup: Setup
    """The setup, whose `turned` contains these files."""
    rows: Mask
    """(n,) photo rows of the files that were found to be turned."""

    def turned_tracks(self, tracks: Tracks) -> Tracks:
        """Tracks in the sensor pixels of before, in those of this setup."""
        mine = np.isin(tracks.photo, self.setup.members[self.rows])
        px = turned_px(tracks.px, mine, self.setup.size[tracks.photo])
        return replace(tracks, px=px.astype(tracks.px.dtype, copy=False))


def upside_down(problem: Problem, state: State, setup: Setup, keep: Keep = MADE_NOW) -> Unturned:
    """Finds the files that were turned, among those that report no heading: all that one program
    rewrote of a camera's photos, or none of them; the clearest first, since it hides others.
    """
    rows = np.zeros(len(setup.members), bool)
    groups = list(_rewritten(setup))
    while groups:
        part = keep.within(str(len(groups)))
        gains = [
            part(f"gain {k}", lambda: _gain_turned(problem, state, setup, group))  # noqa: B023 - called at once
            for k, group in enumerate(groups)
        ]
        if max(gains) < LEAST_GAIN:
            break
        found = np.isin(np.arange(len(rows)), groups.pop(int(np.argmax(gains))))
        problem, state = _turned(problem, state, found, setup.size[setup.members])
        state = _adjusted(problem, state, part).state
        setup, rows = _turned_setup(setup, found), rows | found
    return Unturned(problem=problem, state=state, setup=setup, rows=rows)


def turned_note(names: Sequence[str]) -> str:
    """A sentence on the files that only the lens shows to be turned."""
    files = "1 file was" if len(names) == 1 else f"{len(names)} files were"
    return (
        f"{files} turned upside down by another program, as the lens shows: {sentence_of(names)}."
        " They are used as the camera took them."
    )


def _rewritten(setup: Setup) -> Iterator[Rows]:
    """Rows of the photos without a heading that another program rewrote, by camera and program;
    without the camera's other photos, nothing tells how its lens lies.
    """
    groups: dict[tuple[int, str], list[int]] = {}
    for row, (camera, program) in enumerate(
        zip(setup.camera.tolist(), setup.rewritten, strict=True)
    ):
        if program:
            groups.setdefault((camera, program), []).append(row)
    number = np.bincount(setup.camera)
    for (camera, _), rows in groups.items():
        if len(rows) < number[camera]:
            yield np.array(rows)


def _gain_turned(problem: Problem, state: State, setup: Setup, rows: Rows) -> float:
    """The cost that is saved where these files are taken as turned."""
    asked = _asked(rows, setup, state)
    size, mine = setup.size[setup.members[asked]], np.isin(asked, rows)
    if len(asked) < len(setup.members):
        problem, state = problem.among(asked, state)
    turned = _adjusted(*_turned(problem, state, mine, size))
    return _adjusted(problem, state).cost - turned.cost


def _asked(rows: Rows, setup: Setup, state: State) -> Rows:
    """The rows that tell whether some were turned: of a large survey, some of these and others of
    their camera, around one place.
    """
    if len(setup.members) <= MANY:
        return np.arange(len(setup.members))
    others = np.setdiff1d(np.flatnonzero(setup.camera == setup.camera[rows[0]]), rows)
    place = state.C[rows[len(rows) // 2], :2]
    nearest = []
    for some in (rows, others):
        apart = np.linalg.norm(state.C[some, :2] - place, axis=1)
        nearest.append(some[np.argsort(apart, kind="stable")[:ASKED]])
    return np.sort(np.concatenate(nearest))


def _adjusted(problem: Problem, state: State, keep: Keep = MADE_NOW) -> Adjusted:
    """The adjustment under the loss of the last stage."""
    narrow = problem.with_loss(2.0)
    return adjust(narrow, state, iterations=20, tolerance=3e-4, damping=1e-6, keep=keep)


def _turned(
    problem: Problem, state: State, rows: Mask, size: NDArray[Any]
) -> tuple[Problem, State]:
    """The same problem and state with these rows' (n,) photos, of a size (n, 2), turned."""
    half = np.where(rows[:, None, None], HALF_TURN, np.eye(3))
    px = turned_px(problem.px, rows[problem.photo], size[problem.photo])
    px = px.astype(problem.px.dtype, copy=False)
    return replace(problem, px=px, R0=half @ problem.R0), replace(state, R=half @ state.R)


def _turned_setup(setup: Setup, rows: Mask) -> Setup:
    """The same setup for these rows' files turned."""
    turned = setup.turned.copy()
    turned[setup.members[rows]] = True
    half = np.where(rows[:, None, None], HALF_TURN, np.eye(3))
    base = replace(setup.base, R0=half @ setup.base.R0)
    return replace(setup, turned=turned, base=base, start_R=half @ setup.start_R)
