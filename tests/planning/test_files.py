"""Files for ground stations, read again by other readers; plans and missions from outside."""

import csv
import json
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from shapely import box

from skyquilt.errors import OutputError, SideFileError
from skyquilt.planning.check import check_mission, check_plan
from skyquilt.planning.exports import WRITERS, parts, write_missions
from skyquilt.planning.kml import write_kml
from skyquilt.planning.missions import read_mission
from skyquilt.planning.plan_file import read_plan, write_plan
from skyquilt.planning.records import Drone, KeepOut, PicturePoint, Plan, Sortie, Waypoint
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import geographic, make_site
from skyquilt.planning.stops import flights_of
from skyquilt.planning.terrain import FLAT
from skyquilt.planning.view import find_view
from skyquilt.planning.workflow import Order, iter_plan

ZONE = "EPSG:32633"
VIEW = find_view("FC6310")
X, Y = 370_000.0, 5_773_000.0
SAMPLES = Path(__file__).parents[3] / "shared" / "data" / "missions"
WPML = "{http://www.dji.com/wpmz/1.0.2}"
KML = "{http://www.opengis.net/kml/2.2}"


def plan():
    """Two lines of three points on ground of 120 m, one drone, a detour in the middle."""
    site = make_site(
        box(X, Y, X + 60, Y + 30),
        (KeepOut(shape=box(X + 70, Y - 40, X + 80, Y - 20), name="<barn>"),),
        ZONE,
    )
    points = tuple(
        PicturePoint(id=k + 1, x=X + 30 * (k % 3), y=Y + 25 * (k // 3), z=180.0 + k, ground=120.0,
                     yaw=90.0)
        for k in range(6)
    )  # fmt: skip
    start = (X - 40.0, Y - 10.0)
    drone = Drone(name="Falcon 1", start=start, landing=start, view=VIEW, speed_ms=7.0)
    way = [Waypoint(x=start[0], y=start[1], z=118.0, time_s=0.0),
           Waypoint(x=start[0], y=start[1], z=180.0, time_s=20.0)]  # fmt: skip
    for k, p in enumerate(points):
        if k == 3:
            way.append(Waypoint(x=X + 90, y=Y + 12, z=183.0, time_s=45.0))
        way.append(Waypoint(x=p.x, y=p.y, z=p.z, time_s=30.0 + 10 * k, point=p.id))
    way += [Waypoint(x=start[0], y=start[1], z=185.0, time_s=100.0),
            Waypoint(x=start[0], y=start[1], z=118.0, time_s=120.0)]  # fmt: skip
    return Plan(
        site=site, drones=(drone,), points=points,
        sorties=(Sortie(drone=0, number=1, way=tuple(way)),),
        options={"height_m": 60.0, "clearance_m": 5.0}, terrain=True, bound_s=90.0,
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    write_missions(tmp_path, plan())
    return tmp_path


def taken(places):
    """(longitude, latitude, height above take-off) of the photos as planned."""
    p = plan()
    lonlat = geographic(ZONE, np.array([(q.x, q.y) for q in p.points]))
    return np.column_stack([lonlat, [q.z - 118.0 for q in p.points]])


def test_plan_json_is_read_as_written(tmp_path):
    write_plan(tmp_path / "plan.json", plan())
    again = read_plan(tmp_path / "plan.json")
    assert again.options == plan().options and again.drones[0].view == VIEW
    assert [p.id for p in again.points] == [1, 2, 3, 4, 5, 6]
    for a, b in zip(again.points, plan().points, strict=True):
        assert (a.x, a.y, a.z, a.ground, a.yaw) == pytest.approx(
            (b.x, b.y, b.z, b.ground, b.yaw), abs=2e-3
        )
    assert again.sorties[0].photos == 6
    assert again.sorties[0].metres == pytest.approx(plan().sorties[0].metres, abs=0.01)
    assert again.site.keep_out[0].name == "<barn>"


def test_headings_in_files_count_from_true_north(tmp_path):
    """The zone's north is about -1.5 degrees off where the plan lies, by another formula:
    convergence = dlongitude sin(latitude).
    """
    write_plan(tmp_path / "plan.json", plan())
    point = json.loads((tmp_path / "plan.json").read_text())["points"][0]
    turn = (point["longitude"] - 15) * np.sin(np.radians(point["latitude"]))
    assert point["yaw_deg"] == pytest.approx(90 + turn, abs=0.01) and abs(turn) > 1


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r.update(skyquilt_plan=2),
        lambda r: r.update(crs="EPSG:4326"),
        lambda r: r["points"][0].update(z=float("1e9")),
        lambda r: r["points"][0].update(longitude="13"),
        lambda r: r["points"].append(dict(r["points"][0])),
        lambda r: r["sorties"][0].update(drone=7),
        lambda r: r["sorties"][0].update(way=[[13, 52, 1, 0, None]]),
        lambda r: r["drones"][0]["view"].update(up=-1),
        lambda r: r.update(area={"type": "Point", "coordinates": [1, 2]}),
        lambda r: r.pop("proof"),
        lambda r: r.update(points={"a": 1}),
    ],
)
def test_a_plan_that_is_none_is_one_sentence(tmp_path, change):
    write_plan(tmp_path / "plan.json", plan())
    record = json.loads((tmp_path / "plan.json").read_text())
    change(record)
    (tmp_path / "plan.json").write_text(json.dumps(record))
    with pytest.raises(SideFileError, match=r"^plan\.json"):
        read_plan(tmp_path / "plan.json")


