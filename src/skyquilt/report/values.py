"""Section: what measured values mean, and whether frames were brought to one level."""

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import fixed, mapping, plain
from skyquilt.report.parts import Section, Table

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
