"""The workflow of the simulator: from settings to a folder of photos with their truth."""

import os
import shutil
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from skyquilt.errors import OutputError
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.clip_tracks import add_track, track_in_clip
from skyquilt.simulate.clouds import clouds_of
from skyquilt.simulate.control import lay_out, observations, survey, write_gcp_list
from skyquilt.simulate.exif import Body, write_jpeg, write_tiff
from skyquilt.simulate.expose import exposer, footprint
from skyquilt.simulate.flight import Shot, Waypoint, fly, plan, site
from skyquilt.simulate.ground import Ground
from skyquilt.simulate.multispectral import SHORT, Sensor, rig_of, told
from skyquilt.simulate.noise import Noise
from skyquilt.simulate.reported import Place, Report, Start, place_at, report_all
from skyquilt.simulate.scene import Country, Scene, empty_scene
from skyquilt.simulate.settings import FlightSettings, Multispectral, Pictures, Thermal, Video
from skyquilt.simulate.smoke import smoke_of
from skyquilt.simulate.terrain import WATER_M, depth
from skyquilt.simulate.truth import (
    Taken,
    TakenClip,
    covered,
    write_bands,
    write_rasters,
    write_thermal,
    write_truth,
)
from skyquilt.simulate.video import ClipWriter, film, gusts, pictures_of, telemetry
from skyquilt.simulate.weather import Weather

