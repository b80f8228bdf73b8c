"""Finished videos sent over HTTP: their frames become photos of the live map."""

import time

import pytest

from skyquilt.live import uploaded_clips
from skyquilt.live.settings import LiveSettings
from tests.live.conftest import served
from tests.live.test_resumable import Client, begun
from tests.video.clips import filmed

QUICK = LiveSettings(features=600, most_bytes=3_000_000, most_clip_bytes=5_000_000)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return filmed(tmp_path_factory.mktemp("film"))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    with served(tmp_path_factory.mktemp("clips") / "out", QUICK) as site:
        yield site


def photos(site, start, seconds=120):
    """Names of the photos that begin so, when there are no more of them."""
    until, last = time.monotonic() + seconds, -1
    while time.monotonic() < until:
        said = site.web.get("/photos").json()
        rows = said["photos"] if isinstance(said, dict) else said
        found = [p for p in rows if p["name"].startswith(start)]
        waiting = site.folder / "clips" / "waiting"
        if found and len(found) == last and not any(waiting.iterdir()):
            return found
        last = len(found)
        time.sleep(0.3)
    raise AssertionError("no frames")


@pytest.mark.slow
def test_a_video_in_one_request_and_its_telemetry(site, film):
    sent = {"name": "A.SRT", "source": "mini"}
    answer = site.web.post("/photos", params=sent, content=film.with_suffix(".SRT").read_bytes())
    assert (answer.status_code, answer.json()["state"]) == (202, "waiting")
    sent["name"] = "A.MP4"
    answer = site.web.post("/photos", params=sent, content=film.read_bytes())
    assert (answer.status_code, answer.json()) == (202, {"name": "A.MP4", "state": "waiting"})
    found = photos(site, "A.MP4.")
    assert len(found) > 3
    assert {p["source"] for p in found} == {"mini"}
    site.until(lambda: site.web.get(f"/photos/{found[0]['id']}").json()["at"] is not None)
    assert list((site.folder / "clips" / "waiting").iterdir()) == []
    assert list((site.folder / "uploads").glob("*.part")) == []


@pytest.mark.slow
def test_a_video_in_parts_whatever_its_name(site, film, monkeypatch):
    monkeypatch.setattr(uploaded_clips, "PATIENCE_S", 0.0)
    data = film.read_bytes() + b"\0" * 16  # another file
    client = Client(site.web)
    answer = client.send(begun(client, len(data), filename="../../b<.MP4"), data)
    assert answer.status_code == 204
    assert answer.headers["photo-state"] == "waiting"
    assert "photo-id" not in answer.headers
    assert len(photos(site, "b<.MP4.")) > 3
    assert not list(site.folder.parent.rglob("b<*"))


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("a.mp4", b"ffconcat version 1.0\nfile A.MP4\n" * 20),
        ("b.mp4", b"#EXTM3U\n#EXTINF:10,\n/etc/hostname\n#EXT-X-ENDLIST\n" * 20),
        ("c.mov", b"\xff\xd8\xff" + bytes(500)),
    ],
)
def test_what_is_no_video_is_refused_at_once(site, name, body):
    answer = site.web.post("/photos", params={"name": name}, content=body)
    assert answer.status_code == 422
    assert "no video of a known kind" in answer.json()["reason"]


def test_a_torn_video_is_refused_by_the_mapping(site, film, monkeypatch):
    monkeypatch.setattr(uploaded_clips, "PATIENCE_S", 0.0)
    data = film.read_bytes()
    answer = site.web.post("/photos", params={"name": "torn.mp4"}, content=data[: len(data) // 2])
    assert answer.status_code == 202
    until = time.monotonic() + 20
    while time.monotonic() < until:
        refused = site.web.get("/photos").json()["refused"]
        if any(r["name"] == "torn.mp4" for r in refused):
            break
        time.sleep(0.2)
    (row,) = [r for r in refused if r["name"] == "torn.mp4"]
    assert "cut off" in row["reason"]


def test_videos_have_a_limit_of_their_own(site):
    client = Client(site.web)
    assert client.create(4_000_000, filename="a.jpg").status_code == 413
    assert client.create(5_000_001, filename="a.mp4").status_code == 413
    place = begun(client, 4_000_000, filename="a.mp4")
    assert client.ask("DELETE", place).status_code == 204
    answer = site.web.post("/photos", params={"name": "a.mp4"}, content=bytes(5_000_001))
    assert answer.status_code == 413


def test_waiting_videos_are_bounded(site, film, monkeypatch):
    monkeypatch.setattr(uploaded_clips, "MOST_WAITING", 0)
    answer = site.web.post("/photos", params={"name": "z.mp4"}, content=film.read_bytes())
    assert answer.status_code == 422
    assert "waiting already" in answer.json()["reason"]
