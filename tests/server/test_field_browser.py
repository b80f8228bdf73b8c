"""The viewer in the field: phones, gloves, large text, no mouse, a weak link. A real browser."""

import contextlib
import io
import socket
import threading

import numpy as np
import pytest
from PIL import Image

from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey

pytestmark = pytest.mark.slow
TOUCH = {"is_mobile": True, "has_touch": True, "device_scale_factor": 2}
UPRIGHT = {**TOUCH, "viewport": {"width": 360, "height": 640}}
LYING = {**TOUCH, "viewport": {"width": 640, "height": 360}}
TABLET = {**TOUCH, "viewport": {"width": 1024, "height": 768}}
DESK = {"viewport": {"width": 1280, "height": 900}}
SMALL = """() => [...document.querySelectorAll(
    'button, a[href], input, select, summary, [tabindex], [role=button]')]
  .filter((e) => e.offsetParent && !e.closest('.leaflet-control-attribution, .files, p, aside'))
  .map((e) => [e, (e.closest('label') || e).getBoundingClientRect()])
  .filter(([e, b]) => b.width > 0 && (b.width < least || b.height < least))
  .map(([e, b]) => `${e.id || e.textContent}: ${b.width} x ${b.height}`)"""
"""What is too small for a finger; links within sentences do not count (WCAG 2.5.8)."""
WIDE = """() => [...document.querySelectorAll(':root, #panel, #panel *, dialog *')]
  .filter((e) => e.clientWidth && e.scrollWidth > e.clientWidth + 1
    && !e.closest('.sheet') && getComputedStyle(e).overflowX !== 'visible')
  .map((e) => `${e.id || e.tagName}: ${e.scrollWidth} in ${e.clientWidth}`)"""
"""What has to be scrolled sideways."""


@pytest.fixture(scope="module")
def site(finished):
    with ServerThread(
        survey=open_survey(finished.output), guard=Guard(), folder=finished.output
    ) as serving:
        yield serving.url


@pytest.fixture
def opens(browser):
    """Opens pages in contexts of their own; what the console calls errors are `page.errors`."""
    contexts = []

    def opened(url, **look):
        clock = look.pop("clock", False)
        contexts.append(browser.new_context(**look))
        page = contexts[-1].new_page()
        page.errors = []
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.on("console", lambda m: m.type == "error" and page.errors.append(m.text))
        if clock:
            page.clock.install(time="2024-07-15T12:00:05")  # no minute ends meanwhile
        page.goto(url)
        if not url.startswith("file:"):
            page.wait_for_selector("#link.live")
            holds(page, "skyquilt.state.fitted && first && !first.isLoading()")
        return page

    yield opened
    for context in contexts:
        context.close()


def holds(page, expression, seconds=120):
    for _ in range(seconds * 20):
        if page.evaluate(expression):
            return
        threading.Event().wait(0.05)
    raise AssertionError(f"never: {expression}")


def small(page, least):
    return page.evaluate(SMALL.replace("least", str(least)))


