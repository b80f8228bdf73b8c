"""Reads a folder of files as a `Survey`, the input of a run."""

import os
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path, PurePosixPath

from skyquilt.errors import NoPhotosError
from skyquilt.model.photo import Photo, RejectedPhoto, Survey
from skyquilt.outside import MOST_MP, PHOTO_ENDINGS, hidden, plain, walk
from skyquilt.photos.cameras_json import apply_cameras, read_cameras_json
from skyquilt.photos.clips import is_timed, read_clips
from skyquilt.photos.found_files import (
    OTHER_PICTURES,
    RUN_MARKS,
    FoundFiles,
    begins_as_photo,
    notes_on_files,
    nothing_sentence,
)
from skyquilt.photos.implausible_positions import (
    with_coarse_deviations,
    with_one_sign,
    without_ground_heights,
    without_outliers,
    without_stuck,
    without_zero_heights,
)
from skyquilt.photos.left_out import (
    band_note,
    paths_of,
    without_copies,
    without_maps,
    without_panoramas,
    without_reduced,
)
from skyquilt.photos.metadata import INVALID, NO_HEMISPHERE
from skyquilt.photos.read import ReadPhoto, read_photo
from skyquilt.photos.recoded import UNNAMED, recoded
from skyquilt.photos.side_files import apply_positions
from skyquilt.photos.side_rows import sentence_of
from skyquilt.photos.thermal import UNREAD
from skyquilt.photos.thermal_units import in_one_unit, in_palettes, unit_notes
from skyquilt.settings import InputSettings
from skyquilt.video.read import CLIP_ENDINGS, side_files

_SIDE_NAMES = frozenset({"geo.txt", "gcp_list.txt"})


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
    photos = _once(sorted((n, p) for n, p in files if _is_photo(p)))
    clips = sorted((n, p) for n, p in files if p.suffix.lower() in CLIP_ENDINGS)
    known = {n for n, _ in (*photos, *clips)}
    beside = {p for _, clip in clips for p in side_files(clip)}
    others = sorted(
        (n, p)
        for n, p in files
        if n not in known and p.name.lower() not in _SIDE_NAMES and p not in beside
    )
    return FoundFiles(
        photos=tuple(photos), clips=tuple(clips), others=tuple(others), geo=geo, runs=runs
    )


def _once(photos: Sequence[tuple[str, Path]]) -> list[tuple[str, Path]]:
    """Names and files of photos, without a WebP that lies beside another photo of its name, as
    programs write both.
    """
    usual = {path.with_suffix("") for _, path in photos if not _is_webp(path)}
    return [
        (name, path)
        for name, path in photos
        if not (_is_webp(path) and path.with_suffix("") in usual)
    ]


def _is_webp(path: Path) -> bool:
    return path.suffix.lower() == ".webp"


def _is_photo(path: Path) -> bool:
    """Whether a file is to be read: by its name, or a JPEG or PNG that is called something else, as
    phones hand over `.heic` files that they converted.
    """
    ending = path.suffix.lower()
    return ending in PHOTO_ENDINGS or (ending in OTHER_PICTURES and begins_as_photo(path))


