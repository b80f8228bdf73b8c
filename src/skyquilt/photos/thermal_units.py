"""One unit, and one kind of pixels, for all thermal files of a camera; what is said of units."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from skyquilt.model.photo import Photo, RejectedPhoto, Stored
from skyquilt.photos.thermal import STATED, UNFIT, UNREAD, UNSTATED

_FEW = 0.2
"""Share of the frames of a flight up to which those that fit no unit are exceptions (a fire)."""


def in_one_unit(
    photos: Sequence[Photo | RejectedPhoto], read: Callable[[Photo, Stored], Photo | RejectedPhoto]
) -> list[Photo | RejectedPhoto]:
    """The photos, in their order; frames of one camera whose units were derived from their values,
    and differ, are read again in one unit. `read` reads a photo's file in a unit.

    Frames of one flight lie on both sides of a limit between two units: counts that drift, a fire.
    Each was read in a unit of its own, and the map joined degrees with counts.
    """
    derived: dict[str, list[Photo]] = defaultdict(list)
    for photo in photos:
        if isinstance(photo, Photo) and photo.stored and _is_derived(photo):
            derived[photo.camera_key].append(photo)
    unit_of: dict[str, Stored] = {}
    for own in derived.values():
        common = _common([p.stored for p in own])
        unit_of |= {p.name: common for p in own if common not in ("", p.stored)}
    return [
        _read(p, unit_of[p.name], read) if isinstance(p, Photo) and p.name in unit_of else p
        for p in photos
    ]


def _read(
    photo: Photo, unit: Stored, read: Callable[[Photo, Stored], Photo | RejectedPhoto]
) -> Photo | RejectedPhoto:
    found = read(photo, unit)
    if isinstance(found, RejectedPhoto):
        return found
    told = f"Its values are read as {unit}, as those of other frames of its camera."
    return replace(found, notes=tuple(told if n.endswith(STATED) else n for n in found.notes))


def _is_derived(photo: Photo) -> bool:
    return any(UNSTATED in n or UNFIT in n for n in photo.notes)


def _common(units: Sequence[Stored]) -> Stored:
    """The unit for all frames of a camera, of which each alone seems to have its own; empty for
    files of real numbers and of integers, which differ.
    """
    found = Counter(units)
    if {"celsius", "kelvin"} & found.keys() and found.keys() - {"celsius", "kelvin", "counts"}:
        return ""
    if found["counts"] > _FEW * len(units):
        return "counts"
    if found["centicelsius"]:
        # in tenths of a degree or a kelvin these frames are impossible, the others in hundredths
        # of a degree are not
        return "centicelsius"
    del found["counts"]
    return found.most_common(1)[0][0]


def in_palettes(photos: Sequence[Photo]) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos; radiometric JPEGs of a camera of which as many hold a palette's colours alone are
    read as the pictures that they hold, too, so that one map shows all; and a note on these.
    """
    cameras: dict[str, list[Photo]] = defaultdict(list)
    for photo in photos:
        if photo.band == "thermal" and photo.coding:
            cameras[photo.camera_key].append(photo)
    shown: dict[str, Photo] = {}
    for own in cameras.values():
        measured, plain = [p for p in own if p.unit], [p for p in own if not p.unit]
        if len(measured) <= len(plain):
            channels = plain[0].channels
            shown |= {
                p.name: replace(p, unit="", dtype="uint8", channels=channels) for p in measured
            }
    if not shown:
        return tuple(photos), ()
    return tuple(shown.get(p.name, p) for p in photos), (
        f"{len(shown)} thermal photos hold measurements, {min(shown)} for one, but as many or more"
        " of their camera a palette's colours alone: the colours of all are mapped. For a map of"
        " measurements, map those photos by themselves.",
    )


def unit_notes(photos: Sequence[Photo]) -> Iterator[str]:
    """What is said of the units of thermal TIFFs."""
    units = Counter(p.stored for p in photos if p.stored)
    listed = " and ".join(f"{n} as {unit}" for unit, n in units.most_common())
    guessed = next((f" {n}" for p in photos for n in p.notes if UNSTATED in n), "")
    if len(units) > 1:
        yield (
            f"Thermal TIFFs are read in different units, {listed}; set one for all with"
            f" --thermal-unit.{guessed}"
        )
    elif units:
        unit = listed.split(" as ")[1]
        yield f"Thermal TIFFs are read as {unit} ({sum(units.values())}).{guessed}"
    untold = [
        p for p in photos if p.dtype != "uint8" and p.channels == 1 and not (p.unit or p.band_name)
    ]
    if untold:
        yield (
            f"{len(untold)} photos have one band of 16 bits or more and state no unit: they are"
            " mapped as brightness; if they are temperatures, give --thermal-unit."
        )
    palettes = sum(p.band == "thermal" and not p.unit and p.dtype == "uint8" for p in photos)
    if palettes:
        yield (
            f"{palettes} thermal photos hold a palette's colours or greys, not temperatures: a map"
            " of them shows where it is warmer, not how warm. For temperatures, give the camera's"
            " radiometric files (R-JPEG of FLIR, or TIFF)."
        )
    unread = sum(UNREAD in p.notes for p in photos)
    if unread:
        yield (
            f"{unread} photos hold raw data, perhaps temperatures, in a form that is not read (only"
            " those of FLIR and DJI are); their colours are mapped. Convert them to TIFF with the"
            " maker's program for a map of temperatures."
        )
