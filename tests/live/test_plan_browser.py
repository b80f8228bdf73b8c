"""A real browser plans, watches points turn, asks for what is missing, and takes the file."""

import threading
import zipfile

import numpy as np
import pytest

from tests.accessible import problems
from tests.live.test_browser import holds, page, shot  # noqa: F401 - fixtures
from tests.live.test_browser import seen as page_pixels
from tests.live.test_mission import plan_of, watched

pytestmark = pytest.mark.slow


def click(page, *places):  # noqa: F811
    """Clicks the map at shares of its width and height."""
    box = page.locator("#map").bounding_box()
    for x, y in places:
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(60)


def test_points_turn_and_the_follow_up_is_taken(page, flight, tmp_path):  # noqa: F811
    with watched(tmp_path / "out", plan_of(flight, tmp_path)) as (_, web, url):
        asked = []
        page.on("request", lambda r: asked.append(r.url))
        page.goto(url)
        page.wait_for_selector("#link.live")
        holds(page, "skyquilt.plan.marks.size == 7")
        shot(page, "planned")
        for path in flight.photos:
            web.post("/photos", params={"name": path.name}, content=path.read_bytes())
        green = "[...skyquilt.plan.marks.values()].filter(m => m.options.color == '#15803d').length"
        holds(page, f"{green} == 6", 120)
        holds(page, "document.getElementById('drones').textContent.includes('6 of 7 photos')")
        page.click("#plan-coverage")
        holds(page, "document.querySelector('.leaflet-image-layer') !== null")
        page.wait_for_timeout(1500)
        shot(page, "taken")
        page.click("#plan-fill")
        holds(page, "document.querySelectorAll('#plans a.file').length > 0", 120)
        page.wait_for_timeout(800)
        shot(page, "filled")
        with page.expect_download() as download:
            page.click("#plans a.file >> text=kmz")
        assert zipfile.is_zipfile(download.value.path())
        assert not page.errors
        assert all(u.startswith((url, "blob:", "data:")) for u in asked)


def test_an_area_and_a_keep_out_are_drawn_and_planned(page, tmp_path):  # noqa: F811
    with watched(tmp_path / "out", None) as (_, _web, url):
        page.goto(url)
        page.wait_for_selector("#link.live")
        page.evaluate("skyquilt.map.setView([52.1, 13.1], 18, { animate: false })")
        page.click("#draw-area")
        click(page, (0.15, 0.2), (0.55, 0.2), (0.55, 0.75), (0.15, 0.75))
        page.click("#draw-area")
        page.click("#draw-closed")
        click(page, (0.3, 0.4), (0.36, 0.4), (0.36, 0.48))
        page.click("#draw-closed")
        assert page.evaluate("skyquilt.plan.shapes().map(s => [s.closed, s.ring.length])") == [
            [False, 4], [True, 3]
        ]  # fmt: skip
        page.fill("#plan-height", "70")
        page.fill("#plan-drones", "2")
        page.click("#plan-go")
        holds(page, "document.querySelectorAll('#plans a.file').length >= 8", 180)
        page.wait_for_timeout(1000)
        shot(page, "drawn")
        another = page.context.browser.new_page()  # another person's browser
        another.goto(url)
        holds(another, "skyquilt.plan && skyquilt.plan.shapes().length == 2")
        another.click("#draw-clear")
        holds(page, "skyquilt.plan.shapes().length == 0")
        another.close()
        assert not page.errors


def test_an_area_is_drawn_by_keyboard(page, tmp_path):  # noqa: F811
    """Enter sets a corner in the middle of the map, Backspace takes it back, Escape all of them."""
    with watched(tmp_path / "out", None) as (_, _web, url):
        page.goto(url)
        page.wait_for_selector("#link.live")
        page.wait_for_selector("#mission:visible")
        page.evaluate("skyquilt.map.setView([52.1, 13.1], 18, { animate: false })")
        page.focus("#draw-area")
        page.keyboard.press("Enter")
        page.focus("#map")
        for key in ("Enter", "ArrowRight", "Enter", "ArrowDown", "Enter", "Backspace", "Enter"):
            page.keyboard.press(key)
            page.wait_for_timeout(350)  # the map glides
        page.locator("#draw-area").press("Enter")
        shapes = "skyquilt.plan.shapes().map(s => [s.closed, s.ring.length])"
        assert page.evaluate(shapes) == [[False, 3]]
        page.locator("#draw-closed").press("Enter")
        page.locator("#map").press("Enter")
        page.keyboard.press("Escape")
        assert page.get_attribute("#draw-closed", "aria-pressed") == "false"
        assert page.evaluate(shapes) == [[False, 3]]
        assert page.locator("#covering li").count() == 0  # no photos were asked for
        assert not page.errors


def test_a_script_that_comes_late_misses_nothing(page, tmp_path):  # noqa: F811
    """On a weak network the last script of the page comes seconds after the others."""
    with watched(tmp_path / "out", None) as (_, _web, url):
        late = threading.Event()

        def delayed(route):
            late.wait(2)  # longer than the page takes to connect
            route.continue_()

        page.route("**/plan.js", delayed)
        page.goto(url)
        page.wait_for_selector("#mission:visible")
        assert not page.errors


def settled(page):  # noqa: F811
    """The pixels of the page when they have not changed for two seconds: tiles come when the
    machine has time for them.
    """
    page.wait_for_timeout(3000)
    before = page_pixels(page)
    for _ in range(15):
        page.wait_for_timeout(2000)
        now = page_pixels(page)
        if np.array_equal(now, before):
            break
        before = now
    return before


def test_photos_placed_by_their_metadata_are_pale_until_they_are_refined(page, flight, tmp_path):  # noqa: F811
    """A dashed outline, and a fifth of white over what is not sure yet, however many photos show
    it; gone when they are refined.
    """
    with watched(tmp_path / "out", None) as (live, web, url):
        refined, live._refined = live._refined, lambda: None
        for path in flight.photos[:3]:
            web.post("/photos", params={"name": path.name}, content=path.read_bytes())
        page.goto(url)
        page.wait_for_selector("#link.live")
        count = "skyquilt.plan.provisional.getLayers().length"
        holds(page, f"{count} == 3", 60)
        styles = page.evaluate(
            "skyquilt.plan.provisional.getLayers().map(l => l.options.dashArray)"
        )
        assert all(styles)
        page.click("#tracks")  # their lines would be counted too
        page.click("#fit")
        pale = settled(page)
        shot(page, "provisional")
        assert problems(page) == []
        live._refined = refined
        holds(page, f"{count} == 0", 60)
        sure = settled(page)
        shot(page, "no-longer-provisional")
        drawn = (np.abs(sure - (217, 217, 217)).max(-1) > 30) & (
            np.abs(pale - (217, 217, 217)).max(-1) > 12
        )
        assert drawn.sum() > 5000
        lifted = (pale[drawn].mean() - sure[drawn].mean()) / (255 - sure[drawn].mean())
        assert 0.18 < lifted < 0.27  # 0.22, and the outlines; where three photos overlap, too
        assert not page.errors