def read_survey(
    folder: Path | Sequence[Path],
    *,
    geo: Path | None = None,
    cameras: Path | None = None,
    thermal_unit: str | None = None,
    clips: bool = False,
    max_mp: float = MOST_MP,
    clock_offset: float | None = None,
    read: ReadPhoto = read_photo,
) -> Survey:
    """All photos below a folder (or those given) in order of capture, without decoding their
    pixels.

    `geo` is a side file of positions (`geo.txt`, a table, `.SRT`, `.MRK`, `.pos`); without one, a
    `geo.txt` at the top of the folder is used. `cameras` is a `cameras.json`, `thermal_unit` as in
    `read_photo`, `max_mp` the largest area of a photo in megapixels, `clock_offset` in s as in
    `photos.track_positions`, `read` what reads a file.
    With `clips`, video clips are read too, and timed positions in `geo` (or a folder of such files)
    are those of the clips. A bad photo becomes a `RejectedPhoto`. Raises `UsageError` for a folder
    that does not exist, `NoPhotosError` where no photo can be read, `SideFileError` for a bad side
    file.
    """
    asked = InputSettings(geo=geo, cameras=cameras, thermal_unit=thermal_unit, max_mp=max_mp)
    geo, cameras, max_mp = asked.geo, asked.cameras, asked.max_mp
    found = find_files(folder)
    files = [
        read(path, name=name, thermal_unit=thermal_unit, most_mp=max_mp)
        for name, path in found.photos
    ]
    if any(isinstance(p, Photo) and p.stored for p in files):
        files = in_one_unit(
            files, lambda p, unit: read(p.path, name=p.name, thermal_unit=unit, most_mp=max_mp)
        )
    rejected = [p for p in files if isinstance(p, RejectedPhoto)]
    films, more_rejected = read_clips(found.clips, geo) if clips else ((), ())
    rejected += more_rejected
    photos, copies = without_copies(p for p in files if isinstance(p, Photo))
    photos, maps = without_maps(photos)
    photos, round_ = without_panoramas(photos)
    photos, reduced = without_reduced(photos)
    if not photos and not films:
        raise NoPhotosError(nothing_sentence(folder, found, rejected, clips=clips))
    notes: tuple[str, ...] = ()
    side = geo or found.geo
    if side and photos and not (films and is_timed(side)):
        photos, notes = apply_positions(photos, side, clock_offset)
    calibrated = read_cameras_json(cameras) if cameras else {}
    if cameras and not films:  # those of clips are known with their frames
        photos, more = apply_cameras(photos, calibrated, file=cameras)
        notes = (*notes, *more)
    photos, painted = in_palettes(photos)
    photos, greyed = _in_colour(_with_editors(photos))
    photos, implausible = placed_plausibly(photos)
    return Survey(
        photos=photos,
        rejected=tuple(
            sorted((*rejected, *copies, *maps, *round_, *reduced), key=lambda r: r.name)
        ),
        ignored=found.ignored
        if clips
        else tuple(sorted((*found.ignored, *(n for n, _ in found.clips)))),
        clips=films,
        notes=(
            *notes,
            *notes_on_files(
                found, placeless=side is None and any(p.position is None for p in photos)
            ),
            *painted,
            *greyed,
            *implausible,
            *survey_notes(photos, len(copies) + len(reduced)),
        ),
    )


