"""Resumable uploads as a client of the tus protocol 1.0.0 makes them (https://tus.io)."""

import base64
import errno
import logging
import os
import socket
import time
from email.utils import parsedate_to_datetime

import httpx
import pytest

from skyquilt.errors import OutputError
from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from tests.live.conftest import served

QUICK = LiveSettings(features=600, most_bytes=3_000_000)
TUS = {"Tus-Resumable": "1.0.0"}
PART = {"Content-Type": "application/offset+octet-stream"}


class Client:
    """What the protocol asks of a client: create, send parts, after a failure ask and go on."""

    def __init__(self, web, part=50_000, **headers):
        self.web, self.part, self.headers = web, part, TUS | headers

    def ask(self, method, place, content=b"", **headers):
        answer = self.web.request(method, place, content=content, headers=self.headers | headers)
        assert answer.headers["tus-resumable"] == "1.0.0"
        return answer

    def create(self, size, **about):
        pairs = [f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in about.items()]
        headers = {"Upload-Metadata": ",".join(pairs)} if pairs else {}
        return self.ask("POST", "/photos/uploads", **{"Upload-Length": str(size)}, **headers)

    def offset(self, place):
        answer = self.ask("HEAD", place)
        assert answer.status_code == 200
        assert answer.headers["cache-control"] == "no-store"
        return int(answer.headers["upload-offset"])

    def patch(self, place, offset, content, **headers):
        return self.ask(
            "PATCH", place, content, **{"Upload-Offset": str(offset)}, **PART, **headers
        )

    def send(self, place, data, offset=0):
        """All that is left; the last answer."""
        while True:
            answer = self.patch(place, offset, data[offset : offset + self.part])
            if answer.status_code != 204 or offset + self.part >= len(data):
                return answer
            offset += self.part
            assert answer.headers["upload-offset"] == str(offset)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    with served(tmp_path_factory.mktemp("tus") / "out", QUICK) as site:
        yield site


@pytest.fixture
def client(site):
    return Client(site.web)


def begun(client, size=1000, **about):
    answer = client.create(size, **about)
    assert answer.status_code == 201, answer.text
    return answer.headers["location"]


def left(site):
    """Files of uploads under way."""
    folder = site.folder / "uploads"
    return {p.stem for p in folder.glob("*.part")} if folder.exists() else set()


def test_what_the_server_offers(site, client):
    for place in ("/photos/uploads", "/photos/uploads/" + "0" * 32):
        answer = site.web.request("OPTIONS", place)  # without Tus-Resumable, as the protocol has it
        assert answer.status_code == 204
        assert answer.headers["tus-resumable"] == answer.headers["tus-version"] == "1.0.0"
        offered = set(answer.headers["tus-extension"].split(","))
        assert offered == {"creation", "expiration", "termination"}
        assert answer.headers["tus-max-size"] == "8000000000"  # of a video


def test_a_photo_in_parts_is_taken(site, client, flight):
    data = flight.photos[0].read_bytes()
    place = begun(client, len(data), filename="a b.jpg", source="drone-7")
    told = client.ask("HEAD", place)
    assert told.headers["upload-length"] == str(len(data))
    assert "filename" in told.headers["upload-metadata"]
    answer = client.send(place, data)
    assert (answer.status_code, answer.content) == (204, b"")
    assert answer.headers["photo-state"] == "received"
    photo = site.web.get(f"/photos/{answer.headers['photo-id']}").json()
    assert (photo["name"], photo["source"]) == ("a b.jpg", "drone-7")
    assert site.web.get(f"/photos/{photo['id']}/file").content == data
    # who missed the last answer is told by HEAD that all is well
    again = client.ask("HEAD", place)
    assert again.headers["upload-offset"] == again.headers["upload-length"] == str(len(data))
    assert again.headers["photo-id"] == answer.headers["photo-id"]
    assert "upload-expires" not in again.headers
    twice = client.send(begun(client, len(data)), data)
    assert (twice.status_code, twice.headers["photo-state"]) == (204, "duplicate")
    assert not left(site)


def cut_off(site, place, offset, data, length):
    """A PATCH whose connection is lost before all of its `length` bytes were sent."""
    host, port = site.url.removeprefix("http://").strip("/").split(":")
    raw = socket.create_connection((host, int(port)))
    head = {"Host": host, "Upload-Offset": offset, "Content-Length": length, **TUS, **PART}
    lines = "".join(f"{k}: {v}\r\n" for k, v in head.items())
    raw.sendall(f"PATCH {place} HTTP/1.1\r\n{lines}\r\n".encode() + data)
    return raw


def test_an_upload_goes_on_after_a_lost_connection(site, client, flight):
    data = flight.photos[1].read_bytes()
    half = len(data) // 2
    place = begun(client, len(data))
    raw = cut_off(site, place, 0, data[:half], len(data))
    site.until(lambda: client.offset(place) > 0)
    raw.close()
    # the server has seen that the connection is lost: what is wrong now is only the offset
    site.until(lambda: "another request" not in client.patch(place, len(data), b"").text)
    assert client.offset(place) == half  # what came before it was lost counts
    answer = client.send(place, data, half)
    assert answer.headers.get("photo-state") == "received", (answer.status_code, answer.text)


