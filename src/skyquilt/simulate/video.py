"""A clip of the flight: the path between the waypoints, its frames, and the telemetry beside it."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from skyquilt.errors import OutputError
from skyquilt.simulate.camera import Lens, wrap
from skyquilt.simulate.flight import Shot, Waypoint
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.reported import Report
from skyquilt.simulate.settings import FlightSettings, Video

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
_DIAGONAL_35MM = float(np.hypot(36.0, 24.0))
_SHAKE_S, _SWAY_S = 1.5, 5.0
"""Times over which the camera's angles and the drone's position wander."""


def film(
    points: list[Waypoint], settings: FlightSettings, video: Video, takeoff: float
) -> list[Shot]:
    """True poses of all frames: along the lines at constant speed, in curves from one to the next.

    The flight begins at the first waypoint and ends at the last one, or after `seconds`.
    """
    route = settings.route
    path, lines, courses = _path(points)
    speed = route.speed
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    end = float(length[-1]) / speed
    end = min(end, video.seconds) if video.seconds is not None else end
    t = np.arange(0, end + 1e-9, 1 / video.fps)
    x, y = (np.interp(t * speed, length, path[:, k]) for k in (0, 1))
    course = np.interp(t * speed, length, courses)
    line = lines[np.minimum(np.searchsorted(length, t * speed), len(lines) - 1)]
    rng = np.random.default_rng([settings.seed, 61])
    sway = _wander(t, _SWAY_S, rng, 3) * route.jitter * [1, 1, 0.6]
    shake = _wander(t, _SHAKE_S, rng, 3) * [route.yaw_noise, route.tilt_noise, route.tilt_noise]
    shots = []
    for i, when in enumerate(t):
        heading = route.heading if route.fixed_yaw else float(np.degrees(course[i]))
        waypoint = Waypoint(
            x=float(x[i]),
            y=float(y[i]),
            heading=wrap(heading),
            line=int(line[i]),
            course=wrap(float(np.degrees(course[i]))),
            time=float(when),
        )
        shots.append(
            Shot(
                name=f"{i:06d}",
                waypoint=waypoint,
                centre=(
                    float(x[i] + sway[i, 0]),
                    float(y[i] + sway[i, 1]),
                    float(takeoff + route.height + sway[i, 2]),
                ),
                yaw=wrap(heading + float(shake[i, 0])),
                pitch=float(shake[i, 1]),
                roll=float(shake[i, 2]),
            )
        )
    return _moving(shots, t)


def _moving(shots: list[Shot], t: Doubles) -> list[Shot]:
    """Frames with the velocities and rates of rotation at which a rolling shutter meets them, by
    the poses before and after each; the first and the last have one of these.
    """
    last = len(shots) - 1
    moving = []
    for i, shot in enumerate(shots):
        a, b = max(i - 1, 0), min(i + 1, last)
        gap = float(t[b] - t[a]) or 1.0
        velocity = (shots[b].place - shots[a].place) / gap
        turn = Rotation.from_matrix(shots[b].rotation @ shots[a].rotation.T).as_rotvec()
        x, y, z = (float(v) for v in velocity)
        u, v, w = (float(v) for v in np.degrees(turn) / gap)
        moving.append(replace(shot, velocity=(x, y, z), spin=(u, v, w)))
    return moving


def _path(points: list[Waypoint]) -> tuple[Doubles, NDArray[np.int64], Doubles]:
    """A dense path (n, 2) over all waypoints, the line of each of its points and the course there
    in rad, without jumps.
    """
    runs: list[list[Waypoint]] = []
    for p in points:
        if runs and runs[-1][-1].line == p.line:
            runs[-1].append(p)
        else:
            runs.append([p])
    parts, lines = [], []
    last: tuple[Doubles, Doubles] | None = None
    for run in runs:
        a, b = np.array([run[0].x, run[0].y]), np.array([run[-1].x, run[-1].y])
        course = np.radians(run[0].heading if run[0].course is None else run[0].course)
        ahead = np.array([np.sin(course), np.cos(course)])
        if last is not None:
            parts.append(_curve(*last, a, ahead))
            lines.append(np.full(len(parts[-1]), run[0].line))
        share = np.linspace(0, 1, max(int(np.hypot(*(b - a)) / 0.25), 2))[:, None]
        parts.append(a + share * (b - a))
        lines.append(np.full(len(share), run[0].line))
        last = b, ahead
    path = np.concatenate(parts)
    keep = np.concatenate([[True], np.hypot(*np.diff(path, axis=0).T) > 1e-6])
    path = path[keep]
    step = np.diff(path, axis=0)
    course = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    return path, np.concatenate(lines)[keep], np.concatenate([course, course[-1:]])


def _curve(a: Doubles, ahead: Doubles, b: Doubles, then: Doubles) -> Doubles:
    """A curve from a in one direction to b in another: of the length of a half circle."""
    reach = 2.0 * float(np.hypot(*(b - a)))
    s = np.linspace(0, 1, max(int(2 * reach / 0.25), 8))[1:-1, None]
    return np.asarray(
        (2 * s**3 - 3 * s**2 + 1) * a
        + (s**3 - 2 * s**2 + s) * reach * ahead
        + (3 * s**2 - 2 * s**3) * b
        + (s**3 - s**2) * reach * then
    )


def _wander(t: Doubles, period: float, rng: np.random.Generator, columns: int) -> Doubles:
    """Smooth random functions (n, columns) of variance 1."""
    knots = np.arange(-2 * period, (t[-1] if len(t) else 0) + 3 * period, period)
    return np.asarray(CubicSpline(knots, rng.normal(0, 1, (len(knots), columns)))(t))


def gusts(t: Doubles, video: Video, seed: int) -> NDArray[np.bool_]:
    """Which frames a gust blurs: one gust in every `gust_every` seconds."""
    out = np.zeros(len(t), np.bool_)
    if video.gust_blur <= 0:
        return out
    rng = np.random.default_rng([seed, 62])
    start = 0.0
    while len(t) and start < t[-1]:
        begins = start + rng.uniform(0.2, 0.6) * video.gust_every
        out |= (t >= begins) & (t < begins + video.gust_seconds)
        start += video.gust_every
    return out


@dataclass(kw_only=True)
class ClipWriter:
    """Writes frames to a clip."""

    path: Path
    """The file."""
    fps: float
    """Frames per second."""
    lens: Lens
    """Gives the size."""

    def __post_init__(self) -> None:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        size = (self.lens.width, self.lens.height)
        self._writer = cv2.VideoWriter(str(self.path), cv2.CAP_FFMPEG, code, self.fps, size)
        if not self._writer.isOpened():
            raise OutputError(f"OpenCV cannot write a clip to {self.path}")

    def write(self, pixels: NDArray[np.uint8]) -> None:
        """Adds a frame (h, w, 3) RGB."""
        self._writer.write(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finishes the file."""
        self._writer.release()


