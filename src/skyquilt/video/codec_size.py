"""The size of frames that the header of a codec states, in the description of an MP4 or MOV track.

A decoder allocates frames by this header, whatever the container says: so it is read before
anything is decoded. H.264: ITU-T H.264, 7.3.2.1; H.265: ITU-T H.265, 7.3.2.2; MPEG-4: ISO/IEC
14496-2, 6.2.3.
"""

from collections.abc import Callable, Iterator

Size = tuple[int, int]
_HIGH = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135})
"""Profiles of H.264 whose headers tell the format of colours."""
_MOST_ZEROS = 32
_SPS_H265, _SEPARATE, _OWN_ASPECT = 33, 3, 15


class _Bits:
    """Reads a header bit by bit; raises `EOFError` at its end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, count: int) -> int:
        """An unsigned number of some bits."""
        end = self._at + count
        if end > 8 * len(self._data):
            raise EOFError
        first, last = self._at // 8, -(-end // 8)
        number = int.from_bytes(self._data[first:last], "big") >> (8 * last - end)
        self._at = end
        return number & ((1 << count) - 1)

    def golomb(self) -> int:
        """A number in the exponential Golomb code."""
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > _MOST_ZEROS:
                raise EOFError
        return (1 << zeros) - 1 + self.take(zeros)

    def signed(self) -> int:
        """A signed number in the exponential Golomb code."""
        number = self.golomb()
        return (number + 1) // 2 if number % 2 else -(number // 2)


def codec_sizes(description: bytes) -> list[Size]:
    """Widths and heights in px that the codec headers within a sample description (`stsd`) state;
    none where there is none that is known.
    """
    found = []
    for read, header in _headers(description):
        try:
            found.append(read(_Bits(_plain(header))))
        except EOFError:
            continue
    return found


def _headers(description: bytes) -> Iterator[tuple[Callable[[_Bits], Size], bytes]]:
    """Readers, each with the header that it reads."""
    if (at := description.find(b"avcC")) > 0:  # after six bytes: SPS with their lengths
        sets = int.from_bytes(description[at + 9 : at + 10], "big") & 0x1F
        for unit in _units(description, at + 10, sets):
            yield _h264, unit[1:]
    if (at := description.find(b"hvcC")) > 0:  # after 23 bytes: arrays of units of a kind
        arrays, place = int.from_bytes(description[at + 26 : at + 27], "big"), at + 27
        for _ in range(arrays):
            head = description[place : place + 3]
            count = int.from_bytes(head[1:], "big")
            units = list(_units(description, place + 3, count))
            place += 3 + sum(2 + len(u) for u in units)
            if head[:1] and head[0] & 0x3F == _SPS_H265:
                yield from ((_h265, u[2:]) for u in units)
    at = description.find(b"esds")
    while at > 0 and (at := description.find(b"\0\0\1", at + 1)) > 0:
        if 0x20 <= int.from_bytes(description[at + 3 : at + 4], "big") <= 0x2F:
            yield _mpeg4, description[at + 4 :]


def _units(data: bytes, place: int, count: int) -> Iterator[bytes]:
    """Units that follow one another, each after its length in two bytes."""
    for _ in range(count):
        length = int.from_bytes(data[place : place + 2], "big")
        if length == 0:
            return
        yield data[place + 2 : place + 2 + length]
        place += 2 + length


def _plain(unit: bytes) -> bytes:
    """A unit without the bytes that keep start codes from appearing in it."""
    return unit.replace(b"\0\0\3", b"\0\0")


def _h264(bits: _Bits) -> Size:
    profile = bits.take(8)
    bits.take(16)
    bits.golomb()
    if profile in _HIGH:
        colours = bits.golomb()
        if colours == _SEPARATE:
            bits.take(1)
        bits.golomb()
        bits.golomb()
        bits.take(1)
        if bits.take(1):
            _skip_scaling(bits, 12 if colours == _SEPARATE else 8)
    bits.golomb()
    order = bits.golomb()
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.take(1)
        for _ in range(2):
            bits.golomb()
        for _ in range(bits.golomb() & 0xFF):
            bits.golomb()
    bits.golomb()
    bits.take(1)
    width, height = 16 * (bits.golomb() + 1), 16 * (bits.golomb() + 1)
    return width, height if bits.take(1) else 2 * height


def _skip_scaling(bits: _Bits, lists: int) -> None:
    """Goes past lists of factors; 7.3.2.1.1.1."""
    for k in range(lists):
        if not bits.take(1):
            continue
        last = following = 8
        for _ in range(16 if k < 6 else 64):
            if following:
                following = (last + bits.signed()) % 256
            last = following or last


def _h265(bits: _Bits) -> Size:
    bits.take(4)
    layers = bits.take(3)
    bits.take(1 + 96)
    present = [(bits.take(1), bits.take(1)) for _ in range(layers)]
    if layers:
        bits.take(2 * (8 - layers))
    for profile, level in present:
        bits.take(88 * profile + 8 * level)
    bits.golomb()
    if bits.golomb() == _SEPARATE:
        bits.take(1)
    return bits.golomb(), bits.golomb()


def _mpeg4(bits: _Bits) -> Size:
    bits.take(1 + 8)
    if bits.take(1):
        bits.take(4 + 3)
    if bits.take(4) == _OWN_ASPECT:
        bits.take(16)
    if bits.take(1):
        bits.take(3)
        if bits.take(1):
            bits.take(79)
    if bits.take(2):
        raise EOFError  # not rectangular: no decoder of ours takes it
    bits.take(1)
    ticks = bits.take(16)
    bits.take(1)
    if bits.take(1):
        bits.take(max(1, (ticks - 1).bit_length()))
    bits.take(1)
    width = bits.take(13)
    bits.take(1)
    return width, bits.take(13)