_SMOOTH_S = 300.0
"""Correlation time of the position errors of a flight filmed. With 2 m they change by 0.43 m in 7 s
on each axis; those of the Phantom 3 over Brighton change by 0.19 m in that time.
"""
EXPOSURE_S = 1e-3
"""Time for which the shutter of a planned flight is open."""
_OURS = ("photos", "thermal", "multispectral", "video", "truth", "gcp_list.txt")


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of the simulation."""

    stage: str
    """`terrain`, `photos`, `video`, `multispectral`, `thermal terrain`, `thermal` or `truth`."""
    done: int
    """Steps done in this stage."""
    total: int
    """Steps of this stage."""
    name: str = ""
    """Name of the item that was finished."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """One flight with one kind of camera, flown and reported."""

    lens: Lens
    """The true camera."""
    shots: list[Shot]
    """True poses."""
    reports: list[Report]
    """The metadata."""


@dataclass(frozen=True, kw_only=True, eq=False)
class World:
    """Everything that is determined before the first pixel is drawn."""

    settings: FlightSettings
    """The requested settings."""
    place: Place
    """Position on Earth."""
    start: Start
    """Zero heights of the reports."""
    country: Country
    """The terrain."""
    visible: Flight
    """The main flight."""
    thermal: Flight | None
    """The thermal flight."""
    video: Flight | None
    """The frames of the clip."""


def prepare(
    settings: FlightSettings,
    waypoints: list[Waypoint] | None = None,
    takeoff: tuple[float, float] | None = None,
) -> World:
    """Plans, flies and reports; `waypoints` replaces the planned route, `takeoff` (local x, y) the
    place from which heights count, that of the first photo.

    Raises UsageError for settings that do not fit together.
    """
    settings = settings.checked()
    points = plan(settings.route, settings.lens) if waypoints is None else waypoints
    place = place_at(settings.scene.latitude, settings.scene.longitude)
    scene = settings.scene
    hills = Ground(noise=Noise(seed=settings.seed), relief=scene.relief, kind=scene.kind)
    home = takeoff or (points[0].x, points[0].y)
    start = Start(base=settings.scene.base, takeoff=hills.at(*home))
    shots = fly(points, settings.route, start.takeoff, settings.seed, "SIM")
    reports = report_all(shots, settings.reporting, place, start, settings.lens, settings.seed)
    visible = Flight(lens=settings.lens, shots=shots, reports=reports)
    thermal = (
        _thermal_flight(settings, settings.thermal, points, place, start)
        if settings.thermal
        else None
    )
    video = (
        _video_flight(settings, settings.video, points, place, start) if settings.video else None
    )
    country = Country(
        settings=settings.scene,
        bounds=_bounds(settings, [visible, thermal, video]),
        seed=settings.seed,
    )
    reach = (
        0.3
        * min(settings.lens.width, settings.lens.height)
        * settings.route.height
        / settings.lens.focal
    )
    targets = lay_out(settings.control, country, settings.lens, shots, reach, settings.resolution)
    return World(
        settings=settings,
        place=place,
        start=start,
        country=replace(country, targets=targets),
        visible=visible,
        thermal=thermal,
        video=video,
    )


def _video_flight(
    settings: FlightSettings, video: Video, points: list[Waypoint], place: Place, start: Start
) -> Flight:
    """The same flight filmed: errors of consecutive positions are alike, as receivers smooth."""
    shots = film(points, settings, video, start.takeoff)
    reporting = settings.reporting
    reporting = replace(
        reporting,
        gps_correlation=max(reporting.gps_correlation, _SMOOTH_S),
        barometer_noise=0.0,
        yaw_lie="none",
        dewarp=None,
    )
    reports = report_all(shots, reporting, place, start, settings.lens, settings.seed + 2)
    return Flight(lens=settings.lens, shots=shots, reports=reports)


def _thermal_flight(
    settings: FlightSettings, thermal: Thermal, points: list[Waypoint], place: Place, start: Start
) -> Flight:
    """The thermal flight over the same site, with its own lines."""
    route = replace(
        settings.route,
        pattern=settings.route.pattern if settings.route.pattern == "strip" else "block",
        site=site(points, settings.route.heading),
        overlap=thermal.overlap,
        sidelap=thermal.sidelap,
        height=thermal.height,
        drones=1,
        lost=0,
    )
    if route.pattern == "strip":
        forward = (1 - route.overlap) * route.height * thermal.lens.height / thermal.lens.focal
        route = replace(route, photos=int(np.ceil((route.site or (0, 0))[0] / forward)) + 1)
    shots = fly(plan(route, thermal.lens), route, start.takeoff, settings.seed, "THM_T")
    reporting = replace(settings.reporting, dewarp=None)
    reports = report_all(shots, reporting, place, start, thermal.lens, settings.seed + 1)
    return Flight(lens=thermal.lens, shots=shots, reports=reports)


def _bounds(
    settings: FlightSettings, flights: list[Flight | None]
) -> tuple[float, float, float, float]:
    """The area that all photos can see of the lowest ground, with a margin."""
    lowest = -0.9 * settings.scene.relief - 1.0 - depth(settings.scene.kind)
    parts = [footprint(f.lens, shot, lowest) for f in flights if f is not None for shot in f.shots]
    ground = np.concatenate(parts)
    (x0, y0), (x1, y1) = ground.min(axis=0) - 3.0, ground.max(axis=0) + 3.0
    return float(x0), float(y0), float(x1), float(y1)


def simulate(
    settings: FlightSettings,
    output: Path,
    *,
    overwrite: bool = False,
    waypoints: list[Waypoint] | None = None,
    takeoff: tuple[float, float] | None = None,
) -> Iterator[Progress]:
    """Simulates a survey with known truth and writes it; yields progress. `waypoints` and
    `takeoff` as for `prepare`.

    Raises UsageError for settings that do not fit together, OutputError where the folder is not
    empty or not writable.
    """
    world = prepare(settings, waypoints, takeoff)
    try:
        _make_room(output, overwrite)
        yield from _write(world, output)
    except OSError as error:
        raise OutputError(f"cannot write to {output}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(output / ".scratch", ignore_errors=True)


def _make_room(output: Path, overwrite: bool) -> None:
    """Prepares the output folder; with `overwrite`, only files of an earlier simulation are
    removed.
    """
    place = output.absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        what = "a file" if place.exists() else "a link that leads nowhere"
        raise OutputError(f"{place} is {what}; a folder is needed there")
    if output.is_dir() and any(output.iterdir()):
        if not overwrite:
            raise OutputError(f"{output} is not empty; choose another folder or add --overwrite")
        for name in _OURS:
            path = output / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    (output / "truth").mkdir(parents=True, exist_ok=True)


def _write(world: World, output: Path) -> Iterator[Progress]:
    settings, country = world.settings, world.country
    scene = yield from _drawn(world, output, "terrain", settings.resolution, heat=False)
    taken = yield from photograph(world, scene, output)
    points = survey(settings.control, country, world.place)
    visible = world.visible
    found = observations(
        settings.control, country, scene, visible.lens, visible.shots, visible.reports
    )
    seen = [replace(s, photo=s.photo + ".jpg") for s in found]
    if points:
        write_gcp_list(output / "gcp_list.txt", world.place.crs, points, seen)
    part = covered(scene.grid, visible.lens, visible.shots, 0.0)
    write_rasters(output / "truth", scene, part, world.place, world.start.base)
    clips = []
    if world.video is not None and settings.video is not None:
        clips.append((yield from _roll(world, world.video, settings.video, scene, output)))
    if settings.multispectral is not None:
        taken += yield from _bands(world, settings.multispectral, scene, output)
        write_bands(output / "truth", scene, part, world.place)
    del scene
    if world.thermal is not None and settings.thermal is not None:
        taken += yield from _film(world, world.thermal, settings.thermal, output)
    write_truth(
        output / "truth" / "truth.json",
        settings,
        world.place,
        world.start,
        taken,
        points,
        seen,
        clips,
    )
    yield Progress(stage="truth", done=1, total=1)


def _drawn(
    world: World, output: Path, stage: str, res: float, *, heat: bool
) -> Generator[Progress, None, Scene]:
    """Draws the terrain; returns the scene."""
    thermal = world.settings.thermal
    weather = thermal.weather if heat and thermal is not None else world.settings.weather
    scene = empty_scene(
        world.country.grid(res),
        thermal=heat,
        scratch=output / ".scratch" / stage,
        hours=not heat and world.settings.pictures.sun_hours > 0,
        water=WATER_M if world.settings.scene.kind == "shore" else None,
    )
    for done, total in world.country.draw(scene, weather, scratch=output / ".scratch" / stage):
        yield Progress(stage=stage, done=done, total=total)
    return scene


def photograph(
    world: World,
    scene: Scene,
    output: Path,
    *,
    resume: bool = False,
    share: tuple[int, int] = (0, 1),
) -> Generator[Progress, None, list[Taken]]:
    """Takes and writes the visible photos; returns what was taken. `resume`: files that are there
    already are kept. `share`: (k, n), only the k-th, counted from 0, of every n photos.
    """
    pictures, flight = world.settings.pictures, world.visible
    camera = exposer(scene, flight.lens)
    folder = output / "photos"
    folder.mkdir(exist_ok=True)
    taken = []
    shaken = np.random.default_rng([world.settings.seed, 54]).permutation(len(flight.shots))
    spoilt = set(shaken[: pictures.blurred].tolist())
    smoke = smoke_of(pictures.fires, flight.shots, world.settings.seed)
    clouds = clouds_of(pictures.clouds, world.settings.seed)
    sharp, shake = pictures, replace(pictures, motion_blur=pictures.blurred_px)
    for number, (shot, report) in enumerate(zip(flight.shots, flight.reports, strict=True)):
        if number % share[1] != share[0]:
            continue
        rng = np.random.default_rng([world.settings.seed, 51, number])
        pictures = shake if number in spoilt else _moving(sharp, shot, flight.lens)
        gain = float(np.exp(rng.normal(0, pictures.exposure_noise)))
        name = f"{shot.name}.jpg"
        if not (resume and (folder / name).exists()):
            pixels = camera.visible(shot, pictures, gain, rng, _moment(world, shot), smoke, clouds)
            if report.turned:
                pixels = np.ascontiguousarray(pixels[::-1, ::-1])
            body = Body(
                model="Simulated 4:3",
                serial=f"SIM{shot.waypoint.drone + 1:03d}",
                start=world.settings.weather.moment,
            )
            part = folder / f".{name}"  # whole, or not there
            write_jpeg(part, pixels, report, body, pictures.quality)
            part.replace(folder / name)
        taken.append(
            Taken(
                shot=shot,
                report=report,
                band="visible",
                file=f"photos/{name}",
                exposure=gain,
                blurred=number in spoilt,
            )
        )
        yield Progress(stage="photos", done=number + 1, total=len(flight.shots), name=name)
    return taken


def _moving(pictures: Pictures, shot: Shot, lens: Lens) -> Pictures:
    """The settings of a photo of a planned flight: blurred by what passes below the drone while the
    shutter is open.
    """
    if shot.waypoint.velocity is None:
        return pictures
    passed = float(np.hypot(*shot.waypoint.velocity)) * EXPOSURE_S
    blur = passed * lens.focal / shot.waypoint.above
    return replace(pictures, motion_blur=max(pictures.motion_blur, blur))


def _roll(
    world: World, flight: Flight, video: Video, scene: Scene, output: Path
) -> Generator[Progress, None, TakenClip]:
    """Films and writes the clip and its telemetry; returns what was taken."""
    folder, settings = output / "video", world.settings
    folder.mkdir(exist_ok=True)
    camera = exposer(scene, flight.lens)
    times = np.array([s.waypoint.time for s in flight.shots])
    windy = gusts(times, video, settings.seed)
    smoke = smoke_of(settings.pictures.fires, flight.shots, settings.seed)
    clouds = clouds_of(settings.pictures.clouds, settings.seed)
    path = folder / "FLIGHT.MP4"
    writer = ClipWriter(path=path, fps=video.fps, lens=flight.lens)
    try:
        for number, shot in enumerate(flight.shots):
            rng = np.random.default_rng([settings.seed, 53, number])
            pictures = pictures_of(settings, video, gust=bool(windy[number])).pictures
            writer.write(camera.visible(shot, pictures, 1.0, rng, None, smoke, clouds))
            yield Progress(
                stage="video", done=number + 1, total=len(flight.shots), name=f"{number:06d}"
            )
    finally:
        writer.close()
    track = track_in_clip(flight.reports, times, video, settings.weather.moment)
    if track is not None:
        add_track(path, track)
    else:
        text = telemetry(flight.reports, times, video, flight.lens, settings.weather.moment)
        path.with_suffix(".SRT").write_text(text, encoding="utf-8")
    frames = [
        Taken(shot=s, report=r, band="visible", file="video/FLIGHT.MP4", exposure=1.0)
        for s, r in zip(flight.shots, flight.reports, strict=True)
    ]
    return TakenClip(file="video/FLIGHT.MP4", fps=video.fps, frames=frames, blurred=windy.tolist())


def _bands(
    world: World, asked: Multispectral, scene: Scene, output: Path
) -> Generator[Progress, None, list[Taken]]:
    """Takes and writes a file for each band of each photo; returns what was taken."""
    flight, settings = world.visible, world.settings
    rig = rig_of(asked, flight.lens, settings.seed)
    sensors = [Sensor.over(scene, band) for band in rig]
    folder = output / "multispectral"
    folder.mkdir(exist_ok=True)
    taken = []
    for number, (shot, report) in enumerate(zip(flight.shots, flight.reports, strict=True)):
        rng = np.random.default_rng([settings.seed, 55, number])
        light = 1 + asked.light_changes * float(np.sin(shot.waypoint.time / 40))
        said = light * (1 + asked.sun_sensor_noise * float(rng.normal()))
        capture = f"{settings.seed:08x}-{number:08x}"
        plain = replace(report, turned=False, focal=None, dewarp=None)
        for sensor in sensors:
            band = sensor.band
            counts, us = sensor.counts(shot, light, rng)
            body = Body(
                model="Simulated multispectral",
                serial=f"MSP{shot.waypoint.drone + 1:03d}",
                start=settings.weather.moment,
            )
            name = f"{shot.name}_MS_{SHORT[band.name]}.TIF"
            more = told(band, asked, flight.lens, capture, us, said)
            write_tiff(folder / name, counts, plain, body, f"band {band.name}", more)
            taken.append(
                Taken(
                    shot=sensor.shot(shot),
                    report=plain,
                    band=band.name,
                    file=f"multispectral/{name}",
                    exposure=us / 1e6,
                )
            )
        yield Progress(
            stage="multispectral", done=number + 1, total=len(flight.shots), name=shot.name
        )
    return taken


def _moment(world: World, shot: Shot) -> Weather | None:
    """The sunlight of a photo; None where the sun stands still."""
    hours, weather = world.settings.pictures.sun_hours, world.settings.weather
    if not hours:
        return None
    last = max(s.waypoint.time for s in world.visible.shots)
    share = shot.waypoint.time / last if last > 0 else 0.0
    return replace(weather, hour=min(weather.hour + hours * share, 23.99))


def _film(
    world: World, flight: Flight, thermal: Thermal, output: Path
) -> Generator[Progress, None, list[Taken]]:
    """Takes and writes the thermal frames; returns what was taken."""
    res = thermal.height / thermal.lens.focal
    scene = yield from _drawn(world, output, "thermal terrain", res, heat=True)
    camera = exposer(scene, flight.lens)
    body = Body(model="Simulated thermal", serial="THM001", start=thermal.weather.moment)
    folder = output / "thermal"
    folder.mkdir(exist_ok=True)
    taken = []
    for number, (shot, report) in enumerate(zip(flight.shots, flight.reports, strict=True)):
        rng = np.random.default_rng([world.settings.seed, 52, number])
        offset = float(rng.normal(0, thermal.drift))
        counts = camera.heat(shot, thermal.noise, offset, rng)
        if report.turned:
            counts = np.ascontiguousarray(counts[::-1, ::-1])
        name = f"{shot.name}.tif"
        write_tiff(folder / name, counts, report, body)
        taken.append(
            Taken(shot=shot, report=report, band="thermal", file=f"thermal/{name}", exposure=offset)
        )
        yield Progress(stage="thermal", done=number + 1, total=len(flight.shots), name=name)
    write_thermal(
        output / "truth", scene, covered(scene.grid, flight.lens, flight.shots, 0.0), world.place
    )
    return taken
