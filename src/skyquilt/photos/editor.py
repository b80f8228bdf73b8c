"""Which program, if any, rewrote the file after the camera."""

import re

from skyquilt.photos import exif as tag
from skyquilt.photos.exif import Exif
from skyquilt.photos.xmp import Xmp

_PROGRAMS = re.compile(
    r"photo ?viewer|photoshop|lightroom|camera"
    r" raw|adobe|gimp|paint|microsoft|windows|picasa|snapseed|acdsee|"
    r"xnview|irfanview|faststone|imagemagick|graphicsmagick|darktable|rawtherapee|capture"
    r" one|affinity|"
    r"pixelmator|digikam|gthumb|shotwell|photos \d|preview|mac"
    r" os|macos|luminar|dxo|corel|photoscape|"
    r"google|instagram|pix4d|agisoft|metashape|opencv|matlab|ffmpeg|dji photo|silkypix|topaz",
    re.IGNORECASE,
)


def find_editor(exif: Exif, xmp: Xmp) -> str | None:
    """The program that EXIF or XMP names, if it is no camera's firmware; else None."""
    named = (exif.text(tag.SOFTWARE), xmp.text("xmp:CreatorTool"), xmp.text("softwareAgent"))
    return next((name for name in named if _PROGRAMS.search(name)), None)
