"""A multispectral camera beside that of the photos: a file for each band, with what DJI's cameras
write of a band ("Mavic 3M Image Processing Guide").

Each band has a camera of its own: a few centimetres beside the others, turned against them by an
angle that no file tells, with another lens. Exposure is automatic, so it changes from file to file;
files tell it, with the light that a sun sensor measured, so that reflectance can be found.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skyquilt.simulate.camera import Lens
from skyquilt.simulate.expose import Exposer, exposer
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Doubles, Floats
from skyquilt.simulate.scene import Scene
from skyquilt.simulate.settings import Multispectral

WAVELENGTHS = {"Blue": 475, "Green": 560, "Red": 650, "RedEdge": 730, "NIR": 860}
"""Centre of each band in nm, by the name in its files."""
SHORT = {"Blue": "B", "Green": "G", "Red": "R", "RedEdge": "RE", "NIR": "NIR"}
"""What the names of its files end with."""
BLACK, FULL = 3200, 65535
_SENSITIVITY = 18.0
"""Share of the range that light of 1 fills in a second at a gain of 1."""
_BRIGHT = 0.6
"""Share of the range that automatic exposure gives to the brightest fiftieth of a picture."""
_NOISE = 60.0
"""Standard deviation of a count."""
_FALLOFF = 0.25
"""Loss of light in the corners."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BandCamera:
    """One camera of the rig."""

    name: str
    """The band's name in its files."""
    lens: Lens
    """Its true lens."""
    turn: Doubles
    """(3, 3) from the camera of the photos to this one."""
    offset: Doubles
    """(3,) where it is, in m along the axes of the camera of the photos."""
    gain: float
    """Of its detector."""
    vignetting: tuple[float, ...]
    """Coefficients of r to r^6 (r in px) of the factor that undoes its loss of light."""


@dataclass(frozen=True, kw_only=True)
class _BandShot(Shot):
    """A shot of a camera that is turned against, and beside, that of the photos."""

    turn: tuple[tuple[float, ...], ...] = field(default=())

    @property
    def rotation(self) -> Doubles:
        """(3, 3) from map to camera."""
        return np.asarray(np.array(self.turn) @ super().rotation)


def rig_of(settings: Multispectral, flown: Lens, seed: int) -> list[BandCamera]:
    """The cameras of all bands, beside one that has the lens `flown`."""
    rng = np.random.default_rng([seed, 61])
    focal = settings.designed(flown)
    found = []
    for number, name in enumerate(WAVELENGTHS):
        lens = Lens(
            width=settings.width,
            height=settings.height,
            focal=focal * (1 + 0.01 * rng.normal()),
            offset_x=4 * rng.normal(),
            offset_y=4 * rng.normal(),
            k1=-0.10 + 0.02 * rng.normal(),
            k2=0.05 + 0.02 * rng.normal(),
            p1=0.0003 * rng.normal(),
            p2=0.0003 * rng.normal(),
        )
        corner = float(np.hypot(lens.width, lens.height)) / 2
        lost = _FALLOFF * (1 + 0.1 * rng.normal())
        found.append(
            BandCamera(
                name=name,
                lens=lens,
                turn=Rotation.from_rotvec(
                    np.radians(settings.turned_deg) * rng.normal(size=3)
                ).as_matrix(),
                offset=settings.apart_m * np.array([number % 3 - 1.0, number // 3 - 0.5, 0.0]),
                gain=float(rng.choice([1.0, 2.0, 4.0])),
                vignetting=(0.0, lost / (1 - lost) / corner**2, 0.0, 0.0, 0.0, 0.0),
            )
        )
    return found


def reflectance(seen: Floats, name: str) -> Floats:
    """Share of the light (h, w) that ground of these colours (h, w, 3, RGB 0 to 255) gives back in
    a band: plants are dark in red and bright in the near infrared.
    """
    red, green, blue = np.moveaxis((np.clip(seen, 0, 255) / np.float32(255)) ** 2.2 * 0.7, -1, 0)
    grey = (red + green + blue) / 3
    plant = np.clip((2 * green - red - blue) / (3 * grey + 0.02) * 2.5, 0, 1)
    shares = {"Red": red, "Green": green, "Blue": blue, "RedEdge": 0.9 * grey + 0.18 * plant}
    found = shares.get(name, 0.95 * grey + 0.45 * plant * (0.6 + 2 * green))
    return np.asarray(found, np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """Takes the files of one band."""

    band: BandCamera
    """Its camera."""
    camera: Exposer
    """The same over the scene."""

    @classmethod
    def over(cls, scene: Scene, band: BandCamera) -> "Sensor":
        """The sensor of a band over a scene."""
        return cls(band=band, camera=exposer(scene, band.lens))

    def shot(self, shot: Shot) -> Shot:
        """Where this camera is when the photo of a shot is taken."""
        centre = shot.place + shot.rotation.T @ self.band.offset
        known = {name: getattr(shot, name) for name in Shot.__dataclass_fields__}
        turn = tuple(map(tuple, self.band.turn.tolist()))
        return _BandShot(**{**known, "centre": tuple(centre.tolist())}, turn=turn)

    def counts(
        self, shot: Shot, light: float, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint16], int]:
        """The file's counts (h, w), and its exposure time in us."""
        seen = self.camera.colours(self.shot(shot), rng)
        share = reflectance(seen, self.band.name) * np.float32(light)
        rate = self.band.gain * _SENSITIVITY
        exposure = _BRIGHT / max(float(np.percentile(share, 98)) * rate, 1e-6) * 1e6
        exposure = float(np.clip(exposure * np.exp(0.1 * rng.normal()), 50, 20_000))
        us = round(exposure)
        signal = share * np.float32(rate * us / 1e6) / self._undone()
        noise = rng.standard_normal(signal.shape, dtype=np.float32)
        counts = BLACK + FULL * signal + np.float32(_NOISE) * noise * np.sqrt(1 + 20 * signal)
        return np.clip(np.rint(counts), 0, FULL).astype(np.uint16), us

    def _undone(self) -> Floats:
        """Factor (h, w) that undoes the loss of light."""
        lens = self.band.lens
        x, y = np.meshgrid(np.arange(lens.width) - lens.cx, np.arange(lens.height) - lens.cy)
        r = np.hypot(x, y)
        powers = (k * r ** (n + 1) for n, k in enumerate(self.band.vignetting) if k)
        return np.asarray(1 + sum(powers), np.float32)


def told(
    band: BandCamera, settings: Multispectral, flown: Lens, capture: str, us: int, light: float
) -> dict[str, str]:
    """What a file tells of its band in XMP; `light`: as the sun sensor measured it."""
    nm = WAVELENGTHS[band.name]
    return {
        "BandName": band.name,
        "BandFreq": f"{nm}(+/-16)nm",
        "CentralWavelength": str(nm),
        "BlackCurrent": str(BLACK),
        "SensorGain": f"{band.gain:g}",
        "SensorGainAdjustment": "1.000",
        "ExposureTime": str(us),
        "Irradiance": f"{1000 * light:.3f}",
        "SensorIndex": str(list(WAVELENGTHS).index(band.name) + 1),
        "VignettingData": ", ".join(f"{k:.6e}" for k in band.vignetting),
        "CalibratedFocalLength": f"{settings.designed(flown):.3f}",
        "CalibratedOpticalCenterX": f"{band.lens.cx:.3f}",
        "CalibratedOpticalCenterY": f"{band.lens.cy:.3f}",
        "CaptureUUID": capture,
    }
