"""The end of a flight: the batch workflow runs on the accepted photos, those of all bands too, and
reuses the features that were already computed.
"""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from skyquilt.errors import NoPhotosError
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import FINISHED, PHOTOS
from skyquilt.live.settings import LiveSettings
from skyquilt.model.event import Event, Note
from skyquilt.multispectral.workflow import iter_bands
from skyquilt.outside import is_file, remove_folder
from skyquilt.photos.side_rows import sentence_of
from skyquilt.settings import MosaicSettings

NAMED = "named"
"""Folder with links to the photos under readable names, for the files of the final map."""

RESERVED = {"con", "prn", "aux", "nul"} | {f"{p}{n}" for p in ("com", "lpt") for n in range(1, 10)}
"""Names of devices of Windows, which no file can have there, whatever its ending."""


def iter_finish(folder: Path, settings: LiveSettings) -> Iterator[Event]:
    """Makes the batch mosaic in `folder/finished`; the live map is not changed.

    Raises:
        SkyquiltError: as `iter_bands`; NoPhotosError if no photo was accepted.
    """
    ledger = Ledger(folder, write=False)
    try:
        rows = ledger.rows(
            "select id, name, file from photo where state not in ('superseded', 'refused') order by"
            " id"
        )
    finally:
        ledger.close()
    if not rows:
        raise NoPhotosError(f"{folder} holds no accepted photo; there is nothing to finish")
    paths, lost = named(folder, [(int(i), str(n), str(f)) for i, n, f in rows])
    if lost:
        yield Note(
            text=f"the files of {len(lost)} accepted photos are gone from {folder / PHOTOS}; the"
            f" final map is made without them: {sentence_of(lost)}",
            warning=True,
        )
    if not paths:
        raise NoPhotosError(
            f"all photos are gone from {folder / PHOTOS}; there is nothing to finish"
        )
    wanted = MosaicSettings(
        features=settings.features,
        crs=settings.crs,
        thermal_unit=settings.thermal_unit,
        band=settings.band,
        shutter=settings.shutter,
        shutter_readout_ms=settings.shutter_readout_ms,
        vertical_datum=settings.vertical_datum,
        max_view_angle=settings.max_view_angle,
        max_mp=settings.most_mp,
    )
    # if the final map is requested again after more photos have arrived, it is made anew; results
    # computed before are reused from the store, and the former map is shown until then
    yield from iter_bands(
        paths, folder / FINISHED, wanted, overwrite=True, stays=True, needed=False
    )


def named(folder: Path, photos: list[tuple[int, str, str]]) -> tuple[list[Path], list[str]]:
    """Makes links to accepted photos (number, name, file), and names those whose files are gone.
    The link names are safe as file names and contain the names under which the photos were sent.
    """
    home = folder / NAMED
    remove_folder(home)
    home.mkdir()
    taken: set[str] = set()
    paths, lost = [], []
    for number, name, file in photos:
        if not is_file(folder / PHOTOS / file):
            lost.append(name)
            continue
        stem = re.sub(r"[^A-Za-z0-9_-]", "_", Path(name).stem)[:80].strip("_") or "photo"
        plain = f"{stem}{Path(file).suffix}"
        if plain.lower() in taken or stem.lower() in RESERVED:
            plain = f"{stem}-{number}{Path(file).suffix}"
        taken.add(plain.lower())
        target = home / plain
        try:
            os.link(folder / PHOTOS / file, target)
        except OSError:  # a file system without hard links
            shutil.copyfile(folder / PHOTOS / file, target)
        paths.append(target)
    return paths, lost
