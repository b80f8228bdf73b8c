"""The report page of a comparison: mosaics side by side, Table 6.1 and the graphs of Fig. 6.4, A's
Tables 1 and 2.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.report.graphs import COLOURS, lines, picture
from skyquilt.report.numbers import DASH, fixed
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Block, Figure, LegendItem, Missing, Section, Table

Columns = Mapping[str, Mapping[str, Any]]
ORDER = ("position", "pose", "image", "hybrid")
"""The thesis's order of lambda_corr, ascending."""


def comparison_page(record: Mapping[str, Any], previews: Mapping[str, NDArray[Any]]) -> str:
    """The page from the record in compare.json and an image (h, w, 4) of each mosaic."""
    every: Columns = record["methods"]
    ran = {n: c for n, c in every.items() if "refused" not in c}
    sections = (
        Section(id="mosaics", title="Mosaics", blocks=_mosaics(ran, previews)),
        Section(id="quality", title="Quality", lead=_lead(record), blocks=_quality(ran)),
        Section(id="photos", title="Photo by photo", blocks=_graphs(ran)),
        Section(id="geolocation", title="Geolocation", blocks=(_geolocation(ran),)),
        Section(id="time", title="Time", blocks=(_time(ran, len(record["photos"])),)),
        Section(id="refused", title="Methods that refused", blocks=(_refused(every),)),
    )
    return plain_page(
        title=f"Methods compared: {record['title']}",
        version=str(record["version"]),
        sections=sections,
        summary=f"{len(record['photos'])} photos, {len(every)} ways to align them.",
        source="The figures behind this page are in compare.json; each method's own run lies in a"
        " folder of its name.",
    )


def _lead(record: Mapping[str, Any]) -> str:
    return f"Judged by {record['judged_by']}. {thesis_order(record['methods'])}"


def thesis_order(methods: Columns) -> str:
    """Sentences on whether the order found in the thesis is confirmed."""
    corr = {n: methods[n].get("lambda_corr") for n in ORDER if n in methods}
    known = {n: c for n, c in corr.items() if c is not None}
    if len(known) < len(ORDER):
        return "Not all four methods of the thesis's Table 6.1 have a result here."
    found = sorted(known, key=lambda n: known[n])
    told = " < ".join(f"{n} {known[n]:.3f}" for n in found)
    if tuple(found) == ORDER:
        return f"The thesis's order of the correlation reappears: {told}."
    return (
        f"The thesis found position < pose < image < hybrid in correlation; here it is {told}."
        " If image is better than"
        " hybrid, photos fit their neighbours better than a single height and the reported tilts"
        " allow: image deforms them"
        " freely, at the cost of wrong distances, which the geolocation below shows."
    )


def _mosaics(ran: Columns, previews: Mapping[str, NDArray[Any]]) -> tuple[Block, ...]:
    shown = [
        picture(
            previews[n],
            n,
            f"{c['placed']} photos placed, {len(c['blocks'])} piece(s).",
            longest=700,
        )
        for n, c in ran.items()
        if n in previews
    ]
    return tuple(shown) or (Missing(why="No method made a map."),)


def _quality(ran: Columns) -> tuple[Block, ...]:
    if not ran:
        return (Missing(why="No method made a map."),)
    names = tuple(ran)
    rows: list[tuple[str, ...]] = []
    first = next(iter(ran.values()))
    for k, d in enumerate(first["distances"]):
        on_map = [c["distances"][k]["on_map"] for c in ran.values()]
        rows.append((f"{d['a']} to {d['b']}, m", _f(d["metres"], 2), *(_f(v, 2) for v in on_map)))
    errors = [_errors(c) for c in ran.values()]
    if first["distances"]:
        rows.append(("largest error, m", DASH, *(_f(max(e) if e else None, 2) for e in errors)))
        rows.append(
            ("median error, m", DASH, *(_f(float(np.median(e)) if e else None, 2) for e in errors))
        )
    for key, label in (
        ("lambda_spat", "\u03bb spat (6.1)"),
        ("lambda_spat_of_table", "\u03bb spat as Table 6.1 prints it"),
        ("lambda_corr", "\u03bb corr"),
        ("lambda", "\u03bb"),
    ):
        rows.append((label, DASH, *(_percent(c[key]) for c in ran.values())))
    seams = [c["seam_disparity_px"] for c in ran.values()]
    rows.append(("seams, median px (measured)", DASH, *(_seam(s) for s in seams)))
    table = Table(
        title="Table 6.1 of the thesis, on this survey",
        head=("", "Reference", *names),
        rows=tuple(rows),
        numeric="t" + "n" * (len(names) + 1),
        note="\u03bb corr replays the final placements in order of capture at one ground"
        " resolution.",
    )
    return (table,)


