"""Simulated flights of multispectral cameras: bands cut from simulated photos, each by a camera of
its own, which is turned against the others by an angle that no file tells.
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import Camera

BANDS = {"blue": 475, "green": 560, "red": 650, "red edge": 730, "nir": 860}
"""Centres of the bands in nm."""
BLACK, FULL, NODE = 3200, 65535, 8
VIGNETTING = (1.0e-5, 3.0e-7, 0.0, 0.0, 0.0, 0.0)
"""Coefficients of r to r^6 (r in px) of the polynomial that undoes the loss of light."""


@dataclass(frozen=True)
class BandCamera:
    """One camera of the rig."""

    name: str
    camera: Camera
    """As it is; files tell a pinhole of the designed focal length."""
    turn: np.ndarray
    """(3,) rotation vector, rad, from the flight's camera to this one."""
    gain: float
    exposure_us: float


def rig(seed: int, width: int, height: int, focal: float, *, bends: bool = True):
    """Cameras of all bands: turned by about half a degree, focal lengths off by 1 %, principal
    points by 5 px, and lenses that differ.
    """
    rng = np.random.default_rng(seed)
    found = []
    for name in BANDS:
        plain = Camera.ideal(width=width, height=height, focal=focal)
        lens = replace(
            plain,
            focal=focal * (1 + 0.01 * rng.normal()),
            cx=plain.cx + 5 * rng.normal(),
            cy=plain.cy + 5 * rng.normal(),
        )
        if bends:
            lens = replace(lens, k1=-0.1 + 0.02 * rng.normal(), k2=0.05 + 0.02 * rng.normal())
        found.append(
            BandCamera(
                name=name,
                camera=lens,
                turn=np.radians(0.4) * rng.normal(size=3),
                gain=float(rng.choice([1.0, 2.0, 4.0])),
                exposure_us=float(rng.uniform(300, 1500)),
            )
        )
    return found


def reflectance(rgb: np.ndarray, name: str) -> np.ndarray:
    """Share of light (h, w) that ground of these colours (h, w, 3, uint8) gives back in a band:
    plants are dark in red and bright in the near infrared.
    """
    red, green, blue = np.moveaxis((rgb.astype(np.float32) / 255) ** 2.2 * 0.7, -1, 0)
    plant = np.clip((2 * green - red - blue) / (green + red + blue + 0.02) * 2.5, 0, 1)
    grey = (red + green + blue) / 3
    return {
        "blue": blue,
        "green": green,
        "red": red,
        "red edge": 0.9 * grey + 0.18 * plant,
        "nir": 0.95 * grey + 0.45 * plant * (0.6 + 2 * green),
    }[name]


def seen(share: np.ndarray, flown: Camera, band: BandCamera) -> np.ndarray:
    """What a camera of the rig sees of a picture that the flight's camera took."""
    R, lens = rotation_from_vector(band.turn), band.camera
    # lenses bend little over a few pixels
    across, down = (np.arange(0, n + NODE, NODE, dtype=float) for n in (lens.width, lens.height))
    x, y = np.meshgrid(across, down)
    px = project(flown, rays(lens, np.c_[x.ravel(), y.ravel()]) @ R).astype(np.float32)
    at = np.meshgrid(*(np.arange(n, dtype=np.float32) / NODE for n in (lens.width, lens.height)))
    u, v = (
        cv2.remap(np.ascontiguousarray(p), *at, cv2.INTER_LINEAR)
        for p in px.reshape(*x.shape, 2).transpose(2, 0, 1)
    )
    return cv2.remap(share, u, v, cv2.INTER_LINEAR)


def counts(share: np.ndarray, band: BandCamera, light: float) -> np.ndarray:
    """The pixels that a sensor records of shares of the light (h, w), by DJI's published formula
    read backwards, with noise.
    """
    h, w = share.shape
    x, y = np.meshgrid(np.arange(w) - band.camera.cx, np.arange(h) - band.camera.cy)
    r = np.hypot(x, y)
    undone = 1 + sum(k * r ** (n + 1) for n, k in enumerate(VIGNETTING))
    signal = share * light * band.gain * band.exposure_us / 1e6 / undone * 18
    noise = np.random.default_rng(int(share.sum()) % 2**31).normal(0, 40, share.shape)
    return np.clip(np.rint(BLACK + FULL * signal + noise), 0, FULL).astype(np.uint16)


def xmp_of(photo: Path, band: BandCamera, capture: str, focal: float, light: float) -> str:
    """The photo's place and angles, with what DJI's multispectral cameras tell of a band."""
    raw = photo.read_bytes()
    own = re.search(rb"xmlns:drone-dji=\"[^\"]*\"(.*?)/>", raw, re.DOTALL)
    index = list(BANDS).index(band.name)
    more = {
        "BandName": {"red edge": "RedEdge", "nir": "NIR"}.get(band.name, band.name.title()),
        "BandFreq": f"{BANDS[band.name]}(+/-16)nm",
        "CentralWavelength": BANDS[band.name],
        "BlackCurrent": BLACK,
        "SensorGain": band.gain,
        "ExposureTime": round(band.exposure_us),
        "SensorGainAdjustment": 1.0,
        "SensorIndex": index,
        "Irradiance": f"{light:.4f}",
        "VignettingData": ", ".join(str(k) for k in VIGNETTING),
        "CalibratedFocalLength": f"{focal:.3f}",
        "CalibratedOpticalCenterX": f"{band.camera.cx:.3f}",
        "CalibratedOpticalCenterY": f"{band.camera.cy:.3f}",
        "CaptureUUID": capture,
    }
    told = " ".join(f'drone-dji:{k}="{v}"' for k, v in more.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
        f' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {own[1].decode()} {told}/>'
        "</rdf:RDF></x:xmpmeta>"
    )


def film(
    flight: Path,
    folder: Path,
    *,
    seed: int = 1,
    size: tuple[int, int] = (800, 600),
    bends: bool = True,
    colours: bool = False,
    irradiance_noise: float = 0.0,
    shares=reflectance,
):
    """Writes a file for each band of each photo of a simulated flight; returns its cameras.

    `colours`: the photos themselves are there, too, as of drones with a camera in colours.
    `shares` (rgb, name): what of the light ground gives back in a band.
    """
    told = json.loads((flight / "truth" / "truth.json").read_text())
    lens = {k: v for k, v in told["cameras"]["visible"].items() if k not in ("readout", "fisheye")}
    flown = Camera(**lens)
    focal = 1.12 * flown.focal * size[0] / flown.width
    cameras = rig(seed, *size, focal, bends=bends)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for shot, photo in enumerate(sorted((flight / "photos").glob("*.jpg"))):
        with Image.open(photo) as picture:
            rgb, exif = np.asarray(picture.convert("RGB")), picture.getexif()
        exif.get_ifd(0x8769).pop(41989, None)
        exif.get_ifd(0x8769).pop(37386, None)
        exif[271], exif[272] = "DJI", "Rig"
        light = 1 + 0.2 * np.sin(shot / 4)
        for band in cameras:
            share = seen(shares(rgb, band.name), flown, band)
            pixels = counts(share, band, light)
            said = light * (1 + irradiance_noise * rng.normal())
            xmp = xmp_of(photo, band, f"capture-{shot:04d}", focal, said)
            exif[700] = xmp.encode()
            short = "".join(part[0] for part in band.name.upper().split())
            Image.fromarray(pixels).save(folder / f"MS_{shot:04d}_{short}.TIF", exif=exif)
        if colours:
            (folder / f"MS_{shot:04d}_D.JPG").write_bytes(photo.read_bytes())
    return cameras
