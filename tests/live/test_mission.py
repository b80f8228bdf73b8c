"""A live map that knows its plan: points turn, coverage grows, what is missing is planned."""

import json
import shutil
import threading
import zipfile
from contextlib import contextmanager

import cv2
import httpx
import numpy as np
import pytest

from skyquilt.live.fill import known_plan
from skyquilt.live.live_map import LiveMap
from skyquilt.live.mission import Mission
from skyquilt.live.settings import LiveSettings
from skyquilt.live.workflow import iter_live
from skyquilt.planning.ground_cover import cover_of, picture_of, to_mercator
from skyquilt.planning.plan_file import write_plan
from skyquilt.planning.records import Drone, PicturePoint, Plan, Proof, Sortie, View, Waypoint
from skyquilt.planning.site import make_site
from skyquilt.server.access import Guard
from skyquilt.server.mission_watch import MissionWatch
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import LiveSurvey

QUICK = LiveSettings(features=600)


def test_cover_counts_as_shapely_does():
    from shapely import Polygon, box, contains_xy

    cover = cover_of(box(370_000, 5_773_000, 370_100, 5_773_060), "EPSG:32633", 0.5)
    ring = to_mercator(
        np.array([[370_010, 5_773_010], [370_050, 5_773_020], [370_040, 5_773_050.0]]), "EPSG:32633"
    )
    rows, columns = cover.inside.shape
    x = cover.west + (np.arange(columns) + 0.5) * cover.cell
    y = cover.north - (np.arange(rows) + 0.5) * cover.cell
    gx, gy = np.meshgrid(x, y)
    within = contains_xy(Polygon(ring), gx, gy) & cover.inside
    counts = cover.counts([cover.seen(ring)])
    assert (counts.astype(bool) == within).mean() > 0.9995
    area = within.sum() * cover.ground_m**2
    assert area == pytest.approx(Polygon([(10, 10), (50, 20), (40, 50)]).area, rel=0.01)
    picture = cv2.imdecode(np.frombuffer(picture_of(cover, counts, 1), np.uint8), -1)
    assert (picture[within][:, 1] > 100).all() and (
        picture[~within & cover.inside][:, 2] > 200
    ).all()


def plan_of(flight, folder, *, drop=0):
    """A plan whose points are where the simulated photos were taken, and one that none was."""
    truth = json.loads((flight.photos[0].parents[1] / "truth" / "truth.json").read_text())
    lens = truth["cameras"]["visible"]
    places = [np.array(p["position"]) for p in truth["photos"]]
    height = float(np.median([p[2] for p in places])) - truth["vertical"]["takeoff_m"]
    along = places[-1] - places[-2]
    places.append(places[-1] + along)
    crs, yaw = truth["crs"], truth["photos"][0]["yaw_deg"]
    points = tuple(
        PicturePoint(id=k, x=p[0], y=p[1], z=height, ground=0.0, yaw=yaw % 360)
        for k, p in enumerate(places, 1)
    )
    w, h, f = lens["width"] / 2, lens["height"] / 2, lens["focal"]
    view = View(name="sim", width=lens["width"], height=lens["height"], focal=f,
                left=w / f, right=w / f, up=h / f, down=h / f)  # fmt: skip
    start = (places[0][0] - 30, places[0][1])
    drone = Drone(name="one", start=start, landing=start, view=view)
    ground = Waypoint(x=start[0], y=start[1], z=0.0, time_s=0.0)
    way = tuple(Waypoint(x=p.x, y=p.y, z=p.z, time_s=10.0 * p.id, point=p.id) for p in points)
    end = Waypoint(x=start[0], y=start[1], z=0.0, time_s=100.0)
    from shapely import MultiPoint

    hull = MultiPoint([(p.x, p.y) for p in points]).convex_hull.buffer(4.0)
    proof = Proof(views=4, cell_m=1.0, cells=1, least=4, median=4.0, missing_m2=0.0,
                  closed_m2=0.0, gsd_cm=(1.0, 1.0), overlap=0.5)  # fmt: skip
    plan = Plan(
        site=make_site(hull, (), crs), drones=(drone,), points=points,
        sorties=(Sortie(drone=0, number=1, way=(ground, *way, end)),),
        options={"height_m": height, "clearance_m": 5.0, "separation_m": 20.0, "seconds": 1.0},
        terrain=False, proof=proof,
    )  # fmt: skip
    write_plan(folder / "mission.json", plan)
    return folder / "mission.json"


