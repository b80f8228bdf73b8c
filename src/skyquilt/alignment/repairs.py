"""Adjustments that are made again because the one before shows that files tell a part falsely.

Each repair judges what files tell by an adjustment, adjusts again with what it thinks right, and
takes that only where it fits better. They follow one another in the order of `REPAIRS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.displaced_parts import brought_together, outvoted, placed_between
from skyquilt.alignment.enlarged import enlarged_note, enlarged_photos, fits_better
from skyquilt.alignment.false_heights import outvoted_heights
from skyquilt.alignment.false_tilts import common_tilts, leaning_lines, off_told, told_no_tilt
from skyquilt.alignment.late_positions import mirrored, moved_note, on_time, unshifted
from skyquilt.alignment.oblique import reported_oblique, tilted, turned_deg, without_photos
from skyquilt.alignment.oblique_guess import (
    LOOK_DOWN,
    LOWERED,
    agrees,
    believable,
    doubtful_views,
    far_off,
    lowered,
    misled,
    shown_to_look_down,
    taken_to_look_down,
)
from skyquilt.alignment.oblique_start import (
    aslant,
    nearer,
    off_positions,
    slanting,
    turned_priors,
    untold,
)
from skyquilt.alignment.same_lens import sizes_note, unlike
from skyquilt.alignment.stabilised import fits_stabilised, stabilised_cameras, stabilised_note
from skyquilt.alignment.tries import Beginning, Survey, Tried
from skyquilt.alignment.unfit_cameras import (
    cut_notes,
    fits_as_well,
    fits_cut,
    focal_notes,
    unfit_notes,
)
from skyquilt.alignment.unlike_lenses import (
    alike_cameras,
    fits_lenses,
    lenses_note,
    named_lenses,
    unlike_lenses,
)
from skyquilt.errors import AlignmentError
from skyquilt.model.poses import Alignment, Prior

ENLARGED_AGAIN = 3
"""Photos that are enlarged by other factors are divided so often at most: what fits none of the
cameras bends the heights by which the next are told.
"""
LENSES_AGAIN = 3
"""Photos are divided among two lenses so often at most: what is left then tells those that were
given the wrong one.
"""
AWAY = 0.85
"""Photos that tell their poses, and lie further from their positions than this times their
deviations in space (median; two thirds are usual), may have been begun wrongly.
"""
FEW_TURNED = 0.2
"""Photos that stay turned from what they report are hung on the others, if they are no more than
this share.
"""
MORE_ALIKE = 0.8
"""Photos that look nearer to where they say by this factor are told better."""
BEGUN_AGAIN = 5
"""An oblique survey without camera angles is adjusted again as it was found, so often at most, as
long as photos come nearer to their positions.
"""
ONE_LENS = 1.05
"""Pictures of several sizes fit one lens at most so many times as badly as a lens for each size,
which has some ten parameters more for each.
"""
FOCALS_AGAIN = 6
"""Focal lengths are guessed again so often at most: each time an adjustment comes nearer."""


def begun_with(priors: Sequence[Prior], survey: Survey, *, repair: bool) -> Tried:
    """The first adjustment, with what files tell; oblique photos are kept aside for `repair`.

    Raises:
        AlignmentError: no two photos are linked.
    """
    aside = frozenset[int]()
    if repair:
        aside = untold(priors) if slanting(priors) else reported_oblique(priors)
    try:
        return survey.tried(Beginning(priors=priors, aside=aside))
    except AlignmentError:
        if not aside:
            raise
        return survey.tried(Beginning(priors=priors))


def repaired(first: Tried, survey: Survey) -> Tried:
    """The adjustment with all repairs that fit better than what was there before. What is told of
    cameras is what the last of them found.
    """
    for repair in REPAIRS:
        first = repair(first, survey)
    begun, found = first.begun, first.found
    cut = begun.cut & found.cameras.keys() - begun.sizes.keys()
    loose = begun.loose & found.cameras.keys()
    said = (*cut_notes(found, cut), *unfit_notes(found, loose))
    return replace(first, notes=(*first.notes, *said))


def _one_lens(last: Tried, survey: Survey) -> Tried:
    """Pictures of several sizes that one lens took are calibrated together: reduced ones, or else
    parts that were cut out, whose principal points pictures alone tell.
    """
    for cut in (False, True) if len(set(survey.cameras)) > 1 else ():
        if not (sizes := survey.sizes(cut)):
            break
        parts = last.begun.cut.union(sizes if cut else ())
        other = survey.tried(last.begun, sizes=sizes, cut=parts, name=f"sizes {cut} ")
        false = unlike(other.found, survey.cameras, sizes, last.begun.priors)
        if not false and fits_as_well(other.found, last.found, worse=ONE_LENS):
            return replace(other, notes=(*last.notes, sizes_note(sizes)))
    return last


def _guessed_focals(last: Tried, survey: Survey) -> Tried:
    """Focal lengths that no file tells are guessed again where they tend."""
    best = _other_focals(last, survey, survey.focals, "focal")
    if best is last:
        return last
    return replace(best, notes=(*last.notes, *focal_notes(best.found, best.begun.focals)))


def _other_focals(
    last: Tried,
    survey: Survey,
    asked: Callable[[Tried], tuple[Mapping[str, float], bool]],
    name: str,
) -> Tried:
    """The adjustment begun with the factors of focal lengths that are asked for, again and again
    as long as it fits; `name` tells these beginnings from others.
    """
    best = last
    for again in range(FOCALS_AGAIN):
        factors, sure = asked(best)
        if not factors:
            break
        focals = {**best.begun.focals, **factors}
        other = survey.tried(best.begun, focals=focals, name=f"{name} {again} ")
        fits = fits_as_well if sure else fits_cut
        if not fits(other.found, best.found):
            break
        best = replace(other, notes=last.notes)
    return best


def _false_views(last: Tried, survey: Survey) -> Tried:
    """Photos of an oblique survey that look down, whatever they report, begin so: some programs
    count a gimbal's pitch from straight down, or write one angle into all files.
    """
    priors = last.begun.priors
    if not slanting(priors) or not doubtful_views(last.found, priors, survey.linked):
        return last
    down = taken_to_look_down(priors)
    other = survey.tried(last.begun, priors=down, aside=frozenset(), name="down ")
    if not shown_to_look_down(other.found, last.found, priors, survey.linked):
        return last
    counted = lowered(other.found, priors)
    if counted is not priors and not told_no_tilt(other.found, counted)[1]:
        notes = (*last.notes, LOWERED)
        return replace(survey.tried(other.begun, priors=counted, name="lowered "), notes=notes)
    note = LOOK_DOWN.format(sum(map(tilted, priors)), len(priors))
    return replace(other, notes=(*last.notes, note))


def _as_reported(last: Tried, survey: Survey) -> Tried:
    """Photos that look somewhat aslant begin as they report: links of these, taken for similarities
    of the ground's plane, may put them where positions look like gross errors, contradict one
    another, or turn them far from their angles. Photos that do not report their angles are hung on
    the others, and so are a few that stay turned: alone in a false minimum.
    """
    priors = last.begun.priors
    if not aslant(priors):
        return last
    begin = survey.beginnings(last)
    angles = [begin.of(i, p) for i, p in enumerate(priors)]
    away = turned_away(last.found, angles)
    if not (away or len(last.found.blocks) > 1 or far_off(last.found, priors, AWAY)):
        return last
    aside = last.begun.aside | (untold(priors) - begin.centres.keys())
    other = survey.tried(last.begun, in_space=begin, aside=aside, name="as reported ")
    before = without_photos(last.found, dict.fromkeys(aside, "hung on the others"))
    left = turned_away(other.found, angles)
    as_told = len(left) < len(away) and len(other.found.held) >= len(before.held)
    if not (as_told or nearer(other.found, before, priors)) or not agrees(other.found, before):
        return last
    if 0 < len(left) <= FEW_TURNED * len(other.found.held):
        other = survey.tried(other.begun, aside=aside | left, name="without turned ")
    return replace(other, notes=last.notes)


def turned_away(found: Alignment, priors: Sequence[Prior]) -> frozenset[int]:
    """The photos of an adjustment that look elsewhere than they report, further than these err."""
    return frozenset(i for i in found.held if turned_deg(found.poses[i], priors[i]) > STATED_DEG)


def _enlargements(last: Tried, survey: Survey) -> Tried:
    """Photos that are enlarged without a word are calibrated by themselves."""
    best = last
    for again in range(ENLARGED_AGAIN):
        factors = best.begun.enlarged
        cameras = [f"{c} {factors.get(i, 1.0)}" for i, c in enumerate(survey.cameras)]
        large = enlarged_photos(best.found, cameras, best.begun.priors)
        if not large:
            break
        factors = {**factors, **{i: factors.get(i, 1.0) * f for i, f in large.items()}}
        other = survey.tried(best.begun, enlarged=factors, name=f"big {again} ")
        if not fits_better(other.found, best.found):
            break
        best = other
    if best is last:
        return last
    return replace(best, notes=(*last.notes, enlarged_note(best.begun.enlarged, survey.cameras)))


def _unlike_lenses(last: Tried, survey: Survey) -> Tried:
    """Photos of several lenses that files tell to be of one camera are calibrated by themselves: as
    their names tell, or else of two lenses as these bend them.
    """
    if named := named_lenses(
        survey.names, survey.cameras, alike_cameras(last.found, survey.cameras)
    ):
        other = survey.tried(last.begun, lenses=named, name="named lenses ")
        if fits_lenses(other.found, last.found, {}):
            note = lenses_note(named, survey.cameras, survey.names)
            return replace(other, notes=(*last.notes, note))
    best = last
    for again in range(LENSES_AGAIN):
        before = best.begun.lenses
        lenses = unlike_lenses(best.found, survey.cameras, before)
        if not lenses or lenses == before:
            break
        other = survey.tried(best.begun, lenses=lenses, name=f"lenses {again} ")
        if not fits_lenses(other.found, best.found, before):
            break
        best = other
    if best is last:
        return last
    note = lenses_note(best.begun.lenses, survey.cameras, survey.names)
    return replace(best, notes=(*last.notes, note))


def _cut_pictures(last: Tried, survey: Survey) -> Tried:
    """Principal points of photos that were cut off are told by these alone, and the focal lengths
    of files count for the whole pictures.
    """
    cameras = survey.cut(last)
    best = _freed(last, survey, cameras, fits_cut, cut=cameras, name="cut ")
    if best is last or not (focals := survey.wholes(best)):
        return best
    whole = survey.tried(best.begun, focals={**best.begun.focals, **focals}, name="whole ")
    return replace(whole, notes=last.notes) if fits_as_well(whole.found, best.found) else best


def _held_in_the_middle(last: Tried, survey: Survey) -> Tried:
    """Principal points that took the place of tilts are held again where photos were found to look
    elsewhere since, and lie in the middle then.
    """
    cut = last.begun.cut
    false = cut - survey.cut(last) if last.begun.guess is not None else frozenset[str]()
    return _freed(last, survey, false, fits_as_well, cut=cut - false, name="uncut ")


def _mirrored_positions(last: Tried, survey: Survey) -> Tried:
    """Positions that are mirrored are mirrored back."""
    back = mirrored(last.found, last.begun.priors)
    if back is None:
        return last
    return _if_nearer(last, survey, back.priors, "mirrored ", back.note)


def _late_positions(last: Tried, survey: Survey) -> Tried:
    """Positions that belong to other photos are moved to these."""
    priors = last.begun.priors
    moved = unshifted(last.found, priors, survey.cameras)
    if moved is priors:
        return last
    return _if_nearer(last, survey, moved, "moved ", moved_note(priors, moved))


def _late_moments(last: Tried, survey: Survey) -> Tried:
    """Positions of another moment are moved along the flight; views ahead look alike, at first."""
    late = on_time(last.found, last.begun.priors, survey.cameras, survey.speeds)
    if late is None:
        return last
    ahead = _guessed_directions(last, survey)
    return ahead if ahead is not last else _if_nearer(last, survey, late.priors, "late ", late.note)


def _outvoted_positions(last: Tried, survey: Survey) -> Tried:
    """Positions that contradict those of most photos are not used."""
    if slanting(last.begun.priors):
        return last
    majority = outvoted(last.found, survey.names, last.begun.priors, survey.cameras)
    if majority is None:
        return last
    return _if_nearer(last, survey, majority.priors, "outvoted ", majority.note)


def _outvoted_heights(last: Tried, survey: Survey) -> Tried:
    """Heights that contradict those of most photos are not used."""
    majority = outvoted_heights(last.found, survey.names, last.begun.priors, survey.cameras)
    if majority is None:
        return last
    other = survey.tried(last.begun, priors=majority.priors, name="heights ")
    if not fits_as_well(other.found, last.found):
        return last
    return replace(other, notes=(*last.notes, majority.note))


def _common_tilts(last: Tried, survey: Survey) -> Tried:
    """Tilts with an error that all photos of a camera have in common are corrected by it. False
    heights look like such an error, too, but then pictures contradict it.
    """
    priors = last.begun.priors
    corrected, notes = common_tilts(last.found, priors, survey.cameras)
    if not notes:
        return last
    other = survey.tried(last.begun, priors=corrected, name="common tilts ")
    if not fits_as_well(other.found, last.found):
        return last
    as_told = off_told(other.found, corrected) < MORE_ALIKE * off_told(last.found, priors)
    if as_told or off_positions(other.found, priors) < off_positions(last.found, priors):
        return replace(other, notes=(*last.notes, *notes))
    return last


def _leaning_lines(last: Tried, survey: Survey) -> Tried:
    """Oblique photos whose lines lean as their gimbal is off are corrected by that."""
    priors = last.begun.priors
    if not (slanting(priors) or aslant(priors)):
        return last
    corrected, notes = leaning_lines(last.found, priors, survey.cameras)
    return _if_nearer(last, survey, corrected, "leaning ", *notes) if notes else last


def _false_tilts(last: Tried, survey: Survey) -> Tried:
    """Tilts that pictures contradict as a whole are not used, or count for little already, since
    they scatter.
    """
    loose, note = told_no_tilt(last.found, last.begun.priors)
    if slanting(last.begun.priors) or not note:
        return last
    other = survey.tried(last.begun, priors=loose, name="loose ")
    off, before = (off_positions(t.found, loose) for t in (other, last))
    best = other if off < before else last
    return replace(best, notes=(*last.notes, note)) if MORE_ALIKE * off < before else last


def _guessed_directions(last: Tried, survey: Survey) -> Tried:
    """Directions of oblique photos that files do not tell, or tell falsely, are guessed."""
    priors = last.begun.priors
    if not misled(last.found, priors, survey.linked):
        return last
    guess = survey.guess(last)
    if guess is None:
        return last
    other = survey.tried(last.begun, guess=guess, aside=untold(guess), name="guessed ")
    fits = nearer(other.found, last.found, priors) and agrees(other.found, last.found)
    if fits and believable(other.found, last.found, priors):
        return replace(other, notes=last.notes)
    return last


def _found_directions(last: Tried, survey: Survey) -> Tried:
    """Oblique photos are begun again with the directions in which they were found."""
    best, priors = last, last.begun.priors
    for again in range(BEGUN_AGAIN):
        turned = turned_priors(best.found, priors)
        if turned is None:
            break
        name = f"turned {again} "
        other = survey.tried(best.begun, guess=turned, aside=untold(turned), name=name)
        if not nearer(other.found, best.found, priors):
            break
        best = other
    return best if best is last else replace(best, notes=last.notes)


def _false_focals(last: Tried, survey: Survey) -> Tried:
    """Focal lengths that files tell and pictures contradict are guesses, too."""
    return _other_focals(last, survey, survey.false_focals, "told")


def _unfit_cameras(last: Tried, survey: Survey) -> Tried:
    """Shutters and aspect ratios that pictures contradict are told by these alone."""
    cameras = survey.unfit(last)
    return _freed(last, survey, cameras, fits_as_well, loose=cameras, name="unfit ")


def _stabilised(last: Tried, survey: Survey) -> Tried:
    """Photos that stabilisation cut out of larger pictures, each elsewhere, have axes of their own.
    What was thought of their shutter and of where all of them were cut took the place of these.
    """
    cameras = stabilised_cameras(last.found, survey.cameras)
    if not cameras:
        return last
    loose, cut = last.begun.loose - cameras, last.begun.cut - cameras
    other = survey.tried(last.begun, stabilised=cameras, loose=loose, cut=cut, name="stabilised ")
    if not fits_stabilised(other.found, last.found, survey.cameras):
        return last
    note = stabilised_note(other.found, survey.cameras, cameras)
    return replace(other, notes=(*last.notes, note))


def _displaced_parts(last: Tried, survey: Survey) -> Tried:
    """Parts of the survey whose positions are displaced are brought together."""
    priors = last.begun.priors
    if slanting(priors) or last.begun.guess is not None:
        return last
    together = brought_together(last.found, survey.names, priors, survey.cameras)
    if together is None:
        return last
    other = _if_nearer(last, survey, together.priors, "together ", together.note)
    if other is last:
        return last
    return replace(other, found=placed_between(other.found, together.apart_m))


def _freed(
    last: Tried,
    survey: Survey,
    cameras: frozenset[str],
    fits: Callable[[Alignment, Alignment], bool],
    **changes: Any,
) -> Tried:
    """The adjustment with changes that free or hold some cameras, where there are any and it
    `fits`.
    """
    if not cameras:
        return last
    other = survey.tried(last.begun, **changes)
    return replace(other, notes=last.notes) if fits(other.found, last.found) else last


def _if_nearer(
    last: Tried, survey: Survey, priors: Sequence[Prior], name: str, *notes: str
) -> Tried:
    """The adjustment with other priors, where photos come nearer to their positions with these."""
    other = survey.tried(last.begun, priors=priors, name=name)
    if off_positions(other.found, priors) < off_positions(last.found, priors):
        return replace(other, notes=(*last.notes, *notes))
    return last


REPAIRS: tuple[Callable[[Tried, Survey], Tried], ...] = (
    _one_lens,
    _guessed_focals,
    _false_views,
    _mirrored_positions,
    _as_reported,
    _enlargements,
    _unlike_lenses,
    _cut_pictures,
    _late_positions,
    _leaning_lines,
    _late_moments,
    _outvoted_positions,
    _outvoted_heights,
    _common_tilts,
    _false_tilts,
    _guessed_directions,
    _found_directions,
    _false_focals,
    _held_in_the_middle,
    _unfit_cameras,
    _stabilised,
    _displaced_parts,
)
"""All repairs, in order: each relies on those before."""
