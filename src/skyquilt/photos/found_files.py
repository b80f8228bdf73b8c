"""The files in the input: photos, clips, side files, and sentences on all others."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.outside import PHOTO_ENDINGS, hidden, is_folder, open_regular, plain, walk
from skyquilt.photos.left_out import paths_of
from skyquilt.photos.side_rows import sentence_of
from skyquilt.video.read import CLIP_ENDINGS, side_files

OTHER_PICTURES = (*(".avif", ".bmp", ".gif", ".heic", ".heif", ".insp", ".jp2", ".jxl", ".webp"),)
"""Endings of pictures in formats that are not read."""
_RAW = frozenset(
    f".{ending}"
    for ending in (
        *(
            "arw",
            "cr2",
            "cr3",
            "dng",
            "nef",
            "orf",
            "pef",
            "r3d",
            "insp",
            "raf",
            "raw",
            "rw2",
            "srw",
        ),
    )
)
"""The same of raw pictures, which cameras write beside photos, and of two fisheyes in one file."""
_UNREAD = frozenset(OTHER_PICTURES) | _RAW
RUN_MARKS = frozenset({"run.toml", "live.db", ".skyquilt"})
"""What the folder of an earlier run or of a live map holds, each one or another of these."""
_DAMAGED = (
    "truncated",
    "cut off",
    "broken",
    "damaged",
    "empty",
    "cannot be read",
    "cannot be decoded",
)
"""Words in the reasons of files that another copy may not have."""
_SIDE_NAMES = frozenset({"geo.txt", "gcp_list.txt"})


@dataclass(frozen=True, kw_only=True)
class FoundFiles:
    """The files in the input."""

    photos: tuple[tuple[str, Path], ...]
    """Name in the survey and file, sorted by name."""
    clips: tuple[tuple[str, Path], ...]
    """The same of video clips."""
    ignored: tuple[str, ...]
    """Names of all other files."""
    geo: Path | None
    """A `geo.txt` at the top of the folder."""
    runs: tuple[str, ...]
    """Folders of earlier runs, which are not read."""
    unread: tuple[str, ...] = ()
    """Folders that the system does not let be read, each with the reason."""
    others: tuple[tuple[str, Path], ...] = ()
    """Name and path of the files in `ignored`."""


def find_files(source: Path | Sequence[Path]) -> FoundFiles:
    """Finds photos by file name extension in a folder and its subfolders, or among single files.

    Hidden files and folders are skipped, those of storage systems (`@eaDir`, `__MACOSX`) too, and
    so are folders of earlier runs (they contain `run.toml`, or `.skyquilt` while a run is not
    finished) and of live maps. Raises `UsageError`
    where a given path does not exist.
    """
    paths = paths_of(source)
    if isinstance(source, (str, os.PathLike)) and paths[0].is_dir():
        return _in_folder(paths[0])
    return _listed(paths)


def _in_folder(folder: Path) -> FoundFiles:
    runs: list[str] = []
    unread: list[str] = []

    def cannot(path: Path, error: OSError) -> None:
        name = path.relative_to(folder).as_posix() if path != folder else folder.as_posix()
        unread.append(f"{_text(name)} ({error.strerror or error})")

    found = _walk(folder, runs, folder, cannot)
    files = [(_text(p.relative_to(folder).as_posix()), p) for p in found]
    geo = next((p for name, p in files if name.lower() == "geo.txt"), None)
    return replace(_sorted(files, geo, tuple(sorted(runs))), unread=tuple(sorted(unread)))


def _walk(
    folder: Path, runs: list[str], top: Path, unread: Callable[[Path, OSError], None]
) -> Iterator[Path]:
    for here, folders, files in walk(folder, unread):
        if here != top and not RUN_MARKS.isdisjoint((*files, *folders)):
            runs.append(_text(here.relative_to(top).as_posix()))
            folders.clear()
            continue
        yield from (here / f for f in files if not hidden(f))


def _listed(paths: Sequence[Path]) -> FoundFiles:
    """Single files: they keep their file names where these differ, else their path below the common
    folder. A `geo.txt` among them counts, and one of a folder, where there is one only.
    """
    files: list[Path] = []
    unread: list[str] = []
    geo = [p for p in paths if p.name.lower() == "geo.txt" and p.is_file()]
    for path in paths:
        inside = _in_folder(path) if path.is_dir() else None
        files += (
            [p for _, p in (*inside.photos, *inside.clips, *inside.others)] if inside else [path]
        )
        unread += inside.unread if inside else ()
        geo += [inside.geo] if inside and inside.geo else []
    unique = list(dict.fromkeys(p.absolute() for p in files))
    top = Path(os.path.commonpath([p.parent for p in unique])) if unique else Path()
    bare = len({p.name for p in unique}) == len(unique)
    found = _sorted(
        [(_text(p.name if bare else p.relative_to(top).as_posix()), p) for p in unique],
        geo[0] if len(geo) == 1 else None,
        (),
    )
    return replace(found, unread=tuple(unread))


def _text(name: str) -> str:
    """A name that can be written to any text file and terminal: Linux allows bytes in file names
    that are no valid text, and control characters.
    """
    return plain(name)


def _sorted(
    files: Sequence[tuple[str, Path]], geo: Path | None, runs: tuple[str, ...]
) -> FoundFiles:
    photos = sorted((n, p) for n, p in files if _is_photo(p))
    clips = sorted((n, p) for n, p in files if p.suffix.lower() in CLIP_ENDINGS)
    known = {n for n, _ in (*photos, *clips)}
    beside = {p for _, clip in clips for p in side_files(clip)}
    others = sorted(
        (n, p)
        for n, p in files
        if n not in known and p.name.lower() not in _SIDE_NAMES and p not in beside
    )
    return FoundFiles(
        photos=tuple(photos),
        clips=tuple(clips),
        ignored=tuple(n for n, _ in others),
        geo=geo,
        runs=runs,
        others=tuple(others),
    )


def notes_on_files(found: FoundFiles, photos: Sequence[Photo], *, sided: bool) -> tuple[str, ...]:
    """Sentences on what is in the input and not in the survey. `sided`: whether a side file gives
    positions.
    """
    return (
        *_run_notes(found),
        *_closed_note(found),
        *_unread_notes(found),
        *_misnamed_note(found),
        *_link_note(found),
        *(() if sided else _side_note(found, photos)),
    )


def _run_notes(found: FoundFiles) -> tuple[str, ...]:
    return tuple(f"The folder {run} contains an earlier run and was skipped." for run in found.runs)


def _closed_note(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on folders that cannot be read."""
    if not found.unread:
        return ()
    number = f"{len(found.unread)} folders" if len(found.unread) > 1 else "1 folder"
    return (
        f"{number} cannot be read, and photos in there are not in the map:"
        f" {sentence_of(found.unread)}.",
    )


