"""A real browser drives the viewer."""

import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skyquilt.live.settings import LiveSettings
from tests.end_to_end.conftest import relabel
from tests.live.conftest import served

pytestmark = pytest.mark.slow
QUICK = LiveSettings(features=600)
SHOTS = os.environ.get("SKYQUILT_SCREENSHOTS")
"""A folder to keep screenshots in, for a person to look at."""


@pytest.fixture
def page(browser):
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.errors = []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.agrees = False
    page.on("dialog", lambda dialog: answered(page, dialog))
    yield page
    context.close()


def answered(page, dialog):
    """A dialog of a page that does not `agree` is an error."""
    if page.agrees:
        dialog.accept()
    else:
        page.errors.append(dialog.message)
        dialog.dismiss()


def shot(page, name):
    if SHOTS:
        page.screenshot(path=str(Path(SHOTS) / f"{name}.png"))


def holds(page, expression, seconds=120):
    """Waits until an expression is true; the page's own policy forbids Playwright's way of
    waiting.
    """
    for _ in range(seconds * 10):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"never: {expression}")


def seen(page):
    """(h, w, 3) what the map shows."""
    with Image.open(io.BytesIO(page.locator("#map").screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def coloured(page):
    """Share of the map that is neither background nor white."""
    pixels = seen(page)
    return float((np.abs(pixels - (217, 217, 217)).max(-1) > 12).mean())


def test_a_flight_without_positions_is_explained_and_finished(page, flight, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        page.agrees = True
        page.goto(site.url)
        holds(page, "document.querySelector('#empty h2')?.textContent.includes('on the map yet')")
        for path in flight.photos[:3]:
            copy = tmp_path / path.name
            shutil.copyfile(path, copy)
            relabel(copy, drop=("position",))
            site.send(copy)
        words = "document.querySelector('#empty').textContent"
        holds(page, f"{words}.includes('No photo has a position so far')")
        page.click("#finish")
        holds(page, f"{words}.includes('The final map has no place on Earth')", 60)
        holds(page, "document.querySelectorAll('#downloads a').length == 3")
        shot(page, "without positions")
        assert page.errors == []


def dropped(page, name, content):
    """A file is let go over the map."""
    files = page.evaluate_handle(
        "([name, text]) => { const d = new DataTransfer(); d.items.add(new File([text], name));"
        " return d; }",
        [name, json.dumps(content)],
    )
    for event in ("dragover", "drop"):
        page.dispatch_event("#map", event, {"dataTransfer": files})


def test_the_map_appears_and_grows_and_everything_on_it_works(page, flight, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        page.goto(site.url)
        page.wait_for_selector("#link.live")
        empty = coloured(page)
        site.send(flight.photos[0])
        holds(page, "document.querySelectorAll('#map .leaflet-tile[src]').length > 0")
        page.wait_for_timeout(700)
        one = coloured(page)
        assert one > empty + 0.02
        for path in flight.photos[1:]:
            site.send(path)
        site.until(lambda: set(site.states().values()) == {"refined"})
        holds(
            page,
            "[...document.querySelectorAll('#photos .state')].filter(e => e.textContent =="
            " 'refined').length == 6",
        )
        page.click("#fit")
        page.wait_for_timeout(1500)
        assert coloured(page) > 0.08
        shot(page, "grown")

        # a click lists photos, the chosen one is marked, another can be chosen, full size is one
        # click away
        box = page.locator("#map").bounding_box()
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.click(*middle)
        page.wait_for_selector("#covering li.chosen a")
        count = page.locator("#covering li").count()
        at = page.evaluate("() => { const c = skyquilt.map.getCenter(); return [c.lng, c.lat]; }")
        found = site.web.get("/photos", params={"lon": at[0], "lat": at[1]}).json()["photos"]
        assert count == len(found) > 1
        assert page.locator("#covering li span").all_inner_texts() == [p["name"] for p in found]
        page.locator("#covering li").nth(1).click()
        assert page.locator("#covering li.chosen span").inner_text() == found[1]["name"]
        href = page.locator("#covering li a").first.get_attribute("href")
        assert site.web.get(href).headers["content-type"] == "image/jpeg"
        shot(page, "covering")

        # a length that the projection itself knows
        page.click("#distance")
        page.mouse.click(middle[0] - 100, middle[1])
        page.mouse.click(middle[0] + 100, middle[1])
        said = float(page.inner_text("#measured").split()[0])
        from pyproj import Geod

        ends = [
            page.evaluate(
                "(x) => { const p = skyquilt.map.containerPointToLatLng([x, 450]); return [p.lng,"
                " p.lat]; }",
                box["width"] / 2 + dx,
            )
            for dx in (-100, 100)
        ]
        true = Geod(ellps="WGS84").line_length(*zip(*ends, strict=True))
        assert said == pytest.approx(true, rel=2e-3)
        page.click("#area")
        for dx, dy in ((-80, -60), (80, -60), (80, 60), (-80, 60)):
            page.mouse.click(middle[0] + dx, middle[1] + dy)
        words = page.inner_text("#measured").split()
        square = float(words[0]) * (10000 if words[1] == "ha" else 1)
        assert square == pytest.approx((true / 200) ** 2 * 160 * 120, rel=6e-3)
        shot(page, "area")
        page.click("#area")

        # a layer is chosen, shown, and its text stays text
        layer = {
            "type": "Feature",
            "properties": {"what": "<img src=x onerror=alert(1)>"},
            "geometry": {"type": "Point", "coordinates": at},
        }
        (tmp_path / "found.geojson").write_text(json.dumps(layer))
        page.set_input_files("#files", str(tmp_path / "found.geojson"))
        page.wait_for_selector("#overlays li")
        dropped(
            page,
            "area.geojson",
            {
                **layer,
                "geometry": {"type": "LineString", "coordinates": [at, [at[0] + 1e-4, at[1]]]},
            },
        )
        holds(page, "document.querySelectorAll('#overlays li').length == 2")
        assert (
            site.web.get("/layers/area.geojson").json()["features"][0]["geometry"]["type"]
            == "LineString"
        )
        page.mouse.click(*middle)
        page.wait_for_selector(".leaflet-popup")
        assert "<img src=x" in page.inner_text(".leaflet-popup")
        assert page.locator(".leaflet-popup img").count() == 0

        # two maps beside each other
        site.until(
            lambda: "visible-newest" in [n["name"] for n in site.web.get("/info").json()["layers"]]
        )
        holds(
            page,
            "[...document.querySelector('#other').options].some(o => o.value == 'visible-newest')",
        )
        page.click("#swipe")
        page.wait_for_selector("#handle:visible")
        before = page.evaluate("() => skyquilt.map.getPane('second').style.clip")
        handle = page.locator("#handle").bounding_box()
        page.mouse.move(handle["x"] + 5, 400)
        page.mouse.down()
        page.mouse.move(handle["x"] - 200, 400, steps=4)
        page.mouse.up()
        assert page.evaluate("() => skyquilt.map.getPane('second').style.clip") != before
        shot(page, "swipe")
        page.click("#swipe")
        page.click("#rule")
        assert page.get_attribute("#rule", "aria-pressed") == "true"
        page.evaluate(
            "() => { const t = document.querySelector('#time'); t.value = 0; t.oninput(); }"
        )
        assert page.inner_text("#until") != "now"
        page.click("#export")
        assert page.errors == []


def test_it_comes_back_when_the_server_does(page, flight, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        site.send(flight.photos[0])
        page.goto(site.url)
        page.wait_for_selector("#link.live")
        page.wait_for_selector("#photos li")
        port = int(site.url.rsplit(":", 1)[1].strip("/"))
    page.wait_for_selector("#link.lost", timeout=15000)
    with served(tmp_path / "out", QUICK, port=port) as site:
        page.wait_for_selector("#link.live", timeout=20000)
        site.send(flight.photos[1], name="<b>second.jpg")
        holds(page, "document.querySelectorAll('#photos li').length == 2")
        assert "<b>second.jpg" in page.inner_text("#photos")
        assert page.locator("#photos b").count() == 0
        assert page.errors == []


def test_two_spectra_lie_beside_each_other_on_either_side_of_the_handle(page, both, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        for path in [*both.photos, *sorted((both.folder / "thermal").glob("*.tif"))]:
            assert site.send(path).is_success
        site.until(lambda: all(p["ring"] for p in site.web.get("/photos").json()["photos"]))
        site.settle()
        page.goto(site.url)
        page.wait_for_selector("#link.live")
        holds(page, "[...document.querySelector('#layer').options].some(o => o.value == 'thermal')")
        page.click("#fit")

        def settled():
            page.wait_for_timeout(1200)
            return seen(page)

        alone = {}
        for name in ("thermal", "visible"):
            page.select_option("#layer", name)
            alone[name] = settled()
        assert np.abs(alone["thermal"] - alone["visible"]).max(-1).mean() > 5
        page.click("#swipe")
        page.select_option("#other", "thermal")
        both_shown = settled()
        shot(page, "spectra")
        handle, box = page.locator("#handle").bounding_box(), page.locator("#map").bounding_box()
        middle = round(handle["x"] + handle["width"] / 2 - box["x"])
        aside = round(handle["width"])
        assert 0.4 * box["width"] < middle < 0.6 * box["width"]
        for part, name in (
            (np.s_[:, : middle - aside], "visible"),
            (np.s_[:, middle + aside :], "thermal"),
        ):
            assert (np.abs(both_shown[part] - alone[name][part]).max(-1) > 8).mean() < 0.002, name
        assert page.errors == []


def test_from_the_empty_page_to_the_final_map(browser, flight, tmp_path):
    """What is missing is said, the growing map stays in view, and "Finish flight" ends with the
    final map and its files.
    """
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.on("dialog", lambda dialog: dialog.accept())
    with served(tmp_path / "out", QUICK) as site:
        page.goto(site.url)
        page.wait_for_selector("#link.live")
        assert "Copy photos into the watched folder" in page.inner_text("#empty")
        shot(page, "empty")
        assert not page.locator("#profile").is_visible()  # there are no heights yet
        for path in flight.photos:
            site.send(path)
        site.until(lambda: set(site.states().values()) == {"refined"})
        inside = (
            "(() => { const l = skyquilt.state.layers.get('visible'); if (!l || !l.bounds) return"
            " false; const [w, s, e, n] = l.bounds; return skyquilt.map.getBounds().contains("
            "[[s, w], [n, e]]); })()"
        )
        holds(page, inside)
        assert not page.locator("#empty").is_visible()
        # refined photos have no reason
        holds(page, "document.querySelectorAll('#photos small').length == 0")
        tracks = page.evaluate("skyquilt.state.tracks")
        assert sorted(tracks[0]) == tracks[0] and len(tracks) == 1
        page.click("#finish")
        holds(page, "document.querySelector('#layer').value == 'finished'", seconds=180)
        holds(page, "document.querySelectorAll('#downloads a').length >= 3")
        assert page.locator("#downloads a").all_inner_texts() == ["Map", "Heights", "Report"]
        assert page.locator("#profile").is_visible()
        page.wait_for_timeout(1500)
        shot(page, "finished")
        assert coloured(page) > 0.08
    context.close()
