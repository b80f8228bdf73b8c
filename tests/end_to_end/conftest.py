"""A small flight of known truth, the command line in this process, and ways to spoil photos."""

import contextlib
import io
import json
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.cli.main import run
from skyquilt.engine.folder import CONTRACT
from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from tests.once import flown_once, once_for_all, pictures_seen_before  # noqa: F401 - a fixture
from tests.photos.conftest import gps_exif, with_segment

QUICK = ("--features", "300", "--surface", "ties", "--gsd", "30", "--jobs", "2")
"""Options with which the small flight is mapped in about a second."""
IDLE = {
    "position": ("--surface",),
    "pose": ("--surface",),
    "image": ("--surface",),
    "hybrid": ("--surface",),
    "flightline": ("--surface", "--features"),
    "--trust-metadata": ("--features",),
}
"""Those that have no effect beside a word: they are refused."""


def quick_beside(words: Sequence[object]) -> list[str]:
    """The options that suit other words of a command."""
    idle = {name for word in words for name in IDLE.get(str(word), ())}
    if not {"position", "pose", "hybrid", "flightline"} & set(words):
        idle.discard("--features")
    pairs = zip(QUICK[::2], QUICK[1::2], strict=True)
    return [word for pair in pairs if pair[0] not in idle for word in pair]


WIDE, HIGH = 480, 360
"""Size of its photos in px."""


@dataclass(frozen=True, kw_only=True)
class Told:
    """What a user sees of a command."""

    code: int
    out: str
    err: str
    output: Path

    @property
    def metrics(self) -> dict[str, Any]:
        return json.loads((self.output / "metrics.json").read_text())

    @property
    def notes(self) -> str:
        return "\n".join(self.metrics["notes"])

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines()]

    def made(self) -> "Told":
        """The command succeeded and every file of the contract is there, whole."""
        assert self.code == 0, self.err
        assert "Traceback" not in self.err + self.out
        assert [n for n in CONTRACT if not (self.output / n).is_file()] == []
        assert leftovers(self.output) == []
        return self

    def refused(self, code: int, *words: str) -> "Told":
        """The command said why in one sentence on standard error, and left nothing like a
        result.
        """
        assert self.code == code, self.err or self.out
        assert "Traceback" not in self.err + self.out
        last = self.err.strip().splitlines()[-1] if self.err.strip() else ""
        assert last.startswith("skyquilt: "), self.err
        for word in words:
            assert word.lower() in last.lower(), last
        if self.output.is_dir():
            assert [n for n in CONTRACT if (self.output / n).exists()] == []
            assert leftovers(self.output) == []
        return self


def leftovers(folder: Path) -> list[str]:
    """Names of half-written files."""
    return sorted(p.name for p in folder.rglob("*.partial"))


def skyquilt(*words: str | Path) -> tuple[int, str, str]:
    """Exit code, standard output and standard error; what a user would see as a traceback
    escapes.
    """
    out, err, argv, on_interrupt = (
        io.StringIO(),
        io.StringIO(),
        sys.argv,
        signal.getsignal(signal.SIGINT),
    )
    sys.argv = ["skyquilt", *map(str, words)]
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            mock.patch.object(os, "_exit", sys.exit),
        ):
            run()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.argv = argv
        signal.signal(signal.SIGINT, on_interrupt)
    return code, out.getvalue(), err.getvalue()


Mosaic = Callable[..., Told]


@pytest.fixture
def mosaic(tmp_path: Path) -> Mosaic:
    """`skyquilt mosaic PHOTOS -o OUT` with quick options; later options win."""

    def command(
        photos: Path, *options: str | Path, output: Path | None = None, quick: bool = True
    ) -> Told:
        output = output or tmp_path / "out"
        words = (
            "mosaic",
            photos,
            "-o",
            output,
            *(quick_beside(options) if quick else ()),
            *options,
        )
        code, out, err = skyquilt(*words)
        return Told(code=code, out=out, err=err, output=output)

    return command


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photos of WIDE x HIGH px with `gcp_list.txt` beside their folder `photos`."""
    settings = FlightSettings(
        seed=3,
        lens=Lens().scaled(WIDE, HIGH),
        route=Route(photos=9),
        control=Control(points=5, checks=1),
    )
    return flown_once(tmp_path_factory, "end_to_end", settings)


@pytest.fixture
def photos(flight: Path, tmp_path: Path) -> Path:
    """A copy of the flight's photos to spoil."""
    return Path(shutil.copytree(flight / "photos", tmp_path / "photos"))


