"""Mutations that know the structure of inputs: JPEG segments, TIFF directories, words of text."""

import random
import re
import struct

ODD_NUMBERS = (
    b"0",
    b"-1",
    b"1e999",
    b"NaN",
    b"-inf",
    b"1e308",
    b"9" * 400,
    "²".encode(),
    "١٢".encode(),
    b"0x10",
    b"1_0",
    b"00000000000012000",
    b"2147483648",
    b"9223372036854775808",
    b"-0.0000001",
    b"",
    b"/0",
)
"""Numbers that readers may not expect."""
ODD_TEXT = (
    b"\x00",
    b"\x1b[2J",
    b"[/y]",
    b"\xff\xfe",
    "\u202e".encode(),
    b'"',
    b"'",
    b"<",
    b"&#0;",
    b"%s%n",
    b"../../../",
    b"a" * 5000,
    b"{" * 2000,
    b"[" * 2000,
    b",,,,",
    b"\r\n\r\n",
    b"\\ud800",
)
"""Text that readers may not expect."""
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?")
_WORD = re.compile(rb"[\w.:-]+|[^\w\s]")


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to four mutations, chosen by what the data look like."""
    for _ in range(rng.randint(1, 4)):
        data = rng.choice(_fitting(data))(data, rng)
    return data


def _fitting(data):
    if data[:2] == b"\xff\xd8":
        return (_jpeg, _jpeg, _bytes, _tiff)
    if data[:2] in (b"II", b"MM"):
        return (_tiff, _tiff, _bytes)
    if data[:4] == b"\x89PNG":
        return (_png, _png, _bytes)
    return (_numbers, _words, _lines, _bytes)


def _bytes(data, rng):
    """Flips, removes, repeats or inserts a few bytes anywhere."""
    body = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(body) + 1)
        kind = rng.randrange(4)
        if kind == 0 and at < len(body):
            body[at] = rng.randrange(256)
        elif kind == 1:
            del body[at : at + rng.randint(1, 16)]
        elif kind == 2:
            body[at:at] = body[at : at + rng.randint(1, 64)]
        else:
            body[at:at] = rng.choice(ODD_TEXT)
    return bytes(body)


def _numbers(data, rng):
    """Replaces a number by an odd one."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return _bytes(data, rng)
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(ODD_NUMBERS) + data[one.end() :]


def _words(data, rng):
    """Replaces, removes or repeats a token."""
    found = list(_WORD.finditer(data[:20_000]))
    if not found:
        return _bytes(data, rng)
    one = rng.choice(found)
    other = rng.choice((b"", one[0] * 2, one[0] * 200, rng.choice(ODD_TEXT), rng.choice(found)[0]))
    return data[: one.start()] + other + data[one.end() :]


def _lines(data, rng):
    """Removes, repeats or exchanges lines."""
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at:at] = [lines[other]] * rng.choice((1, 2, 50))
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)


def _jpeg(data, rng):
    """Changes a segment: its length, its content, its place; or the size in the frame header."""
    segments, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] not in (0xDA, 0xD9):
        size = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        segments.append((at, at + size, data[at + 1]))
        at += size
    if not segments:
        return _bytes(data, rng)
    start, end, marker = rng.choice(segments)
    body = data[start:end]
    kind = rng.randrange(5)
    if 0xC0 <= marker <= 0xC2 and kind < 3:
        size = struct.pack(">HH", rng.choice((0, 1, 31, 400, 65535)), rng.choice((1, 300, 65500)))
        body = body[:5] + size + body[9:]
    elif kind == 0:
        body = body[:2] + struct.pack(">H", rng.randrange(65536)) + body[4:]
    elif kind == 1:
        body = b""
    elif kind == 2:
        body = body * rng.choice((2, 3, 40))
    elif len(body) > 4:  # what is inside: EXIF is a TIFF, XMP is text
        inner = body[4:]
        exif = inner.find(b"II*\0") if b"II*\0" in inner else inner.find(b"MM\0*")
        changed = inner[:exif] + _tiff(inner[exif:], rng) if exif >= 0 else _numbers(inner, rng)
        body = body[:2] + struct.pack(">H", min(65535, len(changed) + 2)) + changed[:65533]
    return data[:start] + body + data[end:]


def _tiff(data, rng):
    """Changes a directory entry: tag, type, count, value; or the offset of a directory."""
    order = "<" if data[:2] == b"II" else ">"
    if len(data) < 16:
        return _bytes(data, rng)
    at = struct.unpack_from(order + "I", data, 4)[0]
    if rng.random() < 0.1 or at + 14 > len(data):
        offset = rng.choice((0, 4, 8, len(data), 2**32 - 1, rng.randrange(len(data))))
        return data[:4] + struct.pack(order + "I", offset) + data[8:]
    count = struct.unpack_from(order + "H", data, at)[0]
    entry = at + 2 + 12 * rng.randrange(max(1, count))
    if entry + 12 > len(data):
        return _bytes(data, rng)
    tag, kind, number, value = struct.unpack_from(order + "HHII", data, entry)
    change = rng.randrange(4)
    if change == 0:
        kind = rng.randrange(19)
    elif change == 1:
        number = rng.choice((0, 1, 2, 65535, 2**31, 2**32 - 1))
    elif change == 2:
        value = rng.choice((0, 1, 8, entry, len(data) - 1, 300_000, 2**32 - 1, rng.getrandbits(32)))
    else:
        tag = rng.choice((256, 257, 258, 259, 273, 277, 279, 0x8769, 0x8825, 700, 284, 339))
    return data[:entry] + struct.pack(order + "HHII", tag, kind, number, value) + data[entry + 12 :]


def _png(data, rng):
    """Changes the declared size, or a chunk's length."""
    if len(data) < 33:
        return _bytes(data, rng)
    if rng.random() < 0.5:
        size = struct.pack(">II", rng.choice((0, 31, 13_000, 2**31)), rng.choice((0, 64, 70_000)))
        return data[:16] + size + data[24:]
    at = data.find(rng.choice((b"IDAT", b"iTXt", b"eXIf", b"IEND")))
    if at < 4:
        return _bytes(data, rng)
    return data[: at - 4] + struct.pack(">I", rng.getrandbits(31)) + data[at:]
