"""How a camera took the picture of a file: its size, of which the file shows a reduced copy or a
part, and how its rows were exposed, all at once or one after the other.

EXIF keeps the size that the camera wrote, also in copies by other programs. Focal lengths and
calibrations of cameras refer to it.
"""

import csv
import math
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Shutter
from skyquilt.photos import tags as tag
from skyquilt.photos.tags import Exif

_GUESS_S, _GUESS_SIGMA_S = 0.030, 0.015
_UNKNOWN_SIGMA_S = 0.010
_TABLE_SHARE = 0.10
_OPTION_SHARE = 0.03
_SAME = 0.02
"""Sides or ratios of sides that differ by less are the same, but for rounding."""
_WHOLE_PX = 0.75
"""A part whose sides are more than this share of the picture's was hardly reduced besides."""
_UNKNOWN = 0.25
"""Deviation of a scale that nothing tells, as a share."""
_CENTRE = 0.01
"""Deviation of the principal point of a part, as a share of its longer side; pictures tell more."""


@dataclass(frozen=True, kw_only=True)
class Native:
    """The picture that the camera took, and what a file shows of it."""

    width: float
    """In px as captured; so is `height`."""
    height: float
    file: tuple[int, int]
    """Width and height of the file in px."""
    scale: float = 1.0
    """Px of the file per px as captured."""
    sigma_scale: float = 0.0
    """Its deviation as a share."""
    part: bool = False
    """Whether the file shows a part of it."""

    @property
    def note(self) -> str:
        """What is said of a part."""
        if not self.part:
            return ""
        sizes = "EXIF says {:.0f}x{:.0f} px, the file has {}x{}: cropped"
        said = sizes.format(self.width, self.height, *self.file)
        if not self.sigma_scale:
            return f"{said}; its focal length is that of the whole picture."
        return (
            f"{said} or padded, so the focal length and any calibration in the metadata are"
            " uncertain."
        )

    @property
    def rows(self) -> float:
        """Share of the picture's rows that the file shows."""
        return min(1.0, self.file[1] / self.scale / self.height) if self.part else 1.0

    def focal_of_file(self, focal: Focal) -> Focal:
        """A focal length in px as captured, in px of the file."""
        px = focal.px * self.scale
        return replace(focal, px=px, sigma_px=self._sigma_of_file(px, focal.sigma_px))

    def _sigma_of_file(self, px: float, sigma: float) -> float:
        """Deviation of a focal length of `px` in the file, which has this one as captured."""
        return math.hypot(sigma * self.scale, self.sigma_scale * px)

    def camera_of_file(self, camera: Camera) -> Camera:
        """The lens of the picture as captured as that of the file. Nothing tells which part of the
        picture one shows: its middle is taken.
        """
        width, height = self.file
        if not self.part:
            return camera.rescaled(width, height)
        focal, centre = camera.focal * self.scale, _CENTRE * max(width, height)
        sigmas = camera.sigmas and (
            self._sigma_of_file(focal, camera.sigmas[0]),
            centre,
            centre,
            *camera.sigmas[3:],
        )
        return replace(
            camera,
            width=width,
            height=height,
            focal=focal,
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
            sigmas=sigmas,
        )


def native_picture(exif: Exif, width: int, height: int, *, whole: bool = False) -> Native:
    """The picture of which a file of `width` x `height` px is a copy or a part, as far as EXIF
    tells. `whole`: it is no part, whatever EXIF says; a thermal frame beside its picture.
    """
    x, y = exif.number(tag.PIXELS_X), exif.number(tag.PIXELS_Y)
    file = (width, height)
    if not x or not y or not (1 <= x <= 1e6 and 1 <= y <= 1e6):
        return Native(width=width, height=height, file=file)
    scale = max(width, height) / max(x, y)
    if whole or abs(min(width, height) / min(x, y) / scale - 1) <= _SAME:
        return Native(width=width / scale, height=height / scale, scale=scale, file=file)
    ways = [(width / across, height / down, across, down) for across, down in ((x, y), (y, x))]
    as_written = [w for w in ways if abs(max(w[:2]) - 1) <= _SAME]
    right, down, across, along = (as_written or ways)[0]
    most = max(right, down)
    if most > 1 + _SAME:  # padded, or enlarged along one side
        sigma = min(_UNKNOWN, most - 1)
    elif most > _WHOLE_PX:
        scale, sigma = 1.0, 0.0 if as_written else 1 - most
    else:
        scale, sigma = most, _UNKNOWN
    return Native(width=across, height=along, scale=scale, sigma_scale=sigma, part=True, file=file)


@cache
def _table() -> dict[str, tuple[tuple[float, float], ...]]:
    """Model in plain letters -> (megapixels below which the row applies, readout in s)."""
    text = files("skyquilt.photos").joinpath("shutters.csv").read_text("utf-8")
    table: dict[str, tuple[tuple[float, float], ...]] = {}
    for row in csv.DictReader(text.splitlines()):
        key = plain_model(row["model"])
        entry = (float(row["below_mp"] or "inf"), float(row["readout_ms"]) / 1000)
        table[key] = (*table.get(key, ()), entry)
    return table


def plain_model(text: str) -> str:
    """A camera model's name without case, spaces and signs, as tables are searched."""
    return "".join(c for c in text.lower() if c.isalnum())


def find_shutter(model: str, megapixels: float, rolling: bool | None) -> Shutter:
    """What is known of the shutter of a camera model.

    Args:
        model: as in EXIF.
        megapixels: of the photo as captured.
        rolling: what the sensor table says; None where it says nothing.

    The readout times of `shutters.csv` are those listed by OpenDroneMap (`rollingshutter.py`),
    measured by its users; they are taken to be right within a tenth.
    """
    if rolling is False:
        return Shutter(readout_s=0.0, sigma_s=0.0, source="global")
    for below, readout in _table().get(plain_model(model), ()):
        if megapixels < below:
            return Shutter(readout_s=readout, sigma_s=_TABLE_SHARE * readout, source="table")
    if rolling:
        return Shutter(readout_s=_GUESS_S, sigma_s=_GUESS_SIGMA_S, source="guess")
    return Shutter(readout_s=0.0, sigma_s=_UNKNOWN_SIGMA_S, source="unknown")


def stated_shutter(kind: str | None, readout_ms: float | None) -> Shutter | None:
    """The shutter that a user states by `--shutter` and `--shutter-readout`; None for neither."""
    if readout_ms is None:
        if kind == "rolling":
            return Shutter(readout_s=_GUESS_S, sigma_s=_GUESS_SIGMA_S, source="guess")
        return None if kind != "global" else Shutter(readout_s=0.0, sigma_s=0.0, source="option")
    seconds = readout_ms / 1000
    return Shutter(readout_s=seconds, sigma_s=_OPTION_SHARE * seconds, source="option")


def part_of_shutter(model: str, native: Native, rolling: bool | None) -> Shutter:
    """What is known of the shutter of a camera model, for the rows that a file shows of its
    picture; `rolling`: see `find_shutter`.
    """
    found = find_shutter(model, native.width * native.height / 1e6, rolling)
    if found.source != "table":
        return found
    readout, sigma = found.readout_s * native.rows, found.sigma_s * native.rows
    return replace(found, readout_s=readout, sigma_s=sigma)
