"""Keys of a map's photos and steps in the store: all that enters each result."""

from collections.abc import Sequence

from skyquilt.alignment.addition import added
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.engine.store import digest
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.ground import Ground, poses_digest
from skyquilt.ortho.radiometry import Levelling
from skyquilt.settings import PictureSettings
from skyquilt.workflows.methods import Methods
from skyquilt.workflows.photo_features import features_recipe, picture_recipe
from skyquilt.workflows.second_look import connect


def photo_key(photo: Photo) -> str:
    """Content and metadata of a photo."""
    return digest(
        photo.name, photo.pixels_key, photo.position, photo.attitude, photo.focal, photo.calibration
    )


def alignment_key(known: AlignmentInputs, methods: Methods, earlier: str = "") -> str:
    """Key of an alignment; `earlier`: of the map that it continues."""
    photos = [
        (p.pixels_key, p.name, p.camera_key, p.focal, p.calibration, p.shown_lens, p.editor)
        for p in known.photos
    ]
    moving = [(p.shutter, p.velocity_ned, p.time and p.time.isoformat()) for p in known.photos]
    held = [(k.a, k.b, k.index_a, k.index_b) for k in known.links]
    key = digest(
        photos,
        moving,
        known.frame,
        list(known.priors),
        held,
        list(known.control),
        features_recipe(methods.detector),
        connect,
        list(known.order),
        methods.align,
    )
    return digest(key, earlier, added) if earlier else key


def exposure_key(
    alignment: Alignment,
    photos: Sequence[Photo],
    ground: Ground,
    methods: Methods,
    picture: PictureSettings,
) -> str:
    """Key of the exposure of placed photos of one kind."""
    return digest(
        poses_digest(alignment),
        ground.surface.z,
        ground.grid,
        (picture.balance, picture.balance_thermal, photos[0].unit, photos[0].dtype),
        features_recipe(methods.detector),
        methods.balance,
        methods.drift,
        Levelling,
        [p.pixels_key for p in photos],
        *_growth(ground),
    )


def labels_key(
    alignment: Alignment,
    photos: Sequence[Photo],
    ground: Ground,
    exposure: Exposure,
    methods: Methods,
) -> str:
    """Key of the choice which photo is shown where."""
    return digest(
        poses_digest(alignment),
        ground.surface.z,
        ground.grid,
        dict(exposure.gains),
        dict(exposure.fields),
        dict(exposure.shades),
        methods.seams,
        picture_recipe(),
        [p.pixels_key for p in photos],
        *(
            (i, m.room, m.written and m.written.room)
            for i, m in sorted(ground.limits.marks.items())
        ),
        *_growth(ground),
    )


def _growth(ground: Ground) -> tuple[object, ...]:
    return () if ground.growth is None else ground.growth.key
