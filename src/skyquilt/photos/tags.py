"""EXIF tags and XMP packets as numbers and text; broken values are treated as absent."""

import io
import math
import re
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from typing import Any, BinaryIO

from defusedxml import ElementTree

from skyquilt.model.bands import canonical
from skyquilt.outside import plain, real

EXIF_IFD, GPS_IFD = 0x8769, 0x8825

MAKE, MODEL, SOFTWARE, ORIENTATION, MODIFIED = 0x010F, 0x0110, 0x0131, 0x0112, 0x0132
DESCRIPTION, GDAL_METADATA = 0x010E, 42112
PIXEL_SCALE, PIXEL_MATRIX, GEO_KEYS = 33550, 34264, 34735
TAKEN, SUBSEC, OFFSET = 0x9003, 0x9291, 0x9011
FOCAL_MM, FOCAL_35MM, ZOOM = 0x920A, 0xA405, 0xA404
PLANE_X, PLANE_UNIT = 0xA20E, 0xA210
PIXELS_X, PIXELS_Y = 0xA002, 0xA003
SERIAL, LENS = 0xA431, 0xA434
EXPOSURE_S, F_NUMBER, ISO, ISO_SPEED = 0x829A, 0x829D, 0x8827, 0x8833
BITS, BLACK_LEVEL = 258, 50714
GPS_LAT_REF, GPS_LAT, GPS_LON_REF, GPS_LON, GPS_ALT_REF, GPS_ALT = 1, 2, 3, 4, 5, 6
GPS_TIME, GPS_ERROR, GPS_DATE, GPS_DIRECTION = 7, 0x1F, 0x1D, 0x11
GPS_STATUS, GPS_MODE, GPS_DILUTION = 9, 10, 11


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
    """Text up to the first NUL, stripped, in one line without control characters; empty for other
    types.
    """
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return plain(value.split("\x00")[0].strip(), MOST_TEXT) if isinstance(value, str) else ""


def as_number(value: Any) -> float | None:
    """A finite float from a number, rational or one-element tuple; else None."""
    if isinstance(value, (tuple, list)):
        value = value[0] if len(value) == 1 else None
    if isinstance(value, bytes):
        value = value[0] if len(value) == 1 else None
    return real(value)


def parse_exif(block: bytes) -> Exif:
    """Tags of an EXIF block as stored in a JPEG or PNG (a TIFF header and directories)."""
    return read_tiff_tags(io.BytesIO(block)) if block else Exif()


MOST_VALUE = 1 << 16
"""Largest value of a tag in bytes."""
MOST_TEXT = 4000
"""Largest number of characters of a text."""
MOST_ENTRIES = 4096
"""Largest number of tags of a directory."""
_COUNT_TAGS = frozenset({EXPOSURE_S, F_NUMBER, ISO, ISO_SPEED, BLACK_LEVEL})
"""How counts came about; cameras write these into either directory."""
_IMAGE_TAGS = _COUNT_TAGS | frozenset(
    {MAKE, MODEL, SOFTWARE, ORIENTATION, MODIFIED, DESCRIPTION, GDAL_METADATA, EXIF_IFD, GPS_IFD}
    | {PIXEL_SCALE, PIXEL_MATRIX, GEO_KEYS, BITS}
)
_EXIF_TAGS = _COUNT_TAGS | frozenset(
    {TAKEN, SUBSEC, OFFSET, FOCAL_MM, FOCAL_35MM, ZOOM, PLANE_X, PLANE_UNIT, PIXELS_X, PIXELS_Y}
    | {SERIAL, LENS}
)
_GPS_TAGS = frozenset(
    {GPS_LAT_REF, GPS_LAT, GPS_LON_REF, GPS_LON, GPS_ALT_REF, GPS_ALT, GPS_TIME, GPS_ERROR}
    | {GPS_DATE, GPS_DIRECTION, GPS_STATUS, GPS_MODE, GPS_DILUTION}
)
_FORMS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii"} | {
    11: "f",
    12: "d",
    13: "I",
    16: "Q",
    17: "q",
    18: "Q",
}
"""Type of a value in a directory -> format of `struct`."""


