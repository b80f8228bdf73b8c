"""A strip of photos over chess-boards: observed corners, raised points, and views for
calibration.
"""

from dataclasses import dataclass, field

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.simulate.camera import Lens, camera_rotation
from skyquilt.simulate.flight import fly, plan
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.settings import Route, not_finite


def _wide() -> Lens:
    """28 mm on a full-size sensor, photos reduced to 1500 px."""
    return Lens(
        width=1500,
        height=1000,
        focal=1170.0,
        offset_x=9.0,
        offset_y=-6.0,
        k1=-0.16,
        k2=0.10,
        k3=-0.05,
        p1=0.0012,
        p2=-0.0009,
    )


@dataclass(frozen=True, kw_only=True)
class StripSettings:
    """A row of photos from above over level boards with objects on them."""

    photos: int = 21
    """Number of photos along the strip."""
    overlap: float = 0.70
    """Overlap from photo to photo."""
    height: float = 30.0
    """Flight height above the boards, m."""
    relief: float = 1.2
    """Height of the highest object on the boards, m."""
    things: float = 0.25
    """Share of the observed points that are on objects, at heights of 0 to `relief`, low ones more
    often.
    """
    square: float = 1.0
    """Side of a board's square, m."""
    noise: float = 0.3
    """Standard deviation of an observation, px per axis."""
    tilt: float = 0.3
    """Standard deviation of pitch and of roll, degrees, as for a hand-held camera."""
    views: int = 30
    """Number of views of the board from which the camera is calibrated."""
    lens: Lens = field(default_factory=_wide)
    """The true camera."""
    seed: int = 1
    """Seed of all random numbers."""

    def checked(self) -> "StripSettings":
        """The settings unchanged; raises UsageError where values do not fit together."""
        for name in not_finite(self):
            raise UsageError(f"{name} must be a number, not nan or infinite")
        rules = [
            (self.seed >= 0, f"the seed must not be negative, not {self.seed}"),
            (2 <= self.photos <= 500, f"photos must be 2 to 500, not {self.photos}"),
            (
                0.3 <= self.overlap <= 0.95,
                f"overlap must be 30 to 95 %, not {100 * self.overlap:.0f} %",
            ),
            (1 <= self.height <= 20_000, f"height must be 1 m to 20 km, not {self.height:g} m"),
            (
                0 <= 3 * self.relief <= self.height,
                f"relief must be 0 to a third of the height, not {self.relief:g} m",
            ),
            (0 <= self.tilt <= 8, f"tilt must be 0 to 8 degrees, not {self.tilt:g}"),
            (0 <= self.noise <= 1000, f"noise must be 0 to 1000 px, not {self.noise:g} px"),
        ]
        for holds, sentence in rules:
            if not holds:
                raise UsageError(sentence)
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class Strip:
    """The observations of the camera, and the truth."""

    ids: tuple[Doubles, ...]
    """Per photo (N,), index of the ground point of each observation, increasing."""
    px: tuple[Doubles, ...]
    """Per photo (N, 2), observations in px with noise."""
    targets: tuple[Doubles, ...]
    """Per photo (4, 2) px without noise: corners, in order around it, of the board square of four
    by four below it.
    """
    views: tuple[Doubles, ...]
    """Calibration views: (88, 2) px per view, with noise."""
    board: Doubles
    """(88, 3) the board's corners, m."""
    raised: Doubles
    """(points,) height of each ground point above the boards, m."""


def fly_strip(settings: StripSettings) -> Strip:
    """Simulates the strip; raises UsageError for settings that do not fit together."""
    settings = settings.checked()
    rng, lens = np.random.default_rng([settings.seed, 77]), settings.lens
    route = Route(
        pattern="strip",
        photos=settings.photos,
        overlap=settings.overlap,
        height=settings.height,
        heading=90.0,
        jitter=0.01 * settings.height,
        yaw_noise=2.0,
        tilt_noise=settings.tilt,
    )
    shots = fly(plan(route, lens), route, 0.0, settings.seed, "STRIP")
    points = _points(settings, np.array([s.centre[:2] for s in shots]), rng)
    ids, px, targets = [], [], []
    for shot in shots:
        seen = lens.project(points, shot.rotation, shot.place)
        inside = ((seen > 5) & (seen < (lens.width - 6, lens.height - 6))).all(1)
        ids.append(np.flatnonzero(inside).astype(np.float64))
        px.append(seen[inside] + rng.normal(0, settings.noise, (int(inside.sum()), 2)))
        middle = np.rint(shot.place[:2] / settings.square)
        square = (middle + np.array([[-2, 2], [2, 2], [2, -2], [-2, -2]])) * settings.square
        targets.append(
            lens.project(np.column_stack([square, np.zeros(4)]), shot.rotation, shot.place)
        )
    board, views = _board_views(settings, rng)
    return Strip(
        ids=tuple(ids),
        px=tuple(px),
        targets=tuple(targets),
        views=views,
        board=board,
        raised=points[:, 2],
    )


def _points(settings: StripSettings, centres: Doubles, rng: np.random.Generator) -> Doubles:
    """(n, 3) corners of all squares, and points on objects among them."""
    reach = (
        settings.height
        * np.hypot(settings.lens.width, settings.lens.height)
        / settings.lens.focal
        / 1.8
    )
    (left, low), (right, high) = centres.min(0) - reach, centres.max(0) + reach
    s = settings.square
    x, y = np.arange(np.floor(left / s), right / s), np.arange(np.floor(low / s), high / s)
    corners = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) * s
    count = round(settings.things / (1 - settings.things) * len(corners))
    places = rng.uniform((left, low), (right, high), (count, 2))
    heights = settings.relief * rng.uniform(0, 1, count) ** 2
    return np.vstack(
        [np.column_stack([corners, np.zeros(len(corners))]), np.column_stack([places, heights])]
    )


def _board_views(
    settings: StripSettings, rng: np.random.Generator
) -> tuple[Doubles, tuple[Doubles, ...]]:
    """A board of 11 x 8 corners seen from all sides and in every part of the image."""
    x, y = np.meshgrid(np.arange(11.0), np.arange(8.0))
    board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * 0.05
    views: list[Doubles] = []
    while len(views) < settings.views:
        angles = rng.uniform(-180, 180), *rng.uniform(-35, 35, 2)
        R = camera_rotation(*(float(v) for v in angles))
        far = rng.uniform(0.35, 0.7)
        middle = (
            rng.uniform(-0.5, 0.5, 2) * far * np.array([settings.lens.width, settings.lens.height])
        )
        target = np.array([*middle / settings.lens.focal, far])
        px = settings.lens.project(board, R, board.mean(0) - R.T @ target)
        inside = (
            np.isfinite(px).all()
            and ((px > 0) & (px < (settings.lens.width, settings.lens.height))).all()
        )
        if inside:
            views.append(px + rng.normal(0, 0.15, px.shape))
    return board, tuple(views)
