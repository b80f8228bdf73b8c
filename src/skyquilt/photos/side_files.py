"""Which side file is which."""

from collections.abc import Sequence
from pathlib import Path

from skyquilt.model.photo import Photo
from skyquilt.photos.geo_txt import read_geo_txt
from skyquilt.photos.mrk import read_mrk
from skyquilt.photos.positions_csv import read_positions_csv
from skyquilt.photos.side_rows import apply_rows
from skyquilt.photos.srt import read_srt


def apply_positions(
    photos: Sequence[Photo], file: Path
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos as `.csv`, `.mrk`, `.srt` or (any other ending) `geo.txt` places them, and notes.

    Raises `SideFileError` where the file is malformed or knows none of the photos.
    """
    ending = file.suffix.lower()
    if ending == ".csv":
        return apply_rows(photos, read_positions_csv(file), file=file, source="csv")
    if ending == ".mrk":
        return apply_rows(photos, read_mrk(file, [p.name for p in photos]), file=file, source="mrk")
    if ending == ".srt":
        return apply_rows(photos, read_srt(file, photos), file=file, source="srt")
    return apply_rows(photos, read_geo_txt(file), file=file, source="geo.txt")
