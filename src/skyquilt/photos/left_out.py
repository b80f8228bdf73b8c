"""Photos that a map leaves out before anything is computed.

Smaller copies of photos (previews, thumbnails, what was made to be sent) show nothing that the
photos do not, and would make the map as coarse as they are. Multispectral cameras write a file for
each band: a map of all of them would be a patchwork of bands, so it shows one.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path, PurePosixPath

from skyquilt.errors import UsageError
from skyquilt.model.bands import canonical
from skyquilt.model.photo import Photo, RejectedPhoto, Survey
from skyquilt.outside import plain
from skyquilt.photos.side_rows import sentence_of

SMALLER = 0.8
"""A copy has less than this share of the photo's width; ..."""
SAME = 0.03
"""... the same shape and the same angle of view, within this share."""
EDITED = re.compile(
    r"(?P<name>.+?)[ _-]*(\(\d+\)|[ _-](edit(ed|ad[oa])?|cop(y|ie|ia)|kopi[ea]|bearbeitet|bewerkt"
    r"|modifi(e|é|cat[oa])|retouch(e|ed|é)?|enhanced|adjusted|corrected|(auto)?colou?r|hdr)"
    r"[ _-]?\d*)"
)
"""Stems of files that programs save beside the photo that they changed."""
ROUNDED_DEG = 1e-5
"""Latitudes and longitudes of a photo and its copy differ by less than this."""
IS_MAP = "it is a map (a GeoTIFF, placed on the ground), not a photo"
"""The reason recorded for a map among photos."""
IS_PANORAMA = (
    "it is a panorama by its shape (twice as wide as high, and larger than the photos), joined from"
    " several photos"
)
_FEW = 0.25
"""Share of the photos up to which pictures of that shape are exceptions."""
NAMELESS = "it does not say which band of the camera it shows, as others of its kind do"
PREFERRED = ("green", "red")
"""Bands that are shown before others of as many photos: lawns, fields and roads differ in them."""


def paths_of(source: object) -> list[Path]:
    """Paths of a folder, or of single photos.

    Raises:
        UsageError: it is neither, is not there, or is the folder of a finished run, whose maps are
            no photos.
    """
    paths: list[Path] = []
    try:
        if isinstance(source, (str, os.PathLike)):
            paths = [Path(source)] if str(source) else []
        elif isinstance(source, Iterable) and not isinstance(source, bytes):
            paths = [Path(p) for p in source]
    except TypeError:
        paths = []
    if not paths and source != []:
        told = " ".join(repr(source).split())[:60]
        raise UsageError(f"{told} is neither a folder nor a list of photos")
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path} does not exist; choose a folder of photos.")
        if (path / "run.toml").is_file() and (path / "mosaic.tif").is_file():
            raise UsageError(
                f"{path} is the folder of a finished run, whose maps are no photos; give the folder"
                " of the photos"
            )
    return paths


def without_copies(photos: Iterable[Photo]) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    """The photos, by name, without files of the same content as others, and these."""
    first: dict[str, Photo] = {}
    copies = []
    for photo in sorted(photos, key=lambda p: p.name):
        original = first.setdefault(photo.digest, photo)
        if original is not photo:
            copies.append(
                RejectedPhoto(name=photo.name, reason=f"same file content as {original.name}")
            )
    return tuple(first.values()), tuple(copies)


