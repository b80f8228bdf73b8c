"""`skyquilt inspect`: reports the metadata of photos and where they cannot be right."""

import json as json_module
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from skyquilt.model.photo import Survey


def command(
    photos: Annotated[
        Path, typer.Argument(help="Folder of photos (subfolders included), or one photo.")
    ],
    geo: Annotated[
        Path | None, typer.Option(help="Side file of positions: geo.txt, CSV, DJI .SRT or .MRK.")
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="Calibrations: cameras.json of OpenDroneMap.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Report the metadata of photos, and what is missing or contradictory."""
    from skyquilt.photos.contradictions import contradictions
    from skyquilt.photos.survey import read_survey

    survey = read_survey(photos, geo=geo, cameras=cameras)
    findings = contradictions(survey.photos)
    if json:
        record = {**asdict(survey), "contradictions": findings}
        sys.stdout.write(json_module.dumps(record, default=str, indent=1, allow_nan=False) + "\n")
    else:
        _show(survey, findings)


def _show(survey: "Survey", findings: tuple[str, ...]) -> None:
    from rich.console import Console

    from skyquilt.cli.inspect_tables import camera_table, photo_table, sentences

    console = Console(soft_wrap=False)
    if not console.is_terminal:
        console = Console(width=200)  # a pipe has no width; lines should not be wrapped
    console.print(camera_table(survey), photo_table(survey))
    for line in sentences(survey, findings):
        console.print(line, markup=False, highlight=False)