@contextmanager
def watched(folder, plan):
    """A live map with a server that follows a plan."""
    live = LiveMap(folder, QUICK)
    known_plan(folder, plan)
    stop = threading.Event()
    mapping = threading.Thread(
        target=lambda: [None for _ in iter_live([], live, stop=stop)], daemon=True
    )
    watch = MissionWatch(folder, known_plan(folder))
    with (
        watch,
        ServerThread(survey=LiveSurvey(folder), guard=Guard(), folder=folder, writer=live,
                     watch=watch) as serving,
    ):  # fmt: skip
        mapping.start()
        with httpx.Client(base_url=serving.url, timeout=60, verify=False) as web:
            try:
                yield live, web, serving.url
            finally:
                stop.set()
                mapping.join(60)
                live.close()


def until(holds, seconds=300):
    for _ in range(seconds * 10):
        if holds():
            return
        threading.Event().wait(0.1)
    raise AssertionError("it did not happen in time")


def blurred(path, folder):
    """The same photo, shaken, with its metadata."""
    from PIL import Image

    with Image.open(path) as image:
        pixels = cv2.blur(np.asarray(image), (1, 17))
        info = {"exif": image.info.get("exif", b""), "quality": 92}
        xmp = image.info.get("xmp")
        if xmp:
            info["xmp"] = xmp
        Image.fromarray(pixels).save(folder / path.name, "JPEG", **info)
    return folder / path.name


@pytest.mark.slow
def test_points_turn_and_what_is_missing_is_planned(flight, tmp_path):
    plan = plan_of(flight, tmp_path)
    with watched(tmp_path / "out", plan) as (live, web, _):
        said = web.get("/plan").json()
        assert len(said["plan"]["points"]) == 7
        for path in flight.photos[:-1]:
            assert web.post("/photos", params={"name": path.name},
                            content=path.read_bytes()).status_code < 300  # fmt: skip
        (tmp_path / "b").mkdir()
        shaken = blurred(flight.photos[-1], tmp_path / "b")
        web.post("/photos", params={"name": shaken.name}, content=shaken.read_bytes())
        until(lambda: list(web.get("/plan").json()["states"].values()).count("taken") == 5)
        until(lambda: "unsharp" in web.get("/plan").json()["states"].values())
        states = web.get("/plan").json()["states"]
        assert states["6"] == "unsharp" and states["7"] == "planned"
        drone = web.get("/plan").json()["drones"][0]
        assert (drone["taken"], drone["planned"], drone["seconds_left"]) == (6, 7, 40.0)
        cover = web.get("/coverage").json()
        assert 0 < cover["share"] < 1 and cover["missing_m2"] > 0
        assert web.get("/coverage.png").content[:4] == b"\x89PNG"
        answer = web.post("/plan/missing")
        assert answer.status_code == 202 and answer.json()["name"] == "fill-1"
        assert web.post("/plan/missing").status_code == 409
        until(lambda: web.get("/plan").json()["plans"])
        (made,) = web.get("/plan").json()["plans"]
        kmz = web.get(f"/plans/fill-1/{next(f for f in made['files'] if f.endswith('.kmz'))}")
        (tmp_path / "f.kmz").write_bytes(kmz.content)
        assert zipfile.is_zipfile(tmp_path / "f.kmz")
        again = json.loads((tmp_path / "out" / "plans" / "fill-1" / "plan.json").read_text())
        assert 1 <= len(again["points"]) <= 20
        assert web.get("/plans/fill-1/..%2f..%2flive.db").status_code == 404
        assert web.get("/plans/../live.db").status_code == 404
        kinds = {kind for _, kind, _ in live.ledger.told(0)}
        assert {"plan", "coverage"} <= kinds


