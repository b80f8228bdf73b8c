"""Query strings and parts of paths that nobody means, for every parameter that the application
declares: each is refused or answered, quickly, and the server goes on.
"""

import time
from urllib.parse import quote_from_bytes

import httpx
import pytest
from fastapi.routing import APIRoute

from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import RESUMABLE, Guard
from skyquilt.server.app import make_app
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey
from tests.live.conftest import served

VALUES = (
    b"", b"-1", b"0", b"9" * 400, b"-" + b"9" * 30, b"1e999", b"1e308", b"nan", b"-inf", b"0x10",
    b"1_0", "\u00b2".encode(), "\u0663".encode(), b"\x00", b"\xff\xfe", b"../../etc/passwd",
    b"a" * 5000, b"1;2", b"1,2,3,4", b"0,0,1e308,1e308", b"nan,nan,nan,nan", b"[" * 2000, b"null",
    b"%00", b"EPSG:99999999", b"/vsicurl/http://127.0.0.1:1/a", b"\r\nX-Injected: 1",
)  # fmt: skip
SLOWEST_S = 3.0
MORE = {"/export": ("format=tif",), "/wms": (
    "SERVICE=WMS&VERSION=1.3.0&REQUEST=GetMap&LAYERS=map&STYLES=&CRS=EPSG:3857&BBOX=0,0,1,1"
    "&WIDTH=64&HEIGHT=64&FORMAT=image/png",
    "SERVICE=WMS&VERSION=1.3.0&REQUEST=GetFeatureInfo&LAYERS=map&QUERY_LAYERS=map&STYLES="
    "&CRS=EPSG:3857&BBOX=0,0,1,1&WIDTH=64&HEIGHT=64&I=1&J=1&INFO_FORMAT=application/json",
)}  # fmt: skip
"""Whole query strings of which one value is replaced at a time."""


def routes(folder, survey, methods):
    """(method, path, names of query parameters) of what the application declares."""
    app = make_app(survey, Guard(), None, folder)
    for route in app.routes:
        if isinstance(route, APIRoute):
            queries = [q.alias for q in route.dependant.query_params]
            yield from ((m, route.path, queries) for m in sorted(route.methods & methods))


def attempts(path, queries):
    """Addresses with one odd value each."""
    for value in VALUES:
        word = quote_from_bytes(value, safe="")
        if "{" in path:
            head, tail = path.split("{", 1)
            yield head + word + "".join("/1" if "{" in p else "/" + p
                                        for p in tail.split("/")[1:])  # fmt: skip
        plain = path.replace("{number}", "1").replace("{name}", "a")
        for name in queries:
            yield f"{plain}?{name}={word}"
            others = "&".join(f"{q}=1" for q in queries if q != name)
            yield f"{plain}?{others}&{name}={word}"
        for whole in MORE.get(path, ()):
            parts = whole.split("&")
            for k, part in enumerate(parts):
                name = part.split("=")[0]
                yield f"{plain}?" + "&".join([*parts[:k], f"{name}={word}", *parts[k + 1 :]])
                yield f"{plain}?{whole}&{name}={word}"


def attack(web, listed):
    bad = []
    for method, path, queries in listed:
        if path == "/events":
            continue  # a stream that does not end: tests/live/test_limits.py
        for address in attempts(path, queries):
            started = time.perf_counter()
            answer = web.request(method, address)
            took = time.perf_counter() - started
            if answer.status_code >= 500 or took > SLOWEST_S or "x-injected" in answer.headers:
                bad.append((method, address[:200], answer.status_code, answer.text[:100], took))
    return bad


@pytest.mark.slow
def test_queries_that_nobody_means_to_a_live_map(tmp_path):
    with served(tmp_path / "out", LiveSettings(features=300)) as site:
        survey = open_survey(tmp_path / "out")
        listed = list(routes(tmp_path / "out", survey, {"GET", "HEAD", "DELETE"}))
        assert attack(site.web, listed) == []
        assert site.web.get("/info").status_code == 200


@pytest.mark.slow
def test_the_same_to_a_finished_map(finished):
    survey = open_survey(finished.output)
    listed = list(routes(finished.output, survey, {"GET", "HEAD"}))
    assert sum(1 for _, path, queries in listed for _ in attempts(path, queries)) > 2000
    serving = ServerThread(survey=survey, guard=Guard(), folder=finished.output)
    with serving, httpx.Client(base_url=serving.url, timeout=60, verify=False) as web:
        assert attack(web, listed) == []
        assert web.get("/info").status_code == 200


def test_every_path_that_takes_a_body_gets_odd_ones(tmp_path, finished):
    """A new path cannot be forgotten by `test_bodies`."""
    from tests.server.test_bodies import PLACES

    takes = {"POST", "PUT", "PATCH", "DELETE"}
    survey = open_survey(finished.output)
    declared = {(m, p.split("/{")[0]) for m, p, _ in routes(finished.output, survey, takes)}
    assert (("POST", "/control/run") in declared) and (("POST", RESUMABLE) in declared)
    asked = {(m, p.split("?")[0].removesuffix("/1").removesuffix("/a")) for m, p in PLACES}
    assert declared - asked == set()
