"""Forms a photo: casts its rays, samples the colours, and applies the effects of lens and
sensor.
"""

from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from skyquilt.simulate.camera import Lens
from skyquilt.simulate.clouds import Clouds
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Doubles, Floats, Grid
from skyquilt.simulate.horizon import with_horizon
from skyquilt.simulate.raycast import FLATTEST, first_hits, rays_of, sample
from skyquilt.simulate.scene import Scene
from skyquilt.simulate.settings import Pictures
from skyquilt.simulate.smoke import GREY, Smoke
from skyquilt.simulate.weather import Weather

_TEXTURE_PX = 1024
_WET_M = 0.02


@cache
def _leaves() -> Floats:
    """A periodic texture of clumps, about -1 to 1."""
    white = np.random.default_rng(7).standard_normal((_TEXTURE_PX, _TEXTURE_PX), dtype=np.float32)
    layers = [
        gaussian_filter(white, sigma, mode="wrap") * (3.5 * sigma) for sigma in (0.8, 2.0, 5.0)
    ]
    return np.asarray(np.clip(0.4 * sum(layers), -1.2, 1.2).astype(np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposer:
    """A camera over a scene; stores the rays of its pixels."""

    scene: Scene
    """The scene."""
    lens: Lens
    """The true camera."""
    directions: Floats
    """(h, w, 2) from `Lens.rays`."""
    lowest: float
    """Height of the lowest ground, m above the base."""

    def pixels(self, shot: Shot) -> tuple[Floats, Floats, Grid]:
        """Where each pixel's ray first meets the surface.

        Pixels (h, w, 2) of a window of the scene's grid, heights (h, w) above the base, and that
        window.
        """
        window = self.window(shot)
        corner = np.array([window.xs[0], window.ys[0]])
        rotation, centre = shot.rotation, shot.place
        if shot.moves(self.lens):
            share = np.arange(self.lens.height) / (self.lens.height - 1) - 0.5
            rotation, centre = shot.exposed(self.lens, share)
            rotation, centre = rotation[:, None], centre[:, None]
        rays = rays_of(self.directions, rotation, centre, corner, window.res)
        hits, heights = first_hits(np.ascontiguousarray(self.scene.height[window.slices]), rays)
        return hits, heights, window

    def flanks(self, hits: Floats, heights: Floats, window: Grid) -> Floats:
        """Brightness (h, w) of leaves and plaster on steep flanks, a texture of x, y and z.

        A raster has no texture along the vertical: without this, flanks would show streaks.
        """
        surface = self.scene.height[window.slices]
        slope_x = cv2.Sobel(surface, cv2.CV_32F, 1, 0, scale=1 / (8 * window.res))
        slope_y = cv2.Sobel(surface, cv2.CV_32F, 0, 1, scale=1 / (8 * window.res))
        slope = np.hypot(slope_x, slope_y)
        rough = np.clip(0.6 * (slope - 1.2), 0, 1) * np.clip(
            1.6 - slope / 25, 0.35, 1
        )  # walls are smoother
        steep = sample(rough, hits)
        offset = np.array([window.col, window.row], dtype=np.float32) % _TEXTURE_PX
        where = (
            hits
            + offset
            + (heights / np.float32(window.res))[..., None] * np.array([0.83, 0.71], np.float32)
        )
        x, y = cv2.split(where)
        leaves = cv2.remap(_leaves(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(1 + 0.30 * steep * leaves, dtype=np.float32)

    def window(self, shot: Shot) -> Grid:
        """The part of the scene that a shot can see."""
        grid = self.scene.grid
        ground = grid.pixels(footprint(self.lens, shot, self.lowest))
        low, high = (
            np.floor(ground.min(axis=0)).astype(int) - 34,
            np.ceil(ground.max(axis=0)).astype(int) + 34,
        )
        under = np.floor(grid.pixels(shot.place[:2])).astype(int)
        low, high = np.minimum(low, under - 34), np.maximum(high, under + 34)
        return grid.window(low[1], low[0], high[1] - low[1], high[0] - low[0])

    def visible(
        self,
        shot: Shot,
        settings: Pictures,
        gain: float,
        rng: np.random.Generator,
        weather: Weather | None = None,
        smoke: Smoke | None = None,
        clouds: Clouds | None = None,
    ) -> NDArray[np.uint8]:
        """The visible image (h, w, 3) as the camera stores it; `weather`: another moment than that
        of the scene; `smoke` that drifts over it; `clouds` that shade it.
        """
        seen = self.colours(shot, rng, weather, clouds)
        if smoke is not None:
            veil = smoke.veil(self.directions, shot)[..., None]
            seen = seen * (1 - veil) + veil * GREY
        seen = _blurred(seen, settings)
        seen *= (np.float32(gain) * falloff(self.lens, settings.vignetting))[..., None]
        if settings.noise > 0:
            seen += rng.standard_normal(seen.shape, dtype=np.float32) * np.float32(settings.noise)
        return np.asarray(np.clip(seen + 0.5, 0, 255).astype(np.uint8))

    def colours(
        self,
        shot: Shot,
        rng: np.random.Generator,
        weather: Weather | None = None,
        clouds: Clouds | None = None,
    ) -> Floats:
        """Colours (h, w, 3), 0 to 255, of what lies in the way of each pixel's ray; `weather`:
        another moment than that of the scene; `clouds` that shade it.
        """
        hits, heights, window = self.pixels(shot)
        colours = (
            self.scene.rgb[window.slices]
            if weather is None
            else self.scene.at_hour(window, weather)
        )
        seen = sample(np.ascontiguousarray(colours), hits).astype(np.float32)
        seen *= self.flanks(hits, heights, window)[..., None]
        if clouds is not None:
            east, down = cv2.split(hits * np.float32(window.res))
            x, y = np.float32(window.xs[0]) + east, np.float32(window.ys[0]) - down
            seen *= clouds.light(x, y, shot.waypoint.time)[..., None]
        if self.scene.water is not None:
            place = hits * np.float32(window.res) + np.array([window.xs[0], -window.ys[0]])
            seen = with_waves(seen, place, heights <= self.scene.water + _WET_M, rng)
        seen = with_horizon(seen, self.scene, self.directions, shot)
        return np.asarray(seen, np.float32)

    def heat(
        self, shot: Shot, noise: float, offset: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """The thermal image (h, w) in hundredths of a kelvin."""
        if self.scene.thermal is None:
            raise ValueError("the scene was drawn without temperatures")
        hits, _, window = self.pixels(shot)
        kelvin = sample(
            np.ascontiguousarray(self.scene.thermal[window.slices]).astype(np.float32), hits
        )
        kelvin = cv2.GaussianBlur(kelvin, (0, 0), 0.7) + np.float32(100 * offset)
        kelvin += rng.standard_normal(kelvin.shape, dtype=np.float32) * np.float32(100 * noise)
        return np.asarray(np.clip(kelvin + 0.5, 0, 65535).astype(np.uint16))


def with_waves(
    seen: Floats, place: Doubles, wet: NDArray[np.bool_], rng: np.random.Generator
) -> Floats:
    """A picture (h, w, 3) with the waves of this moment, and with the sun's glitter on them, where
    its pixels, at places (h, w, 2) in m, show water (h, w).
    """
    x, y = place[wet].T
    height = np.zeros(len(x))
    for length in (0.5, 0.9, 1.6, 2.7, 4.5, 7.0):
        course, phase = rng.normal(0.6, 0.35), rng.uniform(0, 2 * np.pi)
        along = x * np.cos(course) + y * np.sin(course)
        height += np.cos(2 * np.pi * along / length + phase) / 3
    out = seen.copy()
    glitter = 160 * np.clip(height - 0.9, 0, 1)
    out[wet] = out[wet] * (1 + 0.2 * height)[:, None] + glitter[:, None]
    return out


@lru_cache(maxsize=2)
def _rays(lens: Lens) -> Floats:
    """`Lens.rays`, read-only: the same for all flights with a lens."""
    rays = lens.rays()
    rays.setflags(write=False)
    return rays


def exposer(scene: Scene, lens: Lens) -> Exposer:
    """Prepares a camera over a scene."""
    lowest = float(scene.height[::16, ::16].min()) - 1.0
    return Exposer(scene=scene, lens=lens, directions=_rays(lens), lowest=lowest)


def footprint(lens: Lens, shot: Shot, level: float) -> Doubles:
    """Map positions (n, 2) where the rays of the image border meet a level height above the
    base; rays flatter than `FLATTEST` end at that slope.
    """
    w, h = lens.width - 0.5, lens.height - 0.5
    side = np.linspace(0, 1, 9)[:-1]
    x = np.concatenate(
        [-0.5 + side * (w + 0.5), np.full(8, w), w - side * (w + 0.5), np.full(8, -0.5)]
    )
    y = np.concatenate(
        [np.full(8, -0.5), -0.5 + side * (h + 0.5), np.full(8, h), h - side * (h + 0.5)]
    )
    ix, iy = lens.undistort((x - lens.cx) / lens.focal, (y - lens.cy) / (lens.focal * lens.aspect))
    rays = np.stack([ix, iy, np.ones_like(ix)], axis=1) @ shot.rotation
    down = np.maximum(-rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]) / FLATTEST)
    return shot.place[:2] + rays[:, :2] * ((shot.centre[2] - level) / down)[:, None]


def falloff(lens: Lens, share: float) -> Floats:
    """(h, w) brightness of the lens's image: 1 in the middle, 1 - share in the corners."""
    x = (np.arange(lens.width, dtype=np.float32) - (lens.width - 1) / 2)[None, :]
    y = (np.arange(lens.height, dtype=np.float32) - (lens.height - 1) / 2)[:, None]
    corner = ((lens.width - 1) ** 2 + (lens.height - 1) ** 2) / 4
    return np.asarray(1 - share * (x * x + y * y) / corner, dtype=np.float32)


def _blurred(seen: Floats, settings: Pictures) -> Floats:
    if settings.blur > 0:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), settings.blur))
    if settings.motion_blur > 0:
        half = int(np.ceil(settings.motion_blur / 2))
        kernel = np.clip(settings.motion_blur / 2 + 0.5 - np.abs(np.arange(-half, half + 1)), 0, 1)
        seen = np.asarray(cv2.filter2D(seen, -1, (kernel / kernel.sum()).reshape(-1, 1)))
    return seen
