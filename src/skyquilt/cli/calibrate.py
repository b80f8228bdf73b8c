"""`skyquilt calibrate`: calibrates a camera from frames of a chess-board."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, Output, Overwrite, Quiet, mode_of
from skyquilt.errors import UsageError

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    frames: Annotated[
        Path, typer.Argument(help="Folder of frames, thermal or visible (subfolders included).")
    ],
    output: Output,
    board: Annotated[str, typer.Option(help="Squares (not corners) of the board, such as 7x6.")],
    square: Annotated[float, typer.Option(help="Side of a square in m.")],
    series: Annotated[
        str,
        typer.Option(
            help="Frames of one pose (for instance when a lamp heats the board part by part) are"
            " combined to one image: auto (frames between which the camera stood still), folders"
            " (each folder is a pose), views (never)."
        ),
    ] = "auto",
    weights: Annotated[
        str,
        typer.Option(
            help="How the frames of one pose are weighted: contrast (those in which black and white"
            " are well separated), printed (word for word as the thesis prints it)."
        ),
    ] = "contrast",
    few_views: Annotated[
        bool,
        typer.Option(
            help="Make do with one or two views: focal length, principal point, k1 and k2 have"
            " priors, and the report says what the views leave open."
        ),
    ] = False,
    focal: Annotated[
        float | None,
        typer.Option(
            help="With --few-views: the focal length in px, believed to 5 %.",
            show_default="what the frames tell",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(help="Threads; 0 = all processors.", min=0)] = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Calibrate a camera from views of a chess-board; writes cameras.json as `mosaic --cameras`
    reads it.
    """
    with ends_at_once():
        from skyquilt.calibration.workflow import CalibrateSettings, iter_calibrate
        from skyquilt.cli.progress import show

    mode = mode_of(quiet=quiet, json=json)
    columns, rows = parse_board(board)
    settings = CalibrateSettings(
        columns=columns,
        rows=rows,
        square_m=square,
        series=series,
        weights=weights,
        few_views=few_views,
        focal_px=focal,
        jobs=jobs,
    )
    events = iter_calibrate(frames, output, settings, overwrite=overwrite)
    show(events, mode=mode, summary=summary)


def parse_board(text: str) -> tuple[int, int]:
    """Columns and rows of squares.

    Raises:
        UsageError: it is not two numbers with an x between.
    """
    found = re.fullmatch(r"\s*(\d{1,3})\s*[xX×]\s*(\d{1,3})\s*", text)
    if not found:
        raise UsageError(f"--board is columns x rows in squares, such as 7x6; got {text!r}")
    return int(found[1]), int(found[2])


def summary(result: "Result") -> str:
    """A summary of a calibration in a few lines."""
    m = result.metrics
    found, other = m["centres"], m["corners"]
    held, held_corners = (m[k]["held_out_px"] for k in ("centres", "corners"))
    kept_out = (
        ()
        if held is None
        else (
            f"on held-out views, each with its own marks: {held['centres']:.3f} px, from corners"
            f" {held_corners['corners']:.3f} px; both measured at the corners:"
            f" {held['corners']:.3f} px, from corners {held_corners['corners']:.3f} px",
        )
    )
    values = found["parameters"]
    terms = [
        f"{n} {values[n]['value']:+.4f} ± {values[n]['sigma']:.4f}"
        for n in values
        if values[n]["free"] and n not in ("focal", "cx", "cy")
    ]
    counted = "1 view" if m["views_used"] == 1 else f"{m['views_used']} views"
    return "\n".join(
        (
            f"{counted} ({m['frames']} frames), {found['points']} centres of squares",
            f"focal length {values['focal']['value']:.2f} ± {values['focal']['sigma']:.2f} px,"
            " principal point"
            f" ({values['cx']['value']:.1f}, {values['cy']['value']:.1f}),"
            f" {', '.join(terms) or 'no distortion'}",
            f"reprojection error from centres {found['rms_px']:.3f} px (RMS), from corners"
            f" {other['rms_px']:.3f} px",
            *kept_out,
            *m["unknown"],
            *(
                f"left out: {name}: {reason}"
                for name, reason in list(m["views_rejected"].items())[:10]
            ),
            f"camera: {result.output / 'cameras.json'}",
            f"report: {result.output / 'report.html'}",
        )
    )