def placed_plausibly(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Photos in order of capture, without positions that cannot be right, those that say little
    with larger deviations, and notes on these.
    """
    ordered, grounded = without_ground_heights(sorted(photos, key=capture_order))
    ordered, stuck = without_stuck(ordered)
    ordered, far = without_outliers(ordered)
    ordered, zero = without_zero_heights(ordered)
    ordered, signs = with_one_sign(ordered)
    ordered, coarse = with_coarse_deviations(ordered)
    return ordered, (*grounded, *stuck, *far, *zero, *signs, *coarse)


def _with_editors(photos: Sequence[Photo]) -> tuple[Photo, ...]:
    """The photos; those that only their coding shows to be rewritten have an unnamed editor."""
    other = recoded([p.camera_key for p in photos], [p.coding for p in photos])
    return tuple(
        replace(p, editor=UNNAMED) if changed and p.editor is None else p
        for p, changed in zip(photos, other, strict=True)
    )


def _in_colour(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos, those saved in grey of a camera whose others are in colour to be read as
    colours, too, so that one map shows both; and a note on these.
    """
    plain = [p for p in photos if p.dtype == "uint8" and not (p.unit or p.band_name)]
    coloured = {p.camera_key for p in plain if p.channels == 3}
    grey = {p.name for p in plain if p.channels == 1 and p.camera_key in coloured}
    if not grey:
        return tuple(photos), ()
    read = [replace(p, channels=3, saved_grey=True) if p.name in grey else p for p in photos]
    return tuple(read), (
        f"{len(grey)} photos are grey, though others of their camera are in colour:"
        f" {sentence_of(sorted(grey))}. They are mapped together, and stay grey; for a map in"
        " colours, leave them out.",
    )


def capture_order(photo: Photo) -> tuple[bool, datetime, str]:
    """Sort key: wall-clock time, then name; photos without a time come last."""
    time = photo.time.replace(tzinfo=None) if photo.time else datetime.max
    return photo.time is None, time, photo.name


_LONG_GAP_H = 12.0


def survey_notes(photos: Sequence[Photo], copies: int = 0) -> tuple[str, ...]:
    """Notes for the user: several cameras or bands, rolling shutters, clocks, what most photos
    lack.
    """
    return (
        *_cameras(photos),
        *band_note(photos),
        *(unit_notes(photos) if any(map(_may_be_thermal, photos)) else ()),
        *_gaps(photos),
        *_clocks(photos),
        *_versions(photos),
        *_copies(copies),
    )


def _cameras(photos: Sequence[Photo]) -> Iterator[str]:
    keys = Counter(p.camera_key for p in photos)
    if len(keys) > 1:
        listed = sentence_of([f"{key} ({n})" for key, n in keys.items()])
        yield (
            f"There are {len(keys)} cameras: {listed}; each is calibrated separately, but for sizes"
            " and zooms of one lens."
        )
    bands = Counter(p.band for p in photos if not p.shows_a_band)  # those of a rig are told apart
    if len(bands) > 1:
        counts = " and ".join(f"{n} {band}" for band, n in sorted(bands.items()))
        yield f"Different spectra are mixed: {counts} photos."
    rolling = sorted({p.camera_key for p in photos if p.rolling_shutter})
    if rolling:
        yield f"Rolling (electronic) shutter: {sentence_of(rolling)}."
    deep = sum(p.dtype == "float32" and p.channels == 3 for p in photos)
    if deep:
        yield (
            f"{deep} photos in colour have floating-point values: these are mapped as recorded,"
            " without a balance of brightness; for one, save them with 8 or 16 bits."
        )


def _versions(photos: Sequence[Photo]) -> Iterator[str]:
    """A sentence on photos that may be several versions of one: of one name, time and place. Rigs
    of several cameras write such files, too, so none is left out.
    """
    first: dict[Hashable, str] = {}
    again: list[str] = []
    for photo in photos:
        place = photo.position
        if photo.time is None or place is None:
            continue
        where = round(place.latitude_deg, 5), round(place.longitude_deg, 5)
        stem = PurePosixPath(photo.name).stem.lower()
        size = photo.width, photo.height
        key = stem, photo.time, where, size, photo.band, photo.band_name
        if first.setdefault(key, photo.name) != photo.name:
            again.append(f"{photo.name} of {first[key]}")
    if again:
        number = f"{len(again)} photos have" if len(again) > 1 else "1 photo has"
        yield (
            f"{number} the name, time and place of others ({sentence_of(again)}): where they are"
            " versions of the same photos (edited, exported, another format), leave one kind out."
        )


def _may_be_thermal(photo: Photo) -> bool:
    return photo.band == "thermal" or photo.dtype != "uint8" or UNREAD in photo.notes


def _gaps(photos: Sequence[Photo]) -> Iterator[str]:
    void = [p.name for p in photos if p.position is None]
    if void and photos:
        which = (
            "No photo has"
            if len(void) == len(photos)
            else f"{len(void)} of {len(photos)} photos lack"
        )
        yield f"{which} a usable GPS position" + (
            f": {sentence_of(void)}."
            if len(void) < len(photos)
            else "; heights above take-off tell the scale of the map."
            if any(p.height_m is not None for p in photos)
            else "."
        )
    stated = {p.name: n for p in photos if p.position is None for n in p.notes if INVALID in n}
    if stated:
        name, note = next(iter(stated.items()))
        number = f"{len(stated)} of {len(photos)} photos"
        yield f"{number} state a position that cannot be used, such as {name}: {note}" + (
            " Degrees are expected; positions in metres of a projected system belong in a geo.txt,"
            " whose first line names the system."
            if "valid range" in note
            else ""
        )
    assumed = [p.name for p in photos if NO_HEMISPHERE in p.notes]
    if assumed:
        yield (
            f"{len(assumed)} photos do not say whether their position lies north or south, east or"
            f" west: {sentence_of(assumed)}. North and east are assumed; where that is wrong, give"
            " positions in a geo.txt."
        )
    if photos and all(p.attitude is None for p in photos):
        yield "No photo has camera angles."
    guessed = sorted({p.camera_key for p in photos if p.focal.source == "guess"})
    if guessed:
        yield f"The focal length is guessed for {sentence_of(guessed)}."
    edited = [p.name for p in photos if p.editor]
    if edited:
        yield f"{len(edited)} photos were rewritten by another program: {sentence_of(edited)}."


def _clocks(photos: Sequence[Photo]) -> Iterator[str]:
    timeless = [p.name for p in photos if p.time is None]
    if timeless and len(timeless) < len(photos):
        yield f"Without a capture time, sorted last: {sentence_of(timeless)}."
    times = sorted(p.time.replace(tzinfo=None) for p in photos if p.time)
    gap = max(((b - a).total_seconds() / 3600 for a, b in pairwise(times)), default=0.0)
    if gap > _LONG_GAP_H:
        yield (
            f"The capture times have a gap of {gap:.0f} h: several flights, or clocks that"
            " disagree."
        )


def _copies(copies: int) -> tuple[str, ...]:
    some = (
        f"{copies} files are copies of others and were"
        if copies > 1
        else "1 file is a copy and was"
    )
    return (f"{some} left out.",) if copies else ()