class Directories:
    """The directories of a TIFF file or EXIF block (TIFF 6.0; BigTIFF). Only tags that are asked
    for are read, and only values of limited size, so the work does not depend on what a file
    claims.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Reads the header; raises `ValueError` where there is none."""
        self.file = file
        file.seek(0)
        head = file.read(16)
        self.order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
        magic = struct.unpack(self.order + "H", head[2:4])[0] if len(head) >= 8 else 0
        if not self.order or magic not in (42, 43):
            raise ValueError("it has no TIFF header")
        self.big = magic == 43
        form, at = ("Q", 8) if self.big else ("I", 4)
        self.first = int(struct.unpack_from(self.order + form, head.ljust(16, b"\0"), at)[0])
        self.counts: dict[int, int] = {}
        """Number of values of each tag met in the directory read last."""

    def read(self, offset: int, wanted: Collection[int]) -> dict[int, Any]:
        """The wanted tags of a directory; numbers as numbers or tuples, rationals as real numbers.

        Raises `ValueError` where the directory lies outside the file; broken values are absent.
        """
        number, entry, inline, field_ = (8, 20, 8, "HHQ") if self.big else (2, 12, 4, "HHI")
        self.file.seek(offset)
        head = self.file.read(number)
        if len(head) < number:
            raise ValueError("a directory lies outside the file")
        entries = int.from_bytes(head, "little" if self.order == "<" else "big")
        body = self.file.read(min(entries, MOST_ENTRIES) * entry)
        found: dict[int, Any] = {}
        self.counts = {}
        for at in range(0, len(body) - entry + 1, entry):
            tag, kind, count = struct.unpack_from(self.order + field_, body, at)
            self.counts[tag] = count
            if tag not in wanted or kind not in _FORMS:
                continue
            size = struct.calcsize("<" + _FORMS[kind]) * count
            raw = body[at + entry - inline : at + entry]
            if size > MOST_VALUE:
                continue
            if size > inline:
                self.file.seek(struct.unpack(self.order + ("Q" if self.big else "I"), raw)[0])
                raw = self.file.read(size)
            if len(raw) >= size and count:
                found.setdefault(tag, self._value(kind, count, raw[:size]))
        return found

    def _value(self, kind: int, count: int, raw: bytes) -> Any:
        if kind in (1, 7):
            return raw
        if kind == 2:
            return raw.removesuffix(b"\0").decode("latin-1")
        numbers = struct.unpack(f"{self.order}{count * len(_FORMS[kind])}{_FORMS[kind][0]}", raw)
        if kind in (5, 10):
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            numbers = tuple(a / b if b else math.nan for a, b in pairs)
        return numbers[0] if count == 1 else numbers


def read_tiff_tags(file: BinaryIO) -> Exif:
    """Tags of a TIFF file or block, read from its directories only; never raises."""
    try:
        directories = Directories(file)
        tags = directories.read(directories.first, _IMAGE_TAGS)
    except (ValueError, OSError, struct.error, OverflowError):
        return Exif(broken=True)
    exif = _below(directories, tags, EXIF_IFD, _EXIF_TAGS)
    return Exif(tags={**tags, **exif}, gps=_below(directories, tags, GPS_IFD, _GPS_TAGS))


def _below(
    directories: Directories, tags: Mapping[int, Any], which: int, wanted: Collection[int]
) -> dict[int, Any]:
    """The directory to which a tag points; empty where it is broken: one broken directory does not
    affect the others.
    """
    at = tags.get(which)
    try:
        return directories.read(at, wanted) if isinstance(at, int) else {}
    except (ValueError, OSError, struct.error, OverflowError):
        return {}


NO_FIX = "Its receiver measured no position then, and wrote an earlier one (GPSStatus V)."
NO_HEIGHT = "Its receiver measured no height then (GPSMeasureMode 2)."
"""Notes of photos whose GPS directory says so."""
DILUTIONS = 5.0, 20.0
"""Dilution of precision up to which positions err as usual, and from which they err no more."""


def unmeasured(exif: Exif) -> list[str]:
    """Those of the notes above that apply."""
    void = as_text(exif.gps.get(GPS_STATUS)).upper() == "V"
    flat = as_text(exif.gps.get(GPS_MODE)) == "2"
    return [NO_FIX] * void + [NO_HEIGHT] * flat


def dilution(exif: Exif) -> float:
    """Factor by which few satellites widen the deviations of the position."""
    usual, most = DILUTIONS
    return min(max(as_number(exif.gps.get(GPS_DILUTION)) or 0.0, usual), most) / usual