def telemetry(
    reports: list[Report], times: Doubles, video: Video, lens: Lens, start: datetime
) -> str:
    """The subtitles beside a clip, in a layout of `LAYOUTS`.

    Positions are measured `fixes_per_second` times a second only: between, the fix before is
    repeated, as receivers do.
    """
    layout = _LAYOUTS[video.layout]
    focal = next((r.focal for r in reports if r.focal), None)
    mm = focal and focal * _DIAGONAL_35MM / float(np.hypot(lens.width, lens.height))
    rows, each = [], 1.0 if layout.per_second else 1 / video.fps
    shown = np.arange(0.0, times[-1] + 1e-9, each) if layout.per_second else times
    for number, at in enumerate(shown, 1):
        report = reports[fixed_in(float(at), video, len(reports))]
        index = min(round(at * video.fps), len(reports) - 1)
        here = reports[index]
        clock = start + timedelta(seconds=float(at - times[index]) + here.clock)
        body = layout.text(report, here, clock, mm, number, each)
        when = float(at) + video.shift
        rows.append(f"{number}\n{_span(when, when + each)}\n{body}\n")
    return "\n".join(rows) + "\n"


def fixed_in(time: float, video: Video, frames: int) -> int:
    """The frame, of so many, of the receiver's last fix at a time in s: receivers measure less
    often than cameras film. A fix is of the moment of the frame that shows it first.
    """
    fixed = np.floor(time * video.fixes_per_second + 1e-6) / video.fixes_per_second
    return min(int(np.ceil(fixed * video.fps - 1e-6)), frames - 1)


def _span(a: float, b: float) -> str:
    return f"{_stamp(a)} --> {_stamp(b)}"


def _stamp(seconds: float) -> str:
    ms = round(1000 * max(seconds, 0.0))
    return f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d},{ms % 1000:03d}"


