"""Inputs that were made to break the program."""

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "attacks"
needs_attacks = pytest.mark.skipif(not SHARED.is_dir(), reason="shared/data/attacks is not there")


def jpeg(width=64, height=48, *segments, **options):
    """A JPEG of one grey with segments (marker, payload)."""
    buffer = io.BytesIO()
    Image.fromarray(np.full((height, width, 3), 90, np.uint8)).save(buffer, "JPEG", **options)
    data = buffer.getvalue()
    more = b"".join(b"\xff" + bytes([m]) + struct.pack(">H", len(p) + 2) + p for m, p in segments)
    return data[:2] + more + data[2:]


def xmp(**values):
    """An XMP segment with properties of DJI."""
    said = " ".join(f'drone-dji:{k}="{v}"' for k, v in values.items())
    packet = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        f' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {said}/></rdf:RDF></x:xmpmeta>'
    )
    return 0xE1, b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()


def deflated_zeros(size):
    """What zlib makes of so many zeros, without packing each of them: equal pieces in a row."""
    packer, piece = zlib.compressobj(9, zlib.DEFLATED, -15), 2**20
    block = packer.compress(bytes(piece)) + packer.flush(zlib.Z_FULL_FLUSH)
    last = packer.compress(bytes(size % piece)) + packer.flush()
    check = (size % 65521) << 16 | 1  # Adler's sum of zeros
    return b"\x78\xda" + block * (size // piece) + last + check.to_bytes(4, "big")


def resident_mb():
    """Resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