_KNOWN = {
    "ns.adobe.com/xap/1.0": "xmp",
    "ns.adobe.com/xap/1.0/mm": "xmpMM",
    "ns.flir.com/xmp/1.0": "FLIR",
    "www.w3.org/1999/02/22-rdf-syntax-ns#": "rdf",
}
"""Usual prefixes of namespaces, without scheme, whose address does not name them."""
_CAMERA = re.compile(r"(?:.*/)?camera/[\d.]+", re.IGNORECASE)
"""Addresses of the namespace that Pix4D defined, and that others (senseFly) write under their own
name; those of phones end in `camera`.
"""
_VERSION = re.compile(r"v?[\d.]+")
MOST_XMP = 1 << 20
"""Largest XMP packet in bytes that is parsed."""
MOST_NODES = 200_000
"""Largest number of XML elements of one packet that are visited."""
_ENVELOPES = tuple(
    (re.compile(begin), re.compile(end))
    for begin, end in (
        (rb"<(?:\w{1,30}+:)?xmpmeta\b", rb"</(?:\w{1,30}+:)?xmpmeta\s{0,9}+>"),
        (rb"<rdf:RDF\b", rb"</rdf:RDF\s{0,9}+>"),
    )
)
# possessive (++) and looking behind: each character is read a fixed number of times
_NAMED = r"(?<![\w-])([\w-]++:[\w-]++)"
_ATTRIBUTE = re.compile(_NAMED + r"\s*+=\s*+(?:\"([^\"<]*+)\"|'([^'<]*+)')")
_ELEMENT = re.compile(r"<([\w-]++:[\w-]++)[^<>]*+>([^<>]*+)</([\w-]++:[\w-]++)\s*+>")


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


def band_name(xmp: Xmp) -> str:
    """The name of the band that a file shows, in lower case; empty where it tells none."""
    return plain(" ".join(xmp.text("Camera:BandName", "BandName").lower().split()), 40)


def band_shown(xmp: Xmp) -> str:
    """The band that a file shows: `canonical` of its name, or of its wavelength where it has none;
    empty where it tells neither.
    """
    name = band_name(xmp)
    return canonical(name, None if name else xmp.number("CentralWavelength"))


def parse_number(text: str) -> float | None:
    """A finite number from `+39.80`, `-1`, `3/4`; None for anything else."""
    top, slash, bottom = text.partition("/")
    above, below = real(top), real(bottom) if slash else 1.0
    return real(above / below) if above is not None and below else None


def parse_xmp(packets: Sequence[bytes]) -> Xmp:
    """Properties of all packets; an earlier packet wins. Never raises."""
    values: dict[str, str] = {}
    broken = False
    for packet in packets:
        if len(packet) > MOST_XMP:
            broken = True
            continue
        try:
            found = dict(_properties(ElementTree.fromstring(_body(packet))))
        except (
            Exception
        ):  # not XML, or forbidden XML: a text search still finds plain name="value" pairs
            found, broken = _searched(packet), True
        values = {**found, **values}
    return Xmp(values={k: plain(v, MOST_TEXT) for k, v in values.items()}, broken=broken)


def _body(packet: bytes) -> bytes:
    """The first complete envelope in a packet; the packet where there is none."""
    for begin, end in _ENVELOPES:
        first = begin.search(packet)
        last = end.search(packet, first.end()) if first else None
        if first and last:
            return packet[first.start() : last.end()]
    return packet


def _name(tag: str) -> str:
    uri, _, local = tag[1:].partition("}") if tag.startswith("{") else ("", "", tag)
    return f"{_prefix(uri)}:{local}"


@lru_cache(maxsize=256)
def _prefix(uri: str) -> str:
    """The usual prefix of a namespace: the last part of its address that is no version number."""
    place = uri.partition("://")[2] or uri
    place = place.rstrip("/")
    if known := _KNOWN.get(place.lower()):
        return known
    if _CAMERA.fullmatch(place):
        return "Camera"
    words = [w for w in place.split("/") if w and not _VERSION.fullmatch(w)]
    return words[-1] if words else place


