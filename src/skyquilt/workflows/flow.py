"""The batch workflow in four steps, each a record made from the one before:

    SurveyInput -> AlignedPhotos -> Ground -> DrawnMap -> metrics of the run

Each step is a generator of events that returns its record; what it needs stands in its signature.
Results are looked up in the run's store before they are made: so a run resumes, and a later
command gets at the photos and the ground of a finished map by the same steps.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from skyquilt.alignment.aligners import placed
from skyquilt.alignment.conflicts import priors_taken
from skyquilt.alignment.far_sites import with_site_notes
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.motion import speeds_of
from skyquilt.alignment.priors import priors
from skyquilt.alignment.progress import AdjustmentSteps
from skyquilt.engine.clock import Clock, CountedParts, Steps, apart
from skyquilt.engine.free_memory import give_back_growth
from skyquilt.engine.pixel_cache import PixelCache, pixel_budget, resident_budget
from skyquilt.engine.store import Store
from skyquilt.engine.workers import Workers
from skyquilt.model.event import Event, Note
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.poses import Alignment, MapFrame, Prior
from skyquilt.model.raster import Bounds, Grid
from skyquilt.ortho import companions, ground, orthomosaic
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.radiometry import Levelling
from skyquilt.ortho.shown_parts import shown_parts
from skyquilt.ortho.spoilt import spoilt_parts
from skyquilt.settings import USUAL_GB, MosaicSettings, PictureSettings
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.finished import Earlier
from skyquilt.workflows.keys import alignment_key, exposure_key, labels_key
from skyquilt.workflows.links import Links, link_photos, make_room, of_unknown_kind, with_fisheyes
from skyquilt.workflows.methods import Methods
from skyquilt.workflows.photo_features import (
    FeaturedPhotos,
    GreyPictures,
    PixelsInUse,
    find_features,
    of_one_kind,
    picture_recipe,
    pixels_of,
)
from skyquilt.workflows.second_look import connect
from skyquilt.workflows.survey_input import SurveyInput, frame_of

ADJUSTED_GB, ADJUSTED_PHOTO_GB = 0.5, 0.00014
"""Memory in GB of an adjustment, and how much more for each photo (measured: docs/scale.md)."""
ADJUSTING = "adjusting"
"""Folder in the store with the parts of an adjustment that is not finished."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlignedPhotos:
    """Photos with features, links and poses."""

    given: SurveyInput
    """The survey as it was read."""
    found: FeaturedPhotos
    """Photos that take part, with features; all indices refer to these."""
    frame: MapFrame
    """The frame that the metadata were read in."""
    priors: tuple[Prior, ...]
    """Pose priors from the metadata, one per photo."""
    links: Links
    """Links between photos that show the same ground; empty for a method that does not need
    them.
    """
    order: tuple[int, ...]
    """Photos in the order in which they are joined."""
    alignment: Alignment
    """Poses and calibration."""
    pixels: PixelsInUse
    """Full-size pixels of a photo by its index."""
    grey: GreyPictures
    """Gives the grey image of a photo."""
    key: str
    """Key of the alignment in the store."""
    earlier: Earlier | None = None
    """The finished map that the others of these photos are added to."""

    @property
    def photos(self) -> tuple[Photo, ...]:
        """The photos."""
        return self.found.photos

    @property
    def rejected(self) -> list[RejectedPhoto]:
        """All files and photos that are not in the map, with reasons."""
        reasons, poses = self.alignment.rejected, self.alignment.poses
        unplaced = [
            RejectedPhoto(name=p.name, reason=reasons.get(i, "it could not be placed"))
            for i, p in enumerate(self.photos)
            if i not in poses
        ]
        return [*self.given.survey.rejected, *self.found.rejected, *unplaced]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Aligned photos and the ground."""

    aligned: AlignedPhotos
    """The photos."""
    ground: Ground
    """Heights, views and the map's grid."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnMap:
    """The rasters of a map."""

    exposure: Exposure
    """The brightness corrections of the photos."""
    compose: Composer
    """The composer that drew the rasters."""
    drawn: companions.Drawn
    """The additional rasters: provenance, views, preview."""
    key: str
    """Key of the labels in the store; empty where there are none."""


def frames_added(
    given: SurveyInput, settings: MosaicSettings, clock: Clock
) -> Generator[Event, None, SurveyInput]:
    """The survey with frames of its clips among its photos; unchanged if there are no clips.

    Raises:
        NoPhotosError: no clip has a frame, and there are no photos.
    """
    if not given.survey.clips:
        return given
    steps = with_frames(given, settings.input, clock.store)
    return (yield from clock.stage("frames", steps))


