"""The report page of one registration."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report.images import jpeg_uri
from skyquilt.report.numbers import DASH, fixed, plain, seconds
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Figure, Section, Sentences, Table, Tile

_CAPTIONS = (
    ("Side by side", "Both images unchanged; lines join places that were matched independently."),
    (
        "Checkerboard",
        "A and B alternate: in a right registration, structures continue across the edges.",
    ),
    ("False colour", "A in green, B in magenta: fringes show where edges do not coincide."),
    ("B over A", "B in warm colours, half transparent."),
    (
        "Error",
        "How far the registration may be off (95 %), over A: blue is none, red the tolerance; a"
        " line at each quarter of it. The error grows away from the patches that agree.",
    ),
)
_EVIDENCE = {
    "surprise": "agreement of independent patches, -log10 of its probability by chance",
    "patches": "patches that could be tested",
    "patches_agreeing": "of these, patches that independently find the same position",
    "correlation": "correlation of edge orientations over the overlap",
    "matches": "matches",
}


def registration_page(record: Mapping[str, Any], pictures: Sequence[NDArray[np.uint8]]) -> str:
    """The page from the record in registration.json and RGB images: four for an accepted
    registration, a fifth if its error is stated; one for a refused one.
    """
    sections = (
        [Section(id="pictures", title="Pictures", blocks=tuple(_figures(pictures)))]
        if pictures
        else []
    )
    sections.append(Section(id="transform", title="Transform", blocks=_transform(record)))
    sections.append(Section(id="evidence", title="Evidence", blocks=(_evidence(record),)))
    return plain_page(
        title=f"{_name(record['b'])} on {_name(record['a'])}",
        summary=_summary(record),
        version=str(record["version"]),
        source="The figures behind this page are in registration.json.",
        sections=tuple(sections),
        tiles=_tiles(record),
    )


def picture(rgb: NDArray[np.uint8], title: str, caption: str) -> Figure:
    """An image (H, W, 3) as a figure embedded in the page."""
    opaque = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    image = Markup('<img src="{}" alt="{}">').format(Markup(jpeg_uri(opaque)), title)
    return Figure(svg=image, title=title, caption=caption, wide=True)


def _figures(pictures: Sequence[NDArray[np.uint8]]) -> list[Figure]:
    if len(pictures) == 1:
        return [
            picture(pictures[0], "Side by side", "Both images unchanged; there is no registration.")
        ]
    return [picture(p, *words) for p, words in zip(pictures, _CAPTIONS, strict=False)]


def _summary(record: Mapping[str, Any]) -> str:
    if not record["accepted"]:
        return f"Refused: {record['reason']}."
    words = f"Accepted: method {record['method']}, {record['model']}, {record['inliers']} inliers."
    return f"{words} {record['reason']}".strip()


def _tiles(record: Mapping[str, Any]) -> tuple[Tile, ...]:
    accepted = bool(record["accepted"])
    return (
        Tile(
            label="Verdict",
            value="accepted" if accepted else "refused",
            verdict="good" if accepted else "poor",
            says="Whether the registration is accepted; the evidence below gives the reasons.",
        ),
        Tile(
            label="Inliers", value=plain(record["inliers"]), says="Features or patches that agree."
        ),
        Tile(
            label="Q",
            value=fixed(record["q"], 2),
            says="Spread of the inliers over A: 1 is everywhere.",
        ),
        Tile(
            label="Residual",
            value=fixed(record["residual_px"], 2),
            unit="px",
            says="RMS distance in B between inliers and their transformed positions.",
        ),
        Tile(
            label="Error",
            value=fixed(record["error_px"], 1),
            unit="px",
            says="Distance in B within which every corner of the picture is right with 95 %;"
            f" {fixed(record['tolerance_px'], 1)} px are tolerated.",
        ),
        Tile(
            label="Time", value=seconds(record["cpu_seconds"]), says="CPU time of the registration."
        ),
    )


def _transform(record: Mapping[str, Any]) -> tuple[Table | Sentences, ...]:
    if record["b_H_a"] is None:
        return (Sentences(items=("There is none, since the registration was refused.",)),)
    m = np.array(record["b_H_a"])
    rows = tuple(tuple(f"{value:.9g}" for value in row) for row in m)
    scale = float(np.sqrt(abs(np.linalg.det(m[:2, :2]))))
    turn = float(np.degrees(np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1])))
    said = (
        "From pixels of A (x right, y down, centres at integers) to pixels of B; a"
        f" {record['model']}.",
        "It mirrors: rows of one of the files run from south to north."
        if np.linalg.det(m[:2, :2]) < 0
        else f"Scale {fixed(scale, 4)}, rotation {fixed(turn, 2)} degrees clockwise.",
        f"Guess from {record['guess']}." if record["guess"] else "There was no guess.",
        *_beside(record),
    )
    return Sentences(items=said), Table(
        title="b_H_a", head=("", "", ""), rows=rows, numeric="nnn", wide=False
    )


def _beside(record: Mapping[str, Any]) -> tuple[str, ...]:
    """What the place of B in its own file is worth."""
    off = record.get("beside_m")
    return () if off is None else (f"By its own file, the middle of B lies {off:.1f} m beside.",)


def _evidence(record: Mapping[str, Any]) -> Table | Sentences:
    found = record["evidence"]
    if not found:
        return Sentences(items=(record["reason"] or DASH,))
    rows = tuple((_EVIDENCE.get(k, k.replace("_", " ")), plain(v)) for k, v in found.items())
    return Table(
        title="Evidence for the decision", head=("what", "figure"), rows=rows, numeric="tn"
    )


def _name(path: str) -> str:
    return path.replace("\\", "/").rsplit("/", 1)[-1]
