"""Formats that rasters are read in: those that hold their pixels.

Others, such as VRT, name files and addresses to be read, and any of them may be called `map.tif`.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyquilt.outside import open_regular

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

GEOTIFF = "GTiff"
"""The format of all rasters of a run, and of terrain."""
MAPS = (GEOTIFF, "MBTiles", "PNG", "JPEG", "JP2OpenJPEG", "WEBP", "BMP", "HFA", "ENVI", "AAIGrid")
"""Formats of maps that users bring along."""
NO_TEXT = "a file or folder on its path has a name that is no UTF-8 text; rename it"
"""Why a map cannot be read that GDAL cannot be asked for."""


def why_unreadable(error: Exception) -> str:
    """What is wrong with a raster that could not be read, to be put after its name. GDAL's own
    words name no cause ("Read failed. See previous exception for details.").
    """
    told = str(error)
    if "not recognized" in told:
        return "it is no raster, or its beginning is damaged"
    if NO_TEXT in told:
        return NO_TEXT
    if "No such file" in told:
        return "it does not exist"
    return "it is damaged, or a copy that was cut off"


def open_raster(path: Path, **options: Any) -> "DatasetReader":
    """Opens a map that a user brings along, of whatever format in `MAPS`.

    Raises:
        rasterio.errors.RasterioIOError: it is none of these, or no regular file.
    """
    import rasterio

    try:
        with open_regular(path):
            pass  # GDAL would wait for the other end of a pipe
    except OSError as error:
        raise rasterio.errors.RasterioIOError(f"{path}: {error.strerror}") from error
    if not is_text(path):
        raise rasterio.errors.RasterioIOError(f"{path}: {NO_TEXT}")
    for driver in MAPS:
        try:
            return rasterio.open(path, driver=driver, **options)
        except rasterio.errors.RasterioIOError as error:
            last = error
    raise last


def is_text(path: Path) -> bool:
    """Whether a path is text, as GDAL wants it; on Linux a name may be any bytes."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True
