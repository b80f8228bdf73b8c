"""Whether control points contradict the pictures, one another, or the photos' own positions: they
are coordinates and marks that people typed, and hold the map.
"""

from collections.abc import Sequence

import numpy as np

from skyquilt.alignment.heights import absolute
from skyquilt.model.photo import Datum, Photo
from skyquilt.model.poses import Alignment, ControlResidual, Prior
from skyquilt.photos.side_rows import sentence_of

MISMARKED_PX = 5.0
"""Lines of sight to one point that miss one another by more, root mean square, were marked
wrongly: people mark to one or two pixels.
"""
MISPLACED = 5.0
"""A point that lies this many deviations off is told, or this many times what most points lie off,
whichever is more: whole surveys are less precise than is taken for them.
"""
MOST_OFF = 20.0
"""Where most points lie this many deviations off, no single one is wrong."""
AWAY_M, AWAY_DEVIATIONS = 20.0, 5.0
"""Control points that move the map further from the photos' positions, and so many times what these
err by, are told,
"""
HIGHER_M = 30.0
"""and so are heights that differ by more: receivers and barometers of drones err by less, mostly.
"""


def control_notes(
    found: Alignment, photos: Sequence[Photo], priors: Sequence[Prior]
) -> tuple[str, ...]:
    """Sentences on control and check points that cannot be right, with what they miss by."""
    seen = [c for c in found.control if c.observations >= 2]
    if found.frame.crs is None or not seen:
        return ()
    marked = {c.name: f"{c.reprojection_px:.0f} px" for c in seen if not _meets(c)}
    if 2 * len(marked) > len(seen):
        return (
            f"Of {len(marked)} of {len(seen)} control points the marks in the photos do not belong"
            " together: their lines of sight miss one another, and the map is not reliable. Pixels"
            " are counted from the upper left corner of the photo as it is stored, to the right"
            " and down; correct that file.",
        )
    return (*_mismarked(marked), *_misplaced(seen), *_away(found, photos, priors))


def _mismarked(marked: dict[str, str]) -> tuple[str, ...]:
    """A sentence on points of wrong marks, by name and by how much their lines of sight miss."""
    if not marked:
        return ()
    return (
        f"The marks of {_named(marked)} do not belong together: their lines of sight miss one"
        " another by so much. Correct or remove these rows of the control points' file.",
    )


def _misplaced(seen: Sequence[ControlResidual]) -> tuple[str, ...]:
    """A sentence on points that lie elsewhere than is told of them."""
    off = {
        c.name: float(np.nanmax(np.abs(c.error_m) / c.sigma_m))
        for c in seen
        if c.sigma_m is not None and _meets(c)
    }
    metres = {c.name: float(np.linalg.norm(np.nan_to_num(c.error_m))) for c in seen}
    usual = float(np.median(list(off.values()))) if off else 0.0
    if usual > MOST_OFF:
        middle = np.median([metres[name] for name in off])
        return (
            f"Control points contradict the pictures and one another: half of them lie more than"
            f" {middle:.2g} m from where the photos show them. Correct their coordinates or"
            " names, or survey them better.",
        )
    wrong = {
        n: f"{metres[n]:.2g} m off"
        for n, times in off.items()
        if times > MISPLACED * max(usual, 1.0)
    }
    if not wrong:
        return ()
    return (
        f"The photos and the other control points do not agree with the coordinates of"
        f" {_named(wrong)}. Correct coordinates, names or marks; such a point hardly counts beside"
        " the others.",
    )


def _away(found: Alignment, photos: Sequence[Photo], priors: Sequence[Prior]) -> tuple[str, ...]:
    """Sentences on a map that control points hold far from the photos' own positions."""
    fit = [c for c in found.control if not c.check]
    told = [i for i in found.held if np.isfinite(priors[i].map_C[:2]).all()]
    notes = []
    if fit and told:
        shift = np.median([(found.poses[i].map_C - priors[i].map_C)[:2] for i in told], axis=0)
        usual = float(np.median([priors[i].sigma_C[0] for i in told]))
        far = float(np.hypot(*shift))
        if far > max(AWAY_M, AWAY_DEVIATIONS * usual):
            notes.append(
                f"The control points put the map {far:,.0f} m from where the photos' positions do"
                f" ({shift[0]:+,.0f} m east, {shift[1]:+,.0f} m north). It lies where they say;"
                " check their coordinate system and its datum, or the photos' positions."
            )
    if any(np.isfinite(c.error_m[2]) for c in fit):
        datum = found.frame.vertical_datum
        zero: Datum = "ellipsoid" if datum == "ellipsoid" else "egm96"
        heights = {i: absolute(p, zero) for i in found.held if (p := photos[i].position)}
        above = [found.poses[i].map_C[2] - z for i, z in heights.items() if z is not None]
        if above and abs(off := float(np.median(above))) > HIGHER_M:
            notes.append(
                f"By the control points the photos were taken {abs(off):,.0f} m"
                f" {'higher' if off > 0 else 'lower'} than they report above the"
                f" {'ellipsoid' if zero == 'ellipsoid' else 'sea'}: heights of"
                " the control points may be in feet, above the ellipsoid, or above a zero of their"
                " own, and the photos' may be wrong. The map's heights are those of the points."
            )
    return tuple(notes)


def _meets(point: ControlResidual) -> bool:
    """Whether its lines of sight meet as near as people mark."""
    return point.reprojection_px <= MISMARKED_PX and bool(np.isfinite(point.error_m[:2]).all())


def _named(off: dict[str, str]) -> str:
    """`gcp1 (10 m), gcp2 (3 m) and 4 more`."""
    return sentence_of([f"{name} ({by})" for name, by in off.items()])
