"""Photos sent from the page of a growing map over networks that fail. A real browser."""

import shutil

import pytest

from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from tests.live.conftest import served
from tests.live.test_browser import holds

pytestmark = pytest.mark.slow
QUICK = LiveSettings(features=300)
WORDS = "document.querySelector('#sendwords').textContent"


@pytest.fixture
def page(browser):
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.errors = []
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    yield page
    context.close()


@pytest.fixture(scope="module")
def large(flight, tmp_path_factory):
    """A photo of more than two parts: bytes behind its end do not matter."""
    path = tmp_path_factory.mktemp("large") / "LARGE.jpg"
    path.write_bytes(flight.photos[1].read_bytes() + bytes(600_000))
    return path


def opened(page, site):
    page.goto(site.url)
    page.wait_for_selector("#link.live")
    # waits of seconds are for the field
    page.evaluate("WAITS_MS.splice(0, WAITS_MS.length, 50)")


def requests(page):
    """Method and last part of the address of each request that sends something."""
    found = []
    page.on(
        "request",
        lambda r: (
            r.method in ("POST", "PATCH", "HEAD")
            and found.append((r.method, r.url.rpartition("/")[2]))
        ),
    )
    return found


def parts_go(page, through):
    """What becomes of each part of a file; other requests go as they are."""
    page.route(
        "**/photos/uploads/*",
        lambda r: through(r) if r.request.method == "PATCH" else r.continue_(),
    )


def test_photos_are_sent_and_refusals_told(page, flight, tmp_path):
    note = tmp_path / "notes.jpg"
    note.write_text("no photo")
    with served(tmp_path / "out", QUICK) as site:
        opened(page, site)
        page.set_input_files("#files", [*flight.photos[:2], note])
        holds(page, f"{WORDS} === '2 of 3 sent'")
        assert "notes.jpg" in page.inner_text("#unsent") and page.is_visible("#resend")
        assert page.is_hidden("#sent") and page.is_hidden("#stopsend")
        holds(page, "skyquilt.state.photos.size === 2")
        holds(page, "/last came \\d/.test(document.querySelector('#counts').textContent)")
        # the clock was set back after the first: the last is still the one of the highest number
        page.evaluate(
            "[...skyquilt.state.photos.values()].reduce((a, p) => p.id < a.id ? p : a)"
            ".received += 9e3;"
            "document.dispatchEvent(new Event('photoslisted'))"
        )
        came = page.evaluate(
            "new Date([...skyquilt.state.photos.values()].reduce((a, p) => p.id > a.id ? p : a)"
            ".received * 1000).toLocaleTimeString()"
        )
        assert f"last came {came}" in page.inner_text("#counts")
        page.click("#resend")
        holds(page, f"{WORDS} === '2 of 3 sent'")
        assert page.inner_text("#unsent").count("notes.jpg") == 1
    assert page.errors == []


def test_a_lost_connection_is_waited_for_and_nothing_is_sent_twice(page, large, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        opened(page, site)
        sent, failing = requests(page), [0]

        def weak(route):
            """Of the parts of a file, the second fails three times."""
            first = route.request.headers.get("upload-offset") == "0"
            if not first and failing[0] < 3:
                failing[0] += 1
                route.abort("connectionreset")
            else:
                route.continue_()

        parts_go(page, weak)
        page.set_input_files("#files", [large])
        holds(page, f"{WORDS} === '1 of 1 sent'")
        holds(page, "skyquilt.state.photos.size === 1")
        assert failing == [3]
        methods = [method for method, _ in sent]
        assert methods.count("POST") == 1 and methods.count("HEAD") == 3
        parts = -(-large.stat().st_size // (256 * 1024))
        assert methods.count("PATCH") == parts + 3  # the three that failed
        assert len({name for method, name in sent if method != "POST"}) == 1
    assert page.errors == []


def test_an_upload_that_expired_begins_again(page, large, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        opened(page, site)
        sent, failed = requests(page), []

        def forgotten(route):
            """The server loses the upload after its first part."""
            if route.request.headers.get("upload-offset") != "0" and not failed:
                failed.append(route.request.url)
                page.request.delete(route.request.url, headers={"Tus-Resumable": "1.0.0"})
                route.abort("connectionreset")
            else:
                route.continue_()

        parts_go(page, forgotten)
        page.set_input_files("#files", [large])
        holds(page, f"{WORDS} === '1 of 1 sent'")
        assert [method for method, _ in sent].count("POST") == 2
        holds(page, "skyquilt.state.photos.size === 1")
    assert page.errors == []


def test_sending_is_stopped(page, flight, large, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        opened(page, site)
        parts_go(page, lambda r: r.abort())
        page.set_input_files("#files", [large, flight.photos[0]])
        holds(
            page,
            "document.querySelector('#sendwaits').textContent.startsWith('Waiting: the server')",
        )
        assert page.evaluate(WORDS) == "Sending 1 of 2: LARGE.jpg"
        page.click("#stopsend")
        holds(page, "document.querySelector('#sending').hidden")
        page.unroute("**/photos/uploads/*")
        page.set_input_files("#files", [flight.photos[2]])
        holds(page, f"{WORDS} === '1 of 1 sent'")
        holds(page, "skyquilt.state.photos.size === 1")
    assert page.errors == []


def test_names_and_folders(page, flight, tmp_path):
    """A dropped folder is searched; names keep their letters."""
    name = "Überflug 森.jpg"
    shutil.copyfile(flight.photos[0], tmp_path / name)
    with served(tmp_path / "out", QUICK) as site:
        opened(page, site)
        page.set_input_files("#files", [tmp_path / name])
        holds(page, "skyquilt.state.photos.size === 1")
        assert page.evaluate("[...skyquilt.state.photos.values()][0].name") == name
        found = page.evaluate(
            """async () => {
                const leaf = (name) => ({
                    isFile: true, name, file: (good) => good(new File(["x"], name)),
                });
                const folder = (name, inside) => ({ isDirectory: true, name, createReader: () => {
                    const left = [inside.slice(0, 2), inside.slice(2), []];
                    return { readEntries: (good) => good(left.shift()) };
                } });
                const inner = folder("100", [leaf("a.jpg")]);
                const tree = folder("DCIM", [leaf("b.jpg"), inner, leaf(".hidden")]);
                const items = [{ webkitGetAsEntry: () => tree }];
                return (await filesIn({ items, files: [] })).map((f) => f.name);
            }"""
        )
        assert found == ["a.jpg", "b.jpg"]
    assert page.errors == []


def test_a_wrong_token_is_told(page, flight, tmp_path):
    with served(tmp_path / "out", QUICK, Guard(token="quiet-lake")) as site:
        opened(page, site)
        page.set_input_files("#files", [flight.photos[0]])
        holds(page, f"{WORDS} === '0 of 1 sent'")
        assert "token" in page.inner_text("#unsent").lower()
        page.fill("#token", "quiet-lake")
        page.click("#resend")
        holds(page, f"{WORDS} === '1 of 1 sent'")
    assert page.errors == []
