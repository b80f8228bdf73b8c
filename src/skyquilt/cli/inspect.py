"""`skyquilt inspect`: reports the metadata of photos and where they cannot be right."""

import json as json_module
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyquilt.cli.options import MaxMp, PhotoPaths, source_of
from skyquilt.outside import MOST_MP, plain, shown

if TYPE_CHECKING:
    from rich.table import Table

    from skyquilt.model.photo import GeoPosition, Photo, Survey

_SHUTTERS = {True: "rolling", False: "global or mechanical", None: "unknown"}
_DATUMS = {
    "takeoff": "take-off",
    "sea_level": "sea level",
    "egm96": "EGM96",
    "ellipsoid": "ellipsoid",
    "unknown": "?",
}


def camera_table(survey: "Survey") -> "Table":
    """One row per camera."""
    from rich.table import Table
    from rich.text import Text

    table = Table("camera", "photos", "size", "type", "focal length", "shutter", title="Cameras")
    for key in dict.fromkeys(p.camera_key for p in survey.photos):
        group = [p for p in survey.photos if p.camera_key == key]
        one = group[0]
        kind = f"{one.band} {one.channels} x {one.dtype} {one.unit}".strip()
        cells = (
            key,
            str(len(group)),
            f"{one.width}x{one.height}",
            kind,
            _focal(one),
            _SHUTTERS[one.rolling_shutter],
        )
        table.add_row(*(Text(plain(c)) for c in cells))  # names may look like markup
    return table


def photo_table(survey: "Survey") -> "Table":
    """One row per photo, in order of capture; notes common to all photos are listed below the table
    instead.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Photos, in order of capture")
    for heading in ("photo", "time", "focal px", "latitude, longitude"):
        table.add_column(heading, no_wrap=True)
    for heading in ("height m", "yaw / pitch / roll", "flight yaw"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("notes")
    shared = set(shared_notes(survey))
    for photo in survey.photos:
        notes = " ".join(n for n in photo.notes if n not in shared)
        table.add_row(*(Text(plain(c)) for c in (photo.name, *_cells(photo), notes)))
    return table


def clip_table(survey: "Survey") -> "Table":
    """One row per video clip."""
    from rich.table import Table

    table = Table(title="Videos; their frames are chosen when a map is made")
    for heading in ("video", "start", "size", "frames", "codec"):
        table.add_column(heading, no_wrap=True)
    for heading in ("focal px", "readout ms", "positions", "notes"):
        table.add_column(heading)
    for clip in survey.clips:
        track = clip.track
        table.add_row(
            clip.name,
            clip.start.isoformat(sep=" ", timespec="seconds") if clip.start else "-",
            f"{clip.width}x{clip.height}",
            f"{clip.frames} in {clip.duration_s:.1f} s",
            clip.codec,
            f"{clip.focal.px:.0f} +- {clip.focal.sigma_px:.0f} ({clip.focal.source})",
            f"{1000 * clip.shutter.readout_s:.0f} +- {1000 * clip.shutter.sigma_s:.0f}"
            f" ({clip.shutter.source})",
            f"{len(track.time_s)} ({track.file})" if track else "-",
            " ".join(clip.notes),
        )
    return table


def shared_notes(survey: "Survey") -> tuple[str, ...]:
    """Notes that all photos have."""
    if not survey.photos:
        return ()
    first = survey.photos[0].notes
    return tuple(n for n in first if all(n in p.notes for p in survey.photos))


def sentences(survey: "Survey", findings: tuple[str, ...]) -> Iterator[str]:
    """What is missing or contradictory, what was left out and why."""
    from skyquilt.photos.side_rows import sentence_of

    yield from (f"All photos: {note}" for note in shared_notes(survey) if len(survey.photos) > 1)
    yield from survey.notes
    yield from findings
    yield from (f"Left out: {r.name}: {r.reason}." for r in survey.rejected)
    if survey.ignored:
        yield f"Other files, not used: {sentence_of(survey.ignored)}."
    placed = sum(p.position is not None for p in survey.photos)
    turned = sum(p.attitude is not None for p in survey.photos)
    if survey.photos or not survey.clips:
        yield f"{len(survey.photos)} photos, {placed} with a position, {turned} with camera angles."
    if survey.clips:
        tracked = sum(c.track is not None for c in survey.clips)
        count = len(survey.clips)
        videos = "1 video" if count == 1 else f"{count} videos"
        yield f"{videos}, {tracked} with positions."


def _cells(photo: "Photo") -> tuple[str, ...]:
    attitude, yaw = photo.attitude, photo.flight_yaw_deg
    angles = (
        f"{attitude.yaw_deg:.1f} / {attitude.pitch_deg:.1f} / {attitude.roll_deg:.1f}"
        if attitude
        else "-"
    )
    return (
        photo.time.isoformat(sep=" ", timespec="milliseconds").removesuffix(".000")
        if photo.time
        else "-",
        _focal(photo),
        _place(photo.position),
        _height(photo.position),
        angles,
        f"{yaw:.1f}" if yaw is not None else "-",
    )


def _focal(photo: "Photo") -> str:
    return f"{photo.focal.px:.0f} +- {photo.focal.sigma_px:.0f} ({photo.focal.source})"


def _place(position: "GeoPosition | None") -> str:
    return f"{position.latitude_deg:.6f}, {position.longitude_deg:.6f}" if position else "-"


def _height(position: "GeoPosition | None") -> str:
    if position is None or position.altitude_m is None:
        return "-"
    return f"{position.altitude_m:.1f} ({_DATUMS[position.datum]})"


def command(
    photos: PhotoPaths,
    geo: Annotated[
        Path | None,
        typer.Option(
            help="Side file of positions: geo.txt, CSV, .SRT, .MRK, .pos, or a track (GPX, a CSV"
            " with times); of videos: .SRT, a track, or a folder of these."
        ),
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="Calibrations: cameras.json of OpenDroneMap.")
    ] = None,
    max_mp: MaxMp = MOST_MP,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Report the metadata of photos and videos, and what is missing or contradictory."""
    from skyquilt.photos.contradictions import contradictions
    from skyquilt.photos.survey import read_survey
    from skyquilt.settings import within

    within("--max-mp", max_mp, 0.01, 10_000, "megapixels")
    survey = read_survey(source_of(photos), geo=geo, cameras=cameras, max_mp=max_mp, clips=True)
    findings = contradictions(survey.photos)
    if json:
        record = {**asdict(survey), "contradictions": findings}
        for photo in record["rejected"]:
            photo.pop("trace")
        for clip in record["clips"]:
            clip["track"] = clip["track"] and _summary(clip["track"])
        sys.stdout.write(json_module.dumps(record, default=str, indent=1, allow_nan=False) + "\n")
    else:
        _show(survey, findings)


def _show(survey: "Survey", findings: tuple[str, ...]) -> None:
    from rich.console import Console

    console = Console(soft_wrap=False)
    if not console.is_terminal:
        console = Console(width=200)  # a pipe has no width; lines should not be wrapped
    if survey.photos:
        console.print(camera_table(survey), photo_table(survey))
    if survey.clips:
        console.print(clip_table(survey))
    for line in sentences(survey, findings):
        console.print(shown(line), markup=False, highlight=False)


def _summary(track: dict[str, object]) -> dict[str, object]:
    """A track with the number of its positions in place of these."""
    import numpy as np

    plain = {k: v for k, v in track.items() if not isinstance(v, np.ndarray)}
    times = np.asarray(track["time_s"])
    return plain | {"positions": len(times), "from_s": float(times[0]), "to_s": float(times[-1])}
