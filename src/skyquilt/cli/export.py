"""`skyquilt export`: any part of a finished run in the formats of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, MaxMemory, Quiet, mode_of, parse_bounds


def command(
    folder: Annotated[Path, typer.Argument(metavar="OUTPUT", help="Folder of a finished run.")],
    what: Annotated[
        str,
        typer.Option(
            help="Formats, separated by commas: png (with a world file), kmz (Google Earth),"
            " mbtiles, tiles (a folder for web maps), tif (Cloud Optimized GeoTIFF), heights (the"
            " same of the surface), footprints (GeoPackage)."
        ),
    ],
    layer: Annotated[
        str,
        typer.Option(
            help="Raster to export: mosaic, thermal, infrared, ndvi, ndre, gndvi, heights,"
            " hillshade, ground, views, provenance."
        ),
    ] = "mosaic",
    bounds: Annotated[
        str | None,
        typer.Option(
            help="west,south,east,north in the CRS of the export.", show_default="the whole map"
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            help="CRS of png, tif, heights, footprints and --bounds, e.g. EPSG:32633.",
            show_default="that of the map",
        ),
    ] = None,
    gsd: Annotated[
        float | None,
        typer.Option(help="Ground size of a pixel in cm.", show_default="that of the map"),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the files.", show_default="OUTPUT/export"),
    ] = None,
    max_memory: MaxMemory = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Export a finished map, or a part of it, as picture, KMZ, web tiles or GeoTIFF.

    The run is not changed and nothing is computed anew; memory stays bounded for maps of any size.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show_exports
        from skyquilt.engine.memory_watch import ends_run, limit_bytes
        from skyquilt.runs.export import Wanted, export, parse_what
    wanted = Wanted(
        what=parse_what(what),
        layer=layer,
        bounds=parse_bounds(bounds),
        crs=crs,
        gsd_m=None if gsd is None else gsd / 100,
    )
    with ends_run(limit_bytes(max_memory), "export a smaller part, or with a larger --gsd"):
        show_exports(export(folder, wanted, output), mode=mode_of(quiet=quiet, json=json))
