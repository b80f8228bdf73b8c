"""A real browser plans, watches points turn, asks for what is missing, and takes the file."""

import zipfile

import pytest

from tests.live.test_browser import browser, holds, page, shot  # noqa: F401 - fixtures
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