@pytest.fixture(scope="session")
def finished(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run, for all processes; not to be changed."""

    def make(output: Path) -> None:
        code, _, err = skyquilt("mosaic", flight / "photos", "-o", output, *QUICK)
        assert code == 0, err

    return once_for_all(tmp_path_factory, "small map", make)


def named(folder: Path) -> list[Path]:
    """Photos in order."""
    return sorted(folder.glob("*.jpg"))


def keep(folder: Path, *numbers: int) -> list[Path]:
    """Removes all photos but these (from 0)."""
    files = named(folder)
    kept = [files[k] for k in numbers]
    for path in set(files) - set(kept):
        path.unlink()
    return kept


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def taken_apart(data: bytes) -> tuple[bytes, str, bytes]:
    """EXIF block, XMP packet, and the JPEG without either."""
    exif, xmp, rest, at = b"", "", data[:2], 2
    while data[at + 1] in (0xE0, 0xE1):
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        payload = data[at + 4 : end]
        if payload.startswith(b"Exif"):
            exif = payload
        elif data[at + 1] == 0xE1:
            xmp = payload.split(b"\x00", 1)[1].decode()
        else:
            rest += data[at:end]
        at = end
    return exif, xmp, rest + data[at:]


def relabel(
    path: Path,
    *,
    place: tuple[float, float] | None = None,
    heights: float | None = None,
    drop: Sequence[str] = (),
    xmp: dict[str, str] | None = None,
    strip: bool = False,
) -> None:
    """Rewrites metadata: another place (latitude, longitude), heights moved by metres, parts
    dropped.

    `drop` names `position`, `altitude`, `focal`, `xmp`.
    """
    block, packet, picture = taken_apart(path.read_bytes())
    if strip:
        path.write_bytes(picture)
        return
    exif = piexif.load(block)
    if place is not None:
        altitude = exif["GPS"].get(piexif.GPSIFD.GPSAltitude, (0, 1))
        exif["GPS"] = gps_exif(*place, altitude[0] / altitude[1])
        packet = re.sub(r'GpsLatitude="[^"]*"', f'GpsLatitude="{place[0]:+.9f}"', packet)
        packet = re.sub(r'GpsLongitude="[^"]*"', f'GpsLongitude="{place[1]:+.9f}"', packet)
    if heights is not None:
        exif, packet = _raised(exif, packet, heights)
    if "position" in drop:
        exif["GPS"] = {}
        packet = re.sub(r'drone-dji:Gps\w+="[^"]*"', "", packet)
    if "altitude" in drop:
        for tag in (piexif.GPSIFD.GPSAltitude, piexif.GPSIFD.GPSAltitudeRef):
            exif["GPS"].pop(tag, None)
        packet = re.sub(r'drone-dji:\w+Altitude="[^"]*"', "", packet)
    if "focal" in drop:
        for tag in (
            piexif.ExifIFD.FocalLength,
            piexif.ExifIFD.FocalLengthIn35mmFilm,
            piexif.ExifIFD.FocalPlaneXResolution,
            piexif.ExifIFD.FocalPlaneYResolution,
        ):
            exif["Exif"].pop(tag, None)
    for name, value in (xmp or {}).items():
        packet = packet.replace('rdf:about=""', f'rdf:about="" drone-dji:{name}="{value}"', 1)
    data = picture
    if "xmp" not in drop:
        data = with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + packet.encode())
    path.write_bytes(with_segment(data, 0xE1, piexif.dump(exif)))


def _raised(exif: dict[str, Any], packet: str, metres: float) -> tuple[dict[str, Any], str]:
    tag, sign = piexif.GPSIFD.GPSAltitude, piexif.GPSIFD.GPSAltitudeRef
    old = exif["GPS"][tag][0] / exif["GPS"][tag][1] * (-1 if exif["GPS"].get(sign) else 1)
    exif["GPS"][tag], exif["GPS"][sign] = (
        (round(abs(old + metres) * 1000), 1000),
        int(old + metres < 0),
    )

    def moved(found: re.Match[str]) -> str:
        return f'{found[1]}="{float(found[2]) + metres:+.3f}"'

    return exif, re.sub(r'((?:Relative|Absolute)Altitude)="([^"]*)"', moved, packet)


def other_camera(flight: Path, folder: Path, *, model: str = "Simulated 3:2") -> list[Path]:
    """The flight's last four photos again as another camera made them, three quarters the size."""
    made = []
    for source in named(flight / "photos")[-4:]:
        block, packet, _ = taken_apart(source.read_bytes())
        exif = piexif.load(block)
        exif["0th"][piexif.ImageIFD.Model] = model
        exif["Exif"][piexif.ExifIFD.FocalLength] = tuple(
            int(v * f)
            for v, f in zip(exif["Exif"][piexif.ExifIFD.FocalLength], (0.75, 1), strict=True)
        )
        buffer = io.BytesIO()
        Image.fromarray(pixels_of(source)).resize(
            (WIDE * 3 // 4, HIGH * 3 // 4), Image.Resampling.BOX
        ).save(buffer, "JPEG", quality=92)
        data = with_segment(
            buffer.getvalue(), 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + packet.encode()
        )
        target = folder / f"B_{source.name}"
        target.write_bytes(with_segment(data, 0xE1, piexif.dump(exif)))
        made.append(target)
    return made
