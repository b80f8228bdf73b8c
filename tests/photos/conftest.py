"""Small image files with metadata written by other libraries than the ones that read them here."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import piexif
import pytest
from PIL import Image

MakeJpeg = Callable[..., Path]


def pixels(width: int = 96, height: int = 64, seed: int = 0) -> np.ndarray:
    """Smooth, coloured, not symmetric."""
    rows, columns = np.mgrid[0:height, 0:width]
    noise = np.random.default_rng(seed).normal(0, 6, (height, width))
    bands = [120 + 80 * np.sin(columns / 9 + seed), 60 + 2 * rows, 40 + columns + noise]
    return np.clip(np.stack(bands, -1), 0, 255).astype(np.uint8)


def jpeg_bytes(
    image: np.ndarray, exif: Mapping[str, Any] | None = None, xmp: str | None = None
) -> bytes:
    """A JPEG with piexif's EXIF and an XMP packet in its own APP1 segment."""
    buffer = io.BytesIO()
    block = piexif.dump(dict(exif)) if exif else b""
    Image.fromarray(image).save(buffer, "JPEG", quality=92, **({"exif": block} if block else {}))
    data = buffer.getvalue()
    if xmp is None:
        return data
    return with_segment(data, 0xE1, b"http://ns.adobe.com/xap/1.0/\x00" + xmp.encode())


def with_segment(data: bytes, marker: int, payload: bytes) -> bytes:
    """The JPEG with one more segment right behind its start."""
    segment = bytes([0xFF, marker]) + (len(payload) + 2).to_bytes(2, "big") + payload
    return data[:2] + segment + data[2:]


def gps_exif(latitude: float, longitude: float, altitude: float = 100.0) -> dict[int, Any]:
    """The GPS directory as piexif wants it."""

    def sexagesimal(value: float) -> tuple[tuple[int, int], ...]:
        degrees, rest = divmod(abs(value), 1)
        minutes, rest = divmod(rest * 60, 1)
        return (int(degrees), 1), (int(minutes), 1), (round(rest * 60 * 100_000), 100_000)

    return {
        piexif.GPSIFD.GPSLatitudeRef: "N" if latitude >= 0 else "S",
        piexif.GPSIFD.GPSLatitude: sexagesimal(latitude),
        piexif.GPSIFD.GPSLongitudeRef: "E" if longitude >= 0 else "W",
        piexif.GPSIFD.GPSLongitude: sexagesimal(longitude),
        piexif.GPSIFD.GPSAltitudeRef: int(altitude < 0),
        piexif.GPSIFD.GPSAltitude: (round(abs(altitude) * 1000), 1000),
    }


def dji_exif(**changes: Any) -> dict[str, Any]:
    """A Phantom 3's EXIF at 46.5 N, 92 W."""
    exif: dict[str, Any] = {
        "0th": {piexif.ImageIFD.Make: "DJI", piexif.ImageIFD.Model: "FC300S"},
        "Exif": {
            piexif.ExifIFD.FocalLength: (361, 100),
            piexif.ExifIFD.DateTimeOriginal: "2016:06:23 16:31:59",
        },
        "GPS": gps_exif(46.5, -92.0, 198.3),
    }
    for directory, tags in changes.items():
        exif.setdefault(directory, {}).update(tags)
    return exif


def dji_xmp(form: str = "attributes", prefix: str = "drone-dji", **values: Any) -> str:
    """An XMP packet of DJI's names in attribute or element form."""
    uri = "http://www.dji.com/drone-dji/1.0/"
    if form == "attributes":
        inner = "".join(f' {prefix}:{k}="{v}"' for k, v in values.items()) + "/>"
    else:
        inner = ">" + "".join(f"<{prefix}:{k}>{v}</{prefix}:{k}>" for k, v in values.items())
        inner += "</rdf:Description>"
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:{prefix}="{uri}"{inner}'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    )


@pytest.fixture
def make_jpeg(tmp_path: Path) -> MakeJpeg:
    """Writes a JPEG under the test's folder: name, exif, xmp, image or seed."""

    def make(
        name: str = "a.jpg",
        *,
        exif: Mapping[str, Any] | None = None,
        xmp: str | None = None,
        image: np.ndarray | None = None,
        seed: int = 0,
    ) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(jpeg_bytes(pixels(seed=seed) if image is None else image, exif, xmp))
        return path

    return make
