"""The camera's place in the aircraft: positions of the antenna become positions of the camera."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from skyquilt.geometry.frames import beside_deg, ned_from_body
from skyquilt.model.photo import GeoPosition, Photo
from skyquilt.photos.side_rows import sentence_of


def with_lever_arm(
    photos: Sequence[Photo], right_forward_up_m: tuple[float, float, float]
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos with positions moved from the antenna to the camera, and notes.

    The arm is turned by the aircraft's angles: its heading, pitch and roll where they are reported,
    else the camera's heading and a level aircraft. Positions of an MRK file have their own offsets
    and are left as they are, as are photos without a heading.
    """
    right, forward, up = right_forward_up_m
    body = np.array([forward, right, -up])
    moved, left = [], []
    for photo in photos:
        heading = photo.flight_yaw_deg
        if heading is None and photo.attitude is not None:
            heading = photo.attitude.yaw_deg
        if photo.position is None or photo.position.source == "mrk" or heading is None:
            left += [] if photo.position is None else [photo.name]
            moved.append(photo)
            continue
        pitch, roll = photo.flight_tilt_deg
        north, east, down = (ned_from_body(heading, pitch, roll) @ body).tolist()
        moved.append(replace(photo, position=_shifted(photo.position, north, east, down)))
    why = "their MRK file has offsets of its own, or no heading is known"
    notes = (f"The lever arm was not applied to {sentence_of(left)}: {why}.",) if left else ()
    return tuple(moved), notes


def _shifted(position: GeoPosition, north: float, east: float, down: float) -> GeoPosition:
    """A position moved by m to the north, east and down."""
    heights = {
        name: height - down
        for name in ("altitude_m", "takeoff_m", "sea_level_m", "ellipsoid_m")
        if (height := getattr(position, name)) is not None and name != "takeoff_m"
    }
    if position.datum == "takeoff":
        heights.pop("altitude_m", None)  # a barometer's zero has the same arm
    latitude, longitude = beside_deg(
        position.latitude_deg, position.longitude_deg, east_m=east, north_m=north
    )
    return replace(position, latitude_deg=latitude, longitude_deg=longitude, **heights)
