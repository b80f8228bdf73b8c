"""`skyquilt spectral-bench`: registration methods on pairs with known truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, Output, Overwrite, Quiet, mode_of
from skyquilt.errors import UsageError

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    pairs: Annotated[
        Path,
        typer.Argument(
            metavar="PAIRS.csv",
            help="Pairs: class, source, a, b, tolerance_px, h11 to h33 (b_H_a).",
        ),
    ],
    output: Output,
    method: Annotated[
        str, typer.Option(help="Methods, separated by commas.")
    ] = "auto,sift,surf,usurf,rfae,surf+rfae",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Register every pair of a list by every method, and compare with the truth.

    Success ratio and mean Q per class and method are those of the thesis's Tables 6.4 and 6.5.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.papers.spectral_bench import iter_spectral_bench

    mode = mode_of(quiet=quiet, json=json)
    asked = tuple(dict.fromkeys(word.strip() for word in method.split(",") if word.strip()))
    if not asked:
        raise UsageError("--method names no method; give at least one, such as auto")
    events = iter_spectral_bench(pairs, output, asked, overwrite=overwrite)
    show(events, mode=mode, summary=summary)


def summary(result: "Result") -> str:
    """Where the results are."""
    return f"rows:   {result.output / 'bench.json'}\nreport: {result.output / 'report.html'}"
