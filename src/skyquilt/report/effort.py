"""Section: where the time went."""

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import mapping, number, seconds
from skyquilt.report.parts import Figure, Missing, Section
from skyquilt.report.svg import drawing, rect, text

WIDE, ROW, LEFT = 760.0, 28.0, 150.0


def time_section(data: ReportInput) -> Section:
    """A bar per stage in execution order."""
    told = mapping(data.metrics.get("seconds"))
    stages = {str(k): s for k, v in told.items() if k != "total" and (s := number(v)) is not None}
    if not stages:
        why = "The time per stage was not recorded."
        return Section(id="time", title="Time per stage", blocks=(Missing(why=why),))
    longest, whole = (
        max(stages.values()) or 1.0,
        number(told.get("total")) or sum(stages.values()) or 1.0,
    )
    parts = []
    for k, (name, value) in enumerate(stages.items()):
        y, width = k * ROW, max(0.0, value / longest * (WIDE - LEFT - 150))
        parts += [
            text(LEFT - 10, y + 18, name, "label end"),
            rect(LEFT, y + 5, max(width, 1), ROW - 10, "bar"),
            text(
                LEFT + max(width, 1) + 8, y + 18, f"{seconds(value)}  ({value / whole:.0%})", "tick"
            ),
        ]
    title = "Time per stage"
    rest = whole - sum(stages.values())
    caption = f"{seconds(whole)} in all." + (
        f" {seconds(rest)} between the stages." if rest > 0.05 * whole else ""
    )
    figure = Figure(
        svg=drawing(parts, title, WIDE, len(stages) * ROW), title=title, caption=caption, wide=True
    )
    return Section(id="time", title=title, blocks=(figure,))
