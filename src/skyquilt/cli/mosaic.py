"""`skyquilt mosaic`: a folder of photos to a georeferenced orthomosaic."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import (
    MAX_MEMORY,
    MAX_MEMORY_UNSAID,
    MAX_MP,
    READOUT_UNSAID,
    READOUTS,
    SHUTTER_UNSAID,
    SHUTTERS,
    THERMAL_UNITS,
    UNIT_UNSAID,
    VERTICAL_DATUMS,
    PhotoPaths,
    mode_of,
    parse_bounds,
    source_of,
)
from skyquilt.errors import UsageError
from skyquilt.outside import MOST_MP

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from skyquilt.model.event import Result
    from skyquilt.runs.export import Export


COMMON, INPUT, METHOD, CAMERA = "Options most people need", "Input", "Method", "Cameras"
PICTURE, FILES, THERMAL, RUN = "Surface and picture", "Files", "Thermal", "Running"
IMAGE, HYBRID = "Method image", "Method hybrid, and lambda of any method"
FLIGHTLINE, POSITION = "Method flightline", "Method position"


def option(panel: str, text: str, *names: str, default: str | None = None) -> Any:
    """An option in a panel of the help; `default` says in words what stands for None."""
    shown: bool | str = True if default is None else default
    return typer.Option(*names, help=text, rich_help_panel=panel, show_default=shown)


def command(
    photos: PhotoPaths,
    output: Annotated[Path, option(COMMON, "Folder for the results.", "--output", "-o")],
    gsd: Annotated[
        float | None, option(COMMON, "Ground size of a map pixel in cm.", default="the photos' own")
    ] = None,
    gcp: Annotated[
        Path | None,
        option(COMMON, "Control points.", default="gcp_list.txt among the photos, if any"),
    ] = None,
    crs: Annotated[
        str | None, option(COMMON, "Output CRS, e.g. EPSG:32633.", default="local UTM")
    ] = None,
    thermal: Annotated[
        Path | None,
        option(
            COMMON, "Folder of thermal photos: their map is laid on the visual one as thermal.tif."
        ),
    ] = None,
    overwrite: Annotated[
        bool, option(COMMON, "Replace the results of another run in OUTPUT.", "--overwrite")
    ] = False,
    geo: Annotated[
        Path | None,
        option(
            INPUT,
            "Positions: geo.txt, CSV, .MRK, .SRT, .pos, or a track (GPX, a CSV with times); of"
            " videos: .SRT, a track, or a folder of these.",
            default="geo.txt among the photos; for videos the file beside each",
        ),
    ] = None,
    frame_overlap: Annotated[
        float, option(INPUT, "Overlap in percent wanted between frames chosen from videos.")
    ] = 78.0,
    clock_offset: Annotated[
        float | None,
        option(
            INPUT,
            "Seconds to add to the time in a video, or of photos placed by a track, to get the"
            " time of its positions.",
            default="found: from the flight's turns, or the time zone",
        ),
    ] = None,
    cameras: Annotated[Path | None, option(INPUT, "Calibrations (cameras.json).")] = None,
    distances: Annotated[
        Path | None,
        option(INPUT, "Known distances (CSV: point_a, point_b, metres) to judge the map by."),
    ] = None,
    sequence: Annotated[
        str,
        option(
            INPUT,
            "Order that methods image, hybrid and flightline take photos in: time, name, or a file"
            " of names.",
        ),
    ] = "time",
    band: Annotated[
        str | None,
        option(
            INPUT,
            "Band that the map shows, of cameras that write a file for each, e.g. nir.",
            default="that of most photos",
        ),
    ] = None,
    all_bands: Annotated[
        bool,
        option(
            INPUT,
            "Draw all bands of such cameras in bands.tif, on the map's grid, and indices of"
            " vegetation (ndvi.tif ...).",
            "--all-bands",
        ),
    ] = False,
    lever_arm: Annotated[
        str | None,
        option(
            INPUT,
            "From the antenna to the camera: right,forward,up in m in the aircraft's body.",
            default="positions are the camera's",
        ),
    ] = None,
    repair: Annotated[
        bool, option(INPUT, "Whether metadata may be wrong.", "--repair-metadata/--trust-metadata")
    ] = True,
    method: Annotated[
        str,
        option(
            METHOD,
            "How photos are aligned: auto, bundle, position, pose, image, hybrid, flightline.",
        ),
    ] = "auto",
    detector: Annotated[
        str | None,
        option(
            METHOD,
            "Features: sift, sift-all (at least 12,000 per photo, for method flightline), surf,"
            " usurf, harris, orb, akaze.",
            default="sift",
        ),
    ] = None,
    matcher: Annotated[
        str | None,
        option(
            METHOD,
            "Matches of two photos: mutual (each other's nearest), guided (near the place that"
            " metadata predict), one-way.",
            default="mutual",
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        option(
            METHOD,
            "What tells right matches from wrong: ransac, lmeds, magsac, ste (the article's),"
            " ste-printed (word for word); for image also ncc, phase, ecc, mi, which compare"
            " pixels.",
            default="magsac for links, ransac for image, ste for flightline",
        ),
    ] = None,
    transform: Annotated[
        str | None,
        option(
            METHOD,
            "How two photos may differ, for image and flightline: translation, similarity, affine,"
            " homography.",
            default="similarity for image, homography for flightline",
        ),
    ] = None,
    features: Annotated[int, option(METHOD, "Features per photo.")] = 1200,
    distortion: Annotated[
        str | None,
        option(
            CAMERA,
            "Lens terms to calibrate, or, for methods that do not, to keep of a known calibration:"
            " none, 2, 4, 6 (radial order), 6t (and tangential), full (and the aspect ratio).",
            default="full to calibrate, 6t to keep",
        ),
    ] = None,
    shutter: Annotated[str | None, option(CAMERA, SHUTTERS, default=SHUTTER_UNSAID)] = None,
    shutter_readout: Annotated[
        float | None, option(CAMERA, READOUTS, default=READOUT_UNSAID)
    ] = None,
    height: Annotated[
        float | None, option(CAMERA, "Height above ground in m, for methods that do not find it.")
    ] = None,
    surface: Annotated[
        str,
        option(
            PICTURE, "Heights: auto (dense where there is relief), dense (everywhere), sweep, ties."
        ),
    ] = "auto",
    vertical_datum: Annotated[
        str | None, option(PICTURE, VERTICAL_DATUMS, default="what most photos state")
    ] = None,
    bounds: Annotated[
        str | None, option(PICTURE, "west,south,east,north in the output CRS.")
    ] = None,
    boundary: Annotated[
        Path | None,
        option(PICTURE, "Polygon to cut the map to: GeoJSON, KML, GeoPackage, Shapefile."),
    ] = None,
    blend: Annotated[
        str, option(PICTURE, "Where photos meet: auto, feather, first, average, multiband.")
    ] = "auto",
    feather: Annotated[float, option(PICTURE, "Width of feathered seams in map pixels.")] = 6.0,
    max_view_angle: Annotated[
        float, option(PICTURE, "Largest angle from the vertical, in degrees, that photos show.")
    ] = 70.0,
    balance: Annotated[
        bool, option(PICTURE, "Bring photos to one brightness.", "--balance/--no-balance")
    ] = True,
    compress: Annotated[
        str, option(FILES, "auto, jpeg, or lossless: deflate, zstd, lzw, none.")
    ] = "auto",
    quality: Annotated[int, option(FILES, "JPEG quality.")] = 85,
    dtm: Annotated[
        bool, option(FILES, "Write dtm.tif as well: the ground without what stands on it.", "--dtm")
    ] = False,
    contours: Annotated[
        float | None, option(FILES, "Write contours.gpkg: lines of the ground, this many m apart.")
    ] = None,
    thermal_route: Annotated[
        str,
        option(
            THERMAL,
            "How the thermal map finds its place: rig (both cameras on one drone: on the visual"
            " poses), maps (the pictures of both), pairs (of photos), heights (the surfaces under"
            " them), positions (GPS alone), auto (the first that can be believed), homographies"
            " (of pairs, as the thesis writes them; never by auto).",
        ),
    ] = "auto",
    thermal_unit: Annotated[
        str | None,
        option(THERMAL, THERMAL_UNITS, default=f"auto with --thermal; else {UNIT_UNSAID}"),
    ] = None,
    balance_thermal: Annotated[
        bool | None,
        option(
            THERMAL,
            "Balance the drift between thermal frames on their overlaps, or leave values as"
            " recorded.",
            "--balance-thermal/--raw-thermal",
            default="temperatures balanced, counts raw",
        ),
    ] = None,
    export: Annotated[
        str | None,
        option(
            FILES,
            "Export the finished map as well, as `skyquilt export` does, to OUTPUT/export: png,"
            " kmz, mbtiles, tiles, tif, heights, footprints, separated by commas.",
        ),
    ] = None,
    write_frames: Annotated[
        bool, option(FILES, "Write the frames used of videos to frames/.", "--write-frames")
    ] = False,
    jobs: Annotated[int, option(RUN, "Threads; 0 = all processors.")] = 0,
    scheduler: Annotated[
        str | None,
        option(
            RUN,
            "Share the work out to processes: local:N (of this machine), tcp://HOST:PORT (a Dask"
            " scheduler), or a scheduler file.",
            default="threads of this process",
        ),
    ] = None,
    memory: Annotated[
        float | None, option(RUN, "Memory to stay within, in GB.", default="1.2")
    ] = None,
    max_mp: Annotated[float, option(RUN, MAX_MP)] = MOST_MP,
    max_memory: Annotated[float | None, option(RUN, MAX_MEMORY, default=MAX_MEMORY_UNSAID)] = None,
    seed: Annotated[int, option(RUN, "Of everything random; equal seeds give equal maps.")] = 0,
    add: Annotated[
        bool,
        option(
            RUN,
            "Add photos that joined the folder to the map in OUTPUT; what they do not change"
            " stays.",
            "--add",
        ),
    ] = False,
    rerun_from: Annotated[
        str | None,
        option(
            RUN,
            "Make everything anew from this stage on: frames (of videos), features, links, align,"
            " surface, balance, seams, mosaic, measure, report.",
        ),
    ] = None,
    quiet: Annotated[bool, option(RUN, "Say nothing but errors.", "--quiet", "-q")] = False,
    verbose: Annotated[
        bool, option(RUN, "Say more: every stage's time.", "--verbose", "-v")
    ] = False,
    json: Annotated[bool, option(RUN, "Print one JSON object per event.", "--json")] = False,
    levelled: Annotated[
        bool,
        option(IMAGE, "Register by features of the dominant plane.", "--levelled/--no-levelled"),
    ] = True,
    image_search: Annotated[
        str,
        option(
            IMAGE,
            "What a photo is registered to: chain (the last photo), loop (the same, with the"
            " loops of the chain closed), overview (the whole map so far).",
        ),
    ] = "chain",
    relief: Annotated[
        float | None,
        option(
            IMAGE,
            "Largest height variation on the ground in m, for --levelled.",
            default="a tenth of the height",
        ),
    ] = None,
    alpha: Annotated[
        float, option(HYBRID, "Weight of distances against looks in lambda, 0 to 1.")
    ] = 0.5,
    optimiser: Annotated[
        str,
        option(HYBRID, "How it searches: surfaces (correlation), anneal (simulated annealing)."),
    ] = "surfaces",
    lines: Annotated[
        str,
        option(FLIGHTLINE, "How lines are told apart: heading, or distance (as in the article)."),
    ] = "heading",
    heading: Annotated[
        float | None,
        option(POSITION, "Heading of all photos in degrees.", default="the commonest reported"),
    ] = None,
) -> None:
    """Turn a folder of drone photos and videos into a georeferenced, orthorectified mosaic.

    Sensible without any option. The same command again resumes a run that was killed.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show, show_exports
        from skyquilt.engine.memory_watch import ends_run, limit_bytes
        from skyquilt.settings import MosaicSettings
        from skyquilt.workflows.mosaic import STAGES, iter_mosaic

    if rerun_from is not None and rerun_from not in STAGES[1:]:
        raise UsageError(f"--rerun-from {rerun_from!r} is not one of {', '.join(STAGES[1:])}")
    for other, given in (
        ("--overwrite", overwrite),
        ("--rerun-from", rerun_from is not None),
        ("--thermal", thermal is not None),
        ("--all-bands", all_bands),
    ):
        if add and given:
            raise UsageError(f"--add and {other} exclude one another")
    if all_bands and thermal is not None:
        raise UsageError("--all-bands and --thermal exclude one another")
    source = source_of(photos)
    mode = mode_of(quiet=quiet, json=json, verbose=verbose)
    exporting = _exporting(export, output)
    settings = MosaicSettings(
        method=method,
        gcp=gcp,
        geo=geo,
        frame_overlap=frame_overlap,
        clock_offset=clock_offset,
        write_frames=write_frames,
        cameras=cameras,
        distances=distances,
        sequence=sequence,
        band=band,
        lever_arm=parse_lever_arm(lever_arm),
        repair=repair,
        detector=detector,
        matcher=matcher,
        estimator=estimator,
        transform=transform,
        features=features,
        distortion=distortion,
        shutter=shutter,
        shutter_readout_ms=shutter_readout,
        height_m=height,
        heading_deg=heading,
        surface=surface,
        dtm=dtm,
        contours_m=contours,
        gsd_cm=gsd,
        crs=crs,
        vertical_datum=vertical_datum,
        bounds=parse_bounds(bounds),
        boundary=boundary,
        blend=blend,
        feather_px=feather,
        max_view_angle=max_view_angle,
        balance=balance,
        balance_thermal=balance_thermal,
        thermal_unit=thermal_unit,
        compress=compress,
        quality=quality,
        jobs=jobs,
        scheduler=scheduler,
        memory_gb=memory,
        max_mp=max_mp,
        seed=seed,
        levelled=levelled,
        image_search=image_search,
        relief_m=relief,
        alpha=alpha,
        optimiser=optimiser,
        lines=lines,
    )
    if thermal is None and thermal_route != "auto":
        raise UsageError(f"--thermal-route {thermal_route!r} needs --thermal, a folder of photos")
    if thermal is not None:
        from skyquilt.thermal.workflow import iter_thermal

        if len(photos) > 1:
            raise UsageError("--thermal needs one folder of visible photos, not several paths")
        events = iter_thermal(
            photos[0],
            thermal,
            output,
            settings,
            route=thermal_route,
            overwrite=overwrite,
            rerun_from=rerun_from,
        )
    elif all_bands:
        from skyquilt.multispectral.workflow import iter_bands

        events = iter_bands(source, output, settings, overwrite=overwrite, rerun_from=rerun_from)
    else:
        events = iter_mosaic(
            source, output, settings, overwrite=overwrite, rerun_from=rerun_from, add=add
        )
    advice = "the same command resumes, with --memory smaller or --max-memory larger"
    with ends_run(limit_bytes(max_memory), advice):
        summary = with_thermal if thermal is not None else with_bands if all_bands else None
        show(events, mode=mode, summary=summary)
        if exporting is not None:
            show_exports(exporting(), mode=mode)


