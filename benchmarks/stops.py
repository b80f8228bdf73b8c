"""Counts the source files that one photo, and one upload, pass through.

python benchmarks/stops.py            # both, with a small simulated flight
python benchmarks/stops.py --stops    # and every file with its functions

*Photo*: from the folder to the drawn map, with default options. A function counts if it receives
the photo as an argument: the folder or the photo's path, its record, its pixels, a list of these
for all photos, or the survey.
*Upload*: from the request to its acceptance. Every function that runs for it counts.

Only files of Skyquilt are counted, by `sys.setprofile`, without records (`model`) and errors. Files
of more than 300 lines are named.
"""

import argparse
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from PIL import Image

import skyquilt

ROOT = Path(skyquilt.__file__).parent
LEFT_OUT = ("model/", "errors.py", "version.py", "__init__.py")
MOST_LINES = 300
Stops = dict[str, set[str]]


@cache
def ours(name: str) -> str:
    """A source file's path within the package; empty: it is not to be counted."""
    if not name.startswith(str(ROOT)):
        return ""
    file = Path(name).relative_to(ROOT).as_posix()
    return file if file.endswith(".py") and not file.startswith(LEFT_OUT) else ""


@contextmanager
def watched(passes: Callable[[FrameType], bool], stops: Stops) -> Iterator[None]:
    """Notes functions of ours, in any thread, whose call `passes`."""

    def look(frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        code = frame.f_code
        file = ours(code.co_filename)
        if not file or code.co_name in stops.get(file, ()) or code.co_name == "<module>":
            return
        if passes(frame):
            stops.setdefault(file, set()).add(code.co_name)

    threading.setprofile(look)
    sys.setprofile(look)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]


def carries(value: Any, path: Path, shape: tuple[int, ...], depth: int = 0) -> bool:
    """Whether a value is the photo, or a record or list that holds it."""
    from skyquilt.model.photo import Photo, Survey

    if isinstance(value, Path):
        return value in (path, path.parent)
    if isinstance(value, Photo):
        return value.path == path
    if isinstance(value, np.ndarray):
        parts = (value, value.base)  # the pixels, or a view of them
        return any(isinstance(a, np.ndarray) and a.shape == shape for a in parts)
    if isinstance(value, Survey):
        return True
    if isinstance(value, list | tuple) and depth == 0:
        return any(carries(v, path, shape, 1) for v in value[:20])
    return False


def photo_stops(photos: Path, output: Path) -> Stops:
    """Files and functions that are handed a photo between the folder and the drawn map."""
    from skyquilt.model.event import StageFinished
    from skyquilt.workflows.mosaic import iter_mosaic

    path, stops = sorted(photos.glob("*.jpg"))[0], Stops()
    with Image.open(path) as image:
        shape = image.height, image.width, 3

    def passes(frame: FrameType) -> bool:
        code = frame.f_code
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        return any(carries(frame.f_locals.get(n), path, shape) for n in names)

    with watched(passes, stops):
        for event in iter_mosaic(photos, output):
            if isinstance(event, StageFinished) and event.stage == "mosaic":
                break
    return stops


def upload_stops(photo: Path, folder: Path) -> Stops:
    """Files and functions that run between a request and the acceptance of its photo."""
    from fastapi.testclient import TestClient

    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings
    from skyquilt.server.access import Guard
    from skyquilt.server.app import make_app
    from skyquilt.server.server_process import UploadEndpoint
    from skyquilt.server.survey import LiveSurvey

    live = LiveMap(folder, LiveSettings())
    writer = UploadEndpoint(folder, LiveSettings())
    app = make_app(LiveSurvey(folder), Guard(), writer, folder)
    stops = Stops()
    body = photo.read_bytes()
    # the server's threads begin under watch; what starting it does is not the photo's way
    with watched(lambda _: True, stops), TestClient(app, base_url="http://127.0.0.1") as client:
        stops.clear()
        answer = client.post("/photos?name=a.jpg&source=test", content=body)
        on_the_way = {file: set(names) for file, names in stops.items()}
    assert answer.status_code == 201, answer.text
    live.close()
    return on_the_way


def told(title: str, stops: Stops, *, functions: bool) -> None:
    lines = {f: len((ROOT / f).read_text().splitlines()) for f in stops}
    print(f"{title}: {len(stops)} files, {sum(map(len, stops.values()))} functions")
    long = [f"{f} ({n})" for f, n in sorted(lines.items()) if n > MOST_LINES]
    print(f"  over {MOST_LINES} lines: {', '.join(long) or 'none'}")
    if functions:
        for file in sorted(stops):
            print(f"  {file}: {', '.join(sorted(stops[file]))}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stops", action="store_true", help="name every file and function")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as home:
        work = Path(home)
        demo = skyquilt.simulate.preset("demo")
        lens, route = demo.lens.scaled(800, 600), replace(demo.route, photos=8)
        settings = replace(demo, lens=lens, route=route, thermal=None)  # small: the way is the same
        for _ in skyquilt.simulate.simulate(settings, work / "flight"):
            pass
        photos = work / "flight" / "photos"
        told("photo", photo_stops(photos, work / "map"), functions=asked.stops)
        one = sorted(photos.glob("*.jpg"))[0]
        told("upload", upload_stops(one, work / "live"), functions=asked.stops)


if __name__ == "__main__":
    main()
