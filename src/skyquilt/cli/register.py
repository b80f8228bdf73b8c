"""`skyquilt register`: registers two images of different spectra."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, Output, Overwrite, Quiet, mode_of

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    a: Annotated[Path, typer.Argument(metavar="A", help="The reference: a photo or a GeoTIFF.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The image to register to it.")],
    output: Output,
    method: Annotated[
        str,
        typer.Option(
            help="auto (structure, accepted only where independent patches agree); parts of it or"
            " beside it: structure, shapes (areas and objects); or a published method, which"
            " accepts nine inliers: sift, sift-octave0, surf, surf-lobe, usurf, rfae, rfae-printed,"
            " rfae-sift, surf+rfae; rfae-refined: rfae, refined and confirmed by patches."
        ),
    ] = "auto",
    metadata: Annotated[
        bool,
        typer.Option(
            "--use-metadata/--ignore-metadata",
            help="Try first the registration that metadata and positions suggest.",
        ),
    ] = True,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Largest error in px of B that is tolerated over the picture: a registration that"
            " may be further off in a corner (95 %) is refused. For auto, structure, shapes and"
            " rfae-refined. Default: 2 % of B's diagonal, for photos of a camera over half of it."
        ),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Register two images of different spectra: photos, radiometric photos or maps.

    A registration that is not certain is refused with a reason (exit code 7).
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.coregistration.methods import RegisterSettings
        from skyquilt.coregistration.workflow import iter_register

    mode = mode_of(quiet=quiet, json=json)
    settings = RegisterSettings(method=method, use_metadata=metadata, tolerance_px=tolerance)
    events = iter_register(a, b, output, settings, overwrite=overwrite)
    show(events, mode=mode, summary=summary)


def summary(result: "Result") -> str:
    """A summary of an accepted registration in a few lines."""
    m = result.metrics
    return "\n".join(
        (
            f"{m['model']}, {m['inliers']} inliers, residual {m['residual_px']} px, Q {m['q']:.2f},"
            f" {m['cpu_seconds']:.2f} s of CPU",
            *_error(m),
            f"B on A: {result.output / 'b_on_a.tif'}",
            f"report: {result.output / 'report.html'}",
        )
    )


def _error(m: Mapping[str, Any]) -> tuple[str, ...]:
    if m["error_px"] is None:
        return ()
    return (f"error: within {m['error_px']:.1f} px of B over the picture (95 %)",)