def _exporting(export: str | None, output: Path) -> "Callable[[], Iterator[Export]] | None":
    """What `--export` asks for, checked before the map is made.

    Raises:
        UsageError: it names what cannot be exported.
    """
    if export is None:
        return None
    from skyquilt.runs.export import Wanted, parse_what
    from skyquilt.runs.export import export as exports

    wanted = Wanted(what=parse_what(export))
    return lambda: exports(output, wanted)


def with_thermal(result: "Result") -> str:
    """A mosaic in a few lines, and how the thermal map lies on it."""
    from skyquilt.cli.progress import mosaic_summary

    t = result.metrics["thermal"]
    how = (
        "its own positions alone, several metres off without RTK"
        if t["route"] == "positions"
        else f"{t['route']}, {t['inliers']} {'pairs' if t['route'] == 'rig' else 'places'} agree"
    )
    return (
        f"{mosaic_summary(result)}\nthermal: {result.output / 'thermal.tif'} ({t['photos_used']} of"
        f" {t['photos_total']} photos, placed by {how})"
    )


def with_bands(result: "Result") -> str:
    """A mosaic in a few lines, and the bands beside it."""
    from skyquilt.cli.progress import mosaic_summary

    told = result.metrics["bands"]
    if not told["shown"]:
        return f"{mosaic_summary(result)}\nbands:  none"
    names = ", ".join(b["name"] for b in told["shown"])
    more = "".join(f", {name}" for name in told["files"] if name != "bands.tif")
    return (
        f"{mosaic_summary(result)}\nbands:  {result.output / 'bands.tif'} ({names}; values:"
        f" {told['values']}){more}"
    )


def parse_lever_arm(text: str | None) -> tuple[float, float, float] | None:
    """Three numbers separated by commas.

    Raises:
        UsageError: they are not.
    """
    if text is None:
        return None
    try:
        right, forward, up = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(
            f"--lever-arm is right,forward,up, three numbers in m; got {text!r}"
        ) from error
    return right, forward, up
