"""A real browser over a network that loses answers: what did not come is asked for again."""

import json

import pytest

from tests.live.conftest import served
from tests.live.test_browser import QUICK, holds, page  # noqa: F401 - fixtures
from tests.live.test_mission import plan_of, watched

pytestmark = pytest.mark.slow
SHAPE = {"type": "Point", "coordinates": [13.1, 52.1]}
AT_ONCE = "setInterval(() => { mended = 0; watch(); }, 300)"
"""Instead of waiting 10 s."""


def once(page, address, answer):  # noqa: F811
    """The first request of an address gets another answer."""
    page.route(address, answer, times=1)


def test_what_fails_once_is_read_again(page, flight, tmp_path):  # noqa: F811
    """Every part of the page had stayed as it was until the connection broke: empty."""
    with watched(tmp_path / "out", plan_of(flight, tmp_path)) as (_, web, url):
        feature = {"type": "Feature", "properties": {}, "geometry": SHAPE}
        layer = {"type": "FeatureCollection", "features": [feature]}
        web.post("/layers", params={"name": "marks.geojson"}, content=json.dumps(layer))
        web.post("/photos", params={"name": "odd.jpg"}, content=b"nothing")
        for k, name in enumerate(("plan", "photos", "layers/*", "coverage", "files")):
            busy = k % 2
            once(page, f"**/{name}", lambda r, b=busy: r.fulfill(status=503) if b else r.abort())
        page.route("**/info", lambda r: r.abort(), times=2)  # when it begins, and when it connects
        page.goto(url)
        page.wait_for_selector("#link.live")
        page.evaluate(AT_ONCE)
        page.wait_for_selector("#mission:visible")
        holds(page, "skyquilt.plan.marks.size == 7", 5)
        holds(page, "skyquilt.state.overlays.size == 1 && skyquilt.state.refused.length == 1", 5)
        holds(page, "document.getElementById('link').textContent == 'live' && missed.size == 0", 5)
        for k, name in enumerate(("other.jpg", "odd.jpg")):  # what was refused comes whole
            web.post("/photos", params={"name": name}, content=flight.photos[k].read_bytes())
            holds(page, f"skyquilt.state.photos.size == {k + 1}", 5)
            assert page.evaluate("skyquilt.state.refused.length") == 1 - k
        assert not page.errors


def test_another_survey_at_the_same_address_is_shown(page, flight, tmp_path):  # noqa: F811
    """It had stood as the live map, with none of the photos that came."""
    with served(tmp_path / "one", QUICK) as one:
        page.goto(one.url)
        for path in flight.photos[:2]:
            one.web.post("/photos", params={"name": path.name}, content=path.read_bytes())
        holds(page, "skyquilt.state.photos.size == 2")
        port = int(one.url.rsplit(":", 1)[1].strip("/"))
    with served(tmp_path / "two", QUICK, port=port) as two:
        page.wait_for_selector("#title:text-is('two')")
        page.wait_for_selector("#link.live")
        two.web.post("/photos", params={"name": "a.jpg"}, content=flight.photos[5].read_bytes())
        holds(page, "[...skyquilt.state.photos.values()].map(p => p.name).join() == 'a.jpg'")


def test_news_and_tiles_that_overtake_slow_answers_stay(page, flight, tmp_path):  # noqa: F811
    with served(tmp_path / "out", QUICK) as live:
        post = {"params": {"name": "a.jpg"}, "content": flight.photos[0].read_bytes()}
        photo = live.web.post("/photos", **post).json()["id"]
        page.goto(live.url)
        holds(page, "first !== null && Object.values(first._tiles).every((t) => t.loaded)")
        old = []
        page.route("**/photos", lambda r: old.append((r, r.fetch())), times=1)
        page.evaluate("void readPhotos()")
        holds(page, "skyquilt.state.meanwhile !== null")
        for _ in range(50):
            page.wait_for_timeout(20)
            if old:
                break
        page.evaluate(f"photoNews({{ id: {photo}, name: 'a.jpg', state: 'refined' }})")
        for route, answer in old:
            route.fulfill(response=answer)
        holds(page, "!skyquilt.state.meanwhile")
        assert page.evaluate(f"skyquilt.state.photos.get({photo}).state") == "refined"
        asked = []
        page.on("request", lambda r: asked.append(r.url) if "/tiles/" in r.url else None)
        held = []
        page.route("**/tiles/**", lambda r: r.continue_() if len(held) > 99 else held.append(r))
        page.evaluate("for (let k = 0; k < 20; k++) first.refresh([map.getBounds()])")
        page.wait_for_timeout(200)
        late = list(held)
        held += [None] * 100
        for route in late:
            route.continue_()
        page.wait_for_timeout(500)
        assert max(map(asked.count, set(asked))) == 2  # one that is late, one of all that came then
        assert not page.errors
