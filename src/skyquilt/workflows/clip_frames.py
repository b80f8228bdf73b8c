"""Stage: the clips of a survey are looked through, and the chosen frames join its photos."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from skyquilt.engine.clock import Steps
from skyquilt.engine.folder import refusal
from skyquilt.engine.store import Store, digest
from skyquilt.errors import NoPhotosError, UnreadablePhotoError
from skyquilt.model.clip import ChosenFrames, Clip, Looks, Track
from skyquilt.model.event import Note
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.outside import remove_file, walk
from skyquilt.photos.cameras_json import apply_cameras, read_cameras_json
from skyquilt.photos.clips import after_others, frames_of
from skyquilt.photos.frame_files import frame_jpeg
from skyquilt.photos.survey import placed_plausibly
from skyquilt.raster.atomic import mended, whole_file
from skyquilt.settings import InputSettings
from skyquilt.video.choice import FrameChoice
from skyquilt.video.clock import Offset, OffsetSearch
from skyquilt.video.decoder import Decoder
from skyquilt.video.looks import Looker, joined
from skyquilt.video.positions import clip_zero
from skyquilt.workflows.photo_features import PhotoPixels
from skyquilt.workflows.survey_input import SurveyInput, completed

_REACH_S = 60.0
_ALL_S = 1e7
_UNLIKE = 0.35
_MOVES_MS = 3.0
_LEAST_SPAN = 0.6
"""Telemetry that lasts a smaller share of its clip, or the clip of it, belongs to another one."""
_SPAN_S = 1.0
"""Unless they differ by no more than this: rows may be a second apart."""
LONGEST_NAME = 240
"""Bytes of a frame's file name: file systems take 255, a few of them for files in work."""
_FRAME = re.compile(r".+\.\d{6}\.jpg")
"""Names of the files of frames."""


@dataclass(frozen=True, kw_only=True)
class FrameMethods:
    """How frames are chosen; part of the key of a run."""

    look: Looker = field(default_factory=Looker)
    """Looks through a clip."""
    choose: FrameChoice = field(default_factory=FrameChoice)
    """Chooses frames."""
    search: OffsetSearch = field(default_factory=OffsetSearch)
    """Compares the clocks of a clip and its positions."""


def frame_methods(settings: InputSettings) -> FrameMethods:
    """The methods that the settings ask for."""
    return FrameMethods(choose=FrameChoice(overlap=settings.frame_overlap / 100))


def with_frames(given: SurveyInput, settings: InputSettings, store: Store) -> Steps[SurveyInput]:
    """The survey with frames of its clips among its photos.

    Raises:
        NoPhotosError: no clip has a frame, and there are no photos.
        SideFileError: control points or distances do not suit the frames.
    """
    methods = frame_methods(settings)
    photos: list[Photo] = []
    told: list[ChosenFrames] = []
    rejected: list[RejectedPhoto] = []
    notes: list[str] = []
    clips = given.survey.clips
    total = sum(_looks_in(c, methods.look) for c in clips)
    before, late = 0, after_others(clips)
    for number, clip in enumerate(clips):
        try:
            looks = yield from _seen(clip, methods.look, store, before, total)
        except UnreadablePhotoError as error:
            rejected.append(RejectedPhoto(name=clip.name, reason=str(error)))
            continue
        finally:
            before += _looks_in(clip, methods.look)
        if not len(looks.time_s):
            rejected.append(RejectedPhoto(name=clip.name, reason="none of its frames decodes"))
            continue
        chosen = methods.choose(clip, looks)
        chosen, use_track, said = timed(clip, looks, chosen, methods, settings.clock_offset)
        frames = frames_of(clip, chosen, number=number, use_track=use_track, late_s=late[number])
        chosen = replace(chosen, placed=sum(f.position is not None for f in frames))
        photos += frames
        told.append(chosen)
        notes += [f"{clip.name}: {n}" for n in (*clip.notes, *said, *_ended(clip, looks))]
        notes.append(_sentence(clip, chosen))
    if not photos and not given.survey.photos:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected)
        raise NoPhotosError(f"no clip has a frame that can be used ({reasons})")
    every, more = placed_plausibly([*given.survey.photos, *photos])
    if settings.cameras is not None:
        known = read_cameras_json(settings.cameras)
        every, lacking = apply_cameras(every, known, file=settings.cameras)
        more = (*more, *lacking)
    survey = replace(
        given.survey,
        photos=every,
        clips=(),
        rejected=(*given.survey.rejected, *rejected),
        notes=(*given.survey.notes, *notes, *more),
    )
    yield from (Note(text=n) for n in (*notes, *more))
    return completed(replace(given, survey=survey, clips=tuple(told)), settings)


def write_frames(output: Path, photos: Sequence[Photo], pixels: PhotoPixels) -> Steps[None]:
    """Writes the frames among the photos to `output/frames`, as JPEG with the metadata of photos.

    Raises:
        OutputError: the disk is full or read-only.
    """
    folder = output / "frames"
    frames = [(i, p, folder / frame_file(p)) for i, p in enumerate(photos) if p.frame_s is not None]
    kept = {path for *_, path in frames}
    for done, (index, photo, path) in enumerate(frames, 1):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise refusal(folder, error) from error
        if done == 1:  # of an earlier run that chose others
            for here, _, names in walk(folder):
                for name in names:
                    if _FRAME.fullmatch(name) and here / name not in kept:
                        with mended(here / name):
                            remove_file(here / name)
        with whole_file(path) as file:
            file.write(frame_jpeg(photo, pixels(index)))
        yield done, len(frames)