def test_waypoints_by_pymavlink(folder):
    from pymavlink import mavwp

    loader = mavwp.MAVWPLoader()
    assert loader.load(str(folder / "01-falcon-1.waypoints")) > 12
    items = [loader.wp(k) for k in range(loader.count())]
    assert [i.command for i in items[:4]] == [16, 22, 178, 205]
    assert items[0].z == pytest.approx(118.0) and items[-1].command == 20
    shots = [a for a, b in pairwise(items) if a.command == 16 and b.command == 203]
    found = np.array([(i.y, i.x, i.z) for i in shots])
    assert np.abs(found - taken(shots)) == pytest.approx(0, abs=1e-4)
    assert np.abs((found - taken(shots))[:, :2]).max() < 1e-7
    assert all(i.frame == 3 for i in shots)


def test_the_qgroundcontrol_plan_has_what_its_document_asks_for(folder):
    """Fields of the plan file format of the developers' guide; items are MAVLink commands."""
    from pymavlink.dialects.v20 import common as mavlink

    record = json.loads((folder / "01-falcon-1.plan").read_text())
    assert record["fileType"] == "Plan" and record["version"] == 1
    assert {"mission", "geoFence", "rallyPoints", "groundStation"} <= set(record)
    mission = record["mission"]
    assert mission["version"] == 2 and len(mission["plannedHomePosition"]) == 3
    known = mavlink.enums["MAV_CMD"]
    for number, item in enumerate(mission["items"], 1):
        assert item["doJumpId"] == number and len(item["params"]) == 7
        assert item["command"] in known and item["type"] == "SimpleItem"
    shots = [
        a for a, b in pairwise(mission["items"]) if a["command"] == 16 and b["command"] == 2000
    ]
    found = np.array([(i["params"][5], i["params"][4], i["params"][6]) for i in shots])
    assert np.abs(found - taken(shots)).max() < 0.01
    fences = record["geoFence"]["polygons"]
    assert [f["inclusion"] for f in fences] == [True, False]
    if SAMPLES.exists():
        sample = json.loads((SAMPLES / "qgc_geofence.plan").read_text())
        assert set(sample) == set(record) and set(sample["mission"]) == set(mission)
        assert set(sample["geoFence"]["polygons"][0]) == set(fences[0])


def waylines(path):
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        return [ET.fromstring(archive.read(name)) for name in archive.namelist()]


def test_the_kmz_takes_a_photo_at_each_point(folder):
    template, way = waylines(folder / "01-falcon-1.kmz")
    assert template.find(f"{KML}Document/{WPML}missionConfig") is not None
    marks = list(way.iter(f"{KML}Placemark"))
    assert [int(m.findtext(f"{WPML}index")) for m in marks] == list(range(len(marks)))
    shots = [
        m for m in marks if "takePhoto" in [a.text for a in m.iter(f"{WPML}actionActuatorFunc")]
    ]
    found = np.array([
        [*map(float, m.findtext(f"{KML}Point/{KML}coordinates").split(",")),
         float(m.findtext(f"{WPML}executeHeight"))] for m in shots
    ])  # fmt: skip
    assert np.abs(found - taken(shots)).max() < 0.01
    assert way.findtext(f".//{WPML}executeHeightMode") == "relativeToStartPoint"


@pytest.mark.skipif(not SAMPLES.exists(), reason="no samples of missions beside the checkout")
def test_the_kmz_has_the_structure_of_the_sample(folder):
    """Every path of elements of the sample is in ours, with the same fixed words."""
    for ours, name in zip(
        waylines(folder / "01-falcon-1.kmz"), ("dji_template.kml", "dji_waylines.wpml"), strict=True
    ):
        theirs = ET.fromstring((SAMPLES / name).read_text())
        assert paths(theirs) <= paths(ours), paths(theirs) - paths(ours)


def paths(root, above=""):
    found = {above + "/" + root.tag}
    for child in root:
        found |= paths(child, above + "/" + root.tag)
    return found


