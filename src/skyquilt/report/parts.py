"""What a page consists of, and how values are written.

`page.html.j2` draws each kind of part and escapes every string that is not `Markup`.
"""

from dataclasses import dataclass
from typing import Literal

from markupsafe import Markup

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import fixed, mapping, plain

Verdict = Literal["good", "fair", "poor", "plain"]
"""How a figure is to be taken; `plain` judges nothing."""


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
    """Whether this is good."""
    says: str
    """One sentence: what it means and where good ends."""
    anchor: str = ""
    """Id of the section that shows more."""


@dataclass(frozen=True, kw_only=True)
class LegendItem:
    """A colour and what it stands for."""

    colour: str
    """Any CSS colour."""
    text: str
    """Its meaning."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A drawing with its caption."""

    svg: Markup
    """The drawing."""
    title: str
    """What is shown; also read out by screen readers."""
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
    """Cells, as many in each row as in the head."""
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
    """A part that is not there."""

    why: str
    """One sentence."""
    kind: Literal["missing"] = "missing"


Block = Figure | Table | Sentences | Missing


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading and what stands below it."""

    id: str
    """Anchor."""
    title: str
    """Heading."""
    lead: str = ""
    """One or two sentences."""
    blocks: tuple[Block, ...]
    """In order."""
    folded: bool = False
    """Collapsed until asked for."""


UNITS = {"celsius": "\u00b0C", "counts": "counts"}
"""Units as people write them."""


def values_section(data: ReportInput) -> tuple[Section, ...]:
    """What measured values mean and whether frames were brought to one level; nothing for
    pictures.
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
    table = Table(title="Measured values", head=("what", "figure"), rows=tuple(rows), numeric="tt")
    return (Section(id="values", title="Measured values", blocks=(table,)),)