def seen(page):
    """(h, w, 3) what the map shows."""
    with Image.open(io.BytesIO(page.locator("#map").screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def covered(page):
    """Share of the map that has a hue, as ground has, and background and buttons have not."""
    return float((np.ptp(seen(page), axis=-1) > 15).mean())


def tap(page, x, y):
    """Taps the map at shares of its width and height."""
    box = page.locator("#map").bounding_box()
    page.touchscreen.tap(box["x"] + x * box["width"], box["y"] + y * box["height"])


@pytest.mark.parametrize("look", [UPRIGHT, LYING, TABLET], ids=["upright", "lying", "tablet"])
def test_a_finger_reaches_everything_and_nothing_is_cut_off(opens, site, look):
    page = opens(site, **look)
    width, height = look["viewport"].values()
    box = page.locator("#map").bounding_box()
    assert min(box["width"], box["height"]) > 0.8 * min(width, height)
    page.select_option("#other", "heights")
    page.locator("#swipe").tap()
    page.locator("#more summary").tap()
    page.get_by_role("button", name="Control points").tap()
    page.get_by_role("button", name="Add a point").tap()
    assert small(page, 44) == []
    page.locator("#swipe").tap()
    tap(page, 0.5, 0.5)
    page.wait_for_selector("#covering li.chosen img.thumb")
    # a finger is no cursor: nothing is left lying over a small map
    page.wait_for_timeout(300)
    assert page.inner_text("#where") == ""
    assert page.evaluate(WIDE) == []
    page.locator("#covering li.chosen a").tap()
    page.wait_for_selector("#big .spot")
    assert small(page, 44) == [] and page.evaluate(WIDE) == []
    head = page.locator("#big header").bounding_box()
    for part in page.locator("#big header > *").all():
        at = part.bounding_box()
        assert at["y"] >= head["y"] and at["y"] + at["height"] <= head["y"] + head["height"] + 1
    page.get_by_role("button", name="Close").tap()
    page.locator("#fold").tap()
    assert page.locator("#map").bounding_box()["height"] == height
    tap(page, 0.5, 0.5)
    holds(page, "!document.body.classList.contains('folded')")  # the answer is shown
    assert page.errors == []


def test_text_follows_the_size_that_the_browser_is_set_to(opens, site, finished):
    """As in the settings of a browser: the size of the root's text; not the page's zoom."""
    page = opens(site, **UPRIGHT)
    report = opens((finished.output / "report.html").as_uri(), **UPRIGHT)
    for each in (page, report):
        size = "parseFloat(getComputedStyle(document.querySelector('h1')).fontSize)"
        before = each.evaluate(size)
        each.evaluate("document.documentElement.style.fontSize = '200%'")
        assert each.evaluate(size) == pytest.approx(2 * before)
        assert each.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate(WIDE) == []
    assert page.locator("#map").bounding_box()["height"] > 300


def test_without_a_mouse(opens, site):
    page = opens(site, **DESK, reduced_motion="reduce", forced_colors="active")
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")  # on the map: the photos of its middle
    page.wait_for_selector("#covering li.chosen")
    page.locator("#covering li.chosen button").focus()
    page.keyboard.press("Escape")
    assert not page.locator("#here").is_visible()
    assert page.evaluate("document.activeElement.id") == "map"
    page.locator("#fold").press("Enter")
    page.locator(".skip").press("Enter")  # the controls are shown where they are gone to
    assert page.locator("#panel").is_visible()
    assert page.evaluate("document.activeElement.id") == "panel"
    # where the system's colours replace the page's, what is pressed still differs
    colour = "(id) => getComputedStyle(document.getElementById(id)).backgroundColor"
    assert page.evaluate(colour, "tracks") != page.evaluate(colour, "prints")
    # who wants no motion gets none
    glides = """() => { map.getPane('mapPane').classList.add('leaflet-zoom-anim');
      return getComputedStyle(document.querySelector('.leaflet-zoom-animated')).transition; }"""
    assert page.evaluate(glides) == "none"
    assert page.errors == []


class Link:
    """A link to a server that counts bytes, can hold everything back, and can break."""

    def __init__(self, url):
        self.behind = int(url.rsplit(":", 1)[1].strip("/"))
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.listening.getsockname()[1]}/"
        self.open, self.up = threading.Event(), True
        self.open.set()
        self.bytes, self.ends = 0, []
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self):
        while True:
            try:
                near, _ = self.listening.accept()
            except OSError:
                return
            if not self.up:
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self.behind))
            self.ends += [near, far]
            threading.Thread(target=self._pass, args=(near, far, 0), daemon=True).start()
            threading.Thread(target=self._pass, args=(far, near, 1), daemon=True).start()

    def _pass(self, one, other, counted):
        try:
            while data := one.recv(1 << 16):
                self.open.wait()
                self.bytes += counted * len(data)
                other.sendall(data)
        except OSError:
            pass
        for end in (one, other):
            end.close()

    def breaks(self):
        self.up = False
        for end in self.ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        self.ends.clear()


@pytest.fixture
def link(site):
    link = Link(site)
    yield link
    link.open.set()
    link.breaks()
    link.listening.close()


