"""A folder of files to a `Survey`: what a run begins with."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path

from skyquilt.errors import NoPhotosError
from skyquilt.model.photo import Photo, RejectedPhoto, Survey
from skyquilt.photos.cameras_json import apply_cameras, read_cameras_json
from skyquilt.photos.files import FoundFiles, find_files
from skyquilt.photos.read import read_photo
from skyquilt.photos.side_files import apply_positions
from skyquilt.photos.side_rows import sentence_of
from skyquilt.photos.survey_notes import survey_notes
from skyquilt.photos.voids import without_ground_heights, without_outliers, without_stuck


def read_survey(
    folder: Path | Sequence[Path],
    *,
    geo: Path | None = None,
    cameras: Path | None = None,
    thermal_unit: str | None = None,
) -> Survey:
    """All photos below a folder (or those given) in order of capture, without decoding their
    pixels.

    `geo` is a side file of positions (`geo.txt`, CSV, `.SRT`, `.MRK`); without one, a `geo.txt` at
    the top of the folder counts. `cameras` is a `cameras.json`, `thermal_unit` as in `read_photo`.
    A bad photo becomes a `RejectedPhoto`. Raises `UsageError` for a folder that does not exist,
    `NoPhotosError` where no photo can be read, `SideFileError` for a bad side file.
    """
    found = find_files(folder)
    read = [read_photo(path, name=name, thermal_unit=thermal_unit) for name, path in found.photos]
    rejected = [p for p in read if isinstance(p, RejectedPhoto)]
    photos, copies = _without_copies(p for p in read if isinstance(p, Photo))
    if not photos:
        raise NoPhotosError(_nothing_sentence(folder, found, rejected))
    notes: tuple[str, ...] = ()
    side = geo or found.geo
    if side:
        photos, notes = apply_positions(photos, side)
    if cameras:
        photos, more = apply_cameras(photos, read_cameras_json(cameras), file=cameras)
        notes = (*notes, *more)
    photos, grounded = without_ground_heights(sorted(photos, key=capture_order))
    photos, stuck = without_stuck(photos)
    photos, far = without_outliers(photos)
    return Survey(
        photos=photos,
        rejected=tuple(sorted((*rejected, *copies), key=lambda r: r.name)),
        ignored=found.ignored,
        notes=(
            *notes,
            *_run_notes(found),
            *grounded,
            *stuck,
            *far,
            *survey_notes(photos, len(copies)),
        ),
    )


def capture_order(photo: Photo) -> tuple[bool, datetime, str]:
    """Sorts by wall-clock time, then name; photos without a time come last."""
    time = photo.time.replace(tzinfo=None) if photo.time else datetime.max
    return photo.time is None, time, photo.name


def _without_copies(photos: Iterable[Photo]) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    first: dict[str, Photo] = {}
    copies = []
    for photo in sorted(photos, key=lambda p: p.name):
        original = first.setdefault(photo.digest, photo)
        if original is not photo:
            copies.append(
                RejectedPhoto(name=photo.name, reason=f"same file content as {original.name}")
            )
    return tuple(first.values()), tuple(copies)


def _run_notes(found: FoundFiles) -> tuple[str, ...]:
    return tuple(
        f"The folder {run} holds an earlier run and was passed over." for run in found.runs
    )


def _nothing_sentence(
    folder: Path | Sequence[Path], found: FoundFiles, rejected: Sequence[RejectedPhoto]
) -> str:
    where = str(folder) if isinstance(folder, (str, Path)) else f"the {len(folder)} files given"
    if rejected:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected[:5])
        return (
            f"None of the {len(rejected)} image files in {where} can be read ({reasons}). Copy"
            " them again."
        )
    held = f"only other files ({sentence_of(found.ignored)})" if found.ignored else "nothing"
    return (
        f"There is no photo in {where}: it holds {held}. Give a folder of JPEG, TIFF or PNG photos."
    )