def without_maps(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    """The photos without maps among them, which would be drawn as one photo more, and these. Where
    all files are placed like maps, they are what was asked for.
    """
    if all(p.placed for p in photos):
        return tuple(photos), ()
    maps = tuple(RejectedPhoto(name=p.name, reason=IS_MAP) for p in photos if p.placed)
    return tuple(p for p in photos if not p.placed), maps


def without_panoramas(
    photos: Sequence[Photo],
) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    """The photos without panoramas all around, whose metadata do not say what they are, and these:
    a few pictures exactly twice as wide as high, as no sensor of a survey's camera is, and wider
    than all photos, which parts cut out of photos are not.
    """
    others = [p for p in photos if p.width != 2 * p.height]
    widest = max((max(p.width, p.height) for p in others), default=0)
    round_ = {p.name for p in photos if p.width == 2 * p.height and p.width > widest}
    if not round_ or len(round_) > _FEW * len(others):
        return tuple(photos), ()
    kept = tuple(p for p in photos if p.name not in round_)
    return kept, tuple(
        RejectedPhoto(name=p.name, reason=IS_PANORAMA) for p in photos if p.name in round_
    )


def without_reduced(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[RejectedPhoto, ...]]:
    """The photos without smaller and without edited copies of others, and these with their reason.

    A smaller copy states the same place and time, and has the same angle of view, the same camera
    with its focal length in pixels of the full size, or the photo's name in its own; or it has the
    same name and no metadata. An edited one states the same place and time, and its name says
    so.
    """
    alike: dict[Hashable, list[Photo]] = defaultdict(list)
    for photo in photos:
        for key in _keys(photo):
            alike[key].append(photo)
    copy_of: dict[str, str] = {}
    edits = {p.name: o.name for p in photos if (o := _edited_from(p, alike)) is not None}
    for group in alike.values():
        largest = max(group, key=lambda p: (p.width, p.name))
        for photo in group:
            if _is_reduced(photo, largest):
                copy_of[photo.name] = largest.name
    reasons = {name: f"it is an edited copy of {original}" for name, original in edits.items()}
    reasons |= {name: f"it is a smaller copy of {original}" for name, original in copy_of.items()}
    kept = tuple(p for p in photos if p.name not in reasons)
    return kept, tuple(RejectedPhoto(name=name, reason=why) for name, why in reasons.items())


def _edited_from(photo: Photo, alike: Mapping[Hashable, Sequence[Photo]]) -> Photo | None:
    """The photo that another program changed and saved under a name that says so; None for others.
    `alike`: photos by what they share with copies.
    """
    told = EDITED.fullmatch(_stem(photo))
    if told is None:
        return None
    for original in alike.get(told["name"], ()):
        ratio = photo.width / original.width
        same = photo.band == original.band and photo.camera_key == original.camera_key
        same &= photo.time is not None and photo.time == original.time
        same &= _at_one_place(photo, original)
        if same and abs(photo.height / original.height / ratio - 1) < SAME:
            return original
    return None


def _at_one_place(photo: Photo, original: Photo) -> bool:
    """Whether a photo states the place of another or none; programs drop the more exact one of two
    that a file has.
    """
    a, b = photo.position, original.position
    if a is None or b is None:
        return a is None
    apart = abs(a.latitude_deg - b.latitude_deg), abs(a.longitude_deg - b.longitude_deg)
    return max(apart) < ROUNDED_DEG


def _keys(photo: Photo) -> Iterator[Hashable]:
    """What a photo shares with its copies."""
    place = photo.position
    if photo.time is not None and place is not None:
        for shifts in product((0.0, ROUNDED_DEG / 2), repeat=2):  # two near ones share a cell
            cell = (place.latitude_deg + shifts[0], place.longitude_deg + shifts[1])
            near = tuple(round(deg / ROUNDED_DEG) for deg in cell)
            yield photo.time, near, shifts, photo.band, photo.band_name
    yield _stem(photo)


def _stem(photo: Photo) -> str:
    return PurePosixPath(photo.name).stem.lower()


def _is_reduced(photo: Photo, original: Photo) -> bool:
    """Whether a photo is a smaller copy of one that shares a key with it."""
    ratio = photo.width / original.width
    if ratio > SMALLER or abs(photo.height / original.height / ratio - 1) > SAME:
        return False
    if photo.time is None and photo.position is None:
        told = original.time is not None or original.position is not None
        return told and _stem(photo) == _stem(original)
    if photo.time != original.time or photo.band != original.band:
        return False
    if photo.position is None or not _at_one_place(photo, original):
        return False
    same_view = abs(photo.focal.px / original.focal.px / ratio - 1) < SAME
    # programs that reduce photos keep what their metadata tell of the pixels of the full size
    untouched = _any_size(photo) == _any_size(original)
    untouched &= abs(photo.focal.px / original.focal.px - 1) < SAME
    if same_view or untouched:
        return True
    # a picture of another lens of the drone may be smaller and have a letter more in its name
    unknown = "guess" in (photo.focal.source, original.focal.source)
    return unknown and _stem(original) in _stem(photo)


def _any_size(photo: Photo) -> str:
    """What metadata tell of the camera (make, model, lens, zoom), without the size of pictures."""
    return photo.camera_key.replace(f" {photo.width}x{photo.height}", "")


def bands_of(photos: Sequence[Photo]) -> Counter[str]:
    """Photos of each band that files of one channel name."""
    return Counter(p.band_name for p in photos if p.shows_a_band)


def of_one_band(survey: Survey, wanted: str | None) -> Survey:
    """The survey with the files that the map shows of a camera that writes one for each band; those
    of other bands, and photos in colours of the same drone, are left out with a reason. Files of
    one channel that name no band stay. `wanted`: the name of a band; None = photos in colours where
    there are about as many as of a band, else the band of which there are most.

    Raises:
        UsageError: no file shows the band that is wanted.
    """
    bands = bands_of(survey.photos)
    wanted = None if wanted is None else canonical(wanted.lower())
    if wanted is not None and wanted not in bands:
        there = f"they show {sentence_of(sorted(bands))}" if bands else "they name none"
        raise UsageError(f"no photo shows the band '{plain(wanted, 40)}' (--band): {there}")
    if not bands or (len(bands) < 2 and wanted is None and not _in_colours(survey.photos)):
        return survey
    shown = wanted if wanted is not None else _usual(survey.photos)
    out = _nameless(survey.photos)
    out |= {p.name: reason for p in survey.photos if (reason := p.other_band(shown))}
    rejected = [RejectedPhoto(name=name, reason=reason) for name, reason in out.items()]
    return replace(
        survey,
        photos=tuple(p for p in survey.photos if p.name not in out),
        rejected=tuple(sorted((*survey.rejected, *rejected), key=lambda r: r.name)),
        other_bands=tuple(p for p in survey.photos if p.name in out and p.shows_a_band),
    )


def band_note(photos: Sequence[Photo]) -> tuple[str, ...]:
    """What is said where files show several bands."""
    bands = bands_of(photos)
    if len(bands) < 2:
        return ()
    listed = sentence_of([f"{name} ({n})" for name, n in sorted(bands.items())])
    shown = _usual(photos)
    which = f"one of them, {shown} unless" if shown else "the photos in colours, unless"
    return (
        f"Each file shows one band of a multispectral camera: {listed}. A map shows {which} --band"
        " names another; --all-bands draws all of them beside it.",
    )


def _nameless(photos: Sequence[Photo]) -> dict[str, str]:
    """A reason for each file that names no band, but looks like those of a camera that does: of the
    same size and type, and fewer than of any band. Among files of one band it would be a patch of
    another.
    """
    like = {(p.width, p.height, p.dtype) for p in photos if p.shows_a_band}
    found = [
        p.name
        for p in photos
        if p.channels == 1 and not (p.band_name or p.unit) and (p.width, p.height, p.dtype) in like
    ]
    few = len(found) < AS_MANY * max(bands_of(photos).values(), default=0)
    return dict.fromkeys(found, NAMELESS) if few else {}


AS_MANY = 0.5
"""Photos in colours are the map where there are at least so many times as many as of a band."""


def _in_colours(photos: Sequence[Photo]) -> bool:
    """Whether photos in colours are about as many as files of the commonest band."""
    colours = sum(p.in_colours for p in photos)
    return colours > AS_MANY * max(bands_of(photos).values(), default=0)


def _usual(photos: Sequence[Photo]) -> str:
    """The band that a map shows where none is asked for; empty for photos in colours."""
    if _in_colours(photos):
        return ""
    bands, rank = bands_of(photos), {name: k for k, name in enumerate(PREFERRED)}
    return min(bands, key=lambda name: (-bands[name], rank.get(name, len(rank)), name))


def without_partner(
    files: Sequence[Photo], beside: Mapping[int, int], placed: Container[int], partner: str
) -> list[RejectedPhoto]:
    """The files of a second camera that no placed photo of the map was taken together with.

    `beside`: index of a file -> that of the map's photo taken together with it; `placed`: those of
    the map's photos that are; `partner`: what these are called.
    """
    return [
        RejectedPhoto(
            name=photo.name,
            reason=f"the {partner} that was taken together with it is not placed"
            if j in beside
            else f"no {partner} was taken together with it",
        )
        for j, photo in enumerate(files)
        if j not in beside or beside[j] not in placed
    ]


def told_left_out(lost: Sequence[RejectedPhoto]) -> list[str]:
    """A sentence for each reason why files are left out."""
    alike: dict[str, list[str]] = {}
    for photo in lost:
        alike.setdefault(photo.reason, []).append(photo.name)
    return [
        f"{names[0]} is left out: {reason}"
        if len(names) == 1
        else f"{len(names)} files are left out, {names[0]} for one: {reason}"
        for reason, names in alike.items()
    ]
