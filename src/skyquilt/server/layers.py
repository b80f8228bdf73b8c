"""GeoJSON layers over the map: detections, tracks, restricted areas, planned routes [methods
D7].
"""

import json
import time
from typing import Any

from skyquilt.live.ledger import Ledger

GEOMETRIES = ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon")
MOST_NESTED = 8


class LayerError(ValueError):
    """Invalid layer data; the message is a sentence."""


def checked(data: bytes) -> dict[str, Any]:
    """A FeatureCollection from GeoJSON bytes (RFC 7946).

    Raises:
        LayerError: the data are invalid.
    """
    try:
        found = json.loads(
            data, parse_constant=lambda name: _no(f"it contains {name}, which is not a number")
        )
    except LayerError:
        raise
    except (ValueError, RecursionError) as error:
        raise LayerError(f"it is not JSON ({error})") from error
    if not isinstance(found, dict):
        raise LayerError("it is JSON, but not a GeoJSON object")
    kind = found.get("type")
    if kind in GEOMETRIES:
        found = {"type": "Feature", "properties": {}, "geometry": found}
    if found.get("type") == "Feature":
        found = {"type": "FeatureCollection", "features": [found]}
    features = found.get("features")
    if found.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise LayerError(
            f"it is of type {str(kind)[:40]!r}; a FeatureCollection, a Feature or a geometry is"
            " needed"
        )
    return {
        "type": "FeatureCollection",
        "features": [_feature(f, k) for k, f in enumerate(features)],
    }


def _no(text: str) -> None:
    raise LayerError(text)


def _feature(feature: Any, k: int) -> dict[str, Any]:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") not in GEOMETRIES:
        raise LayerError(f"feature {k} has no geometry of a known kind")
    _places(geometry.get("coordinates"), k, 0)
    properties = feature.get("properties")
    return {
        "type": "Feature",
        "properties": properties if isinstance(properties, dict) else {},
        "geometry": {"type": geometry["type"], "coordinates": geometry["coordinates"]},
    }


def _places(value: Any, k: int, depth: int) -> None:
    if not isinstance(value, list) or not value or depth > MOST_NESTED:
        raise LayerError(f"feature {k} has invalid coordinates")
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        if len(value) < 2 or abs(value[0]) > 180 or abs(value[1]) > 90:
            raise LayerError(
                f"feature {k} has {str(value)[:60]}, which is not longitude and latitude in degrees"
            )
        return
    for inner in value:
        _places(inner, k, depth + 1)


def put_layer(ledger: Ledger, name: str, layer: dict[str, Any], most: int) -> bool:
    """Stores a layer under a name; False if there are too many layers."""
    with ledger.change() as db:
        count = ledger.row("select count(*) from layer where name != ?", name)
        if count is not None and count[0] >= most:
            return False
        db.execute(
            "insert or replace into layer values (?, ?, ?)", (name, json.dumps(layer), time.time())
        )
        ledger.tell("layer", {"name": name, "features": len(layer["features"])})
    return True


def drop_layer(ledger: Ledger, name: str) -> bool:
    """Removes a layer; False if it does not exist."""
    with ledger.change() as db:
        gone = db.execute("delete from layer where name = ?", (name,)).rowcount > 0
        if gone:
            ledger.tell("layer", {"name": name, "features": 0, "gone": True})
    return gone
