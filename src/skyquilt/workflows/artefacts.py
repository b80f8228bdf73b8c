"""What the store of a run may hold."""

from skyquilt.alignment import problem, start, tracks
from skyquilt.model import camera, clip, features, poses, raster, surface
from skyquilt.model.photo import Attitude, Focal, GeoPosition, RejectedPhoto, Shutter
from skyquilt.ortho import companions, exposure, labels
from skyquilt.workflows.finished import Finished
from skyquilt.workflows.links import PackedLinks
from skyquilt.workflows.photo_features import PhotoFeatures

REGISTRY = {
    c.__name__: c
    for c in (
        PhotoFeatures,
        clip.Looks,
        features.Features,
        features.Link,
        features.RejectedLink,
        PackedLinks,
        features.Matches,
        camera.Camera,
        poses.Alignment,
        poses.MapFrame,
        poses.Pose,
        poses.Motion,
        poses.Accuracy,
        poses.TiePoints,
        poses.ControlResidual,
        poses.Join,
        surface.Surface,
        problem.State,
        start.Start,
        tracks.Tracks,
        RejectedPhoto,
        Focal,
        GeoPosition,
        Attitude,
        Shutter,
        companions.BlockExtras,
        raster.Grid,
        exposure.Exposure,
        labels.Labels,
        Finished,
    )
}
"""Records that the store may hold."""
ARTEFACTS = {
    "frames": "looks",
    "features": "features",
    "read": "pictures",
    "links": "links",
    "align": "alignment",
    "surface": "surface",
    "balance": "balance",
    "seams": "seams",
    "mosaic": "blocks",
}
"""Stage -> folder in the store."""
