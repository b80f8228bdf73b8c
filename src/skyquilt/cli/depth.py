"""`skyquilt depth`: heights of the ground on the map grid."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import (
    Crs,
    Features,
    Gsd,
    Jobs,
    Json,
    Output,
    Overwrite,
    Quiet,
    ThermalUnit,
    mode_of,
)

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    photos: Annotated[
        list[Path], typer.Argument(help="A folder of photos, or two or more photos.")
    ],
    output: Output,
    route: Annotated[
        str,
        typer.Option(
            help="pair (every pixel of two photos, or of the first two in sequence that match),"
            " disparities (of the features of all linked pairs, merged), reconstruction (heights of"
            " the whole adjustment), auto (pair for two photos)."
        ),
    ] = "auto",
    gsd: Gsd = None,
    crs: Crs = None,
    relief: Annotated[
        float | None,
        typer.Option(
            help="Largest height variation on the ground in m: what counts as the dominant plane.",
            show_default="a tenth of the height",
        ),
    ] = None,
    thermal_unit: ThermalUnit = None,
    features: Features = 3000,
    jobs: Jobs = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Depth maps: of a pair, a mosaic of disparities, or the whole reconstruction on a plane.

    Where no two photos determine a height, the command ends with exit code 7.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.depth.workflow import iter_depth
        from skyquilt.settings import MosaicSettings

    mode = mode_of(quiet=quiet, json=json)
    settings = MosaicSettings(
        gsd_cm=gsd, crs=crs, thermal_unit=thermal_unit, features=features, jobs=jobs
    )
    source = photos[0] if len(photos) == 1 else photos
    events = iter_depth(source, output, settings, route=route, relief_m=relief, overwrite=overwrite)
    show(events, mode=mode, summary=summary)


def summary(result: "Result") -> str:
    """A summary of a depth map in a few lines."""
    m = result.metrics
    p = m["percentiles"]
    return "\n".join(
        (
            f"{m['route']}: {m['photos_used']} of {m['photos_total']} photos, {len(m['pairs'])}"
            " pairs measured",
            f"heights {p['1']:.1f} to {p['99']:.1f} {m['unit']} from {m['counted_from']}",
            f"depth:  {result.output / 'depth.tif'}",
            f"report: {result.output / 'report.html'}",
        )
    )
