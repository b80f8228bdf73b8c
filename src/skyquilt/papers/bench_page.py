"""The report page of a benchmark: Tables 6.4 and 6.5 [Yahyanejad 2013], the comparison with the
truth, and every pair.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from skyquilt.report.numbers import DASH, fixed
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Section, Table

Rows = Sequence[Mapping[str, Any]]


def bench_page(record: Mapping[str, Any]) -> str:
    """The page from the record in bench.json."""
    rows, methods = record["pairs"], tuple(record["methods"])
    classes = tuple(dict.fromkeys(r["class"] for r in rows))
    sections = (
        Section(id="truth", title="Truth", blocks=(_truth(rows, methods, classes),)),
        Section(id="stated", title="Stated errors", blocks=(_stated(rows, methods, classes),)),
        Section(id="thesis", title="The thesis's tables", blocks=_thesis(rows, methods, classes)),
        Section(id="cost", title="Cost", blocks=(_cost(rows, methods),)),
        Section(id="pairs", title="Pairs", blocks=(_pairs(rows),)),
    )
    pairs = len(rows) // max(len(methods), 1)
    return plain_page(
        title="Registration between spectra",
        version=str(record["version"]),
        sections=sections,
        summary=f"{pairs} pairs in {len(classes)} classes, {len(methods)} methods:"
        f" {', '.join(methods)}.",
        source="The figures behind this page are in bench.json.",
    )


def _truth(rows: Rows, methods: tuple[str, ...], classes: tuple[str, ...]) -> Table:
    def cell(of: Rows) -> str:
        accepted, right = sum(r["accepted"] for r in of), sum(r["right"] for r in of)
        return f"{right} right, {accepted - right} wrong of {len(of)}"

    return Table(
        title="Registrations that are right, and accepted though wrong",
        head=("class", *methods),
        rows=_by_class(rows, methods, classes, cell),
        numeric="t" + "n" * len(methods),
        note="Right: accepted with an RMS error over the overlap below the pair's tolerance.",
    )


def _stated(rows: Rows, methods: tuple[str, ...], classes: tuple[str, ...]) -> Table:
    def cell(of: Rows) -> str:
        told = [r for r in of if r["stated_px"] is not None and r["corner_px"] is not None]
        if not told:
            return DASH
        held = sum(r["corner_px"] <= r["stated_px"] for r in told)
        ratio = median(r["stated_px"] / max(r["corner_px"], 1e-3) for r in told)
        return f"{held} of {len(told)}; {fixed(ratio, 1)}"

    return Table(
        title="Stated errors: bounds that hold; median of stated to actual",
        head=("class", *methods),
        rows=_by_class(rows, methods, classes, cell),
        numeric="t" + "n" * len(methods),
        note="The bound (95 %) at the worst corner of the part of A that B covers, compared with"
        " the actual distance from the truth there.",
    )


def _thesis(rows: Rows, methods: tuple[str, ...], classes: tuple[str, ...]) -> tuple[Table, Table]:
    def ratio(of: Rows) -> str:
        return f"{sum(r['accepted'] for r in of)}/{len(of)}"

    def mean_q(of: Rows) -> str:
        return f"{fixed(100 * sum(r['q'] for r in of) / max(len(of), 1), 0)} %"

    kinds = "t" + "n" * len(methods)
    return (
        Table(
            title="Table 6.4: registrations accepted",
            head=("class", *methods),
            numeric=kinds,
            rows=_by_class(rows, methods, classes, ratio),
            note="Accepted, whether right or wrong.",
        ),
        Table(
            title="Table 6.5: mean Q",
            head=("class", *methods),
            numeric=kinds,
            rows=_by_class(rows, methods, classes, mean_q),
            note="Q of (6.3); 0 where refused.",
        ),
    )


def _by_class(
    rows: Rows, methods: tuple[str, ...], classes: tuple[str, ...], cell: Any
) -> tuple[Any, ...]:
    """A row per class and one for all."""
    table = [
        (
            kind,
            *(cell([r for r in rows if r["class"] == kind and r["method"] == m]) for m in methods),
        )
        for kind in classes
    ]
    return (*table, ("all", *(cell([r for r in rows if r["method"] == m]) for m in methods)))


def _cost(rows: Rows, methods: tuple[str, ...]) -> Table:
    lines = []
    for method in methods:
        spent = [r["seconds"] for r in rows if r["method"] == method]
        lines.append((method, fixed(sum(spent) / len(spent), 2), fixed(max(spent), 2)))
    return Table(
        title="CPU time per pair, reading included",
        head=("method", "mean, s", "longest, s"),
        rows=tuple(lines),
        numeric="tnn",
    )


def _pairs(rows: Rows) -> Table:
    lines = tuple(
        (
            r["class"],
            r["source"],
            r["method"],
            "right" if r["right"] else "wrong" if r["accepted"] else "refused",
            fixed(r["error_px"], 2),
            fixed(r["corner_px"], 2),
            fixed(r["stated_px"], 2),
            fixed(r["q"], 2),
            str(r["inliers"]),
            fixed(r["seconds"], 2),
            r["reason"] or DASH,
        )
        for r in rows
    )
    head = (
        "class",
        "pair",
        "method",
        "verdict",
        "error, px",
        "worst corner, px",
        "stated, px",
        "Q",
        "inliers",
        "CPU, s",
        "reason",
    )
    return Table(title="Every pair by every method", head=head, rows=lines, numeric="ttttnnnnnnt")
