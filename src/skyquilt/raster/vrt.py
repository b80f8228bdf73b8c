"""A GDAL virtual raster: the pixels of another file with our ground control points."""

from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from numpy.typing import NDArray

_TYPES = {"uint8": "Byte", "uint16": "UInt16", "float32": "Float32"}
_COLOURS = ("Red", "Green", "Blue")


def vrt(
    source: Path,
    *,
    size: tuple[int, int],
    bands: int,
    dtype: str,
    px: NDArray[Any],
    ground: NDArray[Any],
    crs: str | None,
) -> str:
    """XML of a raster of `size` (width, height) whose pixels are those of `source`.

    px (n, 2) are columns and rows counted from the outer corner, ground (n, 2) x and y of `crs` (or
    pixels of another image, if None).
    """
    points = "\n".join(
        f'    <GCP Id="{k}" Pixel="{p[0]:.4f}" Line="{p[1]:.4f}" X="{g[0]:.9f}" Y="{g[1]:.9f}"/>'
        for k, (p, g) in enumerate(zip(px, ground, strict=True), 1)
    )
    body = "\n".join(_band(source, k, bands, _TYPES[dtype]) for k in range(1, bands + 1))
    return (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">\n'
        f"  <GCPList Projection={quoteattr(crs or '')}>\n{points}\n "
        f" </GCPList>\n{body}\n</VRTDataset>\n"
    )


def _band(source: Path, number: int, bands: int, kind: str) -> str:
    colour = f"    <ColorInterp>{_COLOURS[number - 1]}</ColorInterp>\n" if bands == 3 else ""
    return (
        f'  <VRTRasterBand dataType="{kind}" band="{number}">\n{colour}    <SimpleSource>\n'
        f'      <SourceFilename relativeToVRT="0">{escape(str(source))}</SourceFilename>\n'
        f"      <SourceBand>{number}</SourceBand>\n    </SimpleSource>\n  </VRTRasterBand>"
    )
