"""Which way the photo says it looked."""

from skyquilt.geometry.frames import belly_from_gimbal
from skyquilt.model.photo import Attitude
from skyquilt.photos.xmp import Xmp

_GIMBAL = (
    ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
    ("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"),
)
_LOOKS_DOWN_AT_MINUS_90 = -45.0


def read_attitude(xmp: Xmp) -> tuple[Attitude | None, tuple[str, ...]]:
    """Belly angles, or None, with sentences on what is missing.

    `Gimbal*Degree` (DJI, Autel) and `drone-parrot:Camera*Degree` are gimbal angles (pitch -90 =
    nadir). Pix4D's `Camera:Yaw/Pitch/Roll` (senseFly, Parrot Sequoia, MicaSense) count as belly
    angles do: pitch 0 = nadir. Some write -90 there for nadir, and are taken so: no survey looks
    backwards to the horizon.
    """
    for names in _GIMBAL:
        yaw, pitch, roll = (xmp.number(name) for name in names)
        if yaw is not None:
            return _from_gimbal(yaw, pitch, roll, "xmp-gimbal")
    yaw, pitch, roll = (xmp.number(f"Camera:{a}") for a in ("Yaw", "Pitch", "Roll"))
    if yaw is None:
        return None, ("It carries no camera angles.",)
    if pitch is not None and pitch < _LOOKS_DOWN_AT_MINUS_90:
        return _from_gimbal(yaw, pitch, roll, "xmp-camera")
    attitude = Attitude(
        yaw_deg=yaw, pitch_deg=pitch or 0.0, roll_deg=roll or 0.0, source="xmp-camera"
    )
    return attitude, ()


def read_flight_yaw(xmp: Xmp) -> float | None:
    """Heading of the aircraft in degrees clockwise from north; None where it is not given."""
    return xmp.number("FlightYawDegree", "DroneYawDegree")


def _from_gimbal(
    yaw: float, pitch: float | None, roll: float | None, source: str
) -> tuple[Attitude, tuple[str, ...]]:
    notes = (
        ()
        if pitch is not None
        else ("It gives a gimbal yaw but no pitch; straight down is assumed.",)
    )
    belly = belly_from_gimbal(yaw, -90.0 if pitch is None else pitch, roll or 0.0)
    attitude = Attitude(yaw_deg=belly[0], pitch_deg=belly[1], roll_deg=belly[2], source=source)
    return attitude, notes
