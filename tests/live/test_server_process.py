"""The viewer in a process of its own."""

import os
import signal
import threading
import time

import httpx
import pytest

from skyquilt.errors import UsageError
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.workflow import iter_live
from skyquilt.server.access import Guard
from skyquilt.server.server_process import ServerConfig, ServerProcess


def until(holds, seconds=300.0):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def answers(url):
    try:
        return httpx.get(url + "info", timeout=5, verify=False).status_code == 200
    except httpx.HTTPError:
        return False


@pytest.mark.slow
def test_photos_handed_to_it_are_mapped_and_it_comes_back_when_killed(flight, tmp_path):
    settings = LiveSettings(features=600, most_bytes=3_000_000)
    live, stop = LiveMap(tmp_path / "out", settings), threading.Event()
    mapping = threading.Thread(
        target=lambda: [None for _ in iter_live([], live, stop=stop)], daemon=True
    )
    asked = ServerConfig(
        folder=tmp_path / "out", settings=settings, guard=Guard(token="long enough")
    )
    with (
        ServerProcess(asked=asked) as site,
        httpx.Client(base_url=site.url, timeout=30, verify=False) as web,
    ):
        mapping.start()
        token = {"X-Token": "long enough"}
        data = [p.read_bytes() for p in flight.photos]
        assert web.post("/photos", content=data[0]).status_code == 401
        assert web.post("/photos", content=data[0], headers=token).status_code == 201
        assert (
            web.post(
                "/photos", content=b"\xff\xd8\xff" + b"0" * 3_000_000, headers=token
            ).status_code
            == 413
        )
        until(lambda: all(p["ring"] for p in web.get("/photos").json()["photos"]))
        first = site._parts["process"].pid
        os.kill(first, signal.SIGKILL)
        until(lambda: site._parts["process"].pid != first and answers(site.url))
        assert (
            httpx.post(
                site.url + "photos", content=data[1], headers=token, timeout=30, verify=False
            ).status_code
            == 201
        )
        until(lambda: len(list(live.members.on_map())) == 2)
        last = site._parts["process"]
    assert not last.is_alive()
    assert not answers(site.url)
    stop.set()
    mapping.join(30)
    live.close()


@pytest.mark.slow
def test_an_address_that_is_taken_and_a_base_that_is_no_map_are_told(tmp_path):
    live = LiveMap(tmp_path / "out", LiveSettings())
    (tmp_path / "no.tif").write_bytes(b"no map")
    asked = ServerConfig(
        folder=tmp_path / "out", settings=LiveSettings(), guard=Guard(), base=tmp_path / "no.tif"
    )
    with pytest.raises(UsageError, match="--base"), ServerProcess(asked=asked):
        pass
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        asked = ServerConfig(folder=tmp_path / "out", settings=LiveSettings(), guard=Guard())
        with pytest.raises(UsageError, match="choose another --port"):
            ServerProcess(asked=asked, port=taken.getsockname()[1]).__enter__()
    live.close()
