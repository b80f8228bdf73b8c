"""What an adjustment tells: ground points, predicted accuracy, and what a flight leaves open."""

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import Covariance
from skyquilt.alignment.deviations import FEWEST_ERRORS, drift, likeness, point_deviations
from skyquilt.alignment.problem import Problem, State, residuals_px
from skyquilt.alignment.setup import TURNED, Setup
from skyquilt.alignment.stages import heights_above, prune
from skyquilt.alignment.tracks import Tracks
from skyquilt.alignment.triangulate import STEADY_HIGH, polish, triangulated
from skyquilt.model.camera import PARAMETERS
from skyquilt.model.poses import Accuracy, Alignment, TiePoints, no_ties
from skyquilt.photos.side_rows import sentence_of

Array = NDArray[np.float64]
SAMPLED = 400
"""Ground points whose accuracy is predicted, about."""
LEAST_TOLD = 1e-3
"""Share of what is known of a photo's position that all others must tell, to predict it."""
LEAST_SETTLED = 0.05
"""Share of the tracks whose heights must be known: 0.5 and more are of a flight, 0.015 and less of
photos from one place, where chance puts single points anywhere before the camera.
"""
UNDETERMINED = 0.4
"""A focal length whose deviation stays above this share of its prior's is not determined: what the
metadata say of it counts for a sixth or more.
"""
UNSETTLED = "This flight does not determine the focal length"
"""How the sentence begins that says so of a camera."""
STRETCHED = 5.0
"""A ratio of focal lengths this many deviations off its prior shows a stretched picture."""
UNFIT = 0.3
"""Residuals that correlate this much within parts of a photo (`deviations.likeness`) show that no
lens fits: 0 to 0.16 on ordinary flights, 0.43 to 0.56 where one side of the photos is a fifth to a
third longer.
"""
ASPECT = PARAMETERS.index("aspect")
"""Column of the aspect ratio among the intrinsics."""
SEEM = "seem to be stretched"
"""Words of the note of a camera whose ratio of focal lengths is far off."""
NO_FIT = "do not fit a camera as it is taken for"
"""Words of the note of a camera whose residuals correlate so."""
OF_CAMERA = (
    UNSETTLED + " of {0}: ",
    "The photos of {0} " + SEEM,
    "The photos of {0} do not fit ",
    "The optical axis of {0} meets ",
    "Files do not tell the focal length of {0}, ",
    "No file tells the focal length of {0}: ",
)
"""How notes on one camera begin, {0} its name."""


def leave_one_out(
    problem: Problem, state: State, covariance: Covariance | None
) -> tuple[float, float, float] | None:
    """RMS per axis in m of the difference between each measured position and its prediction from
    all other observations; photos of which the others tell nothing are left out.

    Computed from the covariance of the full solution (the usual identity of linear least squares)
    instead of n adjustments.
    """
    known = np.flatnonzero(np.isfinite(problem.C0[:, :2]).all(1))
    if covariance is None or len(known) < 3:
        return None
    out = []
    for i in known:
        axes = np.isfinite(problem.C0[i])
        e = (state.C[i] - problem.C0[i])[axes]
        white = e / problem.sigma_C[i][axes]
        precision = np.diag(1 / problem.sigma_C[i][axes] ** 2) / np.sqrt(
            1 + (white @ white) / problem.loss_C**2
        )
        own = covariance.photos[i, 3:6, 3:6][np.ix_(axes, axes)]
        told = np.eye(len(e)) - own @ precision  # by the others
        if np.linalg.eigvals(told).real.min() < LEAST_TOLD:
            continue
        full = np.full(3, np.nan)
        full[axes] = np.linalg.solve(told, e)
        out.append(full)
    if not out:
        return None
    squares = np.array(out) ** 2
    count = np.isfinite(squares).sum(0)  # perhaps of no height
    rms = np.sqrt(np.where(count, np.nansum(squares, 0), np.nan) / np.maximum(count, 1))
    return float(rms[0]), float(rms[1]), float(rms[2])


