"""Rolling shutters: rows that are exposed from different places. The oracle is the simulator's own
projection, which finds each row's moment by iteration and shares no code with the adjustment.
"""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from skyquilt.alignment import stages
from skyquilt.alignment.adjust import adjust, covariance
from skyquilt.alignment.motion import spins, velocities
from skyquilt.alignment.problem import CAMERA, READOUT, Problem, State, residuals_px
from skyquilt.alignment.setup import FISHEYE
from skyquilt.alignment.triangulate import polish, triangulated
from skyquilt.imaging.nodes import View, project_all, project_nodes
from skyquilt.imaging.views import on_ground
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Motion, Pose
from skyquilt.model.surface import Surface
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.flight import Shot, Waypoint, fly, plan
from skyquilt.simulate.settings import FlightSettings, Route, Video
from skyquilt.simulate.video import film
from tests.alignment.surveys import photo

LENS = Lens(width=1600, height=1200, aspect=1.002, readout=0.030)
SPEED = 10.0


def shots(seed=0, *, fixed_yaw=True, turns=0.0, photos=18, lens=LENS):
    route = Route(
        photos=photos, height=40.0, speed=SPEED, fixed_yaw=fixed_yaw, turns=turns, tilt_noise=1.0
    )
    return fly(plan(route, lens), route, 0.0, seed, "T")


def vector(lens):
    terms = (lens.k1, lens.k2, lens.k3, lens.p1, lens.p2, lens.aspect, 0.0, lens.readout)
    return np.array([lens.focal, lens.cx, lens.cy, *terms])


def frames(seed=0):
    """Frames of a clip of two lines and the turn between them, 0.8 s apart."""
    route = Route(photos=8, height=40.0, speed=SPEED, sidelap=0.4)
    settings = FlightSettings(seed=seed, lens=LENS, route=route)
    return film(plan(route, LENS), settings, Video(fps=5.0), 0.0)[::4]


def timed(flown):
    """The same as photos that tell when they were taken."""
    began = datetime(2026, 5, 1, 12)
    return [replace(photo(s.name), time=began + timedelta(seconds=s.waypoint.time)) for s in flown]


def block(seed=0, *, noise=0.1, lens=LENS, flown=None, **options):
    """Problem and truth of a flight seen through the simulator's camera."""
    rng = np.random.default_rng(seed)
    flown = shots(seed, lens=lens, **options) if flown is None else flown
    C = np.array([s.centre for s in flown])
    xy = rng.uniform(C[:, :2].min(0) - 15, C[:, :2].max(0) + 15, (600, 2))
    X = np.column_stack([xy, 2 * np.sin(xy[:, 0] / 9) + rng.uniform(0, 3, len(xy))])
    rows = []
    for i, shot in enumerate(flown):
        px = shot.project(lens, X)
        inside = (px > 3).all(1) & (px[:, 0] < lens.width - 4) & (px[:, 1] < lens.height - 4)
        rows += [(p, i, *px[p]) for p in np.flatnonzero(inside)]
    table = np.array(sorted(rows))
    point, photos, px = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:]
    keep = np.bincount(point, minlength=len(X))[point] >= 2
    used, point = np.unique(point[keep], return_inverse=True)
    photos, px = photos[keep], px[keep] + rng.normal(0, noise, (int(keep.sum()), 2))
    n, sigma_K = len(flown), [13.0, 8, 8, 0.02, 0.02, 0.01, 2e-3, 2e-3, 3e-3, 0.015]
    errs = np.insert(rng.normal(0, sigma_K) * (noise > 0), FISHEYE, 0.0)
    spins = np.radians([s.spin for s in flown]) * lens.readout
    R = np.array([s.rotation for s in flown])
    truth = State(R=R, C=C, K=vector(lens)[None], X=X[used], turn=spins)
    problem = Problem(
        point=point,
        photo=photos,
        px=px,
        sigma_px=np.full(len(px), max(noise, 0.05)),
        camera=np.zeros(n, int),
        free=np.array([np.arange(CAMERA) != FISHEYE]),
        K0=vector(lens)[None] + errs,
        sigma_K=np.insert(sigma_K, FISHEYE, 1.0)[None],
        C0=C + rng.normal(0, 1.0, C.shape) * (noise > 0),
        sigma_C=np.full(C.shape, 1.0),
        R0=R,
        sigma_R=np.full(C.shape, np.radians(1.0)),
        X0=np.full((len(used), 3), np.nan),
        sigma_X=np.ones((len(used), 3)),
        last_row=np.full(n, lens.height - 1.0),
        velocity=np.array([s.velocity for s in flown]),
        loss_px=1e6,
        loss_C=1e6,
        loss_R=1e6,
    )
    return problem, truth, flown