def test_litchi_columns(folder):
    with (folder / "01-falcon-1.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows[0]) == 46
    shots = [r for r in rows if r["actiontype1"] == "1"]
    found = np.array([
        [float(r["longitude"]), float(r["latitude"]), float(r["altitude(m)"])] for r in shots
    ])  # fmt: skip
    assert np.abs(found - taken(shots)).max() < 0.01
    assert all(r["gimbalpitchangle"] == "-90" and r["altitudemode"] == "0" for r in rows)


def test_long_ways_are_divided_as_ground_stations_want(tmp_path):
    (flight,) = flights_of(plan())
    long = replace(flight, stops=flight.stops * 30)
    for kind, most in (("litchi", 99), ("dji", 200)):
        divided = parts(long, WRITERS[kind].most)
        assert max(len(p.stops) for p in divided) <= most
        assert sum((p.stops for p in divided), ()) == long.stops
        assert len({p.name for p in divided}) == len(divided)


def test_the_kml_is_xml_with_escaped_names(tmp_path):
    write_kml(tmp_path / "plan.kml", plan(), flights_of(plan()))
    root = ET.parse(tmp_path / "plan.kml").getroot()
    names = [m.findtext(f"{KML}name") for m in root.iter(f"{KML}Placemark")]
    assert "<barn>" in names and "6" in names


@pytest.mark.parametrize("ending", [".plan", ".waypoints", ".kmz"])
def test_missions_are_read_back_and_checked_as_the_plan_is(folder, ending):
    mission = read_mission(folder / f"01-falcon-1{ending}")
    assert len(mission.photos) == 6 and mission.relative
    own = check_plan(replace(plan(), terrain=False), FLAT, 1)
    flat = replace(FLAT)
    found = check_mission(mission, VIEW, plan().site, flat, views=1, clearance=0)
    assert found.photos == own.photos == 6
    assert found.proof.gsd_cm == pytest.approx(((62 / 36.48), (67 / 36.48)), rel=0.01)
    assert found.proof.least >= 1 and not found.conflicts


def test_surveys_by_distance_and_fences_of_other_programs(tmp_path):
    simple = {"type": "SimpleItem", "autoContinue": True, "frame": 3}
    items = [
        {**simple, "command": 16, "params": [0, 0, 0, None, 52.1, 13.1, 50]},
        {**simple, "command": 206, "params": [10, 0, 1, 0, 0, 0, 0]},
        {**simple, "command": 16, "params": [0, 0, 0, None, 52.101, 13.1, 50]},
        {**simple, "command": 206, "params": [0, 0, 0, 0, 0, 0, 0]},
    ]
    ring = [[52.1004, 13.0999], [52.1004, 13.1001], [52.1006, 13.1001], [52.1006, 13.0999]]
    record = {
        "fileType": "Plan", "version": 1, "geoFence": {"polygons": [
            {"inclusion": False, "polygon": ring}]},
        "mission": {"plannedHomePosition": [52.1, 13.1, 30], "items": [
            {"type": "ComplexItem", "TransectStyleComplexItem": {"Items": items}}]},
    }  # fmt: skip
    path = tmp_path / "survey.plan"
    path.write_text(json.dumps(record))
    mission = read_mission(path)
    assert len(mission.photos) == 12  # 111.3 m of a degree's thousandth, one at the start
    verdict = check_mission(mission, VIEW, None, FLAT, views=1, clearance=0)
    assert verdict.proof.overlap == pytest.approx(1 - 10 / 50, abs=0.01)
    assert verdict.conflicts == ("1 way enters keep-out area 1.",)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.plan", b"{}", "fileType"),
        ("a.plan", b'{"fileType":"Plan","mission":{"items":[]}}', "no waypoint"),
        ("a.plan", b"[" * 5000, "readable"),
        ("a.waypoints", b"QGC WPL 110\n0\t1\n", "2 fields"),
        ("a.waypoints", b"QGC WPL 110\n" + b"nan\t" * 12, "no number"),
        ("a.waypoints", b"hello", "QGC WPL"),
        ("a.kmz", b"PK\x03\x04", "readable"),
        ("a.txt", b"", "a mission is"),
    ],
)
def test_missions_that_are_none_are_one_sentence(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SideFileError, match=words):
        read_mission(tmp_path / name)


def test_a_folder_that_is_taken_is_told_before_the_routes_are_planned(tmp_path):
    """It took half a minute, and with a long search for routes as long as that."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    order = Order(area=tmp_path / "missing.geojson", settings=PlanSettings(), camera="FC6310")
    with pytest.raises(OutputError, match="already holds files"):
        list(iter_plan(order, tmp_path / "out"))
