"""Layers over the map from files of GIS programs."""

from pathlib import Path

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import CRSError
from shapely import transform
from shapely.geometry import mapping

from skyquilt.errors import SideFileError, UsageError
from skyquilt.live.ledger import Ledger
from skyquilt.outside import plain
from skyquilt.planning.features import read_features
from skyquilt.server.layer_endpoints import put_layer


def layer_of_file(ledger: Ledger, path: Path, most: int) -> None:
    """Stores the shapes of a GeoJSON, KML, KMZ, GeoPackage or Shapefile as a layer under the
    file's name.

    Raises:
        SideFileError: the file cannot be read. UsageError: there are `most` layers already.
    """
    found, crs = read_features(path)
    try:
        turned = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    except CRSError as error:
        raise SideFileError(f"{path.name}: its CRS '{plain(crs, 60)}' is not known") from error
    features = []
    for one in found:
        shape = transform(
            one.shape, lambda xy: np.round(np.column_stack(turned.transform(xy[:, 0], xy[:, 1])), 9)
        )
        if shape.is_empty or not np.isfinite(shape.bounds).all():
            raise SideFileError(f"{path.name}: its coordinates do not fit its CRS")
        geometry = mapping(shape)
        features.append({"type": "Feature", "properties": one.properties, "geometry": geometry})
    layer = {"type": "FeatureCollection", "features": features}
    if not put_layer(ledger, plain(path.name, 120), layer, most):
        raise UsageError(f"--layer: there are {most} layers already; remove one")
