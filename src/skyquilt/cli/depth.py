"""`skyquilt depth`: heights of the ground on the map grid."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.thermal_unit import ThermalUnit
from skyquilt.errors import UsageError

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    photos: Annotated[list[Path], typer.Argument(help="A folder of photos, or two photos and more.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    route: Annotated[
        str,
        typer.Option(
            help="pair (two photos, or the first two in sequence that match), disparities (of all linked pairs,"
            " merged), reconstruction (heights of the whole adjustment), auto (pair for two photos)."
        ),
    ] = "auto",
    gsd: Annotated[
        float | None, typer.Option(help="Ground size of a map pixel in cm.", show_default="the photos' own")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Output CRS, e.g. EPSG:32633.", show_default="local UTM")
    ] = None,
    relief: Annotated[
        float | None,
        typer.Option(
            help="Largest height variation on the ground in m: what counts as the dominant plane.",
            show_default="a tenth of the height",
        ),
    ] = None,
    thermal_unit: ThermalUnit = None,
    features: Annotated[int, typer.Option(help="Features per photo.")] = 3000,
    jobs: Annotated[int, typer.Option(help="Threads; 0 = all processors.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a former result in OUTPUT.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object per event.")] = False,
) -> None:
    """Depth maps: of a pair, a mosaic of disparities, or the whole reconstruction on a plane.

    Where no two photos tell a height, the command refuses (exit code 7).
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.config import MosaicSettings
        from skyquilt.pipelines.depth import iter_depth

    if quiet and json:
        raise UsageError("--quiet and --json exclude one another")
    settings = MosaicSettings(gsd_cm=gsd, crs=crs, thermal_unit=thermal_unit, features=features, jobs=jobs)
    source = photos[0] if len(photos) == 1 else photos
    events = iter_depth(source, output, settings, route=route, relief_m=relief, overwrite=overwrite)
    show(events, mode="quiet" if quiet else "json" if json else "normal", summary=summary)


def summary(result: "Result") -> str:
    """A depth map in a few lines."""
    m = result.metrics
    p = m["percentiles"]
    return "\n".join(
        (
            f"{m['route']}: {m['photos_used']} of {m['photos_total']} photos, {len(m['pairs'])} pairs measured",
            f"heights {p['1']:.1f} to {p['99']:.1f} {m['unit']} from {m['counted_from']}",
            f"depth:  {result.output / 'depth.tif'}",
            f"report: {result.output / 'report.html'}",
        )
    )