def align_photos(
    given: SurveyInput,
    methods: Methods,
    settings: MosaicSettings,
    clock: Clock,
    earlier: Earlier | None = None,
) -> Generator[Event, None, AlignedPhotos]:
    """Features, links and poses of a survey; poses of an `earlier` map stay where new photos do not
    change them.

    Raises:
        NoPhotosError: no photo can be decoded.
        AlignmentError: the method cannot place the photos.
    """
    store, workers = clock.store, clock.workers
    given = yield from frames_added(given, settings, clock)
    photos = given.survey.photos
    cache = PixelCache(
        read=lambda i: pixels_of(photos[i], store),
        budget_bytes=pixel_budget(settings.running.memory_gb),
        resident_bytes=resident_budget(settings.running.memory_gb),
    )
    found = yield from clock.stage(
        "features", find_features(photos, cache, methods.detector, store, workers)
    )
    cache.make_room()
    found = of_one_kind(found)
    pixels = PixelsInUse(found.photos, found.number, cache)
    grey = GreyPictures(found.photos, pixels, store)
    frame = frame_of(found.photos, given.control, settings)
    if earlier is not None and not earlier.complete(found.photos, given.control, frame):
        earlier = None
    if earlier is not None:
        frame = earlier.finished.frame
    reported = priors(found.photos, frame)
    linking = _links(found, frame, reported, grey, methods, store, workers)
    found, links = yield from clock.stage("links", linking)
    known = AlignmentInputs(
        photos=found.photos,
        features=found.features,
        frame=frame,
        priors=reported,
        links=links.links,
        control=given.control,
        order=given.order_of(found.photos),
        grey=grey,
        make_room=lambda: make_room(found, grey, links),
        former=None if earlier is None else earlier.alignment_of(found.photos),
    )
    if links.links and earlier is None:
        yield from memory_notes(len(found.photos), settings.running.memory_gb)
    key = alignment_key(known, methods, earlier.key if earlier else "")
    alignment = yield from clock.stage("align", _align(known, key, methods, clock))
    links.make_room()
    yield from (Note(text=n, warning=True) for n in alignment.notes)
    names, cameras = ([p.name for p in found.photos], [p.camera_key for p in found.photos])
    return AlignedPhotos(
        given=given,
        found=found,
        frame=frame,
        priors=priors_taken(alignment, frame, reported, names, cameras, speeds_of(found.photos)),
        links=links,
        order=tuple(known.order),
        alignment=alignment,
        pixels=pixels,
        grey=grey,
        key=key,
        earlier=earlier,
    )


def memory_notes(photos: int, memory_gb: float | None) -> list[Note]:
    """A note where the adjustment of so many photos takes more memory than is allowed."""
    needed, allowed = ADJUSTED_GB + ADJUSTED_PHOTO_GB * photos, memory_gb or USUAL_GB
    if needed <= allowed:
        return []
    return [
        Note(
            text=f"the adjustment of {photos:,} photos takes about {needed:.1f} GB, more than"
            f" --memory {allowed:g}; if that is too much, map parts of the area one by one"
        )
    ]


def find_ground(
    aligned: AlignedPhotos,
    methods: Methods,
    settings: MosaicSettings,
    clock: Clock,
    output: Path | None = None,
) -> Generator[Event, None, Ground]:
    """Heights and the map's grid; those of the earlier map in `output` stay where nothing changed.

    Raises:
        UsageError: the map would have no pixels, or far too many.
    """
    earlier = None
    if aligned.earlier is not None and output is not None:
        earlier = aligned.earlier.map_of(aligned.photos, clock.store, output)

    def steps() -> Steps[Ground]:
        alignment, looks, gsd_cm = aligned.alignment, aligned.found, settings.picture.gsd_cm
        fixed = aligned.links.marks.shown([p.camera_key for p in looks.photos])
        small, names = looks.thumbnails(sorted(alignment.poses)), [p.name for p in looks.photos]
        heat = [i for i, p in enumerate(looks.photos) if p.band == "thermal"]
        marks, notes = spoilt_parts(alignment, looks.detail, small, names, fixed, gsd_cm, heat)
        found = yield from ground.find_ground(
            alignment,
            aligned.grey,
            methods.surface,
            methods.sweep,
            settings.picture,
            clock.store,
            clock.workers,
            pictures=picture_recipe(),
            earlier=earlier,
            see_through=[i for i, p in enumerate(aligned.photos) if p.alpha],
            marks=marks,
        )
        return replace(found, notes=(*found.notes, *notes))

    return (yield from clock.stage("surface", steps()))


