"""The page of one registration."""

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
    (
        "Side by side",
        "Both pictures as they are; lines join places that were found in both by themselves.",
    ),
    ("Checkerboard", "A and B by turns: what runs on across the squares' edges is registered."),
    ("False colour", "A in green, B in magenta: fringes show where edges part."),
    ("B over A", "B in warm colours, half transparent."),
)
_EVIDENCE = {
    "surprise": "agreement of independent patches, -log10 of what chance would give",
    "patches": "patches that could be asked",
    "patches_agreeing": "of them, those that find the same place by themselves",
    "correlation": "correlation of edge orientations over the overlap",
    "matches": "matches",
}


def registration_page(record: Mapping[str, Any], pictures: Sequence[NDArray[np.uint8]]) -> str:
    """The page from what registration.json says and RGB pictures: four of an accepted one, one of a
    refused.
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
    """A picture (H, W, 3) as a figure, inside the page."""
    opaque = np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])
    image = Markup('<img src="{}" alt="{}">').format(Markup(jpeg_uri(opaque)), title)
    return Figure(svg=image, title=title, caption=caption, wide=True)


def _figures(pictures: Sequence[NDArray[np.uint8]]) -> list[Figure]:
    if len(pictures) == 1:
        return [
            picture(
                pictures[0],
                "Side by side",
                "Both pictures as they are; nothing was laid on anything.",
            )
        ]
    return [picture(p, *words) for p, words in zip(pictures, _CAPTIONS, strict=True)]


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
            says="Whether the registration is believed; the evidence below says why.",
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
            says="RMS distance in B between inliers and the transform.",
        ),
        Tile(
            label="Time", value=seconds(record["cpu_seconds"]), says="CPU time of the registration."
        ),
    )


def _transform(record: Mapping[str, Any]) -> tuple[Table | Sentences, ...]:
    if record["b_H_a"] is None:
        return (Sentences(items=("There is none: a wrong one would be worse.",)),)
    m = np.array(record["b_H_a"])
    rows = tuple(tuple(f"{value:.9g}" for value in row) for row in m)
    scale = float(np.sqrt(abs(np.linalg.det(m[:2, :2]))))
    turn = float(np.degrees(np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1])))
    said = (
        "Takes pixels of A (x right, y down, centres at integers) to pixels of B; a"
        f" {record['model']}.",
        f"Scale {fixed(scale, 4)}, rotation {fixed(turn, 2)} degrees clockwise.",
        f"Known beforehand from {record['guess']}."
        if record["guess"]
        else "Nothing was known beforehand.",
    )
    return Sentences(items=said), Table(
        title="b_H_a", head=("", "", ""), rows=rows, numeric="nnn", wide=False
    )


def _evidence(record: Mapping[str, Any]) -> Table | Sentences:
    found = record["evidence"]
    if not found:
        return Sentences(items=(record["reason"] or DASH,))
    rows = tuple((_EVIDENCE.get(k, k.replace("_", " ")), plain(v)) for k, v in found.items())
    return Table(title="What acceptance rests on", head=("what", "figure"), rows=rows, numeric="tn")


def _name(path: str) -> str:
    return path.replace("\\", "/").rsplit("/", 1)[-1]