def _errors(column: Mapping[str, Any]) -> list[float]:
    return [abs(d["error_m"]) for d in column["distances"] if d["error_m"] is not None]


def _graphs(ran: Columns) -> tuple[Block, ...]:
    if not ran:
        return (Missing(why="No method made a map."),)
    legend = tuple(LegendItem(colour=COLOURS[k % len(COLOURS)], text=n) for k, n in enumerate(ran))
    upper = lines(
        [(n, _array(c["correlation_with_last_of_photo"])) for n, c in ran.items()],
        title="Correlation of overlapping parts of two adjacent photos",
        x_label="photo",
        y_label="CC",
    )
    lower = lines(
        [(n, _array(c["off_position_over_width"])) for n, c in ran.items()],
        title="Distance from the reported position over the width of a photo",
        x_label="photo",
        y_label="widths",
    )
    return (
        Figure(
            svg=upper,
            title="Correlation with the photo before",
            legend=legend,
            wide=True,
            caption="Upper graph of Fig. 6.4: how well each photo fits the one before it where both"
            " overlap.",
        ),
        Figure(
            svg=lower,
            title="Distance from the reported position",
            legend=legend,
            wide=True,
            caption="Lower graph of Fig. 6.4: estimated minus reported position, over the photo's"
            " width.",
        ),
    )


def _geolocation(ran: Columns) -> Block:
    rows = []
    for name, c in ran.items():
        mae, rms = c.get("geolocation_mae_m"), c.get("geolocation_rms_m")
        if mae and rms:
            rows.append((name, *(_f(mae[a], 3) for a in "xyz"), *(_f(rms[a], 3) for a in "xyz")))
    if not rows:
        return Missing(why="The photos carry no positions to compare with.")
    return Table(
        title="Geolocation at the photos' centres against their reported positions (A Table 2), m",
        head=("", "MAE x", "MAE y", "MAE z", "RMS x", "RMS y", "RMS z"),
        rows=tuple(rows),
        numeric="tnnnnnn",
        note="Methods that use reported positions unchanged do not differ from them; this is no"
        " accuracy.",
    )


def _time(ran: Columns, photos: int) -> Block:
    if not ran:
        return Missing(why="No method made a map.")
    rows = tuple(
        (
            n,
            str(photos),
            _f(c["seconds"], 1),
            _f(c["align_seconds"], 1),
            _f(c["cpu_seconds"], 1),
            _f(c["cpu_seconds"] / max(c["placed"], 1), 2),
        )
        for n, c in ran.items()
    )
    return Table(
        title="Time of the whole command (A Table 1)",
        rows=rows,
        numeric="tnnnnn",
        head=("", "photos", "seconds", "alignment, s", "CPU s", "CPU s per photo"),
    )


def _refused(every: Columns) -> Block:
    rows = tuple((n, str(c["refused"])) for n, c in every.items() if "refused" in c)
    if not rows:
        return Missing(why="None: every method placed photos.")
    return Table(title="Refused", head=("method", "why"), rows=rows, numeric="tt")


def _array(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], np.float64)


def _f(value: float | None, digits: int) -> str:
    return DASH if value is None else fixed(value, digits)


def _percent(value: float | None) -> str:
    return DASH if value is None else f"{100 * value:.1f}\u202f%"


def _seam(seam: Mapping[str, Any]) -> str:
    if seam["median"] is None:
        return DASH
    return f"{seam['median']:.2f} ({seam['measured']} of {seam['attempted']})"
