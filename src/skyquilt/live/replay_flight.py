"""Replays a flight: photos of a simulated or real flight arrive as they would from flying
drones.
"""

import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

import numpy as np
import simplejpeg

from skyquilt.errors import NoPhotosError, OutputError, UsageError
from skyquilt.imaging.grey import shrink
from skyquilt.model.photo import Photo
from skyquilt.outside import plain
from skyquilt.photos.headers import APP1, read_jpeg_header
from skyquilt.photos.pixels import decode_jpeg
from skyquilt.photos.survey import capture_order, read_survey
from skyquilt.typed import typed

PREVIEW = 800
"""Longest side in px of previews."""
BURST_S = 30.0
"""Duration of a burst in s."""


@dataclass(frozen=True, kw_only=True)
class FlySettings:
    """Settings of a replayed flight."""

    rate: float = 1.0
    """Photos per second of all drones together."""
    drones: int = 1
    """Number of drones among which the flight is divided; they fly at the same time."""
    loss: float = 0.0
    """Share of photos that never arrive."""
    reorder: float = 0.0
    """Share of photos that arrive a few positions late."""
    previews: bool = False
    """Whether a preview of each photo arrives first, and the full photo some photos later."""
    burst: float | None = None
    """Photos per second during half a minute in the middle of the flight; None = no burst."""
    seed: int = 0
    """Seed of the random losses and order."""

    def __post_init__(self) -> None:
        typed(self)
        for name, value, low, high in (
            ("--rate", self.rate, 0.01, 1000),
            ("--drones", self.drones, 1, 100),
            ("--loss", self.loss, 0, 0.95),
            ("--reorder", self.reorder, 0, 1),
            ("--burst", self.burst, 0.01, 1000),
        ):
            if value is not None and not low <= value <= high:
                raise UsageError(f"{name} {value} lies outside {low} to {high}")


@dataclass(frozen=True, kw_only=True)
class Sent:
    """One file that arrived."""

    name: str
    """Its name."""
    drone: int
    """Number of the drone that sent it, from 1."""
    preview: bool
    """Whether it was a preview."""
    at_s: float
    """Seconds since take-off."""
    answer: str
    """Response of the receiver."""


def order_of(photos: Sequence[Photo], settings: FlySettings) -> list[tuple[int, Photo, bool]]:
    """(drone, photo, preview) in order of arrival."""
    rng = np.random.default_rng(settings.seed)
    shares = np.array_split(np.arange(len(photos)), settings.drones)
    flown = [
        (d + 1, photos[share[k]])
        for k in range(max(map(len, shares)))
        for d, share in enumerate(shares)
        if k < len(share)
    ]
    kept = [f for f in flown if rng.random() >= settings.loss]
    place = np.arange(len(kept), dtype=float)
    late = rng.random(len(kept)) < settings.reorder
    place[late] += rng.uniform(1, 6, late.sum())
    events = [(place[k], 1, d, p, False) for k, (d, p) in enumerate(kept)]
    if settings.previews:
        events = [(x + 3.5, 1, d, p, False) for x, _, d, p, _ in events] + [
            (x, 0, d, p, True) for x, _, d, p, _ in events
        ]
    return [(d, p, small) for _, _, d, p, small in sorted(events, key=lambda e: e[:2])]


def fly(folder: Path, to: str, settings: FlySettings, token: str | None = None) -> Iterator[Sent]:
    """Sends the photos of a folder (or of a simulated flight's `photos` below it) in real time.

    Raises:
        NoPhotosError: there are none. UsageError, OutputError: the receiver is missing, or cannot
            write.
    """
    below = folder / "photos"
    survey = read_survey(below if below.is_dir() else folder)
    if not survey.photos:
        raise NoPhotosError(f"{folder} holds no photos to fly")
    arrivals = order_of(sorted(survey.photos, key=capture_order), settings)
    web = to.startswith(("http://", "https://"))
    if not web and not Path(to).is_dir():
        raise UsageError(
            f"{to} is neither a folder nor an address such as http://127.0.0.1:8080; make the"
            " folder that 'skyquilt live' watches"
        )
    began, due = time.monotonic(), 0.0
    middle = len(arrivals) / settings.rate / 2
    for drone, photo, small in arrivals:
        wait = due - (time.monotonic() - began)
        if wait > 0:
            time.sleep(wait)
        data = preview_of(photo.path) if small else photo.path.read_bytes()
        name = Path(photo.name).name
        name = f"{Path(name).stem}-preview.jpg" if small else name
        answer = (
            _posted(to, name, drone, data, token) if web else _copied(Path(to), name, drone, data)
        )
        yield Sent(
            name=name, drone=drone, preview=small, at_s=time.monotonic() - began, answer=answer
        )
        bursting = settings.burst is not None and 0 <= due - middle < BURST_S
        due += 1 / (settings.burst if bursting and settings.burst else settings.rate)


def preview_of(path: Path) -> bytes:
    """A small JPEG of a photo with all its metadata; other formats are returned unchanged."""
    data = path.read_bytes()
    if data[:2] != b"\xff\xd8":
        return data
    with path.open("rb") as file:
        head = read_jpeg_header(file)
    small, _ = shrink(decode_jpeg(data), PREVIEW)
    plain = simplejpeg.encode_jpeg(np.ascontiguousarray(small), quality=80, colorspace="RGB")
    parts = b"".join(
        bytes([0xFF, m]) + (len(p) + 2).to_bytes(2, "big") + p
        for m, p in head.segments
        if m == APP1
    )
    return bytes(plain[:2] + parts + plain[2:])


def _copied(folder: Path, name: str, drone: int, data: bytes) -> str:
    """Writes the file as a card reader does: it appears under its name before it is complete."""
    target = folder / f"drone-{drone}" / name
    try:
        target.parent.mkdir(exist_ok=True)
        with target.open("wb") as file:
            for k in range(0, len(data), 1 << 20):
                file.write(data[k : k + (1 << 20)])
    except OSError as error:
        raise OutputError(f"cannot write to {target.parent}: {error.strerror or error}") from error
    return "written"


def _posted(url: str, name: str, drone: int, data: bytes, token: str | None) -> str:
    query = urllib.parse.urlencode({"name": name, "source": f"drone-{drone}"})
    headers = {"Content-Type": "application/octet-stream"} | ({"X-Token": token} if token else {})
    try:
        request = urllib.request.Request(
            f"{url.rstrip('/')}/photos?{query}", data=data, headers=headers
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            return f"{answer.status}"
    except urllib.error.HTTPError as error:
        if error.code in (401, 403, 405):
            raise UsageError(
                f"{url} accepts no photos from here ({error.read().decode(errors='replace')[:200]})"
            ) from error
        return f"{error.code}"
    except (OSError, ValueError, HTTPException) as error:  # no address, or no server of ours
        raise UsageError(
            f"{plain(url, 200)} does not answer ({plain(str(error), 200)}); start 'skyquilt live'"
            " first"
        ) from error
