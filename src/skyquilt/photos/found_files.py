"""What a folder of photos contains, and sentences on what of it is not in the survey."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from skyquilt.model.photo import RejectedPhoto
from skyquilt.outside import is_folder, open_regular
from skyquilt.photos.headers import PREVIEWS, RAW_PICTURES
from skyquilt.photos.side_rows import sentence_of

OTHER_PICTURES = (".avif", ".bmp", ".gif", ".heic", ".heif", ".jp2", ".jxl")
"""Endings of pictures in formats that are not read."""
_UNREAD = frozenset(OTHER_PICTURES) | RAW_PICTURES
"""All endings of pictures that are not read."""
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


@dataclass(frozen=True, kw_only=True)
class FoundFiles:
    """The files in the input."""

    photos: tuple[tuple[str, Path], ...]
    """Name in the survey and file, sorted by name."""
    clips: tuple[tuple[str, Path], ...]
    """The same of video clips."""
    others: tuple[tuple[str, Path], ...]
    """The same of all other files."""
    geo: Path | None
    """A `geo.txt` at the top of the folder."""
    runs: tuple[str, ...]
    """Folders of earlier runs, which are not read."""
    unread: tuple[str, ...] = ()
    """Folders that the system does not let be read, each with the reason."""

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of all other files."""
        return tuple(name for name, _ in self.others)

    def lone(self) -> list[tuple[str, Path]]:
        """The other files that do not have the name of a photo or clip, but for its ending, as
        cameras and programs write files beside these.
        """
        read = {PurePosixPath(n).with_suffix("") for n, _ in (*self.photos, *self.clips)}
        return [(n, p) for n, p in self.others if PurePosixPath(n).with_suffix("") not in read]


def notes_on_files(found: FoundFiles, *, placeless: bool) -> tuple[str, ...]:
    """Sentences on what is in the input and not in the survey. `placeless`: whether photos lack
    positions, and no side file is given.
    """
    return (
        *_run_notes(found),
        *_closed_note(found),
        *_unread_notes(found),
        *_misnamed_note(found),
        *_link_note(found),
        *(_side_note(found) if placeless else ()),
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


def _unread_notes(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on pictures in formats that are not read, but for those beside a photo of the same
    name.
    """
    missed = [n for n, _ in found.lone() if PurePosixPath(n).suffix.lower() in _UNREAD]
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
    files; those of a photo's or clip's name (`.jpg_original`) are copies, a `.THM` is a preview.
    """
    looked_at = found.lone()[:_MOST_LOOKED]
    missed = [
        name
        for name, path in looked_at
        if PurePosixPath(name).suffix.lower() not in _UNREAD | PREVIEWS and begins_as_photo(path)
    ]
    if not missed:
        return ()
    number = f"{len(missed)} files are photos" if len(missed) > 1 else "1 file is a photo"
    return (
        f"{number} by content and not by name ({sentence_of(missed)}), and not in the map. Give"
        " them names that end in .jpg or .png.",
    )


def begins_as_photo(path: Path) -> bool:
    """Whether a file begins as a JPEG or PNG."""
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


_SIDE_ENDINGS = frozenset({".csv", ".tsv", ".mrk", ".pos", ".gpx"})
"""Endings of files that may hold positions of photos."""


def _side_note(found: FoundFiles) -> tuple[str, ...]:
    """A sentence on files that may hold the positions that photos lack."""
    files = [n for n in found.ignored if PurePosixPath(n).suffix.lower() in _SIDE_ENDINGS]
    if not files:
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
