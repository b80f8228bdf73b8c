"""Known distances on the ground: a CSV with the header `point_a,point_b,metres`.

The observations of the points are given in one of three ways: by further columns
`px_a,py_a,image_a,px_b,py_b,image_b`, several rows for several observations; by writing a point as
`px py image`; or by the names of points in gcp_list.txt. Pixels have their centres at integers, as
in gcp_list.txt.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.model.photo import ControlPoint, KnownDistance, PointObservation
from skyquilt.outside import plain
from skyquilt.photos.side_rows import (
    PhotoNames,
    finite,
    number,
    read_lines,
    read_table,
    sentence_of,
)

_ENDS = ("a", "b")
_NEEDED = ("point_a", "point_b", "metres")


def read_distances(
    path: Path, photo_names: Iterable[str], control: Sequence[ControlPoint] = ()
) -> tuple[KnownDistance, ...]:
    """Distances between points seen in the photos of a survey.

    Raises:
        SideFileError: the header, a number or a point is wrong, or a photo named is not in the
            survey.
    """
    rows = _rows(path)
    names, known = PhotoNames(photo_names), {c.name: c.observations for c in control}
    observations: dict[str, dict[tuple[str, float, float], PointObservation]] = {}
    lengths: dict[tuple[str, str], float] = {}
    strangers: list[str] = []
    for place, row in rows:
        ends = tuple(_label(row[f"point_{e}"]) for e in _ENDS)
        metres = finite(number(row["metres"]))
        if metres is None or not 0 < metres <= 1e6:
            raise SideFileError(
                f"{place}: expected a length in m above 0, found '{plain(row['metres'], 60)}'."
                " Correct that cell."
            )
        if lengths.setdefault((ends[0], ends[1]), metres) != metres:
            raise SideFileError(
                f"{place}: {ends[0]} to {ends[1]} has two different lengths. Correct one of the"
                " rows."
            )
        for end, label in zip(_ENDS, ends, strict=True):
            for seen in _observations(row, end, label, known, place):
                photo = names.find(seen.photo)
                if photo is None:
                    strangers.append(seen.photo)
                else:
                    observations.setdefault(label, {})[photo, seen.x, seen.y] = PointObservation(
                        photo=photo, x=seen.x, y=seen.y
                    )
    if strangers:
        raise SideFileError(
            f"{path.name} names {sentence_of(sorted(set(strangers)))}; no photo of the survey is"
            " called that."
            " Correct the image names or remove the rows."
        )
    return tuple(
        KnownDistance(
            a=a,
            b=b,
            metres=metres,
            observations_a=tuple(observations[a].values()),
            observations_b=tuple(observations[b].values()),
        )
        for (a, b), metres in lengths.items()
    )


def _rows(path: Path) -> list[tuple[str, Mapping[str, str]]]:
    """Rows by column name, each with its position in the file for messages."""
    lines = read_lines(path)
    table = read_table([line for _, line in lines], file=path.name)
    header = [re.sub(r"[\s(\[].*", "", cell.strip().lower()) for cell in table[0]] if table else []
    missing = [c for c in _NEEDED if c not in header]
    if missing or len(table) < 2:
        raise SideFileError(
            f"{path.name}: expected a header with {', '.join(_NEEDED)} and one line per distance,"
            f" found '{plain(', '.join(header), 200)}' and {max(0, len(table) - 1)} lines. See the"
            " documentation of --distances."
        )
    cells = (
        (f"{path.name}, line {i}", row) for (i, _), row in zip(lines[1:], table[1:], strict=True)
    )
    return [
        (place, dict(zip(header, [*row, *[""] * len(header)], strict=False)))
        for place, row in cells
    ]


def _label(text: str) -> str:
    return " ".join(text.split())


def _observations(
    row: Mapping[str, str],
    end: str,
    label: str,
    known: Mapping[str, Sequence[PointObservation]],
    place: str,
) -> Sequence[PointObservation]:
    """The observations of one end that a row gives."""
    words = [row.get(f"{c}_{end}", "").strip() for c in ("px", "py", "image")]
    if not any(words):
        if known.get(label):
            return known[label]
        words = [*label.split(maxsplit=2), "", "", ""][:3]
    x, y = finite(number(words[0])), finite(number(words[1]))
    if x is None or y is None or not words[2]:
        raise SideFileError(
            f"{place}: there is no observation of point '{plain(label, 80)}'; add columns px_{end},"
            f" py_{end}, image_{end}, or name a point of gcp_list.txt"
        )
    return (PointObservation(photo=words[2], x=x, y=y),)
