"""Control points in the viewer; the simulator's list of marks is the oracle."""

import json

import httpx
import numpy as np
import pytest

from skyquilt.photos.gcp import read_gcp_list
from skyquilt.server.access import Guard
from skyquilt.server.control_list import checked, list_text, read_list
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey

CRS = "EPSG:32633"


@pytest.fixture(scope="module")
def points(flight):
    names = [p.name for p in sorted((flight / "photos").iterdir())]
    return read_gcp_list(next(flight.rglob("gcp_list.txt")), names)[0]


def best(points):
    return max(points, key=lambda p: len(p.observations))


def number(web, name):
    return next(p["id"] for p in web.get("/photos").json()["photos"] if p["name"] == name)


def test_photos_that_show_a_point_are_predicted(web, points):
    for point in points:
        asked = {"x": point.x, "y": point.y, "crs": CRS}
        rows = {p["name"]: p for p in web.get("/control/photos", params=asked).json()["photos"]}
        true = {o.photo: (o.x, o.y) for o in point.observations}
        assert set(true) <= set(rows)
        off = [np.hypot(rows[n]["x"] - x, rows[n]["y"] - y) for n, (x, y) in true.items()]
        assert np.median(off) < 3 and max(off) < 12, point.name


def test_the_place_is_marked_in_the_photo(web, points):
    from pyproj import Transformer

    to = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    point = best(points)
    lon, lat = to.transform(point.x, point.y)
    for o in point.observations:
        at = web.get(f"/photos/{number(web, o.photo)}/place", params={"lon": lon, "lat": lat})
        assert np.hypot(at.json()["x"] - o.x, at.json()["y"] - o.y) < 12


def test_one_mark_proposes_the_others(web, points):
    tried = found = 0
    for point in points:
        first, *others = point.observations
        asked = {"x": point.x, "y": point.y, "crs": CRS, "propose": True}
        asked |= {"marked": number(web, first.photo), "px": first.x, "py": first.y}
        rows = {p["name"]: p for p in web.get("/control/photos", params=asked).json()["photos"]}
        for o in others:
            if "proposed" in rows.get(o.photo, {}):
                x, y = rows[o.photo]["proposed"]
                assert np.hypot(x - o.x, y - o.y) < 1.2, (point.name, o.photo)
                found += 1
            tried += 1
    assert tried > 8 and found > 0.5 * tried


def test_marks_are_stored_and_written_as_the_list_that_mosaic_reads(finished, flight, points):
    names = [p.name for p in sorted((flight / "photos").iterdir())]
    control = {
        "crs": CRS,
        "points": [
            {"name": p.name, "x": p.x, "y": p.y, "z": p.z, "check": p.check} for p in points
        ],
        "marks": [
            {"point": p.name, "photo": o.photo, "x": o.x, "y": o.y}
            for p in points for o in p.observations
        ],
    }  # fmt: skip
    survey = open_survey(finished.output)
    serving = ServerThread(survey=survey, guard=Guard(token="secret-word"), folder=finished.output)
    with serving, httpx.Client(base_url=serving.url, timeout=30, verify=False) as web:
        mine = {"X-Token": "secret-word"}
        assert web.put("/control", json=control).status_code == 401
        assert web.post("/control/run").status_code == 401
        foreign = {**mine, "Origin": "http://elsewhere.example"}
        assert web.put("/control", json=control, headers=foreign).status_code == 403
        assert web.post("/control/run", headers=mine).status_code == 422  # nothing is marked
        said = web.put("/control", json=control, headers=mine)
        assert said.status_code == 200 and said.json()["marks"] == len(control["marks"])
        assert web.get("/control").json()["points"] == control["points"]
        for bad in ({}, {**control, "crs": "EPSG:0"}, {**control, "marks": [{"point": "x"}]}):
            assert web.put("/control", json=bad, headers=mine).status_code == 422
        assert web.put("/control", content=b"[" * 100_000, headers=mine).status_code == 422
        text = (flight / "gcp_list.txt").read_bytes()
        read = web.post("/control/read", params={"crs": CRS}, content=text).json()
        assert len(read["marks"]) == len(control["marks"])
        rows = "name,easting,northing,height\nA,446362.6,5160985.5,438.5\ncheck1,446400,5160900,\n"
        read = web.post("/control/read", params={"crs": CRS}, content=rows.encode()).json()
        assert [(p["name"], p["z"], p["check"]) for p in read["points"]] == [
            ("A", 438.5, False), ("check1", None, True),
        ]  # fmt: skip
    written, notes = read_gcp_list(finished.output / "control" / "gcp_list.txt", names)
    assert not notes and [p.name for p in written] == [p.name for p in points]
    for ours, theirs in zip(written, points, strict=True):
        assert (ours.x, ours.y, ours.z, ours.check) == (
            theirs.x, theirs.y, theirs.z, theirs.check or theirs.name.lower().startswith("check"),
        )  # fmt: skip
        assert len(ours.observations) == len(theirs.observations)
    for path in (finished.output / "control").iterdir():
        path.unlink()
    (finished.output / "control").rmdir()


def test_a_list_survives_its_own_format(tmp_path):
    control = {
        "crs": CRS,
        "points": [{"name": "A", "x": 1.5, "y": 2.25, "z": None, "check": True}],
        "marks": [{"point": "A", "photo": "with blank.jpg", "x": 3.25, "y": 4.0}],
    }
    kept = checked(json.loads(json.dumps(control)), {"with blank.jpg"})
    (tmp_path / "gcp_list.txt").write_text(list_text(kept))
    assert read_list(tmp_path / "gcp_list.txt", ["with blank.jpg"], CRS) == kept