def _properties(root: Any) -> Iterator[tuple[str, str]]:
    """Attributes and elements of every rdf:Description, outermost last so that it wins; fields of
    structures as `prefix:Structure.Field`.
    """
    visits = iter(range(MOST_NODES))
    nodes = list(islice(root.iter(), MOST_NODES))
    for node in reversed([n for n in nodes if _name(n.tag) == "rdf:Description"]):
        yield from ((_name(k), v) for k, v in node.attrib.items())
        for child in node:
            yield _name(child.tag), _value(child, visits)
            yield from _fields(child)


def _fields(node: Any) -> Iterator[tuple[str, str]]:
    """The fields of a structure, written as attributes of its element, as elements in it, or either
    of a description in it.
    """
    name = _name(node.tag)
    for inner in (node, *(c for c in node if _name(c.tag) == "rdf:Description")):
        pairs = [*inner.attrib.items(), *((c.tag, c.text or "") for c in inner if not len(c))]
        for key, value in pairs:
            prefix, _, field_ = _name(key).partition(":")
            if prefix not in ("rdf", "namespace"):  # the latter is that of xml:lang
                yield f"{name}.{field_}", value.strip()


def _value(node: Any, visits: Iterator[int]) -> str:
    """Text of an element, or the items of its list; `visits` counts how many elements may still be
    visited, since nested elements are visited once for each level.
    """
    inside = (i for i, _ in zip(node.iter(), visits, strict=False))
    items = [i.text.strip() for i in inside if _name(i.tag) == "rdf:li" and i.text]
    return ",".join(items) if items else (node.text or "").strip()


def _searched(packet: bytes) -> dict[str, str]:
    text = packet.decode("utf-8", "replace")
    pairs = [(m[1], m[2] or m[3] or "") for m in _ATTRIBUTE.finditer(text)]
    return dict(pairs + [(m[1], m[2]) for m in _ELEMENT.finditer(text) if m[1] == m[3]])


_TEXTS = {MAKE: "tiff:Make", MODEL: "tiff:Model", SERIAL: "aux:SerialNumber", LENS: "aux:Lens"}
_NUMBERS = {
    FOCAL_MM: "exif:FocalLength",
    FOCAL_35MM: "exif:FocalLengthIn35mmFilm",
    ZOOM: "exif:DigitalZoomRatio",
    PLANE_X: "exif:FocalPlaneXResolution",
    PLANE_UNIT: "exif:FocalPlaneResolutionUnit",
    PIXELS_X: "exif:PixelXDimension",
    PIXELS_Y: "exif:PixelYDimension",
}
_PART = r"(\d{1,3}(?:\.\d{1,15})?)"
_ANGLE = re.compile(rf"{_PART}(?:,{_PART})?(?:,{_PART})?\s?([NSEWnsew])", re.ASCII)
"""Degrees as XMP writes them: `46,35.985N` or `46,35,59.1N`."""


def with_xmp(exif: Exif, xmp: Xmp) -> Exif:
    """The tags, and those of XMP's `tiff` and `exif` for what is absent; a position as a whole."""
    told: dict[int, Any] = {t: text for t, name in _TEXTS.items() if (text := xmp.text(name))}
    numbers = {t: parse_number(xmp.text(name)) for t, name in _NUMBERS.items()}
    told |= {t: number for t, number in numbers.items() if number is not None}
    if (turned := parse_number(xmp.text("tiff:Orientation"))) is not None:
        told[ORIENTATION] = int(turned)
    missing = {t: value for t, value in told.items() if t not in exif.tags}
    places = {} if GPS_LAT in exif.gps or GPS_LON in exif.gps else _places(xmp)
    if not missing and not places:
        return exif
    return replace(exif, tags={**exif.tags, **missing}, gps={**exif.gps, **places})


def _places(xmp: Xmp) -> dict[int, Any]:
    """The position in XMP as a GPS directory; empty where it is not whole."""
    found: dict[int, Any] = {}
    axes = (("exif:GPSLatitude", GPS_LAT, GPS_LAT_REF), ("exif:GPSLongitude", GPS_LON, GPS_LON_REF))
    for name, value, reference in axes:
        parts = _ANGLE.fullmatch(xmp.text(name))
        if parts is None:
            return {}
        found[value] = tuple(float(p) for p in parts.groups()[:3] if p is not None)
        found[reference] = parts[4]
    height = parse_number(xmp.text("exif:GPSAltitude"))
    if height is not None:
        found[GPS_ALT] = height
        found[GPS_ALT_REF] = int(parse_number(xmp.text("exif:GPSAltitudeRef")) or 0)
    return found
