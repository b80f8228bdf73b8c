"""Counts of fewer bits than their files have. A camera of 12 bits moves its counts up to the top of
the 16 bits of a file (MicaSense), or leaves them at the low end, as conversions do: then values are
a sixteenth of what they should be, and nothing counts as saturated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from skyquilt.multispectral.captures import BandFiles
from skyquilt.multispectral.recorded import Recorded

DETECTORS = (10, 12, 14)
"""Bits of the counts of detectors."""
FEWEST = 3
"""Files whose brightest count is the largest one of a detector, from which that is no chance."""


def depth_of(bands: Sequence[BandFiles], recorded: Mapping[str, Recorded]) -> tuple[int, str]:
    """Bits of the counts of a camera, where they are certainly fewer than those of its files, and a
    sentence where they may be; 0 and an empty one where counts reach further, or were moved up.
    """
    items = [(p, c) for b in bands for p, c in zip(b.photos, b.converts, strict=True)]
    known = [(recorded[p.name], c) for p, c in items if c.kind != "counts"]
    known = [(r, c) for r, c in known if r.brightest > 0]
    if not known or all(r.step > 1 for r, _ in known):
        return 0, ""
    brightest = max(r.brightest for r, _ in known)
    full = min(c.full for _, c in known)
    dark = max(c.black_level for _, c in known)
    bits = next((n for n in DETECTORS if max(brightest, dark) < 2**n), 0)
    if not bits or full < 2.0 ** (bits + 1):
        return 0, ""
    most, factor = 2**bits - 1, full / 2**bits
    if sum(r.brightest == most for r, _ in known) >= FEWEST:
        return bits, (
            f"Counts of all bands end at {most:,}: they are taken for counts of {bits} bits at the"
            " low end of their files."
        )
    return 0, (
        f"No count of any band is larger than {brightest:,.0f} of {full:,.0f}: if the camera has"
        f" {bits} bits, values are {factor:.0f} times as large as stated here, and saturated places"
        " are not told."
    )


def with_bits(band: BandFiles, bits: int) -> BandFiles:
    """The band with counts of so many bits; as it is where 0."""
    if not bits:
        return band
    return replace(band, converts=tuple(c.with_bits(bits) for c in band.converts))
