"""Offsets of clocks over simulated flights of a minute, whose receivers drift by metres and whose
cameras sway: looks are computed from the true poses.
"""

import numpy as np
import pytest

from skyquilt import simulate as sim
from skyquilt.model.clip import Looks
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Reporting, Route, Video
from skyquilt.simulate.video import telemetry
from skyquilt.video.clock import OffsetSearch
from skyquilt.video.tracks import read_track

LATE_S = 7.0


def looks_of(world, times, rng):
    """What is seen of flat ground, by a grid of points that are tracked within 0.3 px."""
    lens, turn, shift = world.video.lens, [1 + 0j], [0j]
    x, y = (v.ravel() for v in np.meshgrid(*(np.linspace(99, n - 99, 7) for n in lens_size(lens))))
    middle = complex(lens.width - 1, lens.height - 1) / 2
    rays = np.stack([(x - lens.cx) / lens.focal, (y - lens.cy) / lens.focal, np.ones(49)], axis=1)
    for a, b in zip(world.video.shots, world.video.shots[1:], strict=False):
        ahead = rays @ b.rotation
        down = (world.start.takeoff - b.place[2]) / ahead[:, 2]
        seen = (b.place + ahead * down[:, None] - a.place) @ a.rotation.T
        old = lens.focal * (seen[:, 0] + 1j * seen[:, 1]) / seen[:, 2]
        old += complex(lens.cx, lens.cy) - middle + 0.3 * (rng.normal(size=(2, 49)).T @ [1, 1j])
        new = x + 1j * y - middle
        off = new - new.mean()
        turn.append(np.vdot(off, old - old.mean()) / np.vdot(off, off))
        shift.append(old.mean() - turn[-1] * new.mean())
    return Looks(
        time_s=times,
        sharp=np.zeros(len(times)),
        turn=np.array(turn),
        shift=np.array(shift),
        linked=np.arange(len(times)) > 0,
    )


def lens_size(lens):
    return lens.width, lens.height


def found_for(seed, layout, smooth_s, folder, *, noise=2.0, fps=5.0, fixes=2.0, **route):
    """The offset found for a flight, and its deviation."""
    settings = sim.FlightSettings(
        seed=seed,
        lens=Lens().scaled(1280, 960),
        route=Route(**{"photos": 18, "sidelap": 0.4, "speed": 4.8, **route}),
        reporting=Reporting(gps_correlation=smooth_s, gps_noise=noise),
        video=Video(fps=fps, shift=LATE_S, layout=layout, fixes_per_second=fixes),
    )
    world = sim.prepare(settings)
    times = np.array([s.waypoint.time for s in world.video.shots])
    text = telemetry(world.video.reports, times, settings.video, world.video.lens,
                     settings.weather.moment)  # fmt: skip
    (folder / "a.SRT").write_text(text, encoding="utf-8")
    looks = looks_of(world, times, np.random.default_rng(seed))
    found = OffsetSearch()(looks, read_track(folder / "a.SRT"), 0.0, 60.0)
    assert found is not None
    assert found.clear
    return found.seconds - LATE_S, found.sigma_s


@pytest.mark.slow
def test_offsets_are_found_within_their_deviations_and_mostly_within_a_fifth_of_a_second(tmp_path):
    found = [found_for(seed, "mavic3", 300.0, tmp_path) for seed in range(101, 113)]
    off, sigma = np.abs(found).T
    assert np.mean(off < 0.2) >= 0.9  # 1 of 40
    assert 0.02 < np.sqrt(np.mean(np.square(off))) < 0.13
    assert (off < 3 * sigma).all()


@pytest.mark.slow
def test_headings_tell_the_offset_ten_times_better(tmp_path):
    found = [found_for(seed, "gimbal", 300.0, tmp_path) for seed in range(201, 207)]
    off, sigma = np.abs(found).T
    assert (off < 0.05).all()
    assert (sigma < 0.05).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        {"fixes": 1.0},
        {"fixes": 10.0, "fps": 10.0},
        {"noise": 5.0},
        {"speed": 10.0},
        {"fixed_yaw": True},
    ],
    ids=str,
)
def test_rates_noise_speed_and_a_fixed_heading_are_within_the_stated_deviation(tmp_path, more):
    found = [found_for(seed, "mavic3", 300.0, tmp_path, **more) for seed in (101, 104)]
    for off, sigma in found:
        assert abs(off) < 3 * sigma < 0.9
