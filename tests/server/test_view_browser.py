"""A real browser on a finished run: layers, read-outs, measures, control points."""

import io
import json
import os
import socket
import socketserver
import threading
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import mosaic
from tests.accessible import problems, tab_order

pytestmark = pytest.mark.slow
SHOTS = os.environ.get("SKYQUILT_SCREENSHOTS")
"""A folder to keep screenshots in, for a person to look at."""
LOOKS = {"light": (1280, 900), "dark": (1280, 900), "phone": (390, 844)}


@pytest.fixture(scope="module")
def run(flight, tmp_path_factory):
    """The flight's map without its control points: a user is about to add them."""
    output = tmp_path_factory.mktemp("plain") / "out"
    mosaic(flight / "photos", output, MosaicSettings(gsd_cm=15, jobs=2))
    return output


@pytest.fixture(scope="module")
def site(run):
    survey = open_survey(run)
    with ServerThread(survey=survey, guard=Guard(), folder=run) as serving:
        yield serving.url


def opened(browser, site, look="light"):
    width, height = LOOKS[look]
    scheme = "dark" if look == "dark" else "light"
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, accept_downloads=True
    )
    page = context.new_page()
    page.errors, page.asked = [], []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    page.goto(site)
    page.wait_for_selector("#link.live")
    page.wait_for_selector("#covering", state="attached")
    holds(page, "skyquilt.state.fitted && skyquilt.state.photos.size == 9")
    page.wait_for_timeout(800)
    return page


def holds(page, expression, seconds=120):
    for _ in range(seconds * 10):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"never: {expression}")


def slid(page, slider, value):
    page.evaluate(
        "([s, v]) => { const o = document.querySelector(s); o.value = v; o.oninput(); }",
        [slider, value],
    )


def shot(page, name):
    if SHOTS:
        page.screenshot(path=str(Path(SHOTS) / f"view-{name}.png"))


