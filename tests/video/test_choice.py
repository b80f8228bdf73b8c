"""Frames of a clip of known motion: the choice, what it avoids, and what a resume looks at."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.model.clip import Looks
from skyquilt.photos.pixels import read_color
from skyquilt.settings import InputSettings
from skyquilt.video.choice import FrameChoice, relative_sharpness, shared
from skyquilt.video.decoder import Decoder
from skyquilt.video.looks import Looker, joined
from skyquilt.video.read import read_clip
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.photo_features import pixels_of
from skyquilt.workflows.survey_input import read_input
from tests.video.clips import SIZE, flown, write_clip

STEP = 6.0
STILL = range(40, 60)
BLURRED = {13, 27, 28, 80}


def places():
    """To the right for 40 frames, standing still for 20, then downwards for 60."""
    x = np.concatenate([np.arange(40), np.full(80, 39)]) * STEP + 500
    y = np.concatenate([np.zeros(60), np.arange(60)]) * STEP + 600
    return np.stack([x, y], axis=1)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "FLIGHT.MP4"
    return write_clip(path, flown(places(), blurred=BLURRED), fps=5.0)


@pytest.fixture(scope="module")
def looks(film):
    decoder = Decoder(film, grey=True)
    (found,) = [x for x in Looker()(decoder, 0, last=None, open_end=True) if _is(x)]
    return found


def _is(step):
    return isinstance(step, Looks)


def test_motion_is_measured(looks):
    truth = np.diff(places(), axis=0)
    assert looks.linked[1:].all()
    assert abs(looks.shift[1:].real - truth[:, 0]).max() < 0.5
    assert abs(looks.shift[1:].imag - truth[:, 1]).max() < 0.5
    assert abs(looks.shift[1:].sum() - truth.sum(axis=0) @ [1, 1j]) < 3


def test_blurred_frames_are_told_from_sharp_ones(looks):
    sharp = relative_sharpness(looks, 50)
    blurred = np.isin(np.arange(len(sharp)), list(BLURRED))
    assert sharp[blurred].max() < -FrameChoice().blur < sharp[~blurred].min()


@pytest.mark.parametrize("overlap", [0.6, 0.75, 0.85])
def test_frames_overlap_as_wanted_and_avoid_blur_and_standstill(film, looks, overlap):
    clip = read_clip(film, name="FLIGHT.MP4")
    chosen = FrameChoice(overlap=overlap)(clip, looks).chosen
    at = [f.look for f in chosen]
    assert not set(at) & BLURRED
    assert sum(i in STILL for i in at) <= 1
    gone = np.linalg.norm(np.diff(places()[at], axis=0), axis=1)
    sides = np.array([SIZE[0] if b < 40 else SIZE[1] for b in at[1:]])
    true = 1 - gone / sides
    corner = np.array([a < 40 <= b for a, b in pairwise(at)])
    told = np.array([f.overlap for f in chosen[1:]])
    assert abs(told - true)[~corner].max() < 0.02
    assert true[~corner].min() > overlap - 0.04  # one look is up to 2.5 % of the frame
    # no more than 1.2 times the frames that the overlap needs
    need = 1 + (39 * STEP / SIZE[0] + 59 * STEP / SIZE[1]) / (1 - overlap)
    assert len(chosen) <= 1.2 * need + 1


def test_shared_area_of_turned_frames():
    assert shared(1 + 0j, 0j, SIZE) == pytest.approx(1)
    assert shared(1 + 0j, 80 + 60j, SIZE) == pytest.approx(0.75 * 0.75)
    assert shared(1j, 0j, (320, 240)) == pytest.approx(240 / 320)
    assert shared(-1 + 0j, 0j, SIZE) == pytest.approx(1)


def test_chunks_see_what_one_pass_sees(film, looks):
    look, decoder = Looker(chunk=50), Decoder(film, grey=True)
    parts = []
    for number in (0, 1, 2):
        last = float(parts[-1].time_s[-1]) if parts else None
        decoder = Decoder(film, grey=True)  # as after a kill: the decoder starts anew and seeks
        parts += [x for x in look(decoder, number, last=last, open_end=number == 2) if _is(x)]
    both = joined(parts)
    assert both.time_s.tolist() == looks.time_s.tolist()
    assert np.allclose(both.sharp, looks.sharp)
    assert abs(both.shift - looks.shift).max() < 0.5


def test_a_resume_decodes_nothing(film, tmp_path, monkeypatch):
    settings = InputSettings()
    given = read_input(film, settings)
    store = Store(folder=tmp_path, registry=REGISTRY)
    first = result_of(with_frames(given, settings, store))
    names = [p.name for p in first.survey.photos]
    assert names[0].startswith("FLIGHT.MP4.0000")
    assert first.clips[0].looked == 120
    monkeypatch.setattr("skyquilt.workflows.clip_frames.Decoder", None)
    again = result_of(with_frames(given, settings, store))
    assert [p.name for p in again.survey.photos] == names
    other = result_of(with_frames(given, replace(settings, frame_overlap=85.0), store))
    assert len(other.survey.photos) > 1.2 * len(names)


def test_a_frame_is_decoded_from_its_clip_once(film, tmp_path, monkeypatch):
    store = Store(folder=tmp_path, registry=REGISTRY)
    photos = result_of(with_frames(read_input(film, InputSettings()), InputSettings(), store))
    photo = photos.survey.photos[3]
    plain = read_color(photo).astype(float)
    first = pixels_of(photo, store)
    assert first.shape == plain.shape and first.dtype == np.uint8
    assert 10 * np.log10(255**2 / ((first - plain) ** 2).mean()) > 38
    monkeypatch.setattr("skyquilt.photos.pixels.frame_of", None)
    assert (pixels_of(photo, store) == first).all()


def told(film, folder, first_s, rows):
    """A link to the clip of 24 s, with a position of each second from `first_s` on."""
    path = folder / "B.MP4"
    path.symlink_to(film)
    row = (
        "{n}\n00:00:{n:02d},000 --> 00:00:{n:02d},999\n[latitude: 46.{n:06d}] [longitude: 14.3]\n\n"
    )
    text = "".join(row.format(n=n) for n in range(first_s, first_s + rows))
    path.with_suffix(".SRT").write_text(text)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first_s", "rows", "source", "offset_s"),
    [
        (9, 24, "span", 9.0),  # all of it is late
        (0, 24, "clock", 0.0),
        (7, 17, "clock", 0.0),  # the receiver began late
        (0, 34, "clock", 0.0),  # it was written on after the clip ended
        (3, 31, "clock", 0.0),  # both
    ],
)
def test_telemetry_that_is_late_as_a_whole_begins_with_the_clip(
    film, tmp_path, first_s, rows, source, offset_s
):
    """Where the flight does not show when its positions were taken."""
    path, store = (
        told(film, tmp_path, first_s, rows),
        Store(folder=tmp_path / "store", registry=REGISTRY),
    )
    found = result_of(with_frames(read_input(path, InputSettings()), InputSettings(), store))
    (clip,) = found.clips
    assert (clip.offset_source, clip.offset_s) == (source, offset_s)
    assert any("is taken to begin with the clip" in n for n in found.survey.notes) == (offset_s > 0)


def test_telemetry_of_another_clip_is_not_used(film, tmp_path):
    path = told(film, tmp_path, 0, 9)
    settings, store = InputSettings(), Store(folder=tmp_path / "store", registry=REGISTRY)
    found = result_of(with_frames(read_input(path, settings), settings, store))
    assert all(p.position is None for p in found.survey.photos)
    assert any("belongs to another clip or is torn" in n for n in found.survey.notes)
    stated = replace(settings, clock_offset=0.0)
    found = result_of(with_frames(read_input(path, stated), stated, store))
    assert sum(p.position is not None for p in found.survey.photos) > 2
