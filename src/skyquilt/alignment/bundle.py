"""`bundle`: similarity graph -> adjustment with self-calibration and priors -> ground points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from skyquilt.alignment.adjust import covariance, with_common_tilts
from skyquilt.alignment.contradicted_control import control_notes
from skyquilt.alignment.control import Control, hold_to_control, residuals_of_control
from skyquilt.alignment.determined import STATED_DEG, weak_photos, without
from skyquilt.alignment.dominant_plane import level_untold, levelled
from skyquilt.alignment.enlarged import as_enlarged
from skyquilt.alignment.equations import NearFactor
from skyquilt.alignment.false_tilts import alike_off
from skyquilt.alignment.kept_matches import kept_matches
from skyquilt.alignment.least_squares_matching import GreyPicture, LeastSquaresMatching
from skyquilt.alignment.motion import speeds_of
from skyquilt.alignment.near_positions import told_besides
from skyquilt.alignment.oblique import contradicting, found_oblique, hung, tilts_reported
from skyquilt.alignment.oblique_guess import LOWERED, guessed_priors, lowered
from skyquilt.alignment.oblique_start import NO_BEGINNINGS, beginnings, reported_start, slanting
from skyquilt.alignment.outcome import (
    accuracy,
    ground_points,
    leave_one_out,
    misfits,
    unconfirmed,
    undetermined,
)
from skyquilt.alignment.problem import Problem, State
from skyquilt.alignment.repairs import begun_with, repaired
from skyquilt.alignment.same_lens import as_of_sizes, lenses_of_sizes
from skyquilt.alignment.setup import Setup, camera_records, pose_records, priors_by_camera, set_up
from skyquilt.alignment.stabilised import as_stabilised, wandering
from skyquilt.alignment.stages import fine_steps, plain, rough_steps, settled, spinning, weighed
from skyquilt.alignment.start import Start, find_start, focals_by_heights, ground_of, with_focals
from skyquilt.alignment.told_poses import believe_told
from skyquilt.alignment.tracks import Thinning, Tracks, blocks_of, build_tracks, thin
from skyquilt.alignment.triangulate import triangulated
from skyquilt.alignment.tries import Beginning, Survey, Tried
from skyquilt.alignment.unfit_cameras import (
    CameraPriors,
    cut_cameras,
    false_focals,
    loosened,
    other_focals,
    uncentred,
    unfit_cameras,
    whole_focals,
)
from skyquilt.alignment.unlike_lenses import as_of_lenses
from skyquilt.alignment.upside_down import turned_note, upside_down
from skyquilt.engine.free_memory import give_back
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.errors import AlignmentError
from skyquilt.geometry.set_aside import SetAside
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Focal, Photo
from skyquilt.model.poses import Alignment, MapFrame, Prior, TiePoints

ASIDE_AGAIN = 3
"""Photos that lie elsewhere are kept aside so often at most: without them others show that they do.
"""
ROUGHLY = 64
"""Observations per photo of the first stage, which only removes outliers and sets out."""


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """Bundle adjustment of all linked photos at once."""

    distortion: str = "full"
    """What self-calibration may change of the lens: distortion `none`, `2`, `4`, `6` (radial
    order), `6t` (and tangential) or `full` (and the aspect ratio).
    """
    per_photo: int = 400
    """Observations per photo in the adjustment of up to `many` photos, and a third as many beyond;
    all other tie points are triangulated afterwards.
    """
    many: int = 120
    """Photos that support one another well enough for fewer observations each."""
    ties: int = 640
    """Tie points per photo, about, that are kept of more than `many` photos."""
    repair: bool = True
    """Whether metadata may contain gross errors. False = they are weighted by their stated
    deviations.
    """
    match_observations: LeastSquaresMatching | None = field(default_factory=LeastSquaresMatching)
    """Refinement of observations in larger images; None leaves keypoints unchanged."""
    thorough: bool = True
    """Whether observations are weighed by what their residuals show, and the accuracy is predicted.
    False takes a third of the time, for blocks that are soon adjusted again.
    """
    version: ClassVar[int] = 98

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        links: Sequence[Link],
        control: Sequence[Control] = (),
        grey: GreyPicture | None = None,
        keep: Keep = MADE_NOW,
        make_room: Callable[[], None] = give_back,
    ) -> Alignment:
        """Aligns the photos that are connected by links; `grey` gives images for the refinement of
        observations. `keep`: parts of the adjustment of more than `many` photos are kept, so that
        an interrupted run goes on. Its workers refine the observations. `make_room` is called when
        features, and when grey images are not needed any more, and after other large parts.

        Raises:
            AlignmentError: no two photos are linked.
        """

        def sized(begun: Beginning) -> Sequence[Photo]:
            return as_of_sizes(photos, begun.sizes) if begun.sizes else photos

        def taken(begun: Beginning) -> Sequence[Photo]:
            own = sized(begun)
            own = with_focals(own, begun.focals) if begun.focals else own
            own = as_of_lenses(own, begun.lenses) if begun.lenses else own
            own = as_enlarged(own, begun.enlarged) if begun.enlarged else own
            return as_stabilised(own, begun.stabilised) if begun.stabilised else own

        def adjust(begun: Beginning) -> Alignment:
            upright = [k for k in links if not begun.aside & {k.a, k.b}]
            part = (
                keep.within(f"{begun.name}{sorted(begun.aside)}")
                if len(photos) > self.many
                else Keep(workers=keep.workers, told=keep.told)
            )
            own = taken(begun)
            return self._block(own, frame, begun, features, upright, control, grey, part, make_room)

        def guess(tried: Tried) -> Sequence[Prior] | None:
            own = taken(tried.begun)
            return guessed_priors(own, tried.begun.priors, features, links, tried.found)

        def priors_of(tried: Tried) -> CameraPriors:
            return priors_by_camera(taken(tried.begun), self.distortion)

        def guesses(begun: Beginning) -> dict[str, Focal]:
            return {p.camera_key: p.focal for p in sized(begun) if p.lens_guessed}

        def told(begun: Beginning) -> dict[str, Focal]:
            return {p.camera_key: p.focal for p in sized(begun) if p.focal_alone}

        def wholes(tried: Tried) -> dict[str, float]:
            begun = tried.begun
            doubtful = guesses(begun).keys() | told(begun).keys()
            doubtful -= {p.camera_key for p in photos if p.whole_told} | begun.sizes.keys()
            return whole_focals(tried.found, begun.cut & doubtful, begun.focals)

        survey = Survey(
            names=[p.name for p in photos],
            cameras=[p.camera_key for p in photos],
            speeds=speeds_of(photos),
            linked=len({i for k in links for i in (k.a, k.b)}),
            adjust=adjust,
            sizes=lambda cut: lenses_of_sizes(photos, cut=cut),
            unfit=lambda t: unfit_cameras(t.found, priors_of(t)),
            cut=lambda t: cut_cameras(t.found, priors_of(t)),
            wholes=wholes,
            focals=lambda t: other_focals(t.found, guesses(t.begun), t.begun.focals),
            false_focals=lambda t: false_focals(t.found, told(t.begun), t.begun.focals),
            beginnings=lambda t: beginnings(t.found, photos, t.begun.priors),
            guess=guess,
        )
        tried = begun_with(priors, survey, repair=self.repair)
        tried = repaired(tried, survey) if self.repair else tried
        found, begun, notes = tried.found, tried.begun, tried.notes
        if lowered(found, begun.priors) is not begun.priors:
            notes += (LOWERED,)
        weak = weak_photos(found, begun.priors)
        part = blocks_of(len(photos), links)
        all_told = all(p.sigma_tilt_deg <= STATED_DEG for p in begun.priors)
        for again in range(ASIDE_AGAIN if self.repair else 0):
            asked = not all_told or contradicting(found, begun.priors)
            kept = kept_matches(found, features, links) if asked else {}
            more = found_oblique(found, weak, begun.priors, kept, part) - begun.aside
            begun = replace(begun, aside=begun.aside | more)
            if not more or (again and more <= found.rejected.keys() | weak.keys()):
                break  # those bend the block no more
            found = adjust(begun)
            weak = weak_photos(found, begun.priors)
        own = taken(begun)
        done = hung(found, weak, own, begun.priors, features, links, begun.aside)
        done = told_besides(level_untold(done, priors), priors, ground_of(frame))
        notes += control_notes(done, photos, priors) if control else ()
        return replace(done, notes=(*done.notes, *notes)) if notes else done

    def _in_space(self, begun: Beginning) -> bool:
        """Whether the start takes what photos report for their poses."""
        return self.repair and (begun.in_space is not None or slanting(begun.told))

    def _begun(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        begun: Beginning,
        features: Sequence[Features],
        links: Sequence[Link],
        keep: Keep,
    ) -> tuple[Sequence[Photo], Start, Tracks, tuple[str, ...]]:
        """Where the photos that these links connect lie about, and their tracks; the photos as far
        as that tells their focal lengths, and notes.

        Raises:
            AlignmentError: no two photos are linked.
        """
        features = [f.places for f in features]  # read once, though used many times
        start, ground, priors = None, ground_of(frame), begun.told
        if self._in_space(begun):
            else_at = begun.in_space or NO_BEGINNINGS
            start = reported_start(photos, priors, features, links, ground, else_at)
        if start is None:
            start = _kept_start(photos, priors, features, links, ground, keep)
        if not start.blocks:
            raise AlignmentError(f"none of {len(photos)} photos could be linked to another one")
        said, some = tuple[str, ...](), None
        if self.repair and not begun.focals:
            photos, start, said = focals_by_heights(photos, priors, start, ground)
        if len(start.placed) > self.many:
            sizes = [(p.width, p.height) for p in photos]
            some = Thinning(sizes=sizes, per_photo=self.ties, least=self.ties // 2)
        tracks = keep("tracks", lambda: build_tracks(features, start.links, thinning=some))
        return photos, start, tracks, said

    def _block(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        begun: Beginning,
        features: Sequence[Features],
        links: Sequence[Link],
        control: Sequence[Control],
        grey: GreyPicture | None,
        keep: Keep,
        make_room: Callable[[], None],
    ) -> Alignment:
        """Adjusts the photos that these links connect."""
        priors = begun.told
        photos, start, tracks, said = self._begun(photos, frame, begun, features, links, keep)
        sizes = [(p.width, p.height) for p in photos]
        large = len(start.placed) > self.many
        setup = set_up(photos, priors, start, distortion=self.distortion, repair=self.repair)
        setup = wandering(uncentred(loosened(setup, begun.loose), begun.cut))
        begin = each = self.per_photo
        least = 0
        if large:
            begin, each, least = ROUGHLY, self.per_photo // 3, ROUGHLY
        used = setup.sensor_tracks(tracks)
        del tracks
        make_room()
        problem, state = setup.problem(thin(used, sizes, per_photo=begin, least=least))
        aside = SetAside(used, large=large)
        del used
        for step in rough_steps(keep.within("rough")):
            problem, state = step(problem, state)
        del step  # some hold a factor
        setup = setup.moving_as(photos, state)
        problem = replace(problem, velocity=setup.base.velocity)
        state = spinning(problem, state, setup)
        method = self.match_observations
        make_room()
        if sharp := grey is not None and method is not None:
            part = keep.within("sharp")
            used = sharpened(aside.get(), photos, setup, problem, state, method, grey, part)
            aside = SetAside(used, large=large)
            make_room()
        if sharp or begin != each:
            used = aside.get()
            problem, _ = setup.problem(thin(used, sizes, per_photo=each, least=least))
            del used
            state = triangulated(problem, state)
            make_room()
        near = NearFactor()
        for step in fine_steps(keep.within("fine"), near):
            problem, state = step(problem, state)
        make_room()
        if self.repair:
            found = upside_down(problem, state, setup, keep.within("turned"))
            if found.rows.any():
                said += (turned_note([photos[i].name for i in setup.members[found.rows]]),)
                problem, state, setup = found.problem, found.state, found.setup
                aside = SetAside(found.turned_tracks(aside.get()), large=large)
        setup = setup.moving_as(photos, state)
        problem = replace(problem, velocity=setup.base.velocity)
        if self.thorough:
            problem, state = weighed(problem, state, setup, keep.within("weighed"), near)
        else:
            problem, state = plain(problem, state, keep.within("plain"), near)
        setup = replace(setup, base=replace(setup.base, velocity=problem.velocity))
        if self.repair:
            problem, state = settled(problem, state, setup)
            part = keep.within("positions")
            problem, state = believe_told(problem, state, setup, part, near)
            problem, state = settled(problem, state, setup)
        del step, near
        problem, state, frame, reports = hold_to_control(problem, state, frame, setup, control)
        make_room()
        keep.tell("outcome")
        ties = ground_points(aside.get(), setup, state)
        make_room()
        done = _outcome(
            photos, frame, setup, start, ties, problem, state, reports, predicted=self.thorough
        )
        done = replace(done, notes=(*done.notes, *said))
        held = setup.georeferenced or any(not c.check for c in reports)
        return done if held or tilts_reported(priors) else levelled(done)


def _kept_start(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    ground_m: float,
    keep: Keep,
) -> Start:
    """The start of an interrupted run, or found now; its links are kept by their photos."""

    def found() -> tuple[Start, list[tuple[int, int]]]:
        start = find_start(photos, priors, features, links, ground_m)
        return replace(start, links=()), [(k.a, k.b) for k in start.links]

    start, pairs = keep("start", found)
    chosen = set(pairs)
    return replace(start, links=tuple(k for k in links if (k.a, k.b) in chosen))


def sharpened(
    tracks: Tracks,
    photos: Sequence[Photo],
    setup: Setup,
    problem: Problem,
    state: State,
    match_observations: LeastSquaresMatching,
    grey: GreyPicture,
    keep: Keep,
) -> Tracks:
    """Tracks (sensor pixels) with observations refined in larger images."""
    parts = [triangulated(p, state).X for p in setup.problems(tracks)]
    xyz = np.concatenate(parts or [np.zeros((0, 3))])
    cameras, camera_of = camera_records(photos, setup, state, None)
    poses = pose_records(setup, state)
    filed = replace(tracks, px=setup.file_px(tracks.photo, tracks.px))
    by_photo = {i: cameras[k] for i, k in camera_of.items()}
    sharp = match_observations(filed, xyz, poses, by_photo, grey, keep)
    return replace(sharp, px=setup.file_px(sharp.photo, sharp.px))


def _nowhere(start: Start) -> dict[int, str]:
    """Photos of blocks whose place is not known: positions do not tell it, nor links with those
    that they place, or with the largest where they place none. Drawn anyway, they would lie across
    the map wherever their start put them.
    """
    blocks = sorted(start.blocks, key=len, reverse=True)
    known = [b for b in blocks if start.georeferenced.intersection(b)] or blocks[:1]
    lost = [b for b in blocks if b not in known]
    of = "the largest block" if known[0] == blocks[0] else "those that positions place"
    return {
        i: f"it is linked with {len(block) - 1} other photos, but not with the {len(known[0])} of"
        f" {of}, and without a usable position its place is not known;"
        " map these by themselves"
        for block in lost
        for i in block
    }


def _outcome(
    photos: Sequence[Photo],
    frame: MapFrame,
    setup: Setup,
    start: Start,
    ties: TiePoints,
    problem: Problem,
    state: State,
    control: Sequence[Control],
    *,
    predicted: bool,
) -> Alignment:
    seen = np.bincount(ties.photo, minlength=len(photos))
    weak = {int(i): f"it has only {seen[i]} tie points" for i in setup.members if seen[i] < 8}
    if all(c.check for c in control):
        weak |= _nowhere(start)
    ties = without(ties, weak) if weak else ties
    alone = covariance(problem, state)
    alike = alike_off(problem, state, setup.block_rows)
    full = alone and with_common_tilts(alone, problem, state, alike)
    cameras, camera_of = camera_records(
        photos, setup, state, None if full is None else full.camera_sigmas
    )
    placed = pose_records(setup, state, None if full is None else full.photo_sigmas)
    poses = {i: p for i, p in placed.items() if i not in weak}
    blocks = tuple(tuple(i for i in b if i not in weak) for b in start.blocks)
    metric = frame.metric and (start.metric or any(not c.check for c in control))
    return Alignment(
        method="bundle",
        why="",
        frame=replace(frame, metric=metric),
        poses=poses,
        cameras=cameras,
        camera_of=camera_of,
        blocks=tuple(b for b in blocks if b),
        ties=ties,
        rejected=weak,
        control=residuals_of_control(control, frame, setup, problem, state, full),
        accuracy=accuracy(setup, problem, state, full)
        if predicted and full and len(ties.px)
        else None,
        notes=undetermined(setup, problem, state, full)
        + unconfirmed(setup, problem)
        + misfits(setup, problem, state),
        loo_rms_m=leave_one_out(problem, state, alone) if setup.georeferenced else None,
    )
