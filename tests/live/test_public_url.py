"""Behind a reverse proxy: every address that clients are told leads back to the server."""

from types import SimpleNamespace

import defusedxml.ElementTree as ElementTree
import httpx
import pytest

from skyquilt.errors import UsageError
from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from tests.live.conftest import served
from tests.live.test_http import middle, tile_of

PUBLIC = "https://maps.example/flood/east/"
XLINK = "{http://www.w3.org/1999/xlink}href"


class Proxy(httpx.BaseTransport):
    """Hands what is below the public address on to the server and answers 404 to all else, as a
    reverse proxy does; with `keep` the server sees the name that the client asked.
    """

    def __init__(self, url, keep):
        self.inner, self.url, self.keep = httpx.HTTPTransport(), url, keep

    def handle_request(self, request):
        told = str(request.url)
        if not told.startswith(PUBLIC):
            return httpx.Response(404)
        headers = [(k, v) for k, v in request.headers.items() if k != "host" or self.keep]
        there = self.url + told[len(PUBLIC) :]
        sent = httpx.Request(request.method, there, headers=headers, content=request.read())
        return self.inner.handle_request(sent)


@pytest.fixture(scope="module", params=["its own name", "the public name"])
def site(request, flight, tmp_path_factory):
    guard = Guard(public_url=PUBLIC.rstrip("/"), token="long enough")
    keep = request.param == "the public name"
    with (
        served(
            tmp_path_factory.mktemp("proxied") / "out", LiveSettings(features=600), guard
        ) as one,
        httpx.Client(base_url=PUBLIC, transport=Proxy(one.url, keep), timeout=60) as client,
    ):
        assert one.send(flight.photos[0]).status_code == 201
        one.until(lambda: any(n["bounds"] for n in one.web.get("/info").json()["layers"]))
        one.settle()
        yield SimpleNamespace(client=client, web=one.web)


def test_tiles(site):
    template = site.client.get("tiles.json").json()["tiles"][0]
    x, y = tile_of(*middle(site), 19)
    tile = site.client.get(template.format(z=19, x=x, y=y))
    assert tile.status_code == 200
    assert tile.content == site.web.get(f"/tiles/19/{x}/{y}?layer=visible").content


@pytest.mark.parametrize("version", ["1.1.1", "1.3.0"])
def test_wms(site, version):
    asked = {"SERVICE": "WMS", "VERSION": version, "REQUEST": "GetCapabilities"}
    root = ElementTree.fromstring(site.client.get("wms", params=asked).text)
    told = {e.get(XLINK) for e in root.iter() if e.get(XLINK)}
    assert told
    for address in told:
        again = site.client.get(address, params=asked)
        assert again.status_code == 200 and "Capabilities" in again.text


def test_uploads_and_the_page_that_sends_them(site):
    tus = {"Tus-Resumable": "1.0.0", "X-Token": "long enough", "Origin": "https://maps.example"}
    begun = site.client.post("photos/uploads", headers=tus | {"Upload-Length": "1000"})
    assert begun.status_code == 201
    place = begun.headers["location"]
    assert site.client.head(place, headers=tus).headers["upload-offset"] == "0"
    assert site.client.delete(place, headers=tus).status_code == 204
    other = tus | {"Origin": "https://evil.example", "Upload-Length": "1000"}
    assert site.client.post("photos/uploads", headers=other).status_code == 403
    assert site.web.get("/info", headers={"Host": "evil.example"}).status_code == 421


@pytest.mark.parametrize(
    "url",
    ["", "maps.example", "/map/", "ftp://maps.example/", "https://", "https:///map", "https://a b/"]
    + ["https://maps.example/?x=1", "https://maps.example/#a", "https://me@maps.example/"]
    + ["https://maps.example:99999/", "https://maps.example:x/", "https://[::1/", 'https://a/"<b>'],
)
def test_other_addresses_are_refused(url):
    with pytest.raises(UsageError, match="--public-url"):
        Guard(public_url=url)


def test_addresses_of_networks_are_taken():
    for url in ("http://192.0.2.7:8443/map", "https://[2001:db8::1]/", "HTTPS://Maps.Example"):
        assert Guard(public_url=url).knows(Guard(public_url=url).public_host)
