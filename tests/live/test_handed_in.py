"""What is handed to a live map beside photos: layers of GIS programs, areas that were drawn; and
where photos of a growing map show a place.
"""

import io
import json
import zipfile

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer

from skyquilt.live.settings import LiveSettings
from skyquilt.raster.geopackage import write_polygons
from skyquilt.server.access import Guard
from tests.live.conftest import served
from tests.live.test_mission import watched
from tests.planning.test_input import shapefile

RING = np.array([[14.30, 46.60], [14.31, 46.60], [14.31, 46.61], [14.30, 46.60]])
UTM = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)


def kml():
    places = " ".join(f"{x},{y},0" for x, y in RING)
    return (
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>field</name><Polygon>'
        f"<outerBoundaryIs><LinearRing><coordinates>{places}</coordinates></LinearRing>"
        "</outerBoundaryIs></Polygon></Placemark></kml>"
    ).encode()


def zipped(files):
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, body in files.items():
            archive.writestr(name, body)
    return held.getvalue()


def projected():
    return np.column_stack(UTM.transform(*RING.T))


def test_layers_of_gis_programs_are_taken_from_their_content(tmp_path):
    write_polygons(tmp_path / "a.gpkg", "fields", [(projected(), "field")], crs="EPSG:32633")
    shapefile(tmp_path / "b.shp", [projected()], ["field   0 "])
    (tmp_path / "b.prj").write_text(CRS("EPSG:32633").to_wkt("WKT1_ESRI"))
    shape = {f"In/B{p.suffix.upper()}": p.read_bytes() for p in tmp_path.glob("b.*")}
    sent = {
        "a.kml": kml(),
        "a.KMZ": zipped({"doc.kml": kml()}),
        "a.gpkg": (tmp_path / "a.gpkg").read_bytes(),
        "b.zip": zipped(shape),
    }
    with served(tmp_path / "out") as site:
        for name, data in sent.items():
            answer = site.web.post("/layers", params={"name": name}, content=data)
            assert answer.status_code == 201, answer.text
            layer = site.web.get(f"/layers/{name}").json()
            (shown,) = layer["features"]
            ring = np.array(shown["geometry"]["coordinates"]).reshape(-1, 2)
            near = np.abs(ring[:, None] - RING[None]).max(-1).min(0)
            assert near.max() < 2e-7, name
        assert len(site.web.get("/layers").json()["layers"]) == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("a.zip", zipped({"x.txt": b"1"}), "no Shapefile"),
        ("a.zip", b"PK\x03\x04 torn", "not a readable zip"),
        ("a.zip", lambda: zipped({"x.shp": bytes(100_000_001)}), "unpacks to more than"),
        ("a.gpkg", b"SQLite format 3\0" + b"\0" * 2000, "a.gpkg"),
        ("a.kml", b"<kml", "a.kml"),
        ("a.json", b"[", "not JSON"),
    ],
)
def test_what_is_no_layer_gets_a_sentence(tmp_path, name, data, reason):
    with served(tmp_path / "out") as site:
        content = data() if callable(data) else data
        answer = site.web.post("/layers", params={"name": name}, content=content)
        assert answer.status_code == 422 and reason in answer.json()["detail"]
        assert "/tmp" not in answer.text
        assert site.web.get("/layers").json()["layers"] == []


AREAS = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"keep_out": True},
            "geometry": {"type": "Polygon", "coordinates": [RING.tolist()]},
        }
    ],
}


def test_areas_are_kept_with_the_survey_and_told_to_all(tmp_path):
    folder = tmp_path / "out"
    with watched(folder, None) as (_, web, _url):
        assert web.get("/areas").json()["features"] == []
        assert web.put("/areas", content=json.dumps(AREAS)).json() == {"areas": 1}
        assert web.put("/areas", content=b"{").status_code == 422
        with web.stream("GET", "/events", params={"after": 0}) as news:
            told = next(line for line in news.iter_lines() if line == "event: areas")
            assert told
    with watched(folder, None) as (_, web, _url):
        assert web.get("/areas").json() == AREAS


