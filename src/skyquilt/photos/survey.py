"""A folder to a `Survey`."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from skyquilt.errors import NoPhotosError, UsageError
from skyquilt.model.photo import Photo, RejectedPhoto, Survey
from skyquilt.photos.read import read_photo

_PHOTO_ENDINGS = {".jpg", ".jpeg", ".tif", ".tiff", ".png"}
_RUN_MARK = "run.toml"


def read_survey(folder: Path | Sequence[Path]) -> Survey:
    """All photos of a folder (and its subfolders) in order of capture."""
    found, ignored = list_files(folder)
    read = [read_photo(path, name=name) for name, path in found]
    photos = sorted((p for p in read if isinstance(p, Photo)), key=capture_order)
    rejected = [p for p in read if isinstance(p, RejectedPhoto)]
    if not photos:
        raise NoPhotosError(f"no readable photo in {folder}")
    return Survey(photos=tuple(photos), rejected=tuple(rejected), ignored=tuple(ignored))


def capture_order(photo: Photo) -> tuple[bool, datetime, str]:
    """Time, then name; photos without a time come last."""
    time = photo.time.replace(tzinfo=None) if photo.time else datetime.max
    return photo.time is None, time, photo.name


def list_files(folder: Path | Sequence[Path]) -> tuple[list[tuple[str, Path]], list[str]]:
    """Image files as (name, path) and the names of all others, both sorted."""
    if not isinstance(folder, Path):
        return [(p.name, p) for p in sorted(folder)], []
    if not folder.exists():
        raise UsageError(f"{folder} does not exist")
    photos, others = [], []
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(folder).as_posix()
            if path.suffix.lower() in _PHOTO_ENDINGS:
                photos.append((name, path))
            else:
                others.append(name)
    return photos, others
