"""A KML of a plan, for looking."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from skyquilt.planning.plan_file import as_record
from skyquilt.planning.records import Plan
from skyquilt.planning.stops import Flight
from skyquilt.raster.atomic import whole_file


def write_kml(path: Path, plan: Plan, flights: Sequence[Flight]) -> None:
    """A KML for looking: points, ways and areas."""
    record = as_record(plan)
    marks = [_kml_area("Area", record["area"], "area")]
    marks += [
        _kml_area(k["name"] or "Keep out", k["geometry"], "closed") for k in record["keep_out"]
    ]
    mode = "absolute" if plan.terrain else "relativeToGround"
    for flight in flights:
        stops = (flight.home, *flight.stops, flight.landing)
        places = " ".join(f"{s.longitude},{s.latitude},{s.height + flight.home_z}" for s in stops)
        marks.append(
            f"<Placemark><name>{escape(flight.name)}</name><styleUrl>#way</styleUrl><LineString>"
            f"<altitudeMode>{mode}</altitudeMode><coordinates>{places}</coordinates></LineString>"
            "</Placemark>"
        )
    marks += [
        f"<Placemark><name>{p['id']}</name><styleUrl>#point</styleUrl><Point><altitudeMode>{mode}"
        f"</altitudeMode><coordinates>{p['longitude']},{p['latitude']},{p['z']}</coordinates>"
        "</Point></Placemark>"
        for p in record["points"]
    ]
    styles = (
        '<Style id="area"><LineStyle><color>ffe0a040</color><width>2</width></LineStyle><PolyStyle>'
        '<color>30e0a040</color></PolyStyle></Style><Style id="closed"><LineStyle><color>ff2020c0'
        "</color><width>2</width></LineStyle><PolyStyle><color>502020c0</color></PolyStyle></Style>"
        '<Style id="way"><LineStyle><color>ff00d0ff</color><width>2</width></LineStyle></Style>'
        '<Style id="point"><IconStyle><scale>0.4</scale></IconStyle><LabelStyle><scale>0</scale>'
        "</LabelStyle></Style>"
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">'
        f"<Document>{styles}{''.join(marks)}</Document></kml>\n"
    )
    with whole_file(path) as file:
        file.write(text.encode())


def _kml_area(name: str, geometry: dict[str, Any], style: str) -> str:
    shapes = geometry["coordinates"]
    shapes = [shapes] if geometry["type"] == "Polygon" else shapes
    found = []
    for rings in shapes:
        words = [" ".join(f"{x},{y}" for x, y in ring) for ring in rings]
        inner = "".join(
            f"<innerBoundaryIs><LinearRing><coordinates>{w}</coordinates></LinearRing>"
            "</innerBoundaryIs>"
            for w in words[1:]
        )
        found.append(
            f"<Polygon><outerBoundaryIs><LinearRing><coordinates>{words[0]}</coordinates>"
            f"</LinearRing></outerBoundaryIs>{inner}</Polygon>"
        )
    return (
        f"<Placemark><name>{escape(name)}</name><styleUrl>#{style}</styleUrl><MultiGeometry>"
        f"{''.join(found)}</MultiGeometry></Placemark>"
    )