def test_a_lost_connection_is_said_and_what_was_missed_is_loaded(opens, link):
    """A link that goes silent without a word, then one that breaks; the clock is turned on."""
    page = opens(link.url, **UPRIGHT, clock=True)
    page.clock.run_for(4000)
    assert page.inner_text("#stale") == ""
    since = page.evaluate("new Date().toLocaleTimeString([], {hour: '2-digit', minute: '2-digit'})")
    link.open.clear()
    page.clock.run_for(25000)
    holds(page, "document.querySelector('#link').className === 'lost'")
    assert page.locator("#stale").get_attribute("role") == "status"
    assert f"No connection since {since}" in page.inner_text("#stale")
    whole = page.evaluate(
        "[innerWidth, document.querySelector('#stale').getBoundingClientRect().right]"
    )
    assert whole[1] < whole[0]
    link.open.set()
    page.clock.run_for(1000)
    holds(page, "document.querySelector('#link').className === 'live'")
    assert page.inner_text("#stale") == ""
    assert "Connected again" in page.inner_text("#said")
    link.breaks()
    holds(page, "document.querySelector('#link').className === 'lost'")
    page.locator(".leaflet-control-zoom-in").tap()
    page.clock.run_for(2000)
    # what was there before stays, enlarged, instead of an empty map; also where the view jumps
    page.evaluate("trails.remove()")  # these are no tiles
    assert covered(page) > 0.4
    zoom = page.evaluate("map.getZoom()")
    page.evaluate("map.setView(map.getCenter(), map.getZoom() - 2, { animate: false })")
    page.clock.run_for(2000)
    assert page.evaluate("map.getZoom()") == zoom - 2
    assert covered(page) > 0.08  # it is a small part of the view now; 0.04 without
    missing = "Object.values(first._tiles).filter((t) => !t.loaded).length"
    assert page.evaluate(missing) > 0
    link.up = True
    for _ in range(4):
        page.clock.run_for(2000)
        page.wait_for_timeout(100)
    holds(page, "document.querySelector('#link').className === 'live'")
    page.clock.run_for(2000)
    holds(page, f"{missing} === 0")


def test_a_first_look_over_a_weak_link_is_short(opens, link):
    """The page without its tiles came to 265 kB; tiles beside the view are not asked for."""
    page = opens(link.url, **UPRIGHT)
    page.wait_for_timeout(1500)
    outside = page.evaluate("""() => { const b = map.getPixelBounds();
      return Object.values(first._tiles).filter(({ coords: c }) => c.z === map.getZoom() && (
        (c.x + 1) * 256 < b.min.x || c.x * 256 > b.max.x || (c.y + 1) * 256 < b.min.y
        || c.y * 256 > b.max.y)).length; }""")
    assert outside == 0
    tiles = page.evaluate("""performance.getEntriesByType('resource')
      .filter((e) => e.name.includes('/tiles/')).reduce((n, e) => n + e.transferSize, 0)""")
    assert tiles > 10_000
    assert link.bytes - tiles < 120_000
    # the same tiles again, after news of a growing map: only what changed is sent
    count = link.bytes
    page.evaluate("skyquilt.state.last += 1")
    for way in ("out", "in"):
        page.locator(f".leaflet-control-zoom-{way}").tap()
        page.wait_for_timeout(700)
    other = page.evaluate("""performance.getEntriesByType('resource').slice(-40)
      .filter((e) => e.name.includes('/tiles/')).map((e) => [e.name, e.transferSize])""")
    assert len({name for name, _ in other}) < len(other)
    assert link.bytes - count < tiles


def test_the_report_on_a_phone_and_on_paper(opens, finished):
    page = opens((finished.output / "report.html").as_uri(), **UPRIGHT)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert small(page, 24) == []
    assert page.locator(".tools button").first.bounding_box()["width"] == 44
    tiny = page.evaluate("""() => [...document.querySelectorAll('figure svg text')]
      .filter((e) => !e.closest('svg').querySelector('use, image'))
      .map((e) => parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().a)
      .filter((size) => size > 0 && size < 9.5)""")
    assert tiny == []
    page.emulate_media(media="print", reduced_motion="reduce")
    assert page.locator("section > details:not([open])").count() > 0
    assert page.locator("section > details:not([open])").first.is_hidden()
    assert page.evaluate("getComputedStyle(document.querySelector('.lead')).breakAfter") == "avoid"
    assert page.evaluate("getComputedStyle(document.documentElement).scrollBehavior") == "auto"
    assert page.errors == []