@pytest.mark.slow
def test_one_writer_at_a_time_and_a_silent_one_gives_up(flight, tmp_path):
    with served(tmp_path / "out", QUICK, guard=Guard(upload_stall_s=3.0)) as site:
        client, data = Client(site.web), flight.photos[1].read_bytes()
        place = begun(client, len(data))
        raw = cut_off(site, place, 0, data[:1000], len(data))
        # 409 alone may mean the offset: the first writer is there once the answer speaks of it
        site.until(lambda: "another request" in client.patch(place, 999, b"x").text)
        assert client.ask("DELETE", place).status_code == 409
        raw.sendall(data[1000:2000])  # the first one goes on
        site.until(lambda: client.offset(place) in (1000, 2000))
        assert raw.recv(100).startswith(b"HTTP/1.1 408")  # though its connection is still there
        raw.close()
        assert client.offset(place) == 2000
        assert client.send(place, data, 2000).headers["photo-state"] == "received"


def test_the_version_is_asked_for(site, client):
    place = begun(client)
    for version in ({}, {"Tus-Resumable": "0.2.2"}):
        for method, where in (
            ("POST", "/photos/uploads"),
            ("HEAD", place),
            ("PATCH", place),
            ("DELETE", place),
        ):
            headers = {**version, **PART, "Upload-Length": "9", "Upload-Offset": "0"}
            answer = site.web.request(method, where, headers=headers)
            assert answer.status_code == 412
            assert answer.headers["tus-version"] == answer.headers["tus-resumable"] == "1.0.0"
    assert client.offset(place) == 0
    client.ask("DELETE", place)


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ({}, 400),
        ({"Upload-Length": "-1"}, 400),
        ({"Upload-Length": "9" * 5000}, 400),
        ({"Upload-Length": "1e3"}, 400),
        ({"Upload-Defer-Length": "1"}, 400),
        ({"Upload-Length": "0"}, 422),
        ({"Upload-Length": "3000001"}, 413),
        ({"Upload-Length": "9", "Upload-Metadata": "filename a!b"}, 400),
        ({"Upload-Length": "9", "Upload-Metadata": "filename YQ==,filename YQ=="}, 400),
        ({"Upload-Length": "9", "Upload-Metadata": "filename YQ==,,x"}, 400),
        ({"Upload-Length": "9", "Upload-Metadata": "filename YQ==,confidential"}, 201),
        ({"Upload-Length": "9", "Upload-Metadata": "filename //8="}, 201),  # bytes, no UTF-8
    ],
)
def test_creation_refuses_what_it_cannot_take(site, client, headers, code):
    before = left(site)
    answer = client.ask("POST", "/photos/uploads", **headers)
    assert answer.status_code == code, answer.text
    if code == 413:
        assert answer.headers["tus-max-size"] == "3000000"
    if code == 201:
        assert client.ask("DELETE", answer.headers["location"]).status_code == 204
    assert left(site) == before


def test_parts_that_do_not_fit_change_nothing(site, client):
    place = begun(client, 1000)
    assert client.patch(place, 0, b"x" * 400).status_code == 204
    wrong = client.patch(place, 0, b"y")
    assert (wrong.status_code, wrong.headers["upload-offset"]) == (409, "400")
    assert client.ask("PATCH", place, b"y", **PART).status_code == 409  # no offset at all
    assert client.patch(place, 400, b"y" * 601).status_code == 413
    assert client.patch(place, 400, iter([b"y" * 500, b"y" * 101])).status_code == 413
    plain = {"Upload-Offset": "400", "Content-Type": "application/octet-stream"}
    assert client.ask("PATCH", place, b"y", **plain).status_code == 415
    assert client.offset(place) == 400
    assert (site.folder / "uploads" / f"{place[-32:]}.part").read_bytes() == b"x" * 400
    client.ask("DELETE", place)


def test_what_is_no_photo_is_refused_and_gone(site, client):
    place = begun(client, 1000, filename="../../n.jpg")
    answer = client.send(place, b"x" * 1000)
    assert answer.status_code == 422
    assert answer.json()["name"] == "n.jpg"
    assert "neither JPEG" in answer.json()["reason"]
    assert client.ask("HEAD", place).status_code == 404
    assert not left(site)


@pytest.mark.parametrize("name", ["DJI_0001.DNG", "img.arw", "DJI_0002.LRV", "GX01.thm"])
def test_what_is_not_read_by_its_name_is_refused_before_it_is_sent(site, client, flight, name):
    """Whoever dropped a card's folder on the page had waited for every raw picture."""
    answer = client.create(30_000_000, filename=name, source="browser")
    assert answer.status_code == 422
    assert "read" in answer.json()["reason"]
    whole = site.web.post(f"/photos?name={name}", content=flight.photos[0].read_bytes())
    assert whole.json() == answer.json()
    query = "select count(*) from refused where name = ?"
    assert site.live.ledger.row(query, name) == (2,)
    assert not left(site)


