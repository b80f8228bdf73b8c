"""`skyquilt mosaic`: a folder of photos to a georeferenced orthomosaic."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import (
    THERMAL_UNITS,
    UNIT_UNSAID,
    Cameras,
    Crs,
    Features,
    Gsd,
    Jobs,
    Json,
    Output,
    Overwrite,
    Photos,
    Quiet,
    Repair,
    Verbose,
    mode_of,
)
from skyquilt.errors import UsageError

if TYPE_CHECKING:
    from skyquilt.model.event import Result


def command(
    photos: Photos,
    output: Output,
    method: Annotated[
        str,
        typer.Option(
            help="How photos are aligned: auto, bundle, position, pose, image, hybrid, flightline."
        ),
    ] = "auto",
    gsd: Gsd = None,
    crs: Crs = None,
    gcp: Annotated[
        Path | None,
        typer.Option(help="Control points.", show_default="gcp_list.txt among the photos, if any"),
    ] = None,
    geo: Annotated[
        Path | None,
        typer.Option(
            help="Positions: geo.txt, CSV, .MRK or .SRT.",
            show_default="geo.txt among the photos, if any",
        ),
    ] = None,
    cameras: Cameras = None,
    bounds: Annotated[
        str | None, typer.Option(help="west,south,east,north in the output CRS.")
    ] = None,
    boundary: Annotated[
        Path | None,
        typer.Option(help="Polygon to cut the map to: GeoJSON, KML, GeoPackage, Shapefile."),
    ] = None,
    surface: Annotated[
        str,
        typer.Option(help="Heights: ties (tie points alone) or sweep (refined from the images)."),
    ] = "sweep",
    blend: Annotated[
        str, typer.Option(help="Blending of photos: auto, feather, first, average, multiband.")
    ] = "auto",
    feather: Annotated[float, typer.Option(help="Width of feathered seams in map pixels.")] = 6.0,
    balance: Annotated[
        bool, typer.Option("--balance/--no-balance", help="Adjust photos to a common brightness.")
    ] = True,
    balance_thermal: Annotated[
        bool | None,
        typer.Option(
            "--balance-thermal/--raw-thermal",
            help="Balance the drift between thermal frames in their overlaps, or keep the values as"
            " recorded.",
            show_default="temperatures balanced, counts raw",
        ),
    ] = None,
    compress: Annotated[
        str, typer.Option(help="auto, jpeg, or lossless: deflate, zstd, lzw, none.")
    ] = "auto",
    quality: Annotated[int, typer.Option(help="JPEG quality.")] = 85,
    distortion: Annotated[
        str | None,
        typer.Option(
            help="Lens terms to calibrate, or, for methods that do not calibrate, to use of a known"
            " calibration: none, 2, 4, 6 (radial order), 6t (and tangential).",
            show_default="4 to calibrate, 6t to use",
        ),
    ] = None,
    transform: Annotated[
        str | None,
        typer.Option(
            help="Transformation between two photos: translation, similarity, affine, homography.",
            show_default="similarity for image, homography for flightline",
        ),
    ] = None,
    levelled: Annotated[
        bool,
        typer.Option(
            "--levelled/--no-levelled",
            help="Register by features of the dominant plane, for method image.",
        ),
    ] = True,
    image_search: Annotated[
        str,
        typer.Option(
            help="What method image registers a photo to: chain (the last photo), overview (the"
            " whole map so far)."
        ),
    ] = "chain",
    relief: Annotated[
        float | None,
        typer.Option(
            help="Largest height variation on the ground in m, for --levelled.",
            show_default="a tenth of the height",
        ),
    ] = None,
    alpha: Annotated[
        float,
        typer.Option(
            help="Weight of distances against visual agreement, 0 to 1, for method hybrid."
        ),
    ] = 0.5,
    optimiser: Annotated[
        str,
        typer.Option(
            help="How method hybrid searches: surfaces (correlation), anneal (simulated annealing)."
        ),
    ] = "surfaces",
    seed: Annotated[
        int, typer.Option(help="Seed of all random numbers; equal seeds give equal maps.")
    ] = 0,
    sequence: Annotated[
        str,
        typer.Option(
            help="Order in which methods image, hybrid and flightline add photos: time, name, or a"
            " file of names."
        ),
    ] = "time",
    lines: Annotated[
        str,
        typer.Option(
            help="How method flightline separates lines: heading, or distance (as in the paper)."
        ),
    ] = "heading",
    distances: Annotated[
        Path | None,
        typer.Option(help="Known distances (CSV: point_a, point_b, metres) to check the map with."),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(help="Height above ground in m, for methods that do not estimate it."),
    ] = None,
    heading: Annotated[
        float | None,
        typer.Option(
            help="Heading of all photos in degrees, for method position.",
            show_default="the most common reported one",
        ),
    ] = None,
    repair: Repair = True,
    features: Features = 1200,
    thermal: Annotated[
        Path | None,
        typer.Option(
            help="Folder of thermal photos; their map (thermal.tif) is aligned with the visual map."
        ),
    ] = None,
    thermal_unit: Annotated[
        str | None,
        typer.Option(help=THERMAL_UNITS, show_default=f"auto with --thermal; else {UNIT_UNSAID}"),
    ] = None,
    thermal_route: Annotated[
        str,
        typer.Option(
            help="How the thermal map is registered: rig (both cameras on one drone: from the"
            " visual poses), maps (the images of both maps), pairs (of photos), heights (the"
            " surfaces of both), positions (GPS alone), auto (the first that is reliable)."
        ),
    ] = "auto",
    jobs: Jobs = 0,
    memory: Annotated[
        float | None, typer.Option(help="Memory limit in GB.", show_default="1.2")
    ] = None,
    rerun_from: Annotated[
        str | None,
        typer.Option(
            help="Compute everything again from this stage on: features, links, align, surface,"
            " balance, mosaic, measure, report."
        ),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Turn a folder of drone photos into a georeferenced, orthorectified mosaic.

    Sensible without any option. The same command again resumes a run that was killed.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.workflows.methods import MosaicSettings
        from skyquilt.workflows.mosaic import STAGES, iter_mosaic

    if rerun_from is not None and rerun_from not in STAGES[1:]:
        raise UsageError(f"--rerun-from {rerun_from!r} is not one of {', '.join(STAGES[1:])}")
    mode = mode_of(quiet=quiet, json=json, verbose=verbose)
    settings = MosaicSettings(
        method=method,
        gsd_cm=gsd,
        crs=crs,
        gcp=gcp,
        geo=geo,
        cameras=cameras,
        bounds=parse_bounds(bounds),
        boundary=boundary,
        surface=surface,
        blend=blend,
        feather_px=feather,
        balance=balance,
        balance_thermal=balance_thermal,
        thermal_unit=thermal_unit,
        compress=compress,
        quality=quality,
        distortion=distortion,
        transform=transform,
        levelled=levelled,
        image_search=image_search,
        relief_m=relief,
        alpha=alpha,
        optimiser=optimiser,
        seed=seed,
        sequence=sequence,
        lines=lines,
        distances=distances,
        height_m=height,
        heading_deg=heading,
        repair=repair,
        features=features,
        jobs=jobs,
        memory_gb=memory,
    )
    if thermal is None:
        events = iter_mosaic(photos, output, settings, overwrite=overwrite, rerun_from=rerun_from)
    else:
        from skyquilt.thermal.workflow import iter_thermal

        events = iter_thermal(
            photos,
            thermal,
            output,
            settings,
            route=thermal_route,
            overwrite=overwrite,
            rerun_from=rerun_from,
        )
    show(events, mode=mode, summary=None if thermal is None else with_thermal)


def with_thermal(result: "Result") -> str:
    """A summary of a mosaic, and how the thermal map was registered to it."""
    from skyquilt.cli.progress import mosaic_summary

    t = result.metrics["thermal"]
    how = (
        "its own positions alone"
        if t["route"] == "positions"
        else f"{t['route']}, {t['inliers']} {'pairs' if t['route'] == 'rig' else 'places'} agree"
    )
    return (
        f"{mosaic_summary(result)}\nthermal: {result.output / 'thermal.tif'} ({t['photos_used']} of"
        f" {t['photos_total']} photos, placed by {how})"
    )


def parse_bounds(text: str | None) -> tuple[float, float, float, float] | None:
    """Four numbers separated by commas.

    Raises:
        UsageError: they are not.
    """
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(
            f"--bounds is west,south,east,north, four numbers; got {text!r}"
        ) from error
    return west, south, east, north
