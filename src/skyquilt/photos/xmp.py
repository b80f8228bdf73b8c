"""XMP packets as plain names and values, whatever prefix or form the writer chose."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from defusedxml import ElementTree

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
    """Values by `prefix:Name`, with the usual prefixes whatever the file calls them."""

    values: Mapping[str, str] = field(default_factory=dict)
    """All simple properties; of a list the items joined by commas."""
    broken: bool = False
    """A packet was there but was no XML; what a search could recover is in `values`."""

    def text(self, *names: str) -> str:
        """The first of `names` that is there and not empty; `Name` alone means any prefix."""
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
        """A list such as `1.0,2.0`; empty where an item is no number."""
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
        ):  # not XML, or forbidden XML: a search still finds plain name="value" pairs
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