def ground_points(tracks: Tracks, setup: Setup, state: State) -> TiePoints:
    """All tracks triangulated with the final poses; outliers and unstable points are removed. None
    where next to no track is left: the photos were taken from one place.

    Of large surveys these are millions of observations, more than anything else in memory: what is
    found of a part of them is small, and the parts are joined one field at a time.
    """
    found = [_ground_part(part, state, setup) for part in setup.problems(tracks)]
    z = np.concatenate([ties.xyz[:, 2] for ties, _ in found] or [np.zeros(0)])
    height = abs(float(np.median(state.C[:, 2]) - np.median(z))) if len(z) else 0.0
    parts, first = [no_ties()], 0
    while found:
        ties, sigma_z = found.pop(0)
        keep = (sigma_z < STEADY_HIGH * height)[ties.point]
        points, number = np.unique(ties.point[keep], return_inverse=True)
        values = {n: getattr(ties, n)[keep] for n in ("photo", "px", "residual_px")}
        point = (first + number).astype(ties.point.dtype)
        parts.append(TiePoints(xyz=ties.xyz[points], point=point, **values))
        first += len(points)
    if first < LEAST_SETTLED * tracks.count:
        return no_ties()
    lists = {f.name: [getattr(p, f.name) for p in parts] for f in fields(TiePoints)}
    del parts
    return TiePoints(**{name: np.concatenate(lists.pop(name)) for name in list(lists)})


def _ground_part(everything: Problem, state: State, setup: Setup) -> tuple[TiePoints, Array]:
    """The points of some tracks with their sound observations, and how well each height is
    known.
    """
    everything = replace(everything, loss_px=2.0)
    whole, _ = polish(everything, triangulated(everything, state), iterations=3)
    everything, whole = prune(everything, whole, 5.0)
    whole, sigma_z = polish(everything, whole, iterations=2)
    photo = setup.members[everything.photo]
    ties = TiePoints(
        xyz=whole.X,
        point=everything.point.astype(np.int32),
        photo=photo.astype(np.int32),
        px=setup.file_px(photo, everything.px).astype(np.float32),
        residual_px=(residuals_px(everything, whole) * setup.file_sign(photo)).astype(np.float32),
    )
    return ties, sigma_z


