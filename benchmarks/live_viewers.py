"""Viewers of a live map during a measurement: one real browser, or many simulated viewers that pan.

python benchmarks/live_viewers.py URL 20   pans until it is stopped, then prints request times
"""

import http.client
import json
import random
import shutil
import signal
import sys
import threading
import time
from typing import Any
from urllib.parse import urlsplit

import numpy as np

HOOKS = """
(() => {
  const address = new Map(), blobs = new WeakMap(); window.shownTiles = [];
  const blob = Response.prototype.blob;
  Response.prototype.blob = function () {
    const url = this.url;
    return blob.call(this).then((b) => { blobs.set(b, url); return b; });
  };
  const make = URL.createObjectURL;
  URL.createObjectURL = (b) => {
    const made = make.call(URL, b);
    if (blobs.has(b)) address.set(made, blobs.get(b));
    return made;
  };
  document.addEventListener("load", (e) => {
    const url = address.get(e.target.src);
    if (url) window.shownTiles.push([url, Date.now() / 1000]);
  }, true);
})();
"""
"""Notes every tile's picture as the page shows it, with the address that it was fetched from."""


class Browser:
    """A page that follows the map."""

    def __init__(self, url: str) -> None:
        self.url = url

    def __enter__(self) -> "Browser":
        from playwright.sync_api import sync_playwright

        self._play = sync_playwright().start()
        path = shutil.which("chromium") or shutil.which("google-chrome")
        self._chromium = self._play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        self.page = self._chromium.new_page(viewport={"width": 1280, "height": 900})
        self.page.add_init_script(HOOKS)
        self.page.goto(self.url)
        self.page.wait_for_selector("#link.live")
        return self

    def __exit__(self, *error: object) -> None:
        self._chromium.close()
        self._play.stop()

    def wait(self, seconds: float) -> None:
        """Lets the page go on."""
        self.page.wait_for_timeout(1000 * seconds)

    def shown(self) -> dict[str, float]:
        """When each photo's centre was first shown: by a picture asked for after the photo was told
        to be drawn.
        """
        import urllib.request

        drawn: dict[str, tuple[int, list[float]]] = {}
        with urllib.request.urlopen(f"{self.url}events?after=0") as map_events:
            last = self.page.evaluate("() => skyquilt.state.last")
            number = 0
            for raw in map_events:
                line = raw.decode().rstrip()
                if line.startswith("id: "):
                    number = int(line[4:])
                if line.startswith("data: "):
                    said = json.loads(line[6:])
                    if "ring" in said and said["name"] not in drawn:
                        drawn[said["name"]] = (number, said["at"])
                if number >= last:
                    break
        found: dict[str, float] = {}
        for url, at in self.page.evaluate("() => window.shownTiles"):
            parts = urlsplit(url)
            z, x, y = (int(v) for v in parts.path.split("/")[-3:])
            version = int(parts.query.split("v=")[-1])
            for name, (number, (lon, lat)) in drawn.items():
                if name not in found and version >= number and tile_of(lon, lat, z) == (x, y):
                    found[name] = at
        return found


def tile_of(lon: float, lat: float, z: int) -> tuple[int, int]:
    n, phi = 2**z, np.radians(lat)
    return int((lon + 180) / 360 * n), int(
        (1 - np.log(np.tan(phi) + 1 / np.cos(phi)) / np.pi) / 2 * n
    )


def pan(
    url: str, number: int, waits: list[float], kept: list[int], ending: threading.Event
) -> None:
    """One viewer: every two seconds another place or zoom, 5 x 4 tiles; what it has, it asks about
    as browsers do.
    """
    web = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30)
    rng, known = random.Random(number), {}

    def get(path: str, **headers: str) -> Any:
        began = time.monotonic()
        web.request("GET", path, headers=headers)
        answer = web.getresponse()
        body = answer.read()
        waits.append(time.monotonic() - began)
        return answer, body

    ending.wait(rng.uniform(0, 2))
    while not ending.is_set():
        began = time.monotonic()
        layers = json.loads(get("/info")[1])["layers"]
        if layers and layers[0]["bounds"]:
            west, south, east, north = layers[0]["bounds"]
            z = rng.choice((18, 19, 20, 21))
            x0, y0 = tile_of(rng.uniform(west, east), rng.uniform(south, north), z)
            for x in range(x0 - 2, x0 + 3):
                for y in range(y0 - 2, y0 + 2):
                    path = f"/tiles/{z}/{x}/{y}?layer=visible"
                    tag = {"If-None-Match": known[path]} if path in known else {}
                    answer, _ = get(path, **tag)
                    kept[0] += answer.status == 304
                    if answer.headers.get("etag"):
                        known[path] = answer.headers["etag"]
        ending.wait(max(0.0, 2 - (time.monotonic() - began)))


def main(url: str, count: int) -> None:
    waits: list[float] = []
    kept, ending = [0], threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    crowd = [
        threading.Thread(target=pan, args=(url, k, waits, kept, ending), daemon=True)
        for k in range(count)
    ]
    began = time.monotonic()
    for one in crowd:
        one.start()
    ending.wait()
    spent = time.monotonic() - began
    print(
        f"{count} viewers: {len(waits) / spent:.0f} requests per second, answered in"
        f" {1000 * np.median(waits):.0f} ms"
        f" (median), {1000 * np.percentile(waits, 95):.0f} ms (95 %), {kept[0]} known already"
    )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