def test_an_upload_can_be_ended(site, client):
    place = begun(client)
    assert client.patch(place, 0, b"x").status_code == 204
    assert client.ask("DELETE", place).status_code == 204
    for method in ("HEAD", "PATCH", "DELETE"):
        answer = client.ask(method, place, **{"Upload-Offset": "1"}, **PART)
        assert answer.status_code == 404
        assert "upload-offset" not in answer.headers
    assert client.ask("HEAD", "/photos/uploads/..%2F..%2Fetc").status_code in (404, 405)
    assert not left(site)


def test_methods_may_come_in_a_header(client):
    place = begun(client)
    answer = client.ask(
        "POST", place, b"xy", **{"Upload-Offset": "0", "X-HTTP-Method-Override": "PATCH"}, **PART
    )
    assert (answer.status_code, client.offset(place)) == (204, 2)
    assert client.ask("POST", place, **{"X-HTTP-Method-Override": "DELETE"}).status_code == 204
    assert client.ask("HEAD", place).status_code == 404


def test_a_full_disk_is_told_and_the_upload_goes_on(site, client, flight, monkeypatch):
    data = flight.photos[2].read_bytes()
    place = begun(client, len(data))
    with monkeypatch.context() as patch:

        def full(_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patch.setattr(os, "fsync", full)
        assert client.patch(place, 0, data[:1000]).status_code == 507
    assert client.offset(place) == 0
    intake = site.live.intake
    with monkeypatch.context() as patch:

        def no_room(*_):
            raise OutputError("the disk is full")

        patch.setattr(intake, "take", no_room)
        assert client.send(place, data).status_code == 507
        assert client.ask("HEAD", place).status_code == 507  # all bytes are here, and no photo
    told = client.ask("HEAD", place)
    assert told.headers["upload-offset"] == str(len(data))
    assert told.headers["photo-state"] == "received"


@pytest.mark.slow
def test_uploads_that_nobody_goes_on_with_expire_while_the_server_runs(tmp_path):
    with served(tmp_path / "out", QUICK, guard=Guard(upload_keep_s=2.0)) as site:
        client = Client(site.web)
        asked = int(time.time())
        answer = client.create(1000)
        place = answer.headers["location"]
        at = parsedate_to_datetime(answer.headers["upload-expires"]).timestamp()
        assert 0 <= at - asked <= 3.0  # whole seconds
        assert answer.headers["upload-expires"].endswith("GMT")
        time.sleep(1.2)
        more = client.patch(place, 0, b"x")
        assert parsedate_to_datetime(more.headers["upload-expires"]).timestamp() > at
        time.sleep(1.2)
        assert client.offset(place) == 1  # each part puts it off
        site.until(lambda: not list((site.folder / "uploads").iterdir()), 10)  # nobody asks
        assert client.ask("HEAD", place).status_code == 404


@pytest.mark.slow
def test_idle_uploads_do_not_keep_others_out(tmp_path):
    with served(tmp_path / "out", QUICK, guard=Guard(most_uploads=2, upload_idle_s=1.0)) as site:
        client = Client(site.web)
        first = begun(client)
        begun(client)
        full = client.create(1000)
        assert (full.status_code, full.headers["retry-after"]) == (429, "5")
        site.until(lambda: client.create(1000).status_code == 201, 10)
        assert client.patch(first, 0, b"x").status_code == 204  # the idle one may still go on


def test_only_those_who_may_write_upload(tmp_path):
    with served(tmp_path / "out", QUICK, guard=Guard(token="long enough")) as site:
        with httpx.Client(base_url=site.url, verify=False) as web:
            stranger = Client(web)
            assert stranger.create(1000).status_code == 401
            place = begun(Client(web, Authorization="Bearer long enough"))
            for method in ("HEAD", "PATCH", "DELETE"):
                assert stranger.ask(method, place).status_code == 401
        other = Client(site.web, Origin="http://evil.example")
        assert other.create(1000).status_code == 403
        assert other.ask("DELETE", place).status_code == 403
        assert Client(site.web).offset(place) == 0


@pytest.mark.slow
def test_a_server_that_ends_keeps_the_bytes_that_arrived(flight, tmp_path, caplog):
    """Without a traceback; the upload goes on when it is back."""
    data = flight.photos[0].read_bytes()
    with served(tmp_path / "out", QUICK, guard=Guard(upload_stall_s=60.0)) as site:
        client = Client(site.web)
        place = begun(client, len(data))
        raw = cut_off(site, place, 0, data[:1000], len(data))
        site.until(lambda: "another request" in client.patch(place, 999, b"x").text)
        time.sleep(0.5)
    raw.settimeout(10)
    assert raw.recv(100)[:12] == b"HTTP/1.1 408"
    raw.close()
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR] == []
    with served(tmp_path / "out", QUICK) as site:
        client = Client(site.web)
        assert client.offset(place) == 1000
        assert client.send(place, data, 1000).headers["photo-state"] == "received"
