"""`skyquilt simulate`: a flight with known truth over procedural terrain."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from skyquilt.cli.options import in_percent
from skyquilt.errors import UsageError
from skyquilt.outside import whole

if TYPE_CHECKING:
    from skyquilt import simulate as sim
    from skyquilt.simulate.settings import FlightSettings, Multispectral
    from skyquilt.simulate.weather import Weather

PresetName = Literal["default", "demo", "strip", "roundtrip", "thermal", "drones"]
TerrainName = Literal[
    "landscape",
    "bare",
    "slope",
    "cliff",
    "quarry",
    "bridge",
    "town",
    "shore",
    "orchard",
    "crops",
    "solar",
    "dunes",
    "chessboard",
]
"""Equal to `simulate.terrain.Terrain`, which is not imported before it is needed."""


def command(
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="folder for photos/, gcp_list.txt and truth/")
    ],
    preset: Annotated[
        PresetName, typer.Option(help="flight to start from; the options change it")
    ] = "default",
    photos: Annotated[int | None, typer.Option(help="photos planned")] = None,
    overlap: Annotated[
        float | None, typer.Option(help="forward overlap, percent", callback=in_percent)
    ] = None,
    sidelap: Annotated[
        float | None, typer.Option(help="side overlap, percent", callback=in_percent)
    ] = None,
    height: Annotated[float | None, typer.Option(help="above take-off, m")] = None,
    speed: Annotated[float | None, typer.Option(help="over ground, m/s")] = None,
    stops: Annotated[bool, typer.Option("--stops", help="the drone stops for each photo")] = False,
    fixed_yaw: Annotated[
        bool, typer.Option("--fixed-yaw", help="the camera does not turn with the lines")
    ] = False,
    turns: Annotated[
        float | None, typer.Option(help="rate at which the camera turns, std. dev., degrees/s")
    ] = None,
    shutter_readout: Annotated[
        float | None, typer.Option(help="of a rolling shutter, ms; 0 = all rows at once")
    ] = None,
    aspect: Annotated[
        float | None, typer.Option(help="focal length along columns over that along rows")
    ] = None,
    fisheye: Annotated[
        bool, typer.Option("--fisheye", help="the lens is a fisheye (equidistant)")
    ] = False,
    field_of_view: Annotated[
        float | None, typer.Option(help="of the photo's diagonal, degrees")
    ] = None,
    dewarp: Annotated[
        str | None,
        typer.Option(help="a factory calibration in the files, with these P1,P2 in place of true"),
    ] = None,
    aspect_untold: Annotated[
        bool, typer.Option("--aspect-untold", help="that calibration says fy = fx")
    ] = False,
    rtk: Annotated[
        bool, typer.Option("--rtk", help="files state --gps-noise as the deviation of RTK")
    ] = False,
    gps_noise_z: Annotated[
        float | None, typer.Option(help="of heights, m; 1.5 times --gps-noise if not given")
    ] = None,
    heading: Annotated[
        float | None, typer.Option(help="of the first line, degrees from north")
    ] = None,
    size: Annotated[str | None, typer.Option(help="photo size in px, such as 1600x1200")] = None,
    gps_noise: Annotated[float | None, typer.Option(help="standard deviation, m")] = None,
    gps_missing: Annotated[int | None, typer.Option(help="photos without position")] = None,
    yaw_lie: Annotated[
        Literal["none", "turned", "tag"] | None,
        typer.Option(help="middle line: files turned by 180 degrees, or only the tag wrong"),
    ] = None,
    compass_error: Annotated[
        float | None, typer.Option(help="of all headings alike, degrees")
    ] = None,
    gimbal_error: Annotated[
        float | None, typer.Option(help="of all pitch angles alike, degrees")
    ] = None,
    altitude_drift: Annotated[
        float | None, typer.Option(help="error of reported heights at the end, m")
    ] = None,
    focal_error: Annotated[
        float | None, typer.Option(help="of the focal length in the EXIF, percent")
    ] = None,
    no_focal: Annotated[
        bool, typer.Option("--no-focal", help="leave the focal length out")
    ] = False,
    tilt_noise: Annotated[float | None, typer.Option(help="standard deviation, degrees")] = None,
    relief: Annotated[
        float | None, typer.Option(help="height between low and high ground, m")
    ] = None,
    terrain: Annotated[TerrainName | None, typer.Option(help="kind of terrain")] = None,
    season: Annotated[
        Literal["summer", "winter"] | None, typer.Option(help="of the photos")
    ] = None,
    hour: Annotated[float | None, typer.Option(help="solar time of the photos, 0-24")] = None,
    exposure_noise: Annotated[
        float | None, typer.Option(help="relative change from photo to photo")
    ] = None,
    vignetting: Annotated[
        float | None, typer.Option(help="loss of light in the corners, percent")
    ] = None,
    sun_hours: Annotated[
        float | None, typer.Option(help="hours by which the sun moves on over the flight")
    ] = None,
    motion_blur: Annotated[float | None, typer.Option(help="length, px")] = None,
    thermal: Annotated[
        bool | None, typer.Option("--thermal/--no-thermal", help="a thermal flight as well")
    ] = None,
    thermal_season: Annotated[
        Literal["summer", "winter"] | None, typer.Option(help="of the thermal flight")
    ] = None,
    thermal_hour: Annotated[
        float | None, typer.Option(help="solar time of the thermal flight")
    ] = None,
    multispectral: Annotated[
        bool | None,
        typer.Option(
            "--multispectral/--no-multispectral",
            help="files of five bands of a camera beside that of the photos, as well",
        ),
    ] = None,
    video: Annotated[
        float | None, typer.Option(help="a clip of the flight, of so many frames per second")
    ] = None,
    video_seconds: Annotated[
        float | None, typer.Option(help="the clip ends after so many seconds")
    ] = None,
    srt_layout: Annotated[
        Literal[
            "mavic3",
            "gimbal",
            "air2s",
            "mavic2",
            "p4rtk",
            "mavic-pro",
            "matrice300",
            "mini2",
            "mini4",
            "gopro",
        ]
        | None,
        typer.Option(
            help="layout of the clip's telemetry, by the drone that writes it; the last three"
            " write it into the clip"
        ),
    ] = None,
    srt_shift: Annotated[
        float | None, typer.Option(help="seconds by which the telemetry is late")
    ] = None,
    gust_blur: Annotated[
        float | None, typer.Option(help="blur in gusts every 20 s of the clip, px")
    ] = None,
    drones: Annotated[int | None, typer.Option(help="flying at once")] = None,
    plan: Annotated[
        Path | None, typer.Option(help="plan.json to fly: its places, times, camera and site")
    ] = None,
    wind: Annotated[
        str | None,
        typer.Option(
            help="SPEED,FROM in m/s and degrees: pushes photos off places, drones of a plan lean"
        ),
    ] = None,
    lost: Annotated[
        float | None, typer.Option(help="photos of the plan lost on the way, percent")
    ] = None,
    blurred: Annotated[
        float | None, typer.Option(help="photos blurred one by one, percent")
    ] = None,
    fires: Annotated[
        int | None, typer.Option(help="fires on the site, whose smoke drifts over it")
    ] = None,
    clouds: Annotated[
        float | None,
        typer.Option(help="ground in shadows of clouds that drift with the wind, percent"),
    ] = None,
    lose: Annotated[int | None, typer.Option(help="photos lost on the way")] = None,
    oblique: Annotated[
        int | None,
        typer.Option(help="photos added that look ahead, tilted by up to 80 degrees, with sky"),
    ] = None,
    gcp: Annotated[int | None, typer.Option(help="control points")] = None,
    checks: Annotated[int | None, typer.Option(help="check points")] = None,
    seed: Annotated[int | None, typer.Option(help="equal seeds give equal files")] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace an earlier simulation in OUT")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
) -> None:
    """Simulate a drone survey: photos or a clip with metadata, control points, and the truth."""
    from skyquilt import simulate as sim
    from skyquilt.simulate.weather import Weather

    base = sim.preset(preset)
    if no_focal:
        base = _with(base, "reporting", focal_missing=True)
    base = _with(
        base,
        "route",
        photos=photos,
        overlap=_share(overlap),
        sidelap=_share(sidelap),
        height=height,
        heading=heading,
        tilt_noise=tilt_noise,
        drones=drones,
        lost=lose,
        speed=speed,
        stops=stops or None,
        fixed_yaw=fixed_yaw or None,
        turns=turns,
        oblique=oblique,
    )
    base = _with(
        base,
        "reporting",
        gps_noise=gps_noise,
        gps_noise_z=gps_noise_z,
        dewarp=_pair("--dewarp", dewarp),
        dewarp_aspect=False if aspect_untold else None,
        rtk=rtk or None,
        gps_missing=gps_missing,
        yaw_lie=yaw_lie,
        compass_error=compass_error,
        gimbal_error=gimbal_error,
        altitude_drift=altitude_drift,
        focal_error=_share(focal_error),
    )
    base = _with(base, "scene", relief=relief, kind=terrain)
    base = _with(base, "weather", season=season, hour=hour)
    base = _with(
        base,
        "pictures",
        exposure_noise=exposure_noise,
        vignetting=_share(vignetting),
        sun_hours=sun_hours,
        motion_blur=motion_blur,
        fires=fires,
        clouds=_share(clouds),
    )
    base = _with(base, "control", points=gcp, checks=checks)
    base = _thermal(
        base, thermal, Weather(season=thermal_season or "summer", hour=thermal_hour or 13.0)
    )
    if multispectral is not None:
        base = replace(base, multispectral=_multispectral(base, size) if multispectral else None)
    base = replace(base, seed=base.seed if seed is None else seed, lens=_lens(base, size))
    base = _video(
        base,
        fps=video,
        seconds=video_seconds,
        layout=srt_layout,
        shift=srt_shift,
        gust_blur=gust_blur,
    )
    readout = None if shutter_readout is None else shutter_readout / 1000
    base = _with(base, "lens", readout=readout, aspect=aspect, fisheye=fisheye or None)
    if field_of_view is not None:
        base = replace(base, lens=base.lens.seeing(field_of_view))
    pushed = _pair("--wind", wind)
    if pushed is not None:
        base = _with(base, "route", wind=pushed[0], wind_from=pushed[1])
    if plan is None:
        if lost is not None:
            raise UsageError("--lost is a share of a plan's photos; use --lose, or give --plan")
        base = _spoilt(base, blurred)
        flight = sim.simulate(base, out, overwrite=overwrite)
    else:
        flight = _planned(base, plan, out, lost=lost, blurred=blurred, size=size,
                          overwrite=overwrite)  # fmt: skip
    _show(flight, quiet)
    if not quiet:
        typer.echo(f"photos: {out / 'photos'}\ntruth:  {out / 'truth'}")


def _spoilt(settings: "FlightSettings", percent: float | None) -> "FlightSettings":
    """With a share of the photos blurred."""
    if percent is None:
        return settings
    if not 0 <= percent <= 100:
        raise UsageError(f"--blurred must be 0 to 100 %, not {percent:g}")
    return _with(settings, "pictures", blurred=round(percent / 100 * settings.route.photos))


def _planned(
    settings: "FlightSettings",
    path: Path,
    out: Path,
    *,
    lost: float | None,
    blurred: float | None,
    size: str | None,
    overwrite: bool,
) -> "Iterator[sim.Progress]":
    """The flight of a plan."""
    from skyquilt import simulate as sim
    from skyquilt.simulate.planned import planned_flight

    if not 0 <= (lost or 0) < 50:
        raise UsageError(f"--lost must be 0 to 49 %, not {lost:g}")
    flight = planned_flight(path, settings, lost=(lost or 0) / 100)
    changed = replace(flight.settings, lens=_lens(flight.settings, size))
    return sim.simulate(
        _spoilt(changed, blurred),
        out,
        overwrite=overwrite,
        waypoints=flight.waypoints,
        takeoff=flight.takeoff,
    )


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100


def _with(settings: "FlightSettings", part: str, **values: Any) -> "FlightSettings":
    """The settings with the given values of one part replaced."""
    given = {name: value for name, value in values.items() if value is not None}
    changed: Any = {part: replace(getattr(settings, part), **given)}
    return replace(settings, **changed)


def _thermal(
    settings: "FlightSettings", wanted: bool | None, weather: "Weather"
) -> "FlightSettings":
    flight = settings.thermal
    if wanted is not None:
        from skyquilt.simulate.settings import Thermal

        flight = (flight or Thermal()) if wanted else None
    return replace(settings, thermal=None if flight is None else replace(flight, weather=weather))


def _multispectral(settings: "FlightSettings", size: str | None) -> "Multispectral":
    """A multispectral camera whose files have three fifths of the width of the photos."""
    from skyquilt.simulate.settings import Multispectral

    lens = _lens(settings, size)
    return Multispectral(width=round(0.6 * lens.width), height=round(0.6 * lens.height))


def _video(settings: "FlightSettings", **values: Any) -> "FlightSettings":
    """With a clip, if `fps` is given."""
    given = {name: value for name, value in values.items() if value is not None}
    if "fps" not in given:
        if given:
            raise UsageError("options of a clip need --video FPS")
        return settings
    from skyquilt.simulate.settings import Video

    return replace(settings, video=Video(**given))


def _lens(settings: "FlightSettings", size: str | None) -> Any:
    """The preset's lens with another number of pixels."""
    if size is None:
        return settings.lens
    sides = [whole(word, 64, 12000) for word in size.lower().split("x")]
    match sides:
        case [int(width), int(height)]:
            return settings.lens.scaled(width, height)
    raise UsageError(f"--size must look like 1600x1200 (64 to 12000 px each), not '{size}'")


def _pair(option: str, text: str | None) -> tuple[float, float] | None:
    """Two numbers with a comma between them."""
    if text is None:
        return None
    try:
        a, b = (float(word) for word in text.split(","))
    except ValueError:
        raise UsageError(f"{option} takes two numbers such as 0.004,0.004, not '{text}'") from None
    return a, b


def _show(events: "Iterable[sim.Progress]", quiet: bool) -> None:
    """A bar for each stage."""
    if quiet:
        for _ in events:
            pass
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:16}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bars:
        tasks: dict[str, TaskID] = {}
        for event in events:
            if event.stage not in tasks:
                tasks[event.stage] = bars.add_task(event.stage)
            bars.update(tasks[event.stage], completed=event.done, total=event.total)
