"""The parts of a page, and units and values as text.

`page.html.j2` draws each kind of part and escapes every string that is not `Markup`.
"""

from dataclasses import dataclass
from typing import Literal

from markupsafe import Markup

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import fixed, mapping, plain

Verdict = Literal["good", "fair", "poor", "plain"]
"""How good a figure is; `plain` means no verdict."""


@dataclass(frozen=True, kw_only=True)
class Tile:
    """A headline figure."""

    label: str
    """What it is."""
    value: str
    """The figure."""
    unit: str = ""
    """Its unit."""
    verdict: Verdict = "plain"
    """Verdict on the figure."""
    says: str
    """One sentence: what it means and its thresholds."""
    anchor: str = ""
    """Id of the section that shows more."""


@dataclass(frozen=True, kw_only=True)
class LegendItem:
    """A colour and what it stands for."""

    colour: str
    """A CSS colour."""
    text: str
    """Its meaning."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A drawing with its caption."""

    svg: Markup
    """The drawing."""
    title: str
    """What is shown; also read by screen readers."""
    caption: str
    """How to read it."""
    legend: tuple[LegendItem, ...] = ()
    """Colours below the drawing."""
    wide: bool = False
    """Takes the whole width."""
    kind: Literal["figure"] = "figure"


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of strings."""

    title: str
    """Caption of the table."""
    head: tuple[str, ...]
    """Column titles."""
    rows: tuple[tuple[str, ...], ...]
    """Cells, as many in each row as column titles."""
    numeric: str
    """One letter per column: `n` for numbers, `t` for text, `c` for names in code style."""
    note: str = ""
    """A sentence below."""
    wide: bool = True
    """Takes the whole width."""
    kind: Literal["table"] = "table"


@dataclass(frozen=True, kw_only=True)
class Sentences:
    """Plain sentences, one item each."""

    items: tuple[str, ...]
    """The sentences."""
    kind: Literal["sentences"] = "sentences"


@dataclass(frozen=True, kw_only=True)
class Missing:
    """Stands for a part that has no data."""

    why: str
    """The reason, one sentence."""
    kind: Literal["missing"] = "missing"


Block = Figure | Table | Sentences | Missing


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading and the content below it."""

    id: str
    """Anchor."""
    title: str
    """Heading."""
    lead: str = ""
    """One or two sentences."""
    blocks: tuple[Block, ...]
    """The content, in order."""
    folded: bool = False
    """Collapsed until the reader opens it."""


UNITS = {"celsius": "\u00b0C", "counts": "counts"}
"""Units as printed."""


def values_section(data: ReportInput) -> tuple[Section, ...]:
    """Meaning of measured values, and whether the frames were balanced; nothing for colour
    images.
    """
    told = mapping(data.metrics.get("thermal_values"))
    if not told:
        return ()
    unit = UNITS.get(str(told.get("unit")), plain(told.get("unit")))
    rows = [
        ("unit", unit),
        ("drift balanced", "yes" if told.get("balanced") else "no"),
        ("why", plain(told.get("why"))),
    ]
    if told.get("balanced"):
        rows += [
            (f"offsets of the frames, RMS, {unit}", fixed(told.get("offset_rms"), 3)),
            (f"largest offset, {unit}", fixed(told.get("offset_largest"), 3)),
        ]
    if told.get("pattern_largest"):
        taken = fixed(told.get("pattern_largest"), 3)
        rows.append((f"pattern of all frames taken off, from least to most, {unit}", taken))
    table = Table(title="Measured values", head=("what", "figure"), rows=tuple(rows), numeric="tt")
    return (Section(id="values", title="Measured values", blocks=(table,)),)
