"""EXIF tags and XMP packets as numbers and text; broken values are treated as absent."""

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from defusedxml import ElementTree
from PIL import Image

EXIF_IFD, GPS_IFD = 0x8769, 0x8825

MAKE, MODEL, SOFTWARE, ORIENTATION, MODIFIED = 0x010F, 0x0110, 0x0131, 0x0112, 0x0132
DESCRIPTION, GDAL_METADATA = 0x010E, 42112
TAKEN, SUBSEC, OFFSET = 0x9003, 0x9291, 0x9011
FOCAL_MM, FOCAL_35MM, ZOOM = 0x920A, 0xA405, 0xA404
PLANE_X, PLANE_UNIT = 0xA20E, 0xA210
PIXELS_X, PIXELS_Y = 0xA002, 0xA003
SERIAL, LENS = 0xA431, 0xA434
GPS_LAT_REF, GPS_LAT, GPS_LON_REF, GPS_LON, GPS_ALT_REF, GPS_ALT = 1, 2, 3, 4, 5, 6
GPS_TIME, GPS_ERROR, GPS_DATE = 7, 0x1F, 0x1D


@dataclass(frozen=True, kw_only=True, eq=False)
class Exif:
    """Tags by number: those of the image and Exif directories in `tags`, of the GPS directory in
    `gps`.
    """

    tags: Mapping[int, Any] = field(default_factory=dict)
    """IFD0 and the Exif directory together (their numbers do not overlap)."""
    gps: Mapping[int, Any] = field(default_factory=dict)
    """The GPS directory."""
    broken: bool = False
    """There was a block, but it could not be read."""

    def text(self, tag: int) -> str:
        """A tag as text without padding; empty where it is absent."""
        return as_text(self.tags.get(tag))

    def number(self, tag: int) -> float | None:
        """A tag as a finite number; None where it is absent or invalid."""
        return as_number(self.tags.get(tag))


