"""`skyquilt compare`: all methods of alignment on one survey."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import (
    Cameras,
    Gsd,
    Jobs,
    Json,
    Output,
    Overwrite,
    Photos,
    Quiet,
    Repair,
    ThermalUnit,
    mode_of,
)

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    photos: Photos,
    output: Output,
    methods: Annotated[
        str | None,
        typer.Option(
            help="Columns, separated by commas: position, pose, image, image-overview, hybrid,"
            " hybrid-anneal,"
            " flightline, bundle.",
            show_default="all",
        ),
    ] = None,
    first: Annotated[
        int | None, typer.Option(help="Only so many photos, the first ones.", show_default="all")
    ] = None,
    distances: Annotated[
        Path | None,
        typer.Option(
            help="Known distances (CSV: point_a, point_b, metres).", show_default="those of --known"
        ),
    ] = None,
    known: Annotated[
        Path | None,
        typer.Option(
            help="Known points (gcp_list.txt) to judge by; they align nothing.",
            show_default="baselines between cameras",
        ),
    ] = None,
    gsd: Gsd = None,
    geo: Annotated[
        Path | None, typer.Option(help="Positions: geo.txt, CSV, .MRK, .SRT or .pos.")
    ] = None,
    cameras: Cameras = None,
    thermal_unit: ThermalUnit = None,
    height: Annotated[float | None, typer.Option(help="Height above ground in m.")] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            help="Features, in place of each method's own: sift, sift-all, surf, usurf, harris,"
            " orb, akaze.",
            show_default="sift",
        ),
    ] = None,
    matcher: Annotated[
        str | None,
        typer.Option(help="Matches of two photos: mutual, guided, one-way.", show_default="mutual"),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            help="What tells right matches from wrong: ransac, lmeds, magsac, ste, ste-printed;"
            " for image also ncc, phase, ecc, mi.",
            show_default="each method's own",
        ),
    ] = None,
    alpha: Annotated[float, typer.Option(help="Weight of distances against looks, 0 to 1.")] = 0.5,
    lines: Annotated[
        str, typer.Option(help="How flight lines are told apart: heading, distance.")
    ] = "heading",
    repair: Repair = True,
    seed: Annotated[int, typer.Option(help="Of everything random.")] = 0,
    jobs: Jobs = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Align one survey by every method, and set the results side by side.

    Writes compare.json, report.html, and each method's own run in a folder of its name.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.papers.compare import VARIANTS, CompareSettings, iter_compare
        from skyquilt.settings import DEFAULTS, MosaicSettings

    mode = mode_of(quiet=quiet, json=json)
    shared = MosaicSettings(
        gsd_cm=gsd,
        geo=geo,
        cameras=cameras,
        thermal_unit=thermal_unit,
        alpha=alpha,
        jobs=jobs,
        distances=distances,
    )
    asked = tuple(m.strip() for m in methods.split(",")) if methods is not None else tuple(VARIANTS)
    named: dict[str, Any] = {"detector": detector, "matcher": matcher, "estimator": estimator}
    named |= {"height_m": height, "lines": lines, "repair": repair, "seed": seed}
    given = [(k, v) for k, v in named.items() if v is not None and v != DEFAULTS[k]]
    settings = CompareSettings(
        mosaic=shared, variants=asked, first=first, known=known, given=tuple(given)
    )
    events = iter_compare(photos, output, settings, overwrite=overwrite)
    show(events, mode=mode, summary=summary)


def summary(result: "Result") -> str:
    """The comparison as a table."""
    head = (
        "method",
        "photos",
        "lambda corr",
        "lambda spat",
        "lambda",
        "worst distance m",
        "seconds",
        "CPU s",
    )
    rows = [head, *(_row(name, column) for name, column in result.metrics["methods"].items())]
    wide = [max(len(r[k]) for r in rows if len(r) > 2) for k in range(len(head))]
    lines = [
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(r, wide, strict=False))
        )
        for r in rows
    ]
    return "\n".join(
        [
            *lines,
            f"judged by {result.metrics['judged_by']}",
            f"report: {result.output / 'report.html'}",
        ]
    )


def _row(name: str, column: Mapping[str, Any]) -> tuple[str, ...]:
    if "refused" in column:
        return name, f"refused: {column['refused']}"
    errors = [abs(d["error_m"]) for d in column["distances"] if d["error_m"] is not None]
    shares = [column[k] for k in ("lambda_corr", "lambda_spat", "lambda")]
    told = ["-" if s is None else f"{100 * s:.1f} %" for s in shares]
    worst = f"{max(errors):.2f}" if errors else "-"
    return (
        name,
        str(column["placed"]),
        *told,
        worst,
        f"{column['seconds']:.1f}",
        f"{column['cpu_seconds']:.1f}",
    )
