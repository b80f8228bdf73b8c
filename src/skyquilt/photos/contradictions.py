"""Checks whether a survey's metadata contradict each other: they are measurements, not facts."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from skyquilt.geometry.frames import angle_difference_deg, east_north_m
from skyquilt.model.photo import GeoPosition, Photo
from skyquilt.photos.side_rows import sentence_of

_YAW_APART_DEG = 30.0
_NADIR_DEG = 30.0
_ALTITUDE_APART_M = 10.0
_ALTITUDE_RANGE_M = 40.0
_SHORT_MOVE_M = 3.0


def contradictions(photos: Sequence[Photo]) -> tuple[str, ...]:
    """Sentences that report both contradicting values; `photos` in order of capture."""
    return (*_yaws(photos), *_tracks(photos), *_altitudes(photos), *_focals(photos))


def yaw_disagreement_deg(photo: Photo) -> float | None:
    """Camera yaw minus flight yaw in [-180, 180) degrees; None where one is missing or the view is
    oblique.
    """
    if photo.attitude is None or photo.flight_yaw_deg is None:
        return None
    if max(abs(photo.attitude.pitch_deg), abs(photo.attitude.roll_deg)) > _NADIR_DEG:
        return None
    return angle_difference_deg(photo.attitude.yaw_deg, photo.flight_yaw_deg)


def _yaws(photos: Sequence[Photo]) -> Iterator[str]:
    found = [p for p in photos if abs(yaw_disagreement_deg(p) or 0.0) > _YAW_APART_DEG]
    if not found:
        return
    names = [p.name for p in found]
    camera = [p.attitude.yaw_deg for p in found if p.attitude]
    flight = [p.flight_yaw_deg for p in found if p.flight_yaw_deg is not None]
    yield (
        f"Camera yaw and flight yaw differ by more than {_YAW_APART_DEG:.0f} deg in {len(found)}"
        " photos "
        f"(camera {_range(camera)}, aircraft {_range(flight)} deg): {sentence_of(names)}. "
        "The camera may have been turned, or one of the two is wrong."
    )


def _tracks(photos: Sequence[Photo]) -> Iterator[str]:
    """Direction of flight from GPS against the aircraft's heading: a sideways flight, or a wrong
    heading.
    """
    apart = []
    for before, after in pairwise(photos):
        heading = after.flight_yaw_deg if after.flight_yaw_deg is not None else _camera_yaw(after)
        track = _track_deg(before.position, after.position)
        if heading is not None and track is not None:
            apart.append((after.name, abs(angle_difference_deg(track, heading))))
    odd = [name for name, d in apart if d > _YAW_APART_DEG]
    if len(odd) > max(2, len(apart) // 4):
        median = float(np.median([d for _, d in apart]))
        yield (
            "The direction of flight (from GPS) and the heading differ by more than"
            f" {_YAW_APART_DEG:.0f} deg at"
            f" {len(odd)} of {len(apart)} steps, by {median:.0f} deg in the median:"
            f" {sentence_of(odd)}."
        )


def _camera_yaw(photo: Photo) -> float | None:
    return photo.attitude.yaw_deg if photo.attitude else None


def _track_deg(a: GeoPosition | None, b: GeoPosition | None) -> float | None:
    if a is None or b is None:
        return None
    east, north = east_north_m(a, b)
    return (
        float(np.degrees(np.arctan2(east, north)))
        if np.hypot(north, east) > _SHORT_MOVE_M
        else None
    )


def _altitudes(photos: Sequence[Photo]) -> Iterator[str]:
    datums = sorted(
        {p.position.datum for p in photos if p.position and p.position.altitude_m is not None}
    )
    if len(datums) > 1:
        yield f"The heights refer to different zeros: {', '.join(datums)}."
    placed = [p.position for p in photos if p.position]
    both = [
        p.sea_level_m - p.takeoff_m
        for p in placed
        if p.sea_level_m is not None and p.takeoff_m is not None
    ]
    if both and max(both) - min(both) > _ALTITUDE_APART_M:
        yield (
            "Height above sea level minus height above take-off should be constant, but ranges from"
            " "
            f"{min(both):.0f} to {max(both):.0f} m: one of the two drifts."
        )
    for datum in datums:
        heights = [p.altitude_m for p in placed if p.datum == datum and p.altitude_m is not None]
        if max(heights) - min(heights) > _ALTITUDE_RANGE_M:
            yield (
                f"Heights ({datum.replace('_', ' ')}) range from {min(heights):.0f} to"
                f" {max(heights):.0f} m: "
                "the flight climbed, or the altitude drifts."
            )


def _focals(photos: Sequence[Photo]) -> Iterator[str]:
    for key in sorted({p.camera_key for p in photos}):
        focals = [p.focal.px for p in photos if p.camera_key == key]
        if max(focals) > 1.05 * min(focals):
            yield (
                f"Photos of {key} report focal lengths from {min(focals):.0f} to {max(focals):.0f}"
                " px."
            )


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.0f} to {max(values):.0f}"
