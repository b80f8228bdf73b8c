"""Clips that arrive in a watched folder: their chosen frames are accepted as photos.

What was seen of a clip is kept in the survey's folder, so after a crash it is not looked through
again, and frames that were accepted before count as duplicates.
"""

from collections.abc import Iterator
from pathlib import Path

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.errors import SkyquiltError, UnreadablePhotoError
from skyquilt.live.photo_intake import Accepted, Intake, Refused
from skyquilt.model.clip import Clip
from skyquilt.photos.frame_files import frame_jpeg
from skyquilt.photos.pixels import read_color
from skyquilt.settings import InputSettings
from skyquilt.video.read import CLIP_ENDINGS, read_clip
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.survey_input import read_input

SEEN = "clips"
"""Folder, beside that of the photos, of what was seen of clips."""


def is_clip(path: Path) -> bool:
    """Whether a file is a clip by its name."""
    return path.suffix.lower() in CLIP_ENDINGS


def unfinished_clip(path: Path, *, patient: bool) -> str:
    """Why a clip cannot be taken (yet); empty where it can. With `patient` a clip without positions
    beside it waits for them.
    """
    clip = read_clip(path, name=path.name)
    if not isinstance(clip, Clip):
        return clip.reason
    return "no positions are beside it" if patient and clip.track is None else ""


def take_clip(intake: Intake, path: Path, source: str) -> Iterator[Accepted | Refused]:
    """Accepts the chosen frames of a clip that is complete; one refusal where it has none.

    Raises:
        OutputError: the disk is full.
    """
    settings = InputSettings()
    store = Store(folder=intake.inbox.folder.parent / SEEN, registry=REGISTRY)
    try:
        given = result_of(with_frames(read_input(path, settings), settings, store))
    except SkyquiltError as error:
        yield intake.refuse(path.name, source, str(error))
        return
    for photo in given.survey.photos:
        try:
            data = frame_jpeg(photo, read_color(photo))
        except UnreadablePhotoError as error:
            yield intake.refuse(photo.name, source, str(error))
            continue
        yield intake.take([data], f"{photo.name}.jpg", source)
