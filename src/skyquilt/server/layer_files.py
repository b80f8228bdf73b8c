"""Layers over the map from files of GIS programs."""

import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import CRSError
from shapely import transform
from shapely.geometry import mapping

from skyquilt.errors import SideFileError, UsageError
from skyquilt.live.ledger import Ledger
from skyquilt.outside import plain, unzipped
from skyquilt.planning.features import read_features
from skyquilt.server.layer_endpoints import put_layer

SHAPEFILE = (".shp", ".dbf", ".prj")
"""Files of a zipped Shapefile that are read."""
MOST_UNZIPPED = 100_000_000
"""Most bytes of each."""


def layer_of_file(ledger: Ledger, path: Path, most: int) -> None:
    """Stores the shapes of a GeoJSON, KML, KMZ, GeoPackage or Shapefile as a layer under the
    file's name.

    Raises:
        SideFileError: the file cannot be read. UsageError: there are `most` layers already.
    """
    if not put_layer(ledger, plain(path.name, 120), shapes_in(path), most):
        raise UsageError(f"--layer: there are {most} layers already; remove one")


def layer_of_bytes(data: bytes, name: str) -> dict[str, Any]:
    """A FeatureCollection in degrees from the content of a KML, KMZ, GeoPackage or zipped Shapefile
    named `name`.

    Raises:
        SideFileError: it cannot be read.
    """
    ending = Path(name).suffix.lower()
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / f"layer{ending}"
        path.write_bytes(data)
        if ending == ".zip":
            path = _unzipped(path, name)
        try:
            return shapes_in(path)
        except SideFileError as error:
            raise SideFileError(str(error).replace(path.name, plain(name, 120))) from error


def _unzipped(path: Path, name: str) -> Path:
    """The first Shapefile of an archive, with the files that belong to it, beside the archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            known = {n.lower(): n for n in archive.namelist()}
            first = next((n for n in sorted(known) if n.endswith(".shp")), None)
            if first is None:
                raise SideFileError(f"{plain(name, 120)} contains no Shapefile (.shp)")
            for ending in SHAPEFILE:
                inside = known.get(first.removesuffix(".shp") + ending)
                if inside is None:
                    continue
                body = unzipped(archive, inside, MOST_UNZIPPED)
                path.with_suffix(ending).write_bytes(body)
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise SideFileError(f"{plain(name, 120)} is not a readable zip file: {error}") from error
    return path.with_suffix(".shp")


def shapes_in(path: Path) -> dict[str, Any]:
    """The shapes of a GeoJSON, KML, KMZ, GeoPackage or Shapefile as a FeatureCollection in degrees.

    Raises:
        SideFileError: the file cannot be read.
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
    return {"type": "FeatureCollection", "features": features}