def draw_map(
    aligned: AlignedPhotos,
    on: Ground,
    methods: Methods,
    settings: MosaicSettings,
    clock: Clock,
    output: Path,
    key: str,
) -> Generator[Event, None, DrawnMap]:
    """Exposure, then mosaic.tif, provenance.tif and views.tif in `output`; `key` names the run.

    Raises:
        OutputError: the disk is full or read-only.
    """
    alignment, first = aligned.alignment, aligned.photos[0]  # all are of one kind
    exposure = yield from clock.stage(
        "balance",
        apart(
            lambda tell: exposure_of(aligned, on, methods, settings.picture, clock.store, tell),
            CountedParts(),
        ),
    )
    labels, labelled = yield from clock.stage(
        "seams",
        apart(lambda tell: labels_of(aligned, on, exposure, methods, clock, tell), CountedParts()),
    )
    make_room(aligned.found, aligned.grey, aligned.links)
    parts = None
    if labels is not None and aligned.pixels.crowded:
        shown = shown_parts(labels, on.views, on.surface, orthomosaic.BLOCK)
        parts = aligned.pixels.parts(shown)
    compose = orthomosaic.composer(
        first.channels, first.dtype, on, exposure, labels, methods.blend, aligned.pixels, parts
    )
    drawing = orthomosaic.Drawing(
        output=output,
        compose=compose,
        alignment=alignment,
        settings=settings.output,
        boundary=settings.picture.boundary,
        unit=first.unit,
        store=clock.store,
        key=orthomosaic.map_key(key, alignment, on, exposure, labels),
        parts=parts,
        growth=on.growth,
    )
    drawn = yield from clock.stage("mosaic", _drawn(drawing, aligned.pixels, clock.workers))
    return DrawnMap(exposure=exposure, compose=compose, drawn=drawn, key=labelled)


def _drawn(
    drawing: orthomosaic.Drawing, pixels: PixelsInUse, workers: Workers
) -> Steps[companions.Drawn]:
    """Draws the map, then the rasters beside it, for which decoded photos make room."""
    yield from drawing.blocks(workers)
    pixels.make_room()
    give_back_growth()
    return drawing.companions()


def exposure_of(
    aligned: AlignedPhotos,
    on: Ground,
    methods: Methods,
    picture: PictureSettings,
    store: Store,
    tell: Callable[[str], None],
) -> Exposure:
    """The photos' exposure, from their thumbnails."""
    first = aligned.photos[0]
    key = exposure_key(aligned.alignment, aligned.photos, on, methods, picture)
    levelled = Levelling(
        unit=first.unit,
        dtype=first.dtype,
        thumbnails=aligned.found.thumbnails([v.photo for v in on.views]),
        balance=methods.balance,
        drift=methods.drift,
        settings=picture,
        keep=replace(store.parts("balance", key), told=tell),
        mixed=any(p.saved_grey for p in aligned.photos),
        measured=first.channels != 3,  # one band may be temperatures, others are of several spectra
    )
    return store.get_or("balance", key, lambda: levelled(on))


def labels_of(
    aligned: AlignedPhotos,
    on: Ground,
    exposure: Exposure,
    methods: Methods,
    clock: Clock,
    tell: Callable[[str], None],
) -> tuple[Labels | None, str]:
    """Which photo is shown where, and its key in the store; None for blending methods with a rule
    of their own.
    """
    if methods.blend.seam_px is None:
        return None, ""
    key = labels_key(aligned.alignment, aligned.photos, on, exposure, methods)
    keep = replace(clock.store.parts("seams", key, clock.workers), told=tell)
    grows = on.growth

    def made(area: Bounds, part: Grid) -> Labels:
        assert grows is not None
        near = grows.near(on.views, area)
        within = keep.within(f"{area}")
        return methods.seams(near, on.surface, part, aligned.grey, exposure, within)

    def whole() -> Labels:
        kept = None if grows is None else grows.labels(on.grid, made)
        return kept or methods.seams(on.views, on.surface, on.grid, aligned.grey, exposure, keep)

    return clock.store.get_or("seams", key, whole), key


def scene_of(
    given: SurveyInput, methods: Methods, settings: MosaicSettings, clock: Clock
) -> Generator[Event, None, Scene]:
    """Aligned photos and their ground, for workflows that do not draw a map of them."""
    aligned = yield from align_photos(given, methods, settings, clock)
    on = yield from find_ground(aligned, methods, settings, clock)
    return Scene(aligned=aligned, ground=on)


def _links(
    found: FeaturedPhotos,
    frame: MapFrame,
    reported: Sequence[Prior],
    grey: GreyPictures,
    methods: Methods,
    store: Store,
    workers: Workers,
) -> Steps[tuple[FeaturedPhotos, Links]]:
    """Computes links if the method, or the kind of a lens, needs them; the photos they refer to."""
    if len(found.photos) < 2 or not (methods.align.needs_links or of_unknown_kind(found.photos)):
        return found, Links()
    links = yield from link_photos(found, frame, reported, methods, store, workers)
    again, said = with_fisheyes(found, links, grey, methods)
    if not methods.align.needs_links:
        return again, Links(lenses=said)
    if said:
        found = again
        links = yield from link_photos(found, frame, reported, methods, store, workers)
        links = replace(links, lenses=said)
    return (yield from connect(found, links, reported, grey, methods, store, workers))


def _align(known: AlignmentInputs, key: str, methods: Methods, clock: Clock) -> Steps[Alignment]:
    store, keep = clock.store, clock.store.parts(ADJUSTING, key, clock.workers)

    def aligned(tell: Callable[[str], None]) -> Alignment:
        resumable = replace(known, keep=replace(keep, told=tell))
        return placed(store.get_or("alignment", key, lambda: methods.align(resumable)))

    alignment = yield from apart(aligned, AdjustmentSteps())
    store.forget([ADJUSTING])
    return with_site_notes(alignment, [p.name for p in known.photos])
