"""`skyquilt strip-test`: how a strip of photos deforms under different models."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, Overwrite, Quiet, in_percent, mode_of

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for strip.json and report.html.")
    ],
    photos: Annotated[int, typer.Option(help="Number of photos along the strip.")] = 21,
    overlap: Annotated[
        float, typer.Option(help="Overlap from photo to photo, percent.", callback=in_percent)
    ] = 70,
    height: Annotated[float, typer.Option(help="Flight height above the boards, m.")] = 30,
    relief: Annotated[
        float, typer.Option(help="Height of the highest object on the boards, m.")
    ] = 1.2,
    tilt: Annotated[
        float, typer.Option(help="Standard deviation of pitch and roll, degrees.")
    ] = 0.3,
    noise: Annotated[float, typer.Option(help="Standard deviation of an observation, px.")] = 0.3,
    flights: Annotated[
        int, typer.Option(help="Strips flown with different seeds; curves are medians.")
    ] = 5,
    seed: Annotated[int, typer.Option(help="Equal seeds give equal results.")] = 1,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """How well the shape of a strip of photos is preserved: eta under seven lens models, features
    and transformations, and with every other photo.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.papers.strip_test import iter_strip_test
        from skyquilt.simulate import StripSettings

    mode = mode_of(quiet=quiet, json=json)
    settings = StripSettings(
        photos=photos,
        overlap=overlap / 100,
        height=height,
        relief=relief,
        tilt=tilt,
        noise=noise,
        seed=seed,
    )
    events = iter_strip_test(output, settings, flights=flights, overwrite=overwrite)
    show(events, mode=mode, summary=_summary)


def _summary(result: "Result") -> str:
    """The last values of the curves in a few lines."""
    lines = [
        f"{v['name']:36} eta at the end {median(v['eta_end']):.3f}"
        for v in result.metrics["variants"]
    ]
    return "\n".join([*lines, f"report: {result.output / 'report.html'}"])