@pytest.mark.slow
def test_areas_are_planned_in_a_process_of_their_own(tmp_path):
    ring = [[13.1, 52.1], [13.102, 52.1], [13.102, 52.101], [13.1, 52.101], [13.1, 52.1]]
    body = json.dumps({"type": "Polygon", "coordinates": [ring]})
    asked = {"camera": "FC6310", "height": 100, "overlap": 60, "sidelap": 50}
    with watched(tmp_path / "out", None) as (live, web, _):
        assert web.post("/plan/missing").status_code == 409
        assert web.post("/plan", params=asked, content="{").status_code == 422
        assert (
            web.post("/plan", params={**asked, "camera": "../a"}, content=body).status_code == 422
        )
        answer = web.post("/plan", params=asked, content=body)
        assert answer.status_code == 202, answer.text
        until(lambda: web.get("/plan").json()["plans"])
        assert web.get("/plans/plan-1/plan.html").status_code == 200
        wrong = {**asked, "camera": "FC9999"}
        until(lambda: web.post("/plan", params=wrong, content=body).status_code == 202)
        until(lambda: any('"refused"' in text for _, kind, text in live.ledger.told(0)))
        (text,) = [t for _, kind, t in live.ledger.told(0) if '"refused"' in t]
        assert "no camera 'FC9999' is known" in text


def test_a_mission_without_photos_is_planned_and_its_state_is_written(tmp_path):
    """Quick: no server, no photo."""
    site_plan = Plan(
        site=make_site(__import__("shapely").box(370_000, 5_773_000, 370_060, 5_773_040), (),
                       "EPSG:32633"),
        drones=(), points=(), sorties=(), options={}, terrain=False,
    )  # fmt: skip
    live = LiveMap(tmp_path / "o", QUICK)
    try:
        mission = Mission(folder=tmp_path / "o", plan=site_plan)
        state = mission.look(live.ledger, tmp_path / "o" / "photos")
        assert state.share == 0 and state.missing_m2 == pytest.approx(2400, rel=0.01)
        mission.write(state)
        assert (tmp_path / "o" / "coverage.tif").is_file()
    finally:
        live.close()
        shutil.rmtree(tmp_path / "o")


def test_shapes_of_gis_files_become_layers(tmp_path):
    from skyquilt.errors import UsageError
    from skyquilt.server.layer_files import layer_of_file

    (tmp_path / "a.kml").write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>way</name><LineString>'
        "<coordinates>13.1,52.1 13.2,52.15</coordinates></LineString></Placemark></kml>"
    )
    live = LiveMap(tmp_path / "o", QUICK)
    try:
        layer_of_file(live.ledger, tmp_path / "a.kml", 3)
        (body,) = live.ledger.row("select body from layer where name = 'a.kml'")
        (found,) = json.loads(body)["features"]
        assert found["properties"]["name"] == "way"
        assert found["geometry"]["coordinates"] == [[13.1, 52.1], [13.2, 52.15]]
        (tmp_path / "b.kml").write_text((tmp_path / "a.kml").read_text())
        with pytest.raises(UsageError, match="1 layers already"):
            layer_of_file(live.ledger, tmp_path / "b.kml", 1)
    finally:
        live.close()


def test_older_maps_are_layers_below_also_as_mbtiles(tmp_path):
    from skyquilt.errors import UsageError
    from skyquilt.raster.map_source import between, picture
    from skyquilt.raster.mbtiles import write_mbtiles
    from skyquilt.server.survey import base_map

    tile = cv2.imencode(".png", np.full((256, 256, 4), (40, 80, 160, 255), np.uint8))[1].tobytes()
    x, y = between("EPSG:4326", "EPSG:3857").transform(13.1, 52.1)
    half = 20037508.342789244
    z, size = 18, 2 * half / 2**18
    column, row = int((x + half) / size), int((half - y) / size)
    write_mbtiles(tmp_path / "old.mbtiles", [(z, column, row, tile)], name="old",
                  bounds=(13.09, 52.09, 13.11, 52.11), zooms=(z, z))  # fmt: skip
    found = base_map([tmp_path / "old.mbtiles", tmp_path / "old.mbtiles"])
    assert list(found) == ["base", "base-2"]
    west, north = column * size - half, half - row * size
    box = (west + 0.3 * size, north - 0.7 * size, west + 0.7 * size, north - 0.3 * size)
    rgba = picture(found["base"], "EPSG:3857", box, 64, 64)
    assert rgba is not None and tuple(rgba[32, 32]) == (160, 80, 40, 255)
    (tmp_path / "no.tif").write_text("no map")
    with pytest.raises(UsageError, match="not a georeferenced map"):
        base_map([tmp_path / "no.tif"])