def as_text(value: Any) -> str:
    """Text up to the first NUL, stripped; empty for other types."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.split("\x00")[0].strip() if isinstance(value, str) else ""


def as_number(value: Any) -> float | None:
    """A finite float from a number, rational or one-element tuple; else None."""
    if isinstance(value, (tuple, list)):
        value = value[0] if len(value) == 1 else None
    if isinstance(value, bytes):
        value = value[0] if len(value) == 1 else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def parse_exif(block: bytes) -> Exif:
    """Tags of an EXIF block as stored in a JPEG or PNG (a TIFF header and directories)."""
    return read_tiff_tags(io.BytesIO(block)) if block else Exif()


def read_tiff_tags(file: BinaryIO) -> Exif:
    """Tags of a TIFF file or block, read from its directories only; never raises."""
    exif = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file.seek(0)
            exif.load_from_fp(file)
            tags = {**dict(exif), **_directory(exif, EXIF_IFD)}
            return Exif(tags=tags, gps=_directory(exif, GPS_IFD))
    except (
        Exception
    ):  # Pillow raises many exceptions on invalid data, and a broken block must not stop a survey
        return Exif(broken=True)


def _directory(exif: Image.Exif, which: int) -> dict[int, Any]:
    try:
        found = exif.get_ifd(which)
    except Exception:  # as above: one broken directory does not affect the others
        return {}
    return {k: v for k, v in found.items() if isinstance(k, int)}


_KNOWN = {
    "http://www.dji.com/drone-dji/1.0": "drone-dji",
    "http://pix4d.com/camera/1.0": "Camera",
    "http://www.parrot.com/drone-parrot/1.0": "drone-parrot",
    "http://ns.adobe.com/xap/1.0": "xmp",
    "http://ns.adobe.com/xap/1.0/mm": "xmpMM",
    "http://ns.adobe.com/exif/1.0": "exif",
    "http://ns.adobe.com/tiff/1.0": "tiff",
    "http://www.w3.org/1999/02/22-rdf-syntax-ns#": "rdf",
}
_PACKET = re.compile(
    rb"<(?:\w+:)?xmpmeta\b.*?</(?:\w+:)?xmpmeta\s*>|<rdf:RDF\b.*?</rdf:RDF\s*>", re.DOTALL
)
_ATTRIBUTE = re.compile(r"([\w-]+:[\w-]+)\s*=\s*(?:\"([^\"<]*)\"|'([^'<]*)')")
_ELEMENT = re.compile(r"<([\w-]+:[\w-]+)[^<>]*>([^<>]*)</\1\s*>")


@dataclass(frozen=True, kw_only=True, eq=False)
class Xmp:
    """Values by `prefix:Name`, with the usual prefixes, whatever prefixes the file uses."""

    values: Mapping[str, str] = field(default_factory=dict)
    """All simple properties; the items of a list are joined by commas."""
    broken: bool = False
    """There was a packet, but it was not XML; values found by a text search are in `values`."""

    def text(self, *names: str) -> str:
        """The first of `names` that is present and not empty; `Name` alone means any prefix."""
        for name in names:
            keys = (
                [name] if ":" in name else [k for k in self.values if k.partition(":")[2] == name]
            )
            for key in keys:
                if found := self.values.get(key, "").strip():
                    return found
        return ""

    def number(self, *names: str) -> float | None:
        """The first of `names` that is a finite number, also `a/b`; else None."""
        for name in names:
            if (number := parse_number(self.text(name))) is not None:
                return number
        return None

    def numbers(self, name: str) -> tuple[float, ...]:
        """A list such as `1.0,2.0`; empty where an item is not a number."""
        items = [parse_number(part) for part in re.split(r"[,\s]+", self.text(name)) if part]
        return () if None in items else tuple(i for i in items if i is not None)


def parse_number(text: str) -> float | None:
    """A finite number from `+39.80`, `-1`, `3/4`; None for anything else."""
    top, _, bottom = text.strip().partition("/")
    try:
        number = float(top) / float(bottom) if bottom else float(top)
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def parse_xmp(packets: Sequence[bytes]) -> Xmp:
    """Properties of all packets; an earlier packet wins. Never raises."""
    values: dict[str, str] = {}
    broken = False
    for packet in packets:
        try:
            found = dict(_properties(ElementTree.fromstring(_body(packet))))
        except (
            Exception
        ):  # not XML, or forbidden XML: a text search still finds plain name="value" pairs
            found, broken = _searched(packet), True
        values = {**found, **values}
    return Xmp(values=values, broken=broken)


def _body(packet: bytes) -> bytes:
    found = _PACKET.search(packet)
    return found.group() if found else packet


def _name(tag: str) -> str:
    uri, _, local = tag[1:].partition("}") if tag.startswith("{") else ("", "", tag)
    key = uri.rstrip("/")
    return f"{_KNOWN.get(key) or _KNOWN.get(key.lower()) or key.rsplit('/', 1)[-1]}:{local}"


def _properties(root: Any) -> Iterator[tuple[str, str]]:
    """Attributes and elements of every rdf:Description, outermost last so that it wins."""
    for node in reversed(list(root.iter())):
        if _name(node.tag) == "rdf:Description":
            yield from ((_name(k), v) for k, v in node.attrib.items())
            for child in node:
                yield _name(child.tag), _value(child)


def _value(node: Any) -> str:
    items = [i.text.strip() for i in node.iter() if _name(i.tag) == "rdf:li" and i.text]
    return ",".join(items) if items else (node.text or "").strip()


def _searched(packet: bytes) -> dict[str, str]:
    text = packet.decode("utf-8", "replace")
    pairs = [(m[1], m[2] or m[3] or "") for m in _ATTRIBUTE.finditer(text)]
    return dict(pairs + [(m[1], m[2]) for m in _ELEMENT.finditer(text)])