def accuracy(setup: Setup, problem: Problem, state: State, covariance: Covariance) -> Accuracy:
    """Predicted deviations of a sample of ground points; of those that photos of several places
    show and rays tell within the flying height, if there are any: others lie near a horizon, or in
    photos that nothing holds, or between a photo and its copies.
    """
    counts = np.broadcast_to(problem.shared, problem.point.shape)  # photos of a place as one
    number = np.bincount(problem.point, counts, minlength=len(state.X))
    seen = np.flatnonzero(number > 1.5)
    if not len(seen):
        seen = np.flatnonzero(np.bincount(problem.point, minlength=len(state.X)) >= 2)
    sample = seen[:: max(1, len(seen) // SAMPLED)]
    sigma = point_deviations(problem, state, covariance, sample)
    told = sigma.max(1, initial=0.0) < float(np.median(heights_above(state)))
    if told.any():
        sample, sigma = sample[told], sigma[told]
    tied = bool(np.isfinite(problem.X0).any())
    return Accuracy(
        xyz=state.X[sample],
        sigma_m=sigma,
        shared_m=(0.0, 0.0) if tied else _shared(setup, problem, state),
        focal_shares=_focal_shares(setup, problem, covariance),
        design_effect=problem.design_effect,
    )


def _shared(setup: Setup, problem: Problem, state: State) -> tuple[float, float]:
    """Horizontal and vertical deviation in m of all positions alike: the stated one, or what errors
    of positions one after the other have in common. An instrument that drifts over a flight is as
    far off at its start as it may drift, and their mean tells nothing of it.
    """
    known = np.isfinite(problem.C0)  # of a photo without a position nothing is stated
    stated = [
        np.median(sigma[own] if own.any() else sigma)
        for sigma, own in zip(setup.stated_sigma_C.T, known.T, strict=True)
    ]
    error = state.C - problem.C0
    return (max(float(stated[0]), drift(error[:, :2])), max(float(stated[2]), drift(error[:, 2:])))


def _focal_shares(setup: Setup, problem: Problem, covariance: Covariance) -> dict[str, float]:
    """The ratio of each focal length's deviation after the adjustment to that before."""
    after = covariance.camera_sigmas[:, 0]
    shares = np.where(problem.free[:, 0], after / problem.sigma_K[:, 0], 0.0)
    return dict(zip(setup.camera_keys, shares.tolist(), strict=True))


def undetermined(
    setup: Setup, problem: Problem, state: State, covariance: Covariance | None
) -> tuple[str, ...]:
    """Sentences about what the flight does not determine, on the least certain camera first."""
    if covariance is None:
        return ()
    notes = list[tuple[float, str]]()
    height = float(np.median(heights_above(state)))
    after = covariance.camera_sigmas[:, 0]
    for row, key in enumerate(setup.camera_keys):
        share = float(after[row] / state.K[row, 0])
        told = float(problem.sigma_K[row, 0] / state.K[row, 0])
        if problem.free[row, 0] and share > UNDETERMINED * told and share * height > 0.01:
            note = (
                f"{UNSETTLED} of {key}: it stays about as"
                f" uncertain as its metadata ({100 * share:.1f} %), and heights of the ground with"
                f" it ({share * height:.2g} m, one standard deviation); control points, oblique"
                " photos or lines at two heights would."
            )
            notes.append((-share, note))
    return tuple(note for _, note in sorted(notes))


def unconfirmed(setup: Setup, problem: Problem) -> tuple[str, ...]:
    """A sentence where few of many photos have a position: nothing shows whether these err by more
    than they state.
    """
    known = np.isfinite(problem.C0[:, :2]).all(1)
    few, several = int(known.sum()), len(problem.C0)
    if not 0 < few < min(FEWEST_ERRORS, several / 2) or np.isfinite(problem.X0).any():
        return ()
    stated = float(np.median(setup.stated_sigma_C[known, 0]))
    their = "position of one" if few == 1 else f"positions of {few}"
    return (
        f"The map's place rests on the {their} of {several} photos. So few do not show whether they"
        f" err by more than is taken for them ({stated:.2g} m), as those of phones and single fixes"
        " do by 5 to 10 m: the map is as wrong as they are. Positions of more photos, or control"
        " points, would tell.",
    )


def misfits(setup: Setup, problem: Problem, state: State) -> tuple[str, ...]:
    """Sentences about cameras whose photos no lens with square pixels fits, or with the pixels that
    its calibration tells: pictures stretched along one side, anamorphic lenses, and shutters that
    are not what they are taken for.
    """
    notes = []
    alike = likeness(problem, state, setup.size[setup.members])
    for row, key in enumerate(setup.camera_keys):
        told, found = problem.K0[row, ASPECT], state.K[row, ASPECT]
        apart = float(abs(found - told) / problem.sigma_K[row, ASPECT])
        if problem.free[row, ASPECT] and apart > STRETCHED:
            why = (
                f"{SEEM}: self-calibration finds focal lengths along columns and rows"
                f" of the ratio {found:.3f}, {apart:.0f} deviations from {told:.4g}. Pictures"
            )
        elif alike[row] > UNFIT:
            why = (
                f"{NO_FIT}: what is left unexplained goes the same way"
                f" over whole parts of a photo (correlation {alike[row]:.2f}; where all fits, at"
                " most 0.16). A rolling shutter that nothing tells (--shutter rolling), pictures"
            )
        else:
            continue
        notes.append(
            f"The photos of {key} {why} that were resized along one side and anamorphic lenses do"
            " so. Place and scale of the map may be several times as wrong as stated; files as the"
            " camera wrote them, or the true focal_x and focal_y in --cameras, help."
        )
    return tuple(notes)


def of_placed(found: Alignment) -> Alignment:
    """The alignment with what is told of cameras that placed photos were taken with, once."""
    return told_once(without_idle(found))


def told_once(found: Alignment) -> Alignment:
    """The alignment with one sentence on all cameras whose focal length is not determined: on the
    least certain one, and the names of the others. Photos of a lens that zooms are of many cameras.
    """
    camera = {
        note: key
        for note in found.notes
        for key in found.cameras
        if note.startswith(f"{UNSETTLED} of {key}: ")
    }
    if len(camera) < 2:
        return found
    first, *others = camera
    names = sentence_of([camera[note] for note in others])
    whole = f"{first} The same is true of {len(others)} more: {names}."
    notes = (whole if note == first else note for note in found.notes if note not in others)
    return replace(found, notes=tuple(notes))


def without_idle(found: Alignment) -> Alignment:
    """The alignment without what is told of cameras that no placed photo was taken with: those of
    screenshots, copies and photos of other places that were left out.
    """
    used = {found.camera_of[i].removesuffix(TURNED) for i in found.poses}
    idle = {key.removesuffix(TURNED) for key in found.camera_of.values()} - used
    if not idle:
        return found
    begins = tuple(start.format(key) for key in idle for start in OF_CAMERA)
    told = found.accuracy
    if told is not None:
        shares = {key: share for key, share in told.focal_shares.items() if key not in idle}
        told = replace(told, focal_shares=shares)
    notes = tuple(note for note in found.notes if not note.startswith(begins))
    return replace(found, notes=notes, accuracy=told)
