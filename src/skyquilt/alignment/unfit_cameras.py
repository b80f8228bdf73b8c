"""Cameras that are not what they are taken for: shutters that expose row by row without a word,
pictures that were resized along one side or cut off at one, and lenses far from a guess.

Such a camera is adjusted again with a readout time and an aspect ratio, or with a principal point,
that pictures alone tell. A drone that turns with its lines hardly tells the first two apart, so
they are loosened together.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.enlarged import fits_better, misfit_px
from skyquilt.alignment.outcome import ASPECT, NO_FIT
from skyquilt.alignment.problem import READOUT
from skyquilt.alignment.setup import SIGMA_ASPECT, Setup
from skyquilt.model.camera import PARAMETERS, Camera
from skyquilt.model.photo import Focal
from skyquilt.model.poses import Alignment

Floats = NDArray[np.float64]
CameraPriors = Mapping[str, tuple[Floats, Floats, NDArray[np.bool_]]]
"""Of each camera the values, their deviations, and which are estimated (`setup.priors_by_camera`).
"""
CONTRADICTED = 2.2
"""A readout time and an aspect ratio that together lie so many deviations off their priors
contradict these.
"""
ASSUMED = {READOUT: 8e-3, ASPECT: SIGMA_ASPECT}
"""Priors at least as wide are assumed; narrower ones are stated, and stay."""
LOOSE = {READOUT: 0.1, ASPECT: 0.1}
"""Deviations (s, ratio) of what pictures alone tell."""
WORSE = 1.03
"""The larger freedom is taken where photos fit at most so many times as badly with it."""
KEPT = 0.99
"""Share of the observations that another principal point keeps at least."""
CX, CY = (PARAMETERS.index(name) for name in ("cx", "cy"))
OFF_MIDDLE = 3.0
"""A principal point so many deviations off the middle of the picture contradicts that nothing was
cut off.
"""
CUT_BESIDE = 0.1
"""Share of the longer side by which a picture must have been longer before it was cut off, as the
principal point tells, for the focal length to count for that side: less is a lens off its middle.
"""
ASSUMED_MIDDLE, LOOSE_MIDDLE = 0.009, 0.15
"""Deviations of the principal point as shares of the picture's longer side: one at least as wide is
assumed, and that of what pictures alone tell.
"""

DOUBTFUL = 0.02
"""A guessed focal length that a flight leaves as uncertain as this share of it may be another one.
"""
FAR, FAR_OPEN = 1.4, 1.1
"""Factors by which it must be another one then: where pictures settle it, less is within what a
guess allows; where they leave it open, or it was begun again, less is of no effect.
"""
MOST_FAR = 12.0
"""Factor by which it can be another one."""
MAYBE_FALSE, FALSE = 2.0, 5.0
"""A focal length in the file so many deviations off what an adjustment with it finds may be false,
and is: it holds that back, most of all where it is too short.
"""


def unfit_cameras(found: Alignment, priors: CameraPriors) -> frozenset[str]:
    """Names of cameras whose photos contradict the shutter or the shape of pixels that is assumed
    of them, or fit no camera as it is assumed.
    """
    unfit = set[str]()
    for key, (K0, sigma, free) in priors.items():
        if (camera := found.cameras.get(key)) is None:
            continue
        apart = np.abs(np.r_[camera.vector, camera.readout_s] - K0) / sigma
        assumed = [c for c in ASSUMED if free[c] and sigma[c] >= ASSUMED[c]]
        other = float(np.linalg.norm(apart[assumed])) > CONTRADICTED
        if other or (assumed and _fits_none(found, key)):
            unfit.add(key)
    return frozenset(unfit)


def cut_cameras(found: Alignment, priors: CameraPriors) -> frozenset[str]:
    """Names of cameras whose photos show the principal point beside the middle of the picture, or
    fit no camera as it is assumed: other programs may have cut them off.
    """
    cut = set[str]()
    for key, (K0, sigma, free) in priors.items():
        if (camera := found.cameras.get(key)) is None:
            continue
        if not _middle_assumed(sigma, free, max(camera.width, camera.height)):
            continue
        apart = (camera.vector[[CX, CY]] - K0[[CX, CY]]) / sigma[[CX, CY]]
        if float(np.linalg.norm(apart)) > OFF_MIDDLE or _fits_none(found, key):
            cut.add(key)
    return frozenset(cut)


def _middle_assumed(sigma: Floats, free: NDArray[np.bool_], longer: float) -> bool:
    """Whether the principal point is estimated, and known from no calibration; `longer`: side of
    the picture in px.
    """
    return bool(free[[CX, CY]].all() and (sigma[[CX, CY]] >= ASSUMED_MIDDLE * longer).all())


def _fits_none(found: Alignment, key: str) -> bool:
    """Whether an alignment says that a camera's photos fit none as it is taken for."""
    return any(note.startswith(f"The photos of {key} {NO_FIT}") for note in found.notes)


