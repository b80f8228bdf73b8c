"""Folders of live maps that nobody of ours has written: `live` goes on in them, or `view` opens
them, or a sentence refuses them. The database is changed by SQL, its pages by bytes.
"""

import os
import shutil
import sqlite3
import time
import zlib
from pathlib import Path

import httpx
import pytest

from skyquilt.errors import OutputError, SkyquiltError
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import LiveSurvey, open_survey
from tests.attacks import deflated_zeros
from tests.live.test_limits import made_run

pytestmark = pytest.mark.slow
SETTINGS = LiveSettings(features=300)
DEEP = "[" * 200_000
PATHS = (
    "info",
    "photos",
    "tiles.json",
    "layers",
    "photos/1",
    "photos/1/file",
    "photos/1/place?lon=14.3&lat=46.6",
    "at?lon=14.3&lat=46.6",
    "wms?SERVICE=WMS&REQUEST=GetCapabilities",
    "areas",
    "coverage",
    "plan",
    "files",
)


@pytest.fixture(scope="module")
def survey(flight, tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey") / "out"
    live = LiveMap(folder, SETTINGS)
    for path in flight.photos:
        live.add(path)
    for _ in live.drain_all():
        pass
    assert len(list(live.members.on_map())) == 6
    live.close()
    return folder


def sql(*statements, file="live.db"):
    def spoil(folder: Path) -> None:
        db = sqlite3.connect(folder / file)
        for statement in statements:
            db.executescript(statement)
        db.commit()
        db.close()

    return spoil


def meta(key, value):
    return sql(f"insert or replace into meta values ('{key}', '{value}')")


def tiles(body):
    def spoil(folder: Path) -> None:
        db = sqlite3.connect(folder / "tiles.db")
        db.execute("update tile set body = ?", (body,))
        db.commit()
        db.close()

    return spoil


def page(number, data, file="live.db"):
    """Writes bytes into a page of the database."""

    def spoil(folder: Path) -> None:
        sql("pragma journal_mode=delete", file=file)(folder)
        with (folder / file).open("r+b") as opened:
            opened.seek(4096 * (number - 1))
            opened.write(data)

    return spoil


def replaced(make, name="live.db"):
    def spoil(folder: Path) -> None:
        for path in folder.glob(f"{name}*"):
            path.unlink()
        make(folder / name)

    return spoil


BOMB = b"F\x40\0\0\0".ljust(5) + zlib.compress(bytes(8192)).ljust(64, b"\0")
ENDLESS = (
    "with recursive c(x) as (select 1 union all select x + 1 from c) select x, '1', 's', 'f', 1, 1,"
    " 's', 1, 'placed', '', '', '', '', '' from c"
)
REFUSED = {
    "an endless view in place of the photos": sql(
        "alter table photo rename to was; drop table was",
        "create view photo(id, digest, name, source, file, bytes, received, shot, width, state,"
        f" reason, pose, camera, footprint, about) as {ENDLESS}",
    ),
    "a trigger": sql("create trigger t after insert on meta begin delete from photo; end"),
    "a column that is computed": sql("alter table photo add c as (hex(zeroblob(300000000)))"),
    "a condition": sql("drop table seen", "create table seen(path text primary key check(1))"),
    "another table": sql("create table other(a)"),
    "a strange index": sql("create index other on photo(hex(name))"),
    "many tables": sql("".join(f"create table t{i}(a);" for i in range(400))),
    "no database": replaced(lambda p: p.write_bytes(os.urandom(50_000))),
    "a pipe": replaced(os.mkfifo),
    "a folder": replaced(Path.mkdir),
    "page size of garbage": page(1, b"SQLite format 3\0\x00\x03"),
    "a page of another page's": page(3, b"\x05" + b"\xff" * 500),
    "the schema's page zeroed": page(1, bytes(4096)),
    "another format": meta("format", "77"),
    "a frame nested too deep": meta("frame", DEEP),
    "a frame of NaN": meta("frame", '{"crs": "EPSG:32633", "origin": [NaN, 1e999]}'),
    "a frame of a foreign system": meta("frame", '{"crs": "+init=/etc/passwd", "origin": [0, 0]}'),
    "a frame of a list": meta("frame", "[1, 2]"),
    "a cell of nothing": meta("cell", "1e-300"),
    "a size of a list": meta("gsd", "[[]]"),
    "settings of a number": meta("settings", "3"),
    "a schedule of text": meta("schedule", '"x"'),
    "heights of text": sql("insert into height values ('a', 'b', 'c')"),
    "links of text": sql("insert into link values ('a', 'b', x'00')"),
    "tiles: a view": sql(
        "drop table tile", "create view tile as select 'visible' as layer", file="tiles.db"
    ),
    "tiles: a trigger": sql(
        "create trigger t before insert on owed begin delete from tile; end", file="tiles.db"
    ),
    "tiles: no database": replaced(lambda p: p.write_bytes(b"x" * 5000), "tiles.db"),
}
TAKEN = {
    "poses nested too deep": (sql(f"update photo set pose = '{DEEP}' where id = 2"), 5),
    "poses of NaN": (sql("""update photo set pose = '{"R":[NaN],"C":[1e999]}' where id = 2"""), 5),
    "poses of other shapes": (sql("""update photo set pose = '{"R":3,"C":{}}' where id < 4"""), 3),
    "poses far off": (
        sql(
            """update photo set pose = '{"R":[1,0,0,0,-1,0,0,0,-1],"C":[1e9,-1e9,1e9]}'
            where id = 2"""
        ),
        None,
    ),
    "records of other types": (sql("update photo set about = '[3]' where id = 2"), 5),
    "files elsewhere": (sql("update photo set file = '../../../../etc/passwd' where id = 2"), 5),
    "names of bytes": (sql("update photo set name = x'ff00', source = 3 where id = 2"), 6),
    "strange states": (sql("update photo set state = 'x' where id = 2"), None),
    "footprints nested too deep": (sql(f"update photo set footprint = '{DEEP}'"), 6),
    "footprints of text": (
        sql("""update photo set footprint = '{"ring":"abc","at":[1],"pose":7}'"""),
        6,
    ),
    "cameras of NaN": (sql("""update camera set body = '{"width": NaN, "focal": 1e999}'"""), 6),
    "cameras nested too deep": (sql(f"update camera set body = '{DEEP}'"), 6),
    "links of garbage": (sql("update link set body = x'504b0304'"), 6),
    "a giant value": (sql("update photo set reason = hex(zeroblob(20000000)) where id = 2"), 6),
    "heights without end": (sql("update height set z = 9e999"), 6),
    "heights far apart": (
        sql("insert into height values (9000000000000000000, -9000000000000000000, 1e300)"),
        6,
    ),
    "events of garbage": (sql("update event set body = x'ff' || '\n\n: x'"), 6),
    "events nested too deep": (sql(f"update event set body = '{DEEP}'"), 6),
    "tiles that unpack to a gigabyte": (tiles(BOMB + deflated_zeros(300_000_000)), 6),
    "tiles of text": (sql("update tile set body = 'x', version = 'y'", file="tiles.db"), 6),
    "tiles at odd places": (
        sql(
            "insert into tile values ('visible', 3, 9223372036854775807, -9, 1, x'00')",
            "insert into owed values (x'00', 'a', 1e300, 5)",
            file="tiles.db",
        ),
        None,
    ),
}


def strange(survey, tmp_path, spoil):
    folder = tmp_path / "out"
    shutil.copytree(survey, folder)
    spoil(folder)
    return folder


def gone_on(folder):
    """Goes on in a folder; the number of photos on the map."""
    live = LiveMap(folder, SETTINGS)
    try:
        for _ in live.drain_all():
            pass
        return len(list(live.members.on_map()))
    finally:
        live.close()


def looked_at(folder):
    """Statuses of a viewer on a folder."""
    survey = LiveSurvey(folder)
    with ServerThread(survey=survey, guard=Guard(token="looking-only"), folder=folder) as serving:
        said = {p: httpx.get(serving.url + p, timeout=30, verify=False).status_code for p in PATHS}
        with httpx.stream(
            "GET", serving.url + "events?after=0", timeout=30, verify=False
        ) as stream:
            lines = stream.iter_lines()  # it has no end
            said["events"] = stream.status_code if next(lines).startswith(":") else 500
        return said


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(survey, tmp_path, name):
    folder, began = strange(survey, tmp_path, REFUSED[name]), time.process_time()
    with pytest.raises(OutputError) as told:
        gone_on(folder)
    assert len(str(told.value)) < 600 and "\n" not in str(told.value)
    if name not in ("heights of text", "links of text"):
        with pytest.raises(OutputError):
            looked_at(folder)
    assert time.process_time() - began < 5


@pytest.mark.parametrize("name", TAKEN)
def test_what_is_left_out(survey, tmp_path, name):
    spoil, count = TAKEN[name]
    folder, began = strange(survey, tmp_path, spoil), time.process_time()
    said = looked_at(folder)
    assert not [p for p, status in said.items() if status >= 500], said
    assert gone_on(folder) == (count or 6) or count is None
    assert not [p for p, status in looked_at(folder).items() if status >= 500]
    assert time.process_time() - began < 20


def test_the_folder_as_it_was_is_taken(survey, tmp_path):
    """So that the others are refused for what was changed."""
    folder = strange(survey, tmp_path, lambda _: None)
    assert looked_at(folder)["photos"] == 200
    assert gone_on(folder) == 6


FILES = {
    "torn": lambda p: p.write_text('{"features": [{"prop'),
    "nested too deep": lambda p: p.write_text(DEEP),
    "not a number": lambda p: p.write_text("NaN"),
    "a list": lambda p: p.write_text("[1, [2], {}]"),
    "other types": lambda p: p.write_text(
        '{"features": {"a": 1}, "photos_rejected": 3, "crs": []}'
    ),
    "numbers without end": lambda p: p.write_text(
        '{"features": [{"properties": {"filename": "a.jpg", "camera": 1, "translation":'
        ' [1e999, NaN, 3]}, "geometry": {"coordinates": [[[NaN, 1e999]]]}}]}'
    ),
    "larger than files are": lambda p: p.write_bytes(b" " * 65_000_000),
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a link in a circle": lambda p: p.symlink_to(p),
    "bytes": lambda p: p.write_bytes(bytes(range(256)) * 10),
}
RUN = ("shots.geojson", "footprints.geojson", "metrics.json", "run.toml", "control/control.json")
RUN += ("cameras.json", "reconstruction.json", "mosaic.tif", "views.tif", "report.html")
ASKED = ("info", "photos", "photos/1", "photos/1/file", "photos/1/thumbnail", "tiles.json", "files")
ASKED += ("at?lon=13.53&lat=52.32", "control", "control/photos?x=400010&y=5799990", "layers")
ASKED += ("files/report.html", "files/metrics.json", "wms?SERVICE=WMS&REQUEST=GetCapabilities")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return made_run(folder, folder / "photos")


@pytest.mark.parametrize("file", RUN)
def test_files_of_a_finished_run(finished, tmp_path, file):
    """Each is refused with a sentence, or shown without it, and nothing is waited for."""
    for what, make in FILES.items():
        folder, began = tmp_path / what / "out", time.process_time()
        shutil.copytree(finished, folder)
        path = folder / file
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        make(path)
        try:
            survey = open_survey(folder)
        except SkyquiltError as error:
            assert len(str(error)) < 600 and "\n" not in str(error), what
            assert file in ("shots.geojson", "footprints.geojson", "mosaic.tif"), what
            continue
        guard = Guard(token="looking-only")
        with ServerThread(survey=survey, guard=guard, folder=folder) as serving:
            said = {
                p: httpx.get(serving.url + p, timeout=20, verify=False).status_code for p in ASKED
            }
        assert not [p for p, status in said.items() if status >= 500], (what, said)
        assert time.process_time() - began < 5
        shutil.rmtree(folder)
