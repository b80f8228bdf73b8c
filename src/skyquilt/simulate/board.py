"""Frames of a chess-board with known truth: single views, and a series in which a lamp heats it
part by part.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from skyquilt.simulate.camera import Lens
from skyquilt.simulate.grid import Doubles, Floats

_STEP = 0.004
"""Side in m of the board's texture cells, per 0.1 m of a square."""
_OVER = 2
"""Rays per pixel along each axis."""


@dataclass(frozen=True, kw_only=True)
class Chessboard:
    """A board on a wall or a lawn; its first square is white."""

    columns: int = 7
    """Squares in a row."""
    rows: int = 6
    """Squares in a column."""
    square: float = 0.10
    """Side of a square, m."""
    margin: float = 0.05
    """White border around the squares, m."""
    spread: float = 0.02
    """Lateral spread of heat: radius in sides of a square."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardPose:
    """Pose of the board in front of the camera (x right, y down, z forward)."""

    rotation: Doubles
    """(3, 3): board axes (x right, y down, z away) to camera axes."""
    shift: Doubles
    """(3,): centre of the board in camera coordinates, m."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Sensor effects: noise, blur and drift."""

    noise: float = 0.05
    """Standard deviation per pixel, K."""
    blur: float = 0.8
    """Standard deviation of the point spread, px."""
    drift: float = 0.3
    """Standard deviation of a frame's common offset, K."""


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A lamp that moves over the board line by line."""

    frames: int = 92
    """Frames taken during the sweep."""
    lines: int = 4
    """Lines of the sweep."""
    radius: float = 1.6
    """Radius of the heated spot, in sides of a square."""
    rise: float = 6.0
    """Temperature that black paper gains under the lamp, K."""
    white: float = 0.25
    """Share of it that white paper gains."""
    cooling: float = 0.18
    """Share of the gain that is lost from frame to frame."""


def tilted(
    angle_x: float, angle_y: float, spin: float, shift: tuple[float, float, float]
) -> BoardPose:
    """A pose from three rotations in degrees, about x, y and the optical axis, and the centre's
    position in m.
    """
    a, b, c = np.radians([angle_x, angle_y, spin])
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return BoardPose(rotation=rz @ ry @ rx, shift=np.array(shift))


def five_poses(lens: Lens, board: Chessboard, rng: np.random.Generator) -> list[BoardPose]:
    """Five tilted poses with the whole board inside the image."""
    wide = max(board.columns / lens.width, board.rows / lens.height) * board.square * lens.focal
    poses = []
    for angle_x, angle_y, x, y in (
        (32, 0, 0, 0),
        (-32, 0, 0, 0),
        (0, 32, 0, 0),
        (0, -32, 0, 0),
        (22, 22, 0, 0),
    ):
        jitter = rng.normal(0, 4, 3)
        distance = wide * rng.uniform(1.35, 1.5)
        at = (distance * (x + rng.normal(0, 0.02)), distance * (y + rng.normal(0, 0.02)), distance)
        poses.append(tilted(angle_x + jitter[0], angle_y + jitter[1], jitter[2], at))
    return poses


def sweep(
    lens: Lens,
    board: Chessboard,
    pose: BoardPose,
    lamp: Lamp,
    sensor: Sensor,
    rng: np.random.Generator,
) -> Iterator[Floats]:
    """Frames (height, width) in K, with camera and board at rest."""
    black, where = _ink(board), _rays_on_board(lens, board, pose)
    absorbs = black + (1 - black) * lamp.white
    gain, y, x = np.zeros_like(black), *np.indices(black.shape).astype(np.float32)
    leak = board.spread * board.square / _cell(board)
    size = np.array(black.shape) * _cell(board)
    for number in range(lamp.frames):
        at_x, at_y = _lamp_at(number / (lamp.frames - 1), lamp, size)
        off = ((x * _cell(board) - at_x) ** 2 + (y * _cell(board) - at_y) ** 2) / (
            lamp.radius * board.square
        ) ** 2
        gain = gaussian_filter(
            gain * (1 - lamp.cooling) + lamp.rise * lamp.cooling * absorbs * np.exp(-off), leak
        )
        yield _frame(295.0 + gain, where, sensor, rng, 295.0)


def still(
    lens: Lens,
    board: Chessboard,
    pose: BoardPose,
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    clutter: float = 0.0,
) -> Floats:
    """One frame (height, width) of an evenly heated board, black 6 K above white, in front of a
    background whose texture has a standard deviation of `clutter` K.
    """
    where = _rays_on_board(lens, board, pose)
    ground = rng.standard_normal((lens.height, lens.width)).astype(np.float32)
    ground = sum(gaussian_filter(ground, s) * s for s in (2.0, 5.0, 12.0)) * np.float32(2 * clutter)
    warmth = gaussian_filter(295.0 + 6.0 * _ink(board), board.spread * board.square / _cell(board))
    return _frame(warmth, where, sensor, rng, 297.0 + np.asarray(ground, np.float32))


def _cell(board: Chessboard) -> float:
    return _STEP * board.square / 0.1


def _ink(board: Chessboard) -> Floats:
    """1 for black, 0 for white, on a raster over the board and its border; fractions where an edge
    crosses a cell.
    """
    cell, fine = _cell(board), 8
    x, y = (
        (np.arange(round((n * board.square + 2 * board.margin) / cell) * fine) + 0.5) * cell / fine
        - board.margin
        for n in (board.columns, board.rows)
    )
    i, j = np.floor(x / board.square).astype(int), np.floor(y / board.square).astype(int)
    on = ((i >= 0) & (i < board.columns))[None, :] & ((j >= 0) & (j < board.rows))[:, None]
    black = (on & ((i[None, :] + j[:, None]) % 2 == 1)).astype(np.float32)
    return np.asarray(
        black.reshape(len(y) // fine, fine, len(x) // fine, fine).mean((1, 3)), np.float32
    )


def _rays_on_board(lens: Lens, board: Chessboard, pose: BoardPose) -> Floats:
    """Column and row (height, width, 2, finer by `_OVER`) of the board's raster where each ray
    meets it; far outside where a ray misses it.
    """
    x, y = _fine_rays(lens)
    normal = pose.rotation[:, 2]
    depth = (normal @ pose.shift) / (normal[0] * x + normal[1] * y + normal[2])
    rays = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None] - pose.shift
    half = np.array([board.columns, board.rows]) * board.square / 2 + board.margin
    place = (rays @ pose.rotation[:, :2] + half) / _cell(board) - 0.5
    return np.asarray(np.where(depth[..., None] > 0, place, -1e4), np.float32)


@lru_cache(maxsize=2)
def _fine_rays(lens: Lens) -> tuple[Doubles, Doubles]:
    """Ideal normalised coordinates x, y (height, width, finer by `_OVER`), read-only: the same for
    all frames of a camera.
    """
    fine = (
        (np.arange(lens.width * _OVER) + 0.5) / _OVER - 0.5,
        (np.arange(lens.height * _OVER) + 0.5) / _OVER - 0.5,
    )
    xx, yy = np.meshgrid((fine[0] - lens.cx) / lens.focal, (fine[1] - lens.cy) / lens.focal)
    x, y = lens.undistort(xx, yy)
    x.setflags(write=False)
    y.setflags(write=False)
    return x, y


def _lamp_at(share: float, lamp: Lamp, size: Doubles) -> tuple[float, float]:
    """Position of the lamp, m from the raster's corner, after a share of its path; forward and
    back.
    """
    line = min(int(share * lamp.lines), lamp.lines - 1)
    along = share * lamp.lines - line
    along = along if line % 2 == 0 else 1 - along
    return float(size[1] * along), float(size[0] * (line + 0.5) / lamp.lines)


def _frame(
    board: Floats, where: Floats, sensor: Sensor, rng: np.random.Generator, behind: float | Floats
) -> Floats:
    """The sensor's image of a board's temperatures and of those behind it."""
    height, width = where.shape[0] // _OVER, where.shape[1] // _OVER
    seen = cv2.remap(
        board, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    outer = np.array([board.shape[1], board.shape[0]]) - 0.5
    mask = np.all((where > -0.5) & (where < outer), -1).astype(np.float32)
    size = (width, height)
    share = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
    warmth = cv2.resize(seen * mask, size, interpolation=cv2.INTER_AREA) + (1 - share) * behind
    if sensor.blur > 0:
        warmth = cv2.GaussianBlur(warmth, (0, 0), sensor.blur, borderType=cv2.BORDER_REPLICATE)
    noise = rng.normal(0, sensor.noise, warmth.shape) + rng.normal(0, sensor.drift)
    return np.asarray(warmth + noise, np.float32)