_Text = Callable[[Report, Report, datetime, float | None, int, float], str]


@dataclass(frozen=True, kw_only=True)
class _Layout:
    text: _Text
    per_second: bool = False


def _bracketed(
    *, longitude: str = "longitude", heights: str = "both", gimbal: bool = False
) -> _Text:
    """The layouts of a subtitle for each frame."""

    def text(
        fix: Report, here: Report, clock: datetime, mm: float | None, number: int, each: float
    ) -> str:
        spelt = " : " if longitude != "longitude" else ": "
        tenths = heights == "sea"
        lens = ""
        if mm is not None:
            lens = f"[focal_len : {10 * mm:.0f}] " if tenths else f"[focal_len: {mm:.2f}] "
        place = f"[latitude{spelt}{fix.latitude or 0:.6f}]"
        place += f" [{longitude}{spelt}{fix.longitude or 0:.6f}] "
        up = {
            "both": f"[rel_alt: {here.takeoff or 0:.3f} abs_alt: {here.sea_level or 0:.3f}]",
            "sea": f"[altitude: {here.sea_level or 0:.6f}]",
            "": "",
        }[heights]
        angles = ""
        if gimbal and here.gimbal is not None:
            yaw, pitch, roll = here.gimbal
            angles = f" [gb_yaw: {yaw:.1f} gb_pitch: {pitch:.1f} gb_roll: {roll:.1f}]"
        moment = f"{clock:%Y-%m-%d %H:%M:%S}"
        milli = clock.microsecond // 1000
        moment += f",{milli:03d},{clock.microsecond % 1000:03d}" if tenths else f".{milli:03d}"
        return (
            f'<font size="28">FrameCnt: {number}, DiffTime: {1000 * each:.0f}ms\n{moment}\n'
            f"[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [ev: 0] {lens}{place}{up}{angles}"
            " </font>\n"
        )

    return text


def _old(
    fix: Report, here: Report, clock: datetime, mm: float | None, number: int, each: float
) -> str:
    """Mavic Pro."""
    place = f"{fix.longitude or 0:.4f},{fix.latitude or 0:.4f}"
    return (
        f"HOME({place}) {clock:%Y.%m.%d %H:%M:%S}\nGPS({place},16)"
        f" BAROMETER:{here.takeoff or 0:.1f}\nISO:100 Shutter:1000 EV: Fnum:2.8\n"
    )


def _latitude_first(
    fix: Report, here: Report, clock: datetime, mm: float | None, number: int, each: float
) -> str:
    """Matrice 300."""
    place = f"{fix.latitude or 0:.4f},{fix.longitude or 0:.4f}"
    return f"{clock:%Y.%m.%d %H:%M:%S}\nGPS({place},0.0M) BAROMETER:{here.takeoff or 0:.1f}M\n"


def _written(
    fix: Report, here: Report, clock: datetime, mm: float | None, number: int, each: float
) -> str:
    """Phantom 4 RTK."""
    yaw, pitch, roll = here.gimbal or (0.0, -90.0, 0.0)
    nose = here.flight_yaw or 0.0
    return (
        f"F/5.6, SS 400, ISO 100, EV 0,"
        f" GPS ({fix.longitude or 0:.6f}, {fix.latitude or 0:.6f}, 15),"
        f" D 150.00m, H {here.takeoff or 0:.2f}m, H.S 6.00m/s, V.S 0.00m/s,"
        f" F.PRY (0.0°, 0.0°, {nose:.1f}°), G.PRY ({pitch:.1f}°, {roll:.1f}°, {yaw:.1f}°)\n"
    )


_LAYOUTS: dict[str, _Layout] = {
    "mavic3": _Layout(text=_bracketed()),
    "gimbal": _Layout(text=_bracketed(gimbal=True)),
    "air2s": _Layout(text=_bracketed(heights="sea")),
    "mavic2": _Layout(text=_bracketed(longitude="longtitude", heights="")),
    "p4rtk": _Layout(text=_written, per_second=True),
    "mavic-pro": _Layout(text=_old, per_second=True),
    "matrice300": _Layout(text=_latitude_first, per_second=True),
}


def pictures_of(settings: FlightSettings, video: Video, *, gust: bool) -> "FlightSettings":
    """The settings of one frame's picture: blurred in a gust."""
    pictures = settings.pictures
    blur = video.gust_blur if gust else pictures.motion_blur
    return replace(settings, pictures=replace(pictures, motion_blur=blur))