def middle(page):
    box = page.locator("#map").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def seen(page):
    with Image.open(io.BytesIO(page.locator("#map").screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.parametrize("look", LOOKS)
def test_layers_values_and_photos_in_every_look(browser, site, look):
    page = opened(browser, site, look)
    shown = page.locator("button:visible, select:visible").all_inner_texts()
    assert not {"Newest on top", "Finish flight"} & set(shown)
    assert not page.locator("#token").is_visible()
    assert page.locator("#layer option").all_inner_texts() == [
        "Map", "Heights", "Hillshade", "Photos per place", "Photo shown",
    ]  # fmt: skip
    if look != "phone":
        page.mouse.move(middle(page)[0] + 3, middle(page)[1])
        holds(
            page,
            "/EPSG:32633 .* height [-\\d.]+ m/.test(document.querySelector('#where').textContent)",
        )
    page.mouse.click(*middle(page))
    page.wait_for_selector("#covering li.chosen img.thumb")
    holds(page, "document.querySelector('img.thumb').naturalWidth == 480")
    holds(page, "/Heights/.test(document.querySelector('#values').textContent)")
    shot(page, look)
    plain = seen(page)
    page.select_option("#other", "heights")
    assert page.locator("#legend2").is_visible() and " m" in page.inner_text("#legend2")
    page.wait_for_timeout(1200)
    over = seen(page)
    assert np.abs(over - plain).mean() > 8
    page.evaluate(
        "() => { const o = document.querySelector('#opacity'); o.value = 0; o.oninput(); }"
    )
    page.wait_for_timeout(300)
    assert np.abs(seen(page) - plain).mean() < 1.5
    page.evaluate(
        "() => { const o = document.querySelector('#opacity'); o.value = 100; o.oninput(); }"
    )
    page.click("#swipe")
    page.wait_for_selector("#handle:visible")
    page.focus("#handle")
    page.keyboard.press("ArrowLeft")
    assert page.get_attribute("#handle", "aria-valuenow") == "45"
    shot(page, f"swipe-{look}")
    paper = page.evaluate("getComputedStyle(document.querySelector('#panel')).backgroundColor")
    assert (paper == "rgb(255, 255, 255)") == (look != "dark")
    wide = page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert wide  # nothing has to be scrolled sideways
    own = ("blob:", "data:", site)
    assert [u for u in page.asked if not u.startswith(own)] == [] and page.errors == []


def test_tracks_follow_the_time_and_the_slider_works(browser, site):
    page = opened(browser, site)
    tracks = page.evaluate("skyquilt.state.tracks")
    assert len(tracks) == 1 and tracks[0] == sorted(tracks[0])
    assert page.locator("#slider").is_visible()
    page.evaluate(
        "() => { const t = document.querySelector('#time'); t.value = 400; t.oninput(); }"
    )
    assert 1 < len(page.evaluate("skyquilt.state.tracks")[0]) < 9
    assert page.inner_text("#until") not in ("now", "the end")
    assert page.errors == []


def test_measures_by_mouse_and_keyboard_are_kept_and_saved(browser, site):
    page = opened(browser, site)
    x, y = middle(page)
    page.click("#profile")
    page.mouse.click(x - 90, y)
    page.mouse.click(x + 90, y)
    page.wait_for_selector("#graph svg path")
    page.fill("#name", "ditch <b>")
    page.click("#save")
    page.click("#volume")
    page.focus("#map")
    for key in ("Enter", "ArrowRight", "Enter", "ArrowDown", "Enter", "ArrowLeft", "Enter"):
        page.keyboard.press(key)
        page.wait_for_timeout(400)
    assert page.evaluate("skyquilt.state.points.length") == 4
    page.keyboard.press("Backspace")
    assert page.evaluate("skyquilt.state.points.length") == 3
    holds(page, "/m³ above/.test(document.querySelector('#measured').textContent)")
    page.click("#save")
    assert page.locator("#measures li").count() == 2
    assert "ditch <b>" in page.inner_text("#measures") and page.locator("#measures b").count() == 0
    shot(page, "measures")
    with page.expect_download() as saving:
        page.click("#geojson")
    found = json.loads(Path(saving.value.path()).read_text())["features"]
    assert [f["geometry"]["type"] for f in found] == ["LineString", "Polygon"]
    assert found[0]["properties"]["length_m"] > 1 and "above_m3" in found[1]["properties"]
    page.reload()
    holds(page, "document.querySelectorAll('#measures li').length == 2")
    page.set_input_files("#files", files=[{
        "name": "mine.geojson", "mimeType": "application/geo+json",
        "buffer": json.dumps({"type": "FeatureCollection", "features": found}).encode(),
    }])  # fmt: skip
    page.wait_for_selector("#overlays li")
    assert page.errors == []


def test_the_photo_is_shown_in_full_with_the_place_marked(browser, site):
    page = opened(browser, site)
    page.mouse.click(*middle(page))
    page.wait_for_selector("#covering li.chosen a")
    page.locator("#covering li.chosen a").click()
    page.wait_for_selector("#big .spot")
    box = page.locator("#big .spot").bounding_box()
    assert 0 < box["x"] < 1280 and 0 < box["y"] < 900
    shot(page, "full")
    page.keyboard.press("Escape")
    assert not page.locator("#big").is_visible()
    listed = page.locator("#downloads a").all_inner_texts()
    assert listed == ["Map", "Heights", "Report"]
    with page.expect_download() as saving:
        page.locator("#downloads a").first.click()
    assert Path(saving.value.path()).read_bytes()[:2] == b"II"
    assert page.errors == []


@pytest.mark.parametrize("look", ["light", "dark"])
def test_screen_readers_and_keyboards_reach_everything(browser, site, run, look):
    """By Chromium's accessibility tree, the way of the Tab key, and the contrast of all text."""
    page = opened(browser, site, look)
    page.mouse.click(*middle(page))
    page.wait_for_selector("#covering li.chosen img.thumb")
    page.click("#distance")
    page.get_by_role("button", name="Control points").click()
    page.get_by_role("button", name="Add a point").click()
    assert page.evaluate("document.activeElement.tagName") == "INPUT"
    page.wait_for_timeout(500)
    assert problems(page) == []
    page.reload()
    page.wait_for_selector("#link.live")
    page.wait_for_timeout(1500)
    order = tab_order(page)
    assert all(at["seen"] and at["outline"] for at in order)
    assert [at["at"] for at in order] == sorted(at["at"] for at in order)
    reached = [at["what"] for at in order]
    for name in ("layer", "distance", "export", "drop", "fold"):
        assert name in reached, reached
    page.goto((run / "report.html").as_uri())
    assert problems(page) == []
    order = tab_order(page)
    assert len(order) > 20 and all(at["seen"] and at["outline"] for at in order)


def test_a_control_point_is_taken_from_the_map_by_a_click(browser, site):
    page = opened(browser, site)
    page.get_by_role("button", name="Control points").click()
    page.get_by_role("button", name="Add a point").click()
    page.click("#controlpick")
    x, y = middle(page)
    page.mouse.click(x + 60, y - 40)
    holds(page, "document.querySelectorAll('#control form input')[1].value != ''")
    at = page.evaluate(
        "([x, y]) => { const p = skyquilt.map.containerPointToLatLng([x, y]);"
        " return [p.lng, p.lat]; }",
        [x + 60 - page.locator("#map").bounding_box()["x"],
         y - 40 - page.locator("#map").bounding_box()["y"]],
    )  # fmt: skip
    values = [float(page.locator("#control form input").nth(k).input_value()) for k in (1, 2)]
    to = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    assert np.abs(np.array(values) - to.transform(*at)).max() < 0.01
    assert page.locator("#covering li").count() == 0  # the click chose a place, no photos
    shot(page, "pick")
    page.locator("#control form button[type=submit]").click()
    holds(page, "control.points.length == 1 && control.rows.length > 2")
    assert page.locator("#controlpick").count() == 0
    page.mouse.click(x, y)
    page.wait_for_selector("#covering li.chosen")  # clicks choose photos again
    assert page.errors == []


def test_control_points_from_the_list_to_the_residuals(browser, site, flight, run):
    """Coordinates of four control and two check points are loaded; each is marked in one photo, the
    others are proposed; the map made with them lies within centimetres.
    """
    rows, first = ["name,x,y,z,check"], {}
    for line in (flight / "gcp_list.txt").read_text().splitlines()[1:]:
        x, y, z, px, py, photo, name, *check = line.split()
        if name not in first:
            first[name] = (photo, float(px), float(py))
            rows.append(f"{name},{x},{y},{z},{'check' if check else ''}")
    page = opened(browser, site)
    page.get_by_role("button", name="Control points").click()
    page.set_input_files("#controlfile", files=[
        {"name": "points.csv", "mimeType": "text/csv", "buffer": "\n".join(rows).encode()}
    ])  # fmt: skip
    holds(page, f"document.querySelectorAll('#control li').length == {len(first)}")
    for name, (photo, px, py) in first.items():
        page.evaluate("control.rows = []; drawLoupes()")  # those of the point before
        page.locator("#control li", has_text=name).locator("span").first.click()
        loupe = page.locator(f".loupe[data-photo='{photo}']")
        loupe.wait_for()
        # the map is metres off, so the detail is large at first
        page.select_option("#loupes select", "300")
        loupe.scroll_into_view_if_needed()
        holds(
            page, f"document.querySelector(\".loupe[data-photo='{photo}'] img\").naturalWidth > 0"
        )
        at = page.evaluate(f"control.rows.find((r) => r.name == '{photo}')")
        box = loupe.bounding_box()
        k = box["width"] / 300
        loupe.click(position={
            "x": box["width"] / 2 + (px - at["x"]) * k, "y": box["height"] / 2 + (py - at["y"]) * k,
        })  # fmt: skip
        holds(page, f"marksOf('{name}').length == 1")
        marked = page.evaluate(f"marksOf('{name}')[0]")
        assert np.hypot(marked["x"] - px, marked["y"] - py) < 1.0
        page.hover("#propose")
        page.mouse.down()
        page.evaluate("drawLoupes()")  # as when an answer arrives meanwhile
        page.mouse.up()
        holds(page, "/proposed|no other photo/.test(document.querySelector('#said').textContent)")
        page.evaluate("document.querySelector('#said').textContent = ''")
    marks = page.evaluate("control.marks.length")
    assert marks > 2 * len(first)
    page.click("#controlundo")
    assert page.evaluate("control.marks.length") < marks
    shot(page, "control")
    page.click("#controlsave")
    holds(page, "!control.dirty")
    text = (run / "control" / "gcp_list.txt").read_text()
    assert text.startswith("EPSG:32633\n") and len(text.splitlines()) > len(first)
    page.click("#controlrun")
    page.wait_for_selector("#residuals", timeout=180_000)
    told = json.loads((run.with_name("out-control") / "metrics.json").read_text())
    assert page.locator("#residuals tbody tr").count() == len(told["control"]) >= 6
    kept = [p for p in told["control"] if p["check"]]
    assert kept and max(abs(p[k]) for p in kept for k in ("dx_m", "dy_m")) < 0.25
    page.locator("#residuals").scroll_into_view_if_needed()
    shot(page, "residuals")
    assert page.errors == []


class Prefixed(socketserver.StreamRequestHandler):
    """A reverse proxy that shows a server below /map/, and knows nothing else."""

    def handle(self):
        head = [self.rfile.readline()]
        while head[-1] not in (b"\r\n", b""):
            head.append(self.rfile.readline())
        method, path, version = head[0].split(b" ")
        if not path.startswith(b"/map/"):
            self.wfile.write(b"HTTP/1.1 404 Not Found\r\nConnection: close\r\n\r\n")
            return
        kept = [line for line in head[1:-1] if not line.lower().startswith(b"connection:")]
        asked = b" ".join([method, path.removeprefix(b"/map"), version])
        with socket.create_connection(self.server.behind) as behind:
            behind.sendall(b"".join([asked, *kept, b"Connection: close\r\n\r\n"]))
            while data := behind.recv(1 << 16):
                self.wfile.write(data)


def test_the_page_works_below_a_path_of_a_reverse_proxy(browser, site):
    """Nothing is asked for beside that path."""
    proxy = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Prefixed)
    proxy.daemon_threads, proxy.block_on_close = True, False
    proxy.behind = (urlsplit(site).hostname, urlsplit(site).port)
    threading.Thread(target=proxy.serve_forever, daemon=True).start()
    here = f"http://127.0.0.1:{proxy.server_address[1]}"
    page = opened(browser, f"{here}/map/")
    page.mouse.click(*middle(page))
    page.wait_for_selector("#covering img")
    assert page.errors == []
    assert any("/map/tiles/" in url for url in page.asked)
    assert [u for u in page.asked if not u.startswith((f"{here}/map/", "data:", "blob:"))] == []
    assert np.ptp(seen(page), axis=(0, 1)).max() > 100  # the map is drawn
    page.context.close()
    proxy.shutdown()
    proxy.server_close()