def test_areas_of_strangers_are_not_kept(tmp_path):
    with served(tmp_path / "out", guard=Guard(token="a secret")) as site:
        answer = site.web.put("/areas", content=json.dumps(AREAS), headers={"X-Token": "no"})
        assert answer.status_code in (401, 403)


@pytest.mark.slow
def test_photos_of_a_growing_map_show_the_place_that_was_chosen(flight, tmp_path):
    """A place is chosen where one photo shows a pixel, and must lie in the other photos where the
    simulator's own poses, lens and surface put what that pixel shows: wherever the map may lie.
    """
    with rasterio.open(flight.folder / "truth" / "truth_surface.tif") as file:
        ground, to = file.read(1), file.transform
    lens = flight.truth["cameras"]["visible"]
    lonlat = Transformer.from_crs(flight.truth["crs"], "EPSG:4326", always_xy=True)

    def bent(uv):
        r2 = uv @ uv
        radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
        p1, p2 = lens["p1"], lens["p2"]
        cross = 2 * uv[0] * uv[1]
        return uv * radial + [
            p1 * cross + p2 * (r2 + 2 * uv[0] ** 2), p2 * cross + p1 * (r2 + 2 * uv[1] ** 2)
        ]  # fmt: skip

    def pixel(name, place):
        local = flight.rotation(name) @ (place - flight.centre(name))
        u, v = bent(local[:2] / local[2])
        return np.array([
            lens["focal"] * u + lens["cx"], lens["focal"] * lens["aspect"] * v + lens["cy"]
        ])  # fmt: skip

    def on_surface(name, px):
        """The place that a pixel shows: the surface and the lens are met by repetition."""
        wanted = (px - [lens["cx"], lens["cy"]]) / lens["focal"] / [1, lens["aspect"]]
        uv, z = wanted.copy(), float(np.median(ground))
        for _ in range(20):
            uv = uv + wanted - bent(uv)
            ray = flight.rotation(name).T @ np.append(uv, 1.0)
            place = flight.centre(name) + ray * (z - flight.centre(name)[2]) / ray[2]
            c, r = (int(v) for v in ~to * (place[0], place[1]))
            z = float(ground[r, c])
        return place

    with served(tmp_path / "out", LiveSettings(features=1500)) as site:
        for path in flight.photos:
            site.send(path)
        site.until(lambda: list(site.states().values()) == ["refined"] * 6)
        numbers = {p["name"]: p["id"] for p in site.web.get("/photos").json()["photos"]}

        def told(name, at):
            lon, lat = lonlat.transform(*at)
            where = {"lon": lon, "lat": lat}
            answer = site.web.get(f"/photos/{numbers[name]}/place", params=where)
            said = answer.json()
            return np.array([said["x"], said["y"]]) if answer.status_code == 200 else None

        offs = []
        for first in list(numbers)[:3]:
            px = np.array([260.0, 170.0])
            place = on_surface(first, px)
            at = place[:2].copy()
            for _ in range(4):  # Newton: where on the map this photo shows the pixel
                here = told(first, at)
                slope = np.column_stack([told(first, at + d) - here for d in np.eye(2)])
                at += np.linalg.solve(slope, px - here)
            assert np.hypot(*(told(first, at) - px)) < 0.1
            for other in numbers:
                true = pixel(other, place)
                if other != first and (true > 20).all() and (true < (460, 340)).all():
                    found = told(other, at)
                    assert found is not None
                    offs.append(float(np.hypot(*(found - true))))
        assert len(offs) >= 4 and np.median(offs) < 3.0
        far = site.web.get(f"/photos/{numbers[first]}/place", params={"lon": 0, "lat": 0})
        assert far.status_code == 404