def _beside(found: FoundFiles) -> set[PurePosixPath]:
    """Names without endings of photos and clips."""
    return {PurePosixPath(name).with_suffix("") for name, _ in (*found.photos, *found.clips)}


def _unread_notes(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on pictures in formats that are not read, but for those beside a photo of the same
    name, as cameras write them.
    """
    read = _beside(found)
    missed = [
        name
        for name in found.ignored
        if PurePosixPath(name).suffix.lower() in _UNREAD
        and PurePosixPath(name).with_suffix("") not in read
    ]
    if not missed:
        return ()
    number = f"{len(missed)} pictures are" if len(missed) > 1 else "1 picture is"
    return (
        f"{number} not in the map: their format is not read ({sentence_of(missed)}). Save them as"
        " JPEG, TIFF or PNG with their metadata.",
    )


_MOST_LOOKED = 2000
"""Number of other files whose beginning is looked at."""
_BEGINNINGS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")


def _misnamed_note(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on photos whose names do not end as those of photos, as of recovered or downloaded
    files; those of a photo's or clip's name (`.jpg_original`, `.THM`) are copies and previews.
    """
    read = _beside(found)
    missed = [
        name
        for name, path in found.others[:_MOST_LOOKED]
        if PurePosixPath(name).suffix.lower() not in _UNREAD
        and PurePosixPath(name).with_suffix("") not in read
        and _begins_as_photo(path)
    ]
    if not missed:
        return ()
    number = f"{len(missed)} files are photos" if len(missed) > 1 else "1 file is a photo"
    return (
        f"{number} by content and not by name ({sentence_of(missed)}), and not in the map. Give"
        " them names that end in .jpg or .png.",
    )


def _is_photo(path: Path) -> bool:
    """Whether a file is to be read: by its name, or a JPEG or PNG that is called something else, as
    phones hand over `.heic` files that they converted.
    """
    ending = path.suffix.lower()
    return ending in PHOTO_ENDINGS or (ending in OTHER_PICTURES and _begins_as_photo(path))


def _begins_as_photo(path: Path) -> bool:
    try:
        with open_regular(path) as file:
            return file.read(8).startswith(_BEGINNINGS)
    except OSError:
        return False


def _link_note(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on links to folders."""
    links = [name for name, path in found.others if is_folder(path) and not _leads_up(path)]
    if not links:
        return ()
    number = f"{len(links)} links to folders are" if len(links) > 1 else "1 link to a folder is"
    return (
        f"{number} not followed ({sentence_of(links)}); photos in there are not in the map. Give"
        " such a folder itself.",
    )


def _leads_up(link: Path) -> bool:
    """Whether a link leads to a folder that it lies in, so that nothing new is there."""
    return Path(os.path.realpath(link.parent)).is_relative_to(os.path.realpath(link))


_SIDE_ENDINGS = frozenset({".csv", ".tsv", ".mrk", ".pos"})
"""Endings of files that may hold positions of photos."""


def _side_note(found: FoundFiles, photos: Sequence[Photo]) -> tuple[str, ...]:
    """A sentence on files that may hold the positions that photos lack."""
    files = [n for n in found.ignored if PurePosixPath(n).suffix.lower() in _SIDE_ENDINGS]
    if not files or all(p.position is not None for p in photos):
        return ()
    return (
        f"Photos lack positions, and {sentence_of(files)} may hold them: give such a file by"
        " --geo.",
    )


def nothing_sentence(
    folder: Path | Sequence[Path],
    found: FoundFiles,
    rejected: Sequence[RejectedPhoto],
    *,
    clips: bool,
) -> str:
    """Why there is nothing to map. `clips`: whether videos are read, too."""
    where = str(folder)
    if not isinstance(folder, (str, Path)):
        kind = "folders" if all(is_folder(Path(p)) for p in folder) else "files"
        where = f"the {len(folder)} given {kind}"
    if found.unread and not rejected:
        return f"There is no photo in {where} that can be found: {_closed_note(found)[0]}"
    if rejected:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected[:5])
        damaged = any(word in r.reason for r in rejected for word in _DAMAGED)
        return (
            f"None of the {len(rejected)} {'image and video' if found.clips else 'image'} files in"
            f" {where} can be read ({reasons}).{' Copy them again.' if damaged else ''}"
        )
    others = (*found.ignored, *(n for n, _ in found.clips)) if not clips else found.ignored
    held = f"only other files ({sentence_of(others)})" if others else "nothing"
    packed = [n for n in found.ignored if PurePosixPath(n).suffix.lower() in _PACKED]
    why = (
        *(_unread_notes(found) or _misnamed_note(found) or _link_note(found)),
        *([f"Unpack {sentence_of(packed)} first, and give the folder."] if packed else []),
    )
    advice = f"Choose a folder of JPEG, TIFF or PNG photos{' or of videos' if clips else ''}."
    if why:
        return f"There is no photo in {where} that is read. {' '.join(why)}"
    return f"There is no photo in {where}: it contains {held}. {advice}"


_PACKED = frozenset({".zip", ".7z", ".rar", ".tar", ".gz", ".tgz"})
"""Endings of archives."""
