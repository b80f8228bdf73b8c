"""Clips that arrive while live: their chosen frames are accepted as photos.

Looking through a clip takes long, so it is done in short pieces between which photos are mapped.
What was seen of a clip is kept in the survey's folder, so after a crash it is not looked through
again, and frames that were accepted before count as duplicates.
"""

import time
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path

from skyquilt.engine.error_log import log_error
from skyquilt.engine.store import Store
from skyquilt.errors import OutputError, SkyquiltError, UnreadablePhotoError
from skyquilt.live.failures import of_the_system
from skyquilt.live.inbox import SEEN
from skyquilt.live.photo_intake import Accepted, Intake, Refused
from skyquilt.model.clip import Clip
from skyquilt.model.event import Note
from skyquilt.photos.frame_files import frame_jpeg
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import rejected
from skyquilt.settings import InputSettings
from skyquilt.video.decoder import close_clip
from skyquilt.video.read import read_clip
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.survey_input import SurveyInput, read_input

SLICE_S = 0.1
"""Time in s that may be spent on clips before other work is done."""
TOLD = "clips told"
"""Name in the ledger of what was told of clips."""
Taking = Iterator[Accepted | Refused | None]
"""Results of a clip; None after a piece of work without one."""


def unfinished_clip(path: Path, *, patient: bool) -> str:
    """Why a clip cannot be taken (yet); empty where it can. With `patient` a clip without positions
    beside it waits for them.
    """
    clip = read_clip(path, name=path.name)
    if not isinstance(clip, Clip):
        return clip.reason
    return "no positions are beside it" if patient and clip.track is None else ""


def take_clip(intake: Intake, path: Path, source: str, name: str = "") -> Taking:
    """Accepts the chosen frames of a clip that is complete; one refusal where it has none.

    `name`: of the clip, where the file has another one.

    Raises:
        OutputError: the disk is full.
    """
    name = name or path.name
    try:
        given = yield from _looked(path, name, intake)
        for photo in given.survey.photos:
            try:
                data = frame_jpeg(photo, read_color(photo))
            except UnreadablePhotoError as error:
                yield intake.refuse(photo.name, source, str(error))
                continue
            yield intake.take([data], f"{photo.name}.jpg", source)
    except OutputError:
        raise
    except SkyquiltError as error:
        yield intake.refuse(name, source, str(error))
    except Exception as error:  # whatever it is, it concerns this clip alone
        if system := of_the_system(error):
            raise system from error
        log_error(intake.ledger.path.parent, name, error)
        yield intake.refuse(name, source, rejected(name, error).reason)
    finally:
        close_clip(path)


def _looked(path: Path, name: str, intake: Intake) -> Generator[None, None, SurveyInput]:
    """The clip's chosen frames as photos; yields None after each piece of work. What is told of the
    clip, such as that its positions were not used, is told to viewers once.
    """
    settings = InputSettings()
    home = intake.inbox.folder.parent
    store = Store(folder=home / SEEN, registry=REGISTRY, within=home)
    given = read_input(path, settings)
    clips = tuple(replace(c, name=name) for c in given.survey.clips)
    steps = with_frames(replace(given, survey=replace(given.survey, clips=clips)), settings, store)
    notes = list[str]()
    while True:
        try:
            step = next(steps)
        except StopIteration as done:
            found: SurveyInput = done.value
            break
        if isinstance(step, Note):
            notes.append(step.text)
        yield None
    with intake.ledger.change():
        intake.ledger.tell_new(notes, TOLD, before="")
    return found


def advanced(taking: Taking) -> tuple[list[Accepted | Refused], bool]:
    """What a clip gave within `SLICE_S`, and whether that is all of it."""
    until = time.monotonic() + SLICE_S
    found: list[Accepted | Refused] = []
    while time.monotonic() < until:
        try:
            done = next(taking)
        except StopIteration:
            return found, True
        if done is not None:
            found.append(done)
    return found, False