def uncentred(setup: Setup, cameras: Collection[str]) -> Setup:
    """The same for an adjustment in which pictures alone tell the principal points that are assumed
    of some cameras.
    """
    if not cameras:
        return setup
    sigma: Floats = setup.base.sigma_K.copy()
    for row in (k for k, key in enumerate(setup.camera_keys) if key in cameras):
        longer = float(setup.size[setup.members[setup.camera == row]].max())
        if _middle_assumed(sigma[row], setup.base.free[row], longer):
            sigma[row, [CX, CY]] = LOOSE_MIDDLE * longer
    return replace(setup, base=replace(setup.base, sigma_K=sigma))


def loosened(setup: Setup, cameras: Collection[str]) -> Setup:
    """The same for an adjustment in which pictures alone tell the readout times and the aspect
    ratios that are assumed of some cameras.
    """
    if not cameras:
        return setup
    own = np.array([key in cameras for key in setup.camera_keys])
    sigma: Floats = setup.base.sigma_K.copy()
    for c, least in ASSUMED.items():
        wide = own & setup.base.free[:, c] & (sigma[:, c] >= least)
        sigma[wide, c] = LOOSE[c]
    return replace(setup, base=replace(setup.base, sigma_K=sigma))


def fits_as_well(other: Alignment, found: Alignment, *, worse: float = WORSE) -> bool:
    """Whether an alignment holds as many photos as another, and fits the pictures about as well (at
    most so many times `worse`) or better.
    """
    as_well = misfit_px(other) <= worse * misfit_px(found)
    return as_well and len(other.held) >= len(found.held)


def unfit_notes(found: Alignment, cameras: Collection[str]) -> tuple[str, ...]:
    """What the user is told of each camera."""
    notes = []
    for key in sorted(cameras):
        ms, ratio = 1000 * found.cameras[key].readout_s, found.cameras[key].aspect
        order = ", the last row first" if ms < -0.5 else ""
        notes.append(
            f"The photos of {key} do not fit the camera that they were taken for. The pictures tell"
            f" that its rows are exposed within {abs(ms):.0f} ms{order} (0: all at once), and that"
            f" its focal lengths along columns and rows have the ratio {ratio:.3f} (1: nobody"
            " resized the pictures along one side). State them by --shutter-readout and --cameras"
            " if you know better."
        )
    return tuple(notes)


def fits_cut(other: Alignment, found: Alignment) -> bool:
    """Whether an alignment with principal points that pictures tell fits these clearly better, and
    has none outside a picture: such a part is seldom cut out, and other misfits look like it.
    """
    inside = all(0 < c.cx < c.width - 1 and 0 < c.cy < c.height - 1 for c in other.cameras.values())
    return inside and fits_better(other, found, kept=KEPT)


def whole_focals(
    found: Alignment, cameras: Collection[str], begun: Mapping[str, float]
) -> dict[str, float]:
    """Multiples of focal lengths to begin with instead (`begun`: those that an alignment began
    with), of cameras whose photos are parts: what files tell counts for the longer side of the
    picture that the camera took, which has the principal point in its middle.
    """
    out = dict[str, float]()
    for key in sorted(cameras):
        camera = found.cameras[key]
        (right, down), (w, h) = _off_the_middle(camera), (camera.width, camera.height)
        longer = max(w + 2 * abs(right), h + 2 * abs(down)) / max(w, h)
        if longer > 1 + CUT_BESIDE:
            out[key] = longer * begun.get(key, 1.0)
    return out


