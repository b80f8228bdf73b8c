"""Flights over level, textured ground: photos, their features and their pictures, by formulas of
their own.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features
from skyquilt.model.poses import MapFrame
from tests.alignment.surveys import HEIGHT, WIDTH, photo, prior
from tests.texture import texture

FOCAL = 700.0
FRAME = MapFrame(crs="EPSG:32630", origin=(500000.0, 5600000.0), vertical_datum="takeoff")
CELL = 0.2
"""Ground size in m of a pixel of the texture."""


@dataclass
class Flight:
    """What was flown, and what a method gets to see of it."""

    C: np.ndarray
    R: np.ndarray
    photos: list
    priors: list
    features: list
    west: float
    north: float
    size: tuple[int, int]
    """Cells of the ground down and across."""
    seed: int

    @property
    def ground(self):
        """Grey values of the ground's cells; not every test looks at it."""
        return texture(*self.size, seed=self.seed, roughness=1.2)

    def grey(self, i, longest):
        """The picture of photo i."""
        scale = longest / WIDTH
        K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
        S = np.array([[scale, 0, scale / 2 - 0.5], [0, scale, scale / 2 - 0.5], [0, 0, 1]])
        photo_H_map = (
            S @ K @ np.column_stack([self.R[i][:, 0], self.R[i][:, 1], -self.R[i] @ self.C[i]])
        )
        map_H_cell = np.array(
            [[CELL, 0, self.west + CELL / 2], [0, -CELL, self.north - CELL / 2], [0, 0, 1]]
        )
        size = (longest, round(HEIGHT * scale))
        seen = cv2.warpPerspective(
            self.ground, photo_H_map @ map_H_cell, size, flags=cv2.INTER_AREA
        )
        return np.clip(seen, 0, 255).astype(np.uint8)

    def map_xy(self, i, px):
        """Where pixels (n, 2) of photo i truly lie on the ground."""
        ray = np.column_stack(
            [(np.asarray(px) - ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)) / FOCAL, np.ones(len(px))]
        )
        ray = ray @ self.R[i]
        return self.C[i][:2] - ray[:, :2] * (self.C[i][2] / ray[:, 2:])


def fly(
    xy,
    *,
    yaw=0.0,
    height=60.0,
    tilt=0.0,
    gps=0.0,
    yaw_error=0.0,
    seed=0,
    points=4000,
    noise_px=0.2,
    relief=0.0,
):
    """Photos at xy (n, 2) m; `gps` m and `yaw_error` degrees are deviations of what is reported,
    `tilt` of the truth.

    `relief`: a tenth of the points stand this much above the ground, m.
    """
    rng = np.random.default_rng(seed)
    xy = np.asarray(xy, float)
    n = len(xy)
    yaws = np.broadcast_to(np.asarray(yaw, float), n)
    tilts = rng.normal(0, tilt, (n, 2)) if tilt else np.zeros((n, 2))
    C = np.column_stack([xy, np.full(n, height)])
    R = np.array([cam_R_map_from_angles(y, *t) for y, t in zip(yaws, tilts, strict=True)])
    reach = height * WIDTH / FOCAL
    low, high = xy.min(0) - reach, xy.max(0) + reach
    X = np.column_stack([rng.uniform(low, high, (points, 2)), np.zeros(points)])
    X[: points // 10, 2] = relief
    words = rng.normal(size=(points, 32))
    extent = np.ceil((high - low) / CELL).astype(int)
    flight = Flight(
        C=C,
        R=R,
        west=low[0],
        north=high[1],
        features=[],
        photos=[photo(f"P{i:03d}.jpg", focal=FOCAL) for i in range(n)],
        priors=[
            prior(
                [*(xy[i] + rng.normal(0, gps, 2) if gps else xy[i]), height],
                yaw=yaws[i] + rng.normal(0, yaw_error),
                sigma=max(gps, 0.5),
                sigma_yaw=max(yaw_error, 1.0),
            )
            for i in range(n)
        ],
        size=(int(extent[1]), int(extent[0])),
        seed=seed,
    )
    for i in range(n):
        local = (X - C[i]) @ R[i].T
        px = local[:, :2] / local[:, 2:] * FOCAL + ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
        px += rng.normal(0, noise_px, px.shape)
        inside = np.flatnonzero(((px > 5) & (px < (WIDTH - 6, HEIGHT - 6))).all(1))
        found = words[inside] + rng.normal(0, 0.15, (len(inside), 32))
        found = np.abs(found) / np.linalg.norm(found, axis=1, keepdims=True)
        flight.features.append(
            Features(
                px=px[inside],
                size=np.ones(len(inside), np.float32),
                scale=1.0,
                descriptors=np.clip(np.rint(400 * found), 0, 255).astype(np.uint8),
            )
        )
    return flight


def line(count, step=25.0, *, start=(0.0, 0.0), heading=0.0):
    """Places (count, 2) along a straight line, heading in degrees clockwise from north."""
    along = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
    return np.array(start) + np.arange(count)[:, None] * step * along


def lawn(lines, each, step=25.0, apart=30.0):
    """Places of parallel lines flown to and fro, as a lawn is mown."""
    rows = [line(each, step, start=(k * apart, 0.0)) for k in range(lines)]
    return np.concatenate([r if k % 2 == 0 else r[::-1] for k, r in enumerate(rows)])


CAMERA = Camera.ideal(width=WIDTH, height=HEIGHT, focal=FOCAL)
CORNERS = np.array(
    [
        [50.0, 50.0],
        [WIDTH - 51, 50],
        [WIDTH - 51, HEIGHT - 51],
        [50, HEIGHT - 51],
        [WIDTH / 2, HEIGHT / 2],
    ]
)