@pytest.mark.parametrize("turns", [0.0, 5.0])
def test_residuals_are_those_of_a_camera_that_moves_while_it_reads(turns):
    problem, truth, _ = block(noise=0.0, turns=turns)
    off = np.abs(residuals_px(problem, truth)).max()
    assert off < (1e-6 if turns == 0 else 0.02)  # turns enter linearly
    still = replace(truth, K=np.where(np.arange(CAMERA) == READOUT, 0.0, truth.K))
    assert np.abs(residuals_px(problem, still)).max() > 4.0  # the readout shifts rows by 5 px


def test_points_are_found_from_moving_cameras():
    problem, truth, _ = block(noise=0.0, turns=5.0)
    found, _ = polish(problem, triangulated(problem, truth))
    assert np.abs(found.X - truth.X).max() < 0.01
    first = np.linalg.norm(triangulated(problem, truth).X - truth.X, axis=1)
    assert np.median(first) < 0.01


@pytest.mark.slow
def test_the_readout_is_determined_where_lines_go_both_ways_without_turning():
    errors = []
    for seed in range(3):
        problem, truth, _ = block(seed)
        start = replace(truth, C=problem.C0, K=problem.K0.copy())
        found = adjust(problem, start, iterations=40, tolerance=1e-9).state
        sigma = float(np.sqrt(covariance(problem, found).cameras[-1, -1]))
        assert sigma < 0.1 * LENS.readout  # far below its prior of half the readout
        errors.append((found.K[0, READOUT] - LENS.readout) / sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 2.2


@pytest.mark.slow
def test_noise_of_observations_does_not_lengthen_the_readout():
    """An error of 1 px moves the observed row as well. With residuals from there all readouts
    were 3 to 7 deviations too long.
    """
    errors = []
    for seed in range(2):
        problem, truth, _ = block(seed, noise=1.0, fixed_yaw=False)
        start = replace(truth, C=problem.C0, K=problem.K0.copy())
        found = adjust(problem, start, iterations=40, tolerance=1e-9).state
        sigma = covariance(problem, found).camera_sigmas[0, -1]
        errors.append((found.K[0, READOUT] - LENS.readout) / sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 2


@pytest.mark.slow
def test_a_drone_that_turns_with_its_lines_leaves_readout_and_aspect_to_their_priors():
    problem, truth, _ = block(fixed_yaw=False)
    start = replace(truth, C=problem.C0, K=problem.K0.copy())
    found = adjust(problem, start, iterations=40, tolerance=1e-9).state
    full = covariance(problem, found)
    shape, _, sigma = full.camera_sigmas[0, -3:]
    assert full.cameras[-1, -3] / sigma / shape < -0.6  # one makes up for the other
    other, truth, _ = block(fixed_yaw=True)
    start = replace(truth, C=other.C0, K=other.K0.copy())
    found = adjust(other, start, iterations=40, tolerance=1e-9).state
    assert sigma > 3 * np.sqrt(covariance(other, found).cameras[-1, -1])


@pytest.mark.slow
def test_turns_are_found_beside_readout():
    problem, truth, _ = block(turns=5.0, noise=0.05)
    spread = np.full(len(truth.C), np.radians(5.0) * LENS.readout)
    start = replace(truth, C=problem.C0, K=problem.K0.copy(), turn=np.zeros_like(truth.turn))
    found = adjust(replace(problem, sigma_turn=spread), start, iterations=40, tolerance=1e-9).state
    missed = found.turn - truth.turn
    assert np.sqrt((missed**2).mean()) < 0.35 * np.sqrt((truth.turn**2).mean())


def test_some_photos_of_a_problem_are_a_problem():
    """Residuals of what is left are those of the whole."""
    problem, truth, _ = block(turns=5.0)
    some = np.array([3, 4, 5, 9, 10])
    part, its = problem.among(some, truth)
    mine = np.isin(problem.photo, some)
    number = np.bincount(problem.point[mine], minlength=len(truth.X))
    mine &= number[problem.point] >= 2
    assert 50 < len(part.px) == mine.sum() and np.bincount(part.point).min() >= 2
    assert np.array_equal(residuals_px(part, its), residuals_px(problem, truth)[mine])
    assert np.array_equal(some[part.photo], problem.photo[mine])
    for name in ("C0", "sigma_C", "R0", "sigma_R", "velocity"):
        assert np.array_equal(getattr(part, name), getattr(problem, name)[some])
    assert part.sigma_turn is None
    spread = np.arange(len(truth.C)) * 1e-3
    part, _ = replace(problem, sigma_turn=spread).among(some, truth)
    assert np.array_equal(part.sigma_turn, spread[some])


class Sizes:
    """What `weighed` needs of a setup."""

    def __init__(self, photos, spin=None):
        self.members, self.size = np.arange(photos), np.tile([LENS.width, LENS.height], (photos, 1))
        self.spin = spin


def test_cameras_turn_while_frames_of_a_clip_are_taken_as_from_frame_to_frame():
    flown = frames()
    R, true = np.array([s.rotation for s in flown]), np.radians([s.spin for s in flown])
    rate, off = spins(timed(flown), R)
    fast = np.linalg.norm(true, axis=1) > np.radians(15)
    assert 3 <= fast.sum() < len(flown) - 3
    apart = np.linalg.norm(rate - true, axis=1)
    assert (apart[1:-1] < np.maximum(3 * off[1:-1], np.radians(6))).all()
    swaying = np.linalg.norm(rate, axis=1) == 0
    assert swaying.any() and not off[swaying].any() and not (swaying & fast).any()
    assert np.median(apart[fast]) < 0.2 * np.median(np.linalg.norm(true[fast], axis=1))
    for rare in (timed(flown)[::3], [replace(p, time=None) for p in timed(flown)]):
        rate, off = spins(rare, R[: len(rare)])  # more than two seconds apart, or without times
        assert not rate.any() and not off.any()


@pytest.mark.slow
def test_frames_of_a_turn_do_not_bend_the_lens():
    """Rows of a frame are exposed while the drone turns by half a degree: taken for a shape of the
    lens, that moved the principal point.
    """
    flown, off = frames(), {}
    problem, truth, _ = block(flown=flown)
    start = adjust(problem, replace(truth, K=problem.K0.copy(), turn=0 * truth.turn), iterations=40)
    told = spins(timed(flown), truth.R)
    for name, spin in (("untold", None), ("told", told)):
        _, found = stages.weighed(problem, start.state, Sizes(len(flown), spin))
        off[name] = np.linalg.norm(found.K[0, 1:3] - truth.K[0, 1:3])
    assert off["told"] < 3.0 < 0.15 * off["untold"]  # px


@pytest.mark.slow
@pytest.mark.parametrize(("stops", "turns"), [(True, 0.0), (False, 0.0), (False, 5.0)])
def test_some_photos_of_a_large_survey_tell_how_its_cameras_moved(monkeypatch, stops, turns):
    """Whether they stood still and whether they turned: the whole is adjusted once for each weight,
    under what they say, and ends as if all had been asked.
    """
    problem, truth, _ = block(lens=replace(LENS, readout=0.0) if stops else LENS, turns=turns)
    if stops:
        problem = replace(problem, sigma_K=np.where(np.arange(CAMERA) == READOUT, 1e-4, 1.0)[None])
        problem.K0[:, READOUT] = LENS.readout  # what is usual for this model
    whole, asked = len(truth.C), []
    start = adjust(problem, replace(truth, K=problem.K0.copy()), iterations=40).state
    sure, best = stages.weighed(problem, start, Sizes(whole))

    def counted(problem, *args, **options):
        asked.append((len(problem.C0), bool(problem.velocity.any())))
        return adjust(problem, *args, **options)

    monkeypatch.setattr(stages, "ASKED", 8)
    monkeypatch.setattr(stages, "adjust", counted)
    found, state = stages.weighed(problem, start, Sizes(whole))
    assert [moving for n, moving in asked if n < whole] == [True, True, True, False, not stops]
    assert [moving for n, moving in asked if n == whole] == [not stops] * (3 if turns else 2)
    assert (found.sigma_turn is not None) is (turns > 0) and sure.sigma_turn is not None
    assert bool(found.velocity.any()) is bool(sure.velocity.any()) is not stops
    assert np.abs(state.C - best.C).max() < 0.1 * np.abs(best.C - truth.C).max()


@pytest.mark.parametrize("turns", [0.0, 4.0])
def test_pictures_are_drawn_and_read_where_their_rows_saw_the_ground(turns):
    flown = shots(2, turns=turns)
    z = np.zeros((3, 3), np.float32)
    level = Surface(z=z, x0=-500.0, y0=-500.0, cell=500.0, source="plane")
    camera = Camera(
        width=LENS.width,
        height=LENS.height,
        **dict(zip(("focal", "cx", "cy"), vector(LENS)[:3], strict=True)),
        k1=LENS.k1,
        k2=LENS.k2,
        p1=LENS.p1,
        p2=LENS.p2,
        aspect=LENS.aspect,
        readout_s=LENS.readout,
    )
    views, truth = [], []
    for shot in flown[:3]:
        motion = Motion(
            shift_m=np.array(shot.velocity) * LENS.readout,
            turn_rad=np.radians(shot.spin) * LENS.readout,
        )
        pose = Pose(cam_R_map=shot.rotation, map_C=shot.place, motion=motion)
        views.append(View(photo=0, camera=camera, pose=pose, footprint=np.zeros((4, 2))))
    x, y = np.meshgrid(np.linspace(-12, 12, 9), np.linspace(10, -10, 7))
    x, y = x + flown[1].centre[0], y + flown[1].centre[1]
    z = np.zeros_like(x)
    ground = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    together = project_all(views, x, y, z)
    for view, shot, nodes in zip(views, flown, together, strict=False):
        truth = shot.project(LENS, ground)
        inside = ((truth > 0) & (truth < [LENS.width - 1, LENS.height - 1])).all(1)
        assert inside.sum() > 10
        for found in (nodes, project_nodes(view, x, y, z)):
            px = np.column_stack([found.u.ravel(), found.v.ravel()])
            assert np.abs(px - truth)[inside].max() < 0.02
        back = on_ground(view, truth[inside], level)
        assert np.abs(back - ground[inside]).max() < 0.002


def test_velocities_follow_from_positions_and_times():
    flown = shots(3, fixed_yaw=False, photos=40)
    named = timed(flown)
    C = np.array([s.centre for s in flown])
    true = np.array([s.velocity for s in flown])
    found = velocities(named, C)
    off = np.linalg.norm(found - true, axis=1) / SPEED
    assert np.median(off) < 0.04 and off.max() < 0.15  # positions stray by half a metre from a line
    stopping = [replace(p, velocity_ned=(0.0, 0.1, 0.0)) for p in named]
    assert np.abs(velocities(stopping, C)).max() <= 0.1  # it slows down for its photos
    assert not velocities([replace(p, time=None) for p in named], C).any()


def test_whole_seconds_still_tell_the_speed():
    flown = shots(3, fixed_yaw=True, photos=40)
    began = datetime(2026, 5, 1, 12)
    named = [
        replace(photo(s.name), time=began + timedelta(seconds=int(s.waypoint.time))) for s in flown
    ]
    true = np.array([s.velocity for s in flown])
    found = velocities(named, np.array([s.centre for s in flown]))
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.15 * SPEED


def test_a_shot_that_stands_still_is_projected_as_ever():
    shot = Shot(
        name="a",
        waypoint=Waypoint(x=0, y=0, heading=0, line=0),
        centre=(0.0, 0.0, 50.0),
        yaw=10.0,
        pitch=1.0,
        roll=2.0,
    )
    X = np.array([[3.0, 4.0, 0.0]])
    assert (shot.project(LENS, X) == LENS.project(X, shot.rotation, shot.place)).all()