def _off_the_middle(camera: Camera) -> tuple[float, float]:
    """How far right of and below the middle of the picture its principal point lies, px."""
    return camera.cx - (camera.width - 1) / 2, camera.cy - (camera.height - 1) / 2


def cut_notes(found: Alignment, cameras: Collection[str]) -> tuple[str, ...]:
    """What the user is told of each camera."""
    notes = []
    for key in sorted(cameras):
        right, down = _off_the_middle(found.cameras[key])
        notes.append(
            f"The optical axis of {key} meets its photos {abs(right):.0f} px"
            f" {'right' if right > 0 else 'left'} of their middle and {abs(down):.0f} px"
            f" {'below' if down > 0 else 'above'} it, as they show where they overlap: they were"
            " probably cropped along one side. The map is made so; photos as the camera wrote them"
            " are better."
        )
    return tuple(notes)


def other_focals(
    found: Alignment, guesses: Mapping[str, Focal], begun: Mapping[str, float]
) -> tuple[dict[str, float], bool]:
    """Multiples of guessed focal lengths to begin with instead, of cameras of which an alignment
    tells in which direction the guess was off, and whether it settles them all.

    `guesses`: of each camera without another focal length; `begun`: the multiples of them that it
    began with.
    """
    out, sure = dict[str, float](), True
    for key in sorted(guesses.keys() & found.cameras.keys()):
        camera, guess, before = found.cameras[key], guesses[key], begun.get(key, 1.0)
        settled = not _open(camera)
        pulled = _pulled(camera, guess.px * before, guess.sigma_px * before)
        if settled and not pulled and not _fits_none(found, key):
            continue
        towards = camera.focal / (guess.px * before)
        far = FAR if settled and key not in begun else FAR_OPEN
        if max(towards, 1 / towards) <= far:
            continue
        further = towards * min(max(towards, 0.5), 2.0)  # what it began with still holds it back
        if not settled:
            sure = False
            if 1 / MOST_FAR < further * before < MOST_FAR:
                towards = further
        if 1 / MOST_FAR < towards * before < MOST_FAR:
            out[key] = towards * before
    return out, sure


def false_focals(
    found: Alignment, told: Mapping[str, Focal], begun: Mapping[str, float]
) -> tuple[dict[str, float], bool]:
    """Multiples of focal lengths that files tell (`told`: of each camera that has one) to begin
    with instead, where an alignment contradicts these, or went far from the multiples that it
    began with (`begun`); and whether all these are false beyond doubt.
    """
    out, sure = dict[str, float](), True
    for key in sorted(told.keys() & found.cameras.keys()):
        focal, multiple = told[key], found.cameras[key].focal / told[key].px
        if key in begun:
            towards = multiple / begun[key]
            if max(towards, 1 / towards) > FAR_OPEN:
                out[key] = multiple
            continue
        apart = abs(multiple - 1) * focal.px / focal.sigma_px
        if apart > MAYBE_FALSE:
            sure &= apart > FALSE
            out[key] = multiple * min(max(multiple, 0.5), 2.0)  # what is told holds it back
    return out, sure


def _pulled(camera: Camera, began: float, sigma_px: float) -> bool:
    """Whether what a focal length began with, and its deviation in px, move that of the adjustment
    by more than the deviation it has there.
    """
    after = camera.sigmas[0] if camera.sigmas else np.inf
    return bool(abs(camera.focal - began) * after > sigma_px**2)


def _open(camera: Camera) -> bool:
    """Whether an alignment leaves the focal length of a camera uncertain."""
    return camera.sigmas is None or camera.sigmas[0] > DOUBTFUL * camera.focal


def focal_notes(found: Alignment, multiples: Mapping[str, float]) -> list[str]:
    """What the user is told of each camera with a lens that is not usual."""
    notes = []
    for key, factor in sorted(multiples.items()):
        if max(factor, 1 / factor) <= FAR:
            continue
        camera = found.cameras[key]
        wide = 2 * float(np.degrees(np.arctan(camera.width / 2 / camera.focal)))
        said = (
            f"Files do not tell the focal length of {key}, and what is usual does not fit its"
            f" photos: {camera.focal:.0f} px ({wide:.0f} degrees across) do."
        )
        notes.append(said + " State it in --cameras if you know it.")
    return notes
