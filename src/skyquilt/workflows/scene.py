"""The chapters of `mosaic` up to the surface, for stories that need the placed photos
themselves.
"""

import os
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.engine.clock import Clock
from skyquilt.engine.folder import STATE
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import Alignment
from skyquilt.ortho import orthomosaic as drawing
from skyquilt.photos.pixels import read_color
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.survey import read_survey
from skyquilt.workflows import align as placing
from skyquilt.workflows import links as linking
from skyquilt.workflows import photo_features as intake
from skyquilt.workflows.methods import Methods, MosaicSettings, methods
from skyquilt.workflows.mosaic import REGISTRY, pixel_budget, replace_read, with_control


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Placed photos and the ground that their tie points know."""

    taken: intake.Intake
    """Photos and features."""
    links: linking.Links
    """Which of them show the same."""
    alignment: Alignment
    """Their poses."""
    ground: drawing.Ground
    """Heights, views and the map's grid."""
    pixels: Callable[[int], NDArray[Any]]
    """Full-size pixels of a photo by its index."""
    grey: Callable[[int, int], NDArray[np.uint8]]
    """Grey picture of a photo (index), its longest side at most the px given."""


def scene_of(
    photos: Sequence[Photo],
    settings: MosaicSettings,
    parts: Methods,
    clock: Clock,
    control: Sequence[ControlPoint] = (),
) -> Generator[Event, None, Scene]:
    """Places the photos as `iter_mosaic` does; what the clock's store holds of that is not made
    again.
    """
    jobs, store = settings.jobs or os.cpu_count() or 1, clock.store
    cache = PixelCache(read=lambda i: read_color(photos[i]), budget_bytes=pixel_budget(settings))
    taken = yield from clock.stage("features", intake.take_in(photos, cache, parts, store, jobs))
    taken = drawing.single_kind(taken)
    where = {p.name: i for i, p in enumerate(photos)}
    cache = replace_read(cache, [where[p.name] for p in taken.photos])
    pictures = intake.Pictures(taken.photos, cache, store)
    frame = choose_frame(taken.photos, settings.crs, control)
    prior = priors(taken.photos, frame)
    links = yield from clock.stage("links", linking.link_up(taken, prior, parts, store, jobs))
    names = [p.name for p in taken.photos]
    known = placing.AlignmentInputs(
        intake=taken,
        frame=frame,
        priors=prior,
        links=links,
        control=control,
        pictures=pictures,
        order=sequence_of(names, settings.sequence),
    )
    alignment = yield from clock.stage("align", placing.place(known, parts, settings, store))
    yield from (Note(text=n, warning=True) for n in alignment.notes)
    ground = yield from clock.stage(
        "surface", drawing.survey_ground(alignment, pictures, parts, settings, store)
    )
    return Scene(
        taken=taken, links=links, alignment=alignment, ground=ground, pixels=cache, grey=pictures
    )


def scene_of_run(photos: Path | str, run: Result, settings: MosaicSettings) -> Scene:
    """What a finished mosaic of these photos and settings rests on, from its store."""
    folder = Path(photos)
    survey = read_survey(
        folder, geo=settings.geo, cameras=settings.cameras, thermal_unit=settings.thermal_unit
    )
    survey, control = with_control(survey, folder, settings)
    store = Store(folder=run.output / STATE / "store", registry=REGISTRY)
    steps = scene_of(
        survey.photos, settings, methods(settings), Clock(store=store, began=Clock.now()), control
    )
    try:
        while True:
            next(steps)
    except StopIteration as stop:
        found: Scene = stop.value
    return found
