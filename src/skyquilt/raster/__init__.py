"""Writes and reads raster and vector files: Cloud Optimized GeoTIFF, GeoJSON, and the boundary that
a user provides.
"""

from skyquilt.raster.cog import Block, CogWriter, write_array
from skyquilt.raster.spec import RasterSpec

__all__ = ["Block", "CogWriter", "RasterSpec", "write_array"]