def frame_file(photo: Photo) -> str:
    """Path of a frame's file below `frames`: its name, of which the front is cut and replaced by a
    hash where no file system could take it with its ending.
    """
    path = PurePosixPath(f"{photo.name}.jpg")
    whole = os.fsencode(path.name)
    if len(whole) <= LONGEST_NAME:
        return str(path)
    apart = f"{digest(photo.name)[:8]}~"
    end = whole[len(whole) - LONGEST_NAME + len(apart) :].decode("utf-8", "ignore")
    return str(path.with_name(apart + end))


def _looks_in(clip: Clip, look: Looker) -> int:
    return -(-max(clip.frames, 1) // look.step(clip.fps))


def _seen(clip: Clip, look: Looker, store: Store, before: int, total: int) -> Steps[Looks]:
    """The looks of a clip, in chunks from the store or seen now."""
    decoder: Decoder | None = None
    parts: list[Looks] = []
    count = look.chunks(clip.fps, clip.frames)
    try:
        for number in range(count):
            key = digest(clip.digest, look, number, count)
            part = store.get("looks", key)
            if part is None:
                decoder = decoder or Decoder(clip.path, grey=True)
                last = float(parts[-1].time_s[-1]) if parts and len(parts[-1].time_s) else None
                end = number == count - 1
                for step in look(decoder, number, last=last, open_end=end):
                    if isinstance(step, Looks):
                        part = step
                    elif step % 2 == 0:
                        yield min(before + number * look.chunk + step, total), total
                store.put("looks", key, part)
            assert part is not None
            parts.append(part)
            if not len(part.time_s):
                break
    finally:
        if decoder is not None:
            decoder.close()
    return joined(parts)


def timed(
    clip: Clip, looks: Looks, chosen: ChosenFrames, methods: FrameMethods, stated: float | None
) -> tuple[ChosenFrames, bool, list[str]]:
    """The choice with the offset of its clock, whether the positions can be used, and notes."""
    track = clip.track
    if track is None:
        return chosen, False, []
    if stated is not None:
        return replace(chosen, offset_s=stated, offset_source="option"), True, []
    zero = clip_zero(track, clip)
    reach = _REACH_S if track.source in ("srt", "clip") and track.on_clip else _ALL_S
    # where the two do not meet within reach, no time is as good as another
    found = methods.search(looks, track, zero, reach) or methods.search(looks, track, zero, _ALL_S)
    if found is not None and found.clear:
        seconds = 0.0 if abs(found.seconds) < 2 * found.sigma_s else found.seconds
        said = []
        if seconds:
            said = [
                f"Its clock and that of {track.file} differ: positions are taken"
                f" {seconds:+.2f} +- {found.sigma_s:.2f} s later, as the turns of the flight show."
            ]
        chosen = replace(
            chosen, offset_s=seconds, offset_sigma_s=found.sigma_s, offset_source="turns"
        )
        return chosen, True, said
    if _contradicts(found):
        return (
            chosen,
            False,
            [
                f"{track.file} does not move as the clip does: it belongs to another"
                " clip, or its clock is far off, and was not used."
            ],
        )
    if track.source == "srt" and track.on_clip:
        told = float(track.height_time_s[-1] - track.height_time_s[0])
        lasts = max(clip.duration_s, float(looks.time_s[-1]))
        alike = _LEAST_SPAN * lasts <= told <= lasts / _LEAST_SPAN
        if not alike and abs(lasts - told) > _SPAN_S:
            return (
                chosen,
                False,
                [
                    f"{track.file} lasts {told:.0f} s and the clip {lasts:.0f} s: it belongs to"
                    " another clip or is torn, and was not used. --clock-offset 0 uses it anyway."
                ],
            )
        late = _late_as_a_whole(track, lasts)
        if late:
            begun = (
                f"{track.file} lasts as long as the clip, but begins at {late:.1f} s. It is taken"
                " to begin with the clip. --clock-offset 0 takes its times as they are."
            )
            return replace(chosen, offset_s=late, offset_source="span"), True, [begun]
    inside = track.height_time_s[0] - 1 <= zero <= track.height_time_s[-1] + 1
    if not track.on_clip and (clip.start is None or not inside):
        return (
            chosen,
            False,
            [
                f"When the clip begins on the clock of {track.file} is not known, and the flight"
                " does not show it: its positions were not used. State --clock-offset."
            ],
        )
    return replace(chosen, offset_source="clock"), True, []


def _late_as_a_whole(track: Track, lasts: float) -> float:
    """Seconds by which positions begin after a clip that lasts as long; 0 where they do not begin
    and end after it by the same time.
    """
    time = track.height_time_s
    late, beyond = float(time[0]), float(time[-1]) - lasts
    row = float(time[-1] - time[0]) / max(len(time) - 1, 1)
    alike = min(late, beyond) > _SPAN_S and abs(late - beyond) < _SPAN_S + row
    return late if alike else 0.0


def _contradicts(found: Offset | None) -> bool:
    return found is not None and found.misfit > _UNLIKE and found.speed_ms > _MOVES_MS


def _ended(clip: Clip, looks: Looks) -> Sequence[str]:
    """A note on a clip that ends before its container says."""
    last = float(looks.time_s[-1])
    if clip.frames and last < clip.duration_s - max(2.0, 0.05 * clip.duration_s):
        return (
            f"It should last {clip.duration_s:.0f} s, but no frame after {last:.0f} s can be"
            " decoded.",
        )
    return ()


def _sentence(clip: Clip, chosen: ChosenFrames) -> str:
    return (
        f"{clip.name}: {len(chosen.chosen)} frames of {clip.frames} are used, chosen from"
        f" {chosen.looked} by sharpness and an overlap of {100 * chosen.overlap:.0f} %;"
        f" {chosen.placed} have a position."
    )
