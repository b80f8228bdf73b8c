"""`bundle` from photos and links, its set-up, files turned upside down, and control points."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from pyproj import Transformer

from skyquilt.alignment.aligners import blank_notes, choose_method, placed
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.control import Control, control_in_frame, fit_similarity_3d
from skyquilt.alignment.deviations import drift, position_noise
from skyquilt.alignment.problem import READOUT
from skyquilt.alignment.setup import HALF_TURN
from skyquilt.alignment.stages import prune
from skyquilt.engine.codec import decode, encode
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.errors import AlignmentError
from skyquilt.geometry.camera import project
from skyquilt.geometry.frames import angles_from_cam_R_map, rotation_from_vector
from skyquilt.matching.verify import Verify
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches
from skyquilt.model.photo import ControlPoint, Focal, PointObservation
from skyquilt.model.poses import MapFrame
from skyquilt.workflows.artefacts import REGISTRY
from tests.alignment.blocks import HEIGHT, LENS, WIDTH, make_block, seen_by
from tests.alignment.surveys import photo, prior
from tests.once import made_once

FRAME = MapFrame(crs="EPSG:32630", origin=(500000.0, 5600000.0), vertical_datum="takeoff")
SLOW = pytest.mark.slow
LOCAL = MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="takeoff")


@made_once
class Flown:
    """A simulated block as photos, priors, features and links."""

    def __init__(self, seed=0, *, turned=(), yaw_lies=(), gps=1.0, **options):
        sigma_k = np.array([4.0, 2.0, 2.0, 0.01, 0.01, 0.01, 1e-3, 1e-3, 3e-3, 1.0, 1e-3])
        options = {"points": 500, "tilt_deg": 0.5, "sigma_k": sigma_k} | options
        self.block = b = make_block(seed, gps=gps, **options)
        n = len(b.truth.C)
        self.truth, self.turned = b.truth, set(turned)
        self.photos = [
            photo(
                f"{i:02d}.jpg",
                focal=LENS[0],
                sigma_focal=10.0,
                editor="Some Viewer" if i in self.turned else None,
            )
            for i in range(n)
        ]
        self.priors = []
        for i in range(n):
            yaw, pitch, roll = angles_from_cam_R_map(b.problem.R0[i])
            self.priors.append(
                prior(
                    b.problem.C0[i],
                    yaw=yaw + (180 if i in yaw_lies else 0),
                    pitch=pitch,
                    roll=roll,
                    sigma=gps,
                    sigma_z=2 * gps,
                )
            )
        self.features, index = [], []
        for i in range(n):
            mine = np.flatnonzero(b.problem.photo == i)
            px = b.problem.px[mine]
            if i in self.turned:
                px = np.array([WIDTH - 1, HEIGHT - 1]) - px
            self.features.append(
                Features(
                    px=px,
                    size=np.ones(len(px), np.float32),
                    descriptors=np.zeros((len(px), 4), np.uint8),
                    scale=1.0,
                )
            )
            index.append(dict(zip(b.problem.point[mine].tolist(), range(len(mine)), strict=True)))
        self.links = []
        for i in range(n):
            for j in range(i + 1, n):
                shared = sorted(set(index[i]) & set(index[j]))
                if len(shared) >= 20:
                    m = Matches(
                        index_a=np.array([index[i][p] for p in shared]),
                        index_b=np.array([index[j][p] for p in shared]),
                    )
                    link = Verify()(i, j, self.features[i], self.features[j], m, WIDTH)
                    if isinstance(link, Link):
                        self.links.append(link)

    def aligned(self, **options):
        control = options.pop("control", ())
        frame = options.pop("frame", FRAME)
        keep = options.pop("keep", MADE_NOW)
        return Bundle(**options)(
            self.photos, frame, self.priors, self.features, self.links, control, None, keep
        )

    def file_pose(self, i):
        """True rotation of the file, which is its sensor's, turned if the file was."""
        return HALF_TURN @ self.truth.R[i] if i in self.turned else self.truth.R[i]


def stretched(aspect):
    """The blocks' lens on a sensor with pixels of this focal length along columns over rows."""
    return np.r_[LENS[:8], aspect, LENS[9:]]


def worst_turn_deg(flown, alignment):
    turn = [
        cv2.Rodrigues(p.cam_R_map @ flown.file_pose(i).T)[0] for i, p in alignment.poses.items()
    ]
    return float(np.degrees(np.linalg.norm(turn, axis=1)).max())


def assert_residuals_fit(alignment, photos):
    """Tie points projected by the records lie where the residuals say."""
    ties = alignment.ties
    for i in photos:
        mine = ties.photo == i
        px = project(alignment.camera(i), alignment.poses[i].to_camera(ties.xyz[ties.point[mine]]))
        assert px - ties.px[mine] == pytest.approx(ties.residual_px[mine], abs=1e-4)


def relative_error(flown, alignment):
    """RMS in m of camera centres after the common shift is taken away."""
    e = np.array([p.map_C - flown.truth.C[i] for i, p in sorted(alignment.poses.items())])
    return float(np.sqrt(((e - e.mean(0)) ** 2).mean()))


@pytest.fixture(scope="module")
def plain():
    flown = Flown()
    return flown, flown.aligned()


def test_a_block_is_found(plain):
    flown, found = plain
    assert found.blocks == (tuple(range(18)),) and found.method == "bundle" and not found.rejected
    assert worst_turn_deg(flown, found) < 0.6
    assert 0.02 < relative_error(flown, found) < 0.5
    residual = np.linalg.norm(found.ties.residual_px, axis=1)
    assert (
        0.2 < residual.mean() < 0.4
    )  # noise of 0.3 px per axis: 0.376 less what the points absorb
    (camera,) = found.cameras.values()
    assert camera.focal == pytest.approx(flown.truth.K[0, 0], abs=12)
    assert camera.sigmas is not None and 0.5 < camera.sigmas[0] < 10 and camera.sigmas[8] > 0


@pytest.mark.slow
def test_a_block_that_is_soon_adjusted_again_is_found_nearly_as_well(plain):
    flown, thorough = plain
    quick = flown.aligned(thorough=False)
    assert quick.accuracy is None and thorough.accuracy is not None
    assert worst_turn_deg(flown, quick) < 0.6
    assert 0.02 < relative_error(flown, quick) < 1.2 * relative_error(flown, thorough)


@pytest.mark.slow
def test_large_surveys_are_placed_as_well_from_fewer_observations(plain):
    """As if 18 photos were many; the truth is as near as from all observations."""
    flown, usual = plain
    found = flown.aligned(many=5, per_photo=180, ties=64)
    assert set(found.poses) == set(usual.poses)
    assert len(found.ties.point) < 0.9 * len(usual.ties.point)
    assert relative_error(flown, found) < 1.3 * relative_error(flown, usual)
    assert worst_turn_deg(flown, found) < 0.6


class StoppedError(Exception):
    pass


@pytest.mark.slow
@pytest.mark.parametrize("factored", [600, 5])  # photos up to which each step has its factor
def test_an_interrupted_adjustment_of_many_photos_goes_on_at_its_iteration(
    plain, monkeypatch, factored
):
    monkeypatch.setattr("skyquilt.alignment.equations.FACTORED", factored)
    flown, _ = plain
    kept, made = {}, []

    def keep(part, make):
        if part not in kept:
            if len(made) == stop:
                raise StoppedError
            made.append(part)
            kept[part] = encode(make())  # as the store keeps it
        return decode(kept[part], REGISTRY)

    stop = None
    whole = flown.aligned(many=5, keep=Keep(held=keep))
    parts, kept = made, {}
    assert len(parts) == len(set(parts)) > 10
    for stop in (2, len(parts) // 2):
        made = []
        with pytest.raises(StoppedError):
            flown.aligned(many=5, keep=Keep(held=keep))
        stop = None
        again = flown.aligned(many=5, keep=Keep(held=keep))
        assert made == parts  # nothing twice
        assert all((p.map_C == again.poses[i].map_C).all() for i, p in whole.poses.items())
        assert (whole.ties.xyz == again.ties.xyz).all()
        kept = {}
    made = []
    flown.aligned(keep=Keep(held=keep))
    assert made == []  # few photos are adjusted in a moment


def test_tie_points_project_where_they_were_seen(plain):
    _, found = plain
    t = found.ties
    assert_residuals_fit(found, (0, 7, 17))
    assert (np.diff(t.point) >= 0).all() and np.bincount(t.point).min() >= 2


@pytest.mark.slow
def test_files_turned_by_half_a_turn(plain):
    """The middle line upside down: the same residuals and ground, its calibration mirrored, its
    poses turned.
    """
    line = range(6, 12)
    flown = Flown(turned=line)
    found = flown.aligned()
    assert set(found.camera_of.values()) == {"cam", "cam/turned"}
    assert {i for i, k in found.camera_of.items() if k == "cam/turned"} == set(line)
    straight, upside = found.cameras["cam"], found.cameras["cam/turned"]
    assert upside.cx == pytest.approx(WIDTH - 1 - straight.cx) and upside.cy == pytest.approx(
        HEIGHT - 1 - straight.cy
    )
    assert straight.cx == pytest.approx(plain[1].cameras["cam"].cx, abs=0.3)
    assert worst_turn_deg(flown, found) < 0.6
    error, before = (np.sqrt((a.ties.residual_px**2).mean()) for a in (found, plain[1]))
    assert error == pytest.approx(before, rel=0.03)
    assert_residuals_fit(found, (7, 13))


def test_a_mirrored_camera_is_the_turned_file_s():
    """Every coefficient: a point's pixel in the turned file is the half turn of its pixel in the
    sensor.
    """
    camera = Camera(
        width=800,
        height=600,
        focal=700,
        cx=410,
        cy=290,
        k1=-0.1,
        k2=0.03,
        k3=-0.01,
        p1=2e-3,
        p2=-1e-3,
    )
    xyz = np.random.default_rng(0).uniform((-20, -15, 40), (20, 15, 80), (50, 3))
    turned = project(camera.mirrored(), xyz @ HALF_TURN.T)
    assert np.array([799, 599]) - turned == pytest.approx(project(camera, xyz), abs=1e-9)
    assert camera.mirrored().mirrored() == camera


@pytest.mark.slow
def test_yaws_that_lie_do_not_matter(plain):
    """A line whose reported yaw is half a turn off, but whose files nobody turned."""
    flown = Flown(yaw_lies=range(6, 12))
    found = flown.aligned()
    assert set(found.camera_of.values()) == {"cam"}
    assert worst_turn_deg(flown, found) < 0.6
    assert relative_error(flown, found) < relative_error(*plain) + 0.1


@pytest.mark.slow
def test_a_position_that_lies_is_outvoted():
    flown = Flown(2)
    flown.priors[4] = replace(flown.priors[4], map_C=flown.priors[4].map_C + (60.0, -40.0, 0.0))
    found = flown.aligned()
    assert np.abs(found.poses[4].map_C - flown.truth.C[4])[:2].max() < 2.0
    trusting = flown.aligned(repair=False)
    assert (
        np.abs(trusting.poses[4].map_C - flown.truth.C[4])[:2].max() > 3.0
    )  # `--trust-metadata` believes it


@pytest.mark.slow
def test_two_blocks_are_both_kept():
    flown = Flown(3)
    flown.links = [k for k in flown.links if (k.a < 12) == (k.b < 12)]
    found = flown.aligned()
    assert found.blocks == (tuple(range(12)), tuple(range(12, 18)))
    assert len(found.poses) == 18


@pytest.mark.slow
@pytest.mark.parametrize("known", [(), (0,), (13,)])
def test_of_two_blocks_those_are_kept_whose_place_is_known(known):
    """Positions of a block's photos tell its place; without any, only the largest has one. That has
    none where others have: it would lie anywhere.
    """
    flown = Flown(3)
    flown.links = [k for k in flown.links if (k.a < 12) == (k.b < 12)]
    bare = without_positions(Flown(3)).priors
    flown.priors = [flown.priors[i] if i in known else bare[i] for i in range(18)]
    # without any position the map has a frame of its own
    found = flown.aligned(frame=FRAME if known else LOCAL)
    first, second = set(range(12)), set(range(12, 18))
    if 13 in known:
        assert set(found.poses) == second and set(found.rejected) == first
        assert (
            "with 11 other photos, but not with the 6 of those that positions" in found.rejected[0]
        )
    else:
        assert set(found.poses) == first and set(found.rejected) == second
        assert "linked with 5 other photos, but not with the 12" in found.rejected[12]


def test_no_links():
    flown = Flown(4)
    flown.links = []
    with pytest.raises(AlignmentError, match="none of 18"):
        flown.aligned()


def test_leave_one_out_is_larger_than_the_residual_and_of_the_noise_s_size(plain):
    flown, found = plain
    residual = np.array([found.poses[i].map_C - flown.priors[i].map_C for i in range(18)])
    rms = np.sqrt((residual**2).mean(0))
    assert (np.array(found.loo_rms_m)[:2] > rms[:2]).all()
    assert 0.6 < np.mean(found.loo_rms_m[:2]) < 1.6  # GPS noise of 1 m


def test_position_noise_is_what_neighbours_do_not_share():
    rng = np.random.default_rng(0)
    n = 400
    smooth = np.column_stack([np.sin(np.arange(n) / 60) * 20, np.arange(n) * 0.05])
    assert position_noise(smooth + rng.normal(0, 1.5, (n, 2))) == pytest.approx(1.5, rel=0.15)
    assert position_noise(smooth[:5]) == 0.0
    assert position_noise(np.full((10, 2), np.nan)) == 0.0


def test_drift_is_what_neighbours_share():
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 1.5, (400, 1))
    ramp = np.linspace(-30, 30, 400)[:, None]
    assert drift(noise) < 0.8
    assert drift(ramp + noise) == pytest.approx(np.median(np.abs(ramp)) * 1.48, rel=0.1)
    assert drift(ramp[:5]) == 0.0
    assert drift(np.full((10, 2), np.nan)) == 0.0


@pytest.mark.slow
def test_heights_that_drift_leave_the_map_as_uncertain(plain):
    flown, found = plain
    drifting = Flown(4)
    off = np.linspace(0, 60, len(drifting.priors))
    drifting.priors = [
        replace(p, map_C=p.map_C + (0, 0, z)) for p, z in zip(drifting.priors, off, strict=True)
    ]
    again = drifting.aligned()
    bias = np.mean([again.poses[i].map_C[2] - flown.truth.C[i, 2] for i in again.poses])
    assert bias == pytest.approx(30, abs=5)
    assert found.accuracy.shared_m[1] < 3
    assert abs(bias) / 2 < again.accuracy.shared_m[1] < 2 * abs(bias)
    assert again.accuracy.shared_m[0] == pytest.approx(found.accuracy.shared_m[0], rel=0.3)


def test_pruning_drops_lies_and_lonely_points_but_no_control():
    block = make_block(5, lies=0.05)
    problem = replace(block.problem, X0=block.problem.X0.copy())
    problem.X0[0] = block.truth.X[0] + 50  # a control point that fits nothing
    pruned, state = prune(
        problem, replace(block.truth, X=np.r_[block.truth.X[:1] + 50, block.truth.X[1:]]), 8.0
    )
    assert (pruned.point == 0).sum() == (problem.point == 0).sum()
    assert len(pruned.px) >= (~block.wrong).sum() - 2 * block.wrong.sum()
    error = np.abs(pruned.px[:, None] - block.problem.px[block.wrong][None]).sum(2).min(1)
    near = np.linalg.norm(block.problem.px[block.wrong], axis=1)
    assert (error[pruned.point > 0] == 0).sum() < 0.05 * len(near)
    assert np.bincount(pruned.point).min() >= 1 and len(state.X) == pruned.point.max() + 1


# control points


def test_umeyama():
    rng = np.random.default_rng(0)
    x = rng.normal(0, 10, (6, 3))
    s, R, t = 2.5, rotation_from_vector(np.array([0.4, -1.2, 2.0])), np.array([5.0, -7.0, 100.0])
    found_s, found_R, found_t = fit_similarity_3d(x, s * x @ R.T + t)
    assert (
        found_s == pytest.approx(s) and found_R == pytest.approx(R) and found_t == pytest.approx(t)
    )
    mirror = x * (1, 1, -1)  # no rotation makes a mirror image: the best proper one is found
    assert np.linalg.det(fit_similarity_3d(x, mirror)[1]) == pytest.approx(1)
    plane = x * (1, 1, 0)
    assert fit_similarity_3d(plane, s * plane @ R.T + t)[1] == pytest.approx(R)


def sighted(flown, xyz, name, *, check=False, rng=None, offset=0.0):
    """A surveyed point seen by all photos that show it, with 0.3 px of noise."""
    photos, pixels = [], []
    for i in range(len(flown.photos)):
        px = seen_by(flown.truth.R[i], flown.truth.C[i], flown.truth.K[0], xyz[None])[
            0
        ] + rng.normal(0, 0.3, 2)
        if (px > 5).all() and px[0] < WIDTH - 5 and px[1] < HEIGHT - 5:
            photos.append(i)
            pixels.append(px)
    return Control(
        name=name,
        check=check,
        xyz=xyz + offset,
        sigma_m=0.02,
        photo=np.array(photos),
        px=np.array(pixels),
    )


def surveyed(flown, *, offset=0.0, checks=()):
    rng = np.random.default_rng(1)
    places = np.array(
        [[5, 5, 1.0], [60, 4, 0.5], [8, 55, -1.0], [62, 60, 2.0], [35, 30, 0.0], [30, 12, 1.0]]
    )
    return [
        sighted(
            flown, p, f"{'c' if k in checks else 'g'}{k}", check=k in checks, rng=rng, offset=offset
        )
        for k, p in enumerate(places)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, np.array([1.5, -2.0, 430.0])])
def test_control_points_move_the_block_to_the_ground(offset):
    """The GPS shares an offset with nothing on the ground: the points win, in height by hundreds of
    metres.
    """
    flown = Flown(6)
    found = flown.aligned(control=surveyed(flown, offset=offset, checks=(5,)))
    residuals = {c.name: c for c in found.control}
    for c in residuals.values():
        assert np.abs(c.error_m[:2]).max() < 0.08 and abs(c.error_m[2]) < 0.5
        assert c.reprojection_px < 1.0
    assert residuals["c5"].check
    shift = np.mean([p.map_C - flown.truth.C[i] for i, p in found.poses.items()], axis=0)
    assert shift[:2] == pytest.approx(
        np.zeros(2) + offset if np.isscalar(offset) else offset[:2], abs=0.3
    )
    assert found.frame.vertical_datum == "control"


@pytest.mark.slow
def test_check_points_take_no_part():
    """A check point surveyed 5 m wrong is reported as such and changes nothing else."""
    flown = Flown(6)
    control = surveyed(flown, checks=(5,))
    good = flown.aligned(control=control)
    control[5] = replace(control[5], xyz=control[5].xyz + (5.0, 0, 0))
    bad = flown.aligned(control=control)
    for i in good.poses:
        assert bad.poses[i].map_C == pytest.approx(good.poses[i].map_C, abs=1e-9)
    off = [next(c for c in a.control if c.name == "c5").error_m for a in (good, bad)]
    assert off[1] - off[0] == pytest.approx([-5.0, 0, 0], abs=1e-9)


def without_positions(flown):
    flown.priors = [
        replace(p, map_C=np.full(3, np.nan), sigma_C=np.full(3, np.inf), yaw_deg=np.nan)
        for p in flown.priors
    ]
    return flown


@pytest.mark.slow
def test_three_control_points_georeference_photos_without_positions():
    flown = without_positions(Flown(7))
    found = flown.aligned(control=surveyed(flown, checks=(4, 5)))
    assert found.frame.metric and found.loo_rms_m is None  # there was no position to leave out
    assert worst_turn_deg(flown, found) < 1.0
    assert max(np.abs(p.map_C - flown.truth.C[i]).max() for i, p in found.poses.items()) < 2.0
    for c in found.control:
        assert np.abs(c.error_m[:2]).max() < 0.3


def lens_errors(*, noise, control=False):
    """Errors (12, 5) of focal length, principal point, k1 and k2 in units of their stated
    deviations, in twelve blocks whose keypoints err by `noise` px.
    """
    errors = []
    for seed in range(10, 22):
        flown = Flown(seed, noise=noise)
        (camera,) = flown.aligned(control=surveyed(flown) if control else ()).cameras.values()
        errors.append((camera.vector - flown.truth.K[0, :READOUT])[:5] / camera.sigmas[:5])
    return np.array(errors)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_the_deviations_of_a_calibration_are_as_large_as_its_errors(noise):
    """Keypoints are taken to err by more than these do: the deviations follow what they show."""
    errors = lens_errors(noise=noise)
    assert 0.7 < rms(errors) < 1.4
    assert 0.3 < rms(errors[:, 0]) < 1.4  # the focal length alone


@pytest.mark.slow
def test_the_focal_length_s_deviation_is_honest_with_control_points():
    assert 0.3 < rms(lens_errors(noise=0.15, control=True)[:, 0]) < 1.4


def test_two_control_points_are_too_few():
    flown = without_positions(Flown(7))
    with pytest.raises(AlignmentError, match="3 control points"):
        flown.aligned(control=surveyed(flown)[:2])


def test_control_points_in_another_crs():
    photos = [photo("a.jpg"), photo("sub/b.jpg")]
    x, y = Transformer.from_crs(32630, 27700, always_xy=True).transform(500010.0, 5600020.0)
    point = ControlPoint(
        name="p",
        x=x,
        y=y,
        z=None,
        crs="EPSG:27700",
        observations=(
            PointObservation(photo="sub/b.jpg", x=3, y=4),
            PointObservation(photo="gone.jpg", x=1, y=2),
        ),
    )
    unseen = replace(point, name="q", observations=(PointObservation(photo="gone.jpg", x=1, y=2),))
    (found,) = control_in_frame([point, unseen], photos, FRAME)
    assert found.xyz[:2] == pytest.approx([10.0, 20.0], abs=1e-3) and np.isnan(found.xyz[2])
    assert found.photo.tolist() == [1] and found.px.tolist() == [[3.0, 4.0]]


@pytest.mark.parametrize(
    ("positions", "control", "says"),
    [
        (9, 0, "30 links connect the photos, and positions place it"),
        (9, 3, "30 links connect the photos, and control points place it"),
        (0, 3, "30 links connect the photos, and control points place it"),
        (0, 0, "30 links connect the photos, but no positions: the map is not georeferenced"),
    ],
)
def test_what_places_the_map_is_said(positions, control, says):
    assert choose_method(9, 30, positions, control) == ("bundle", says)


@pytest.mark.parametrize(("blank", "told"), [(0, False), (2, False), (3, True), (4, True)])
def test_photos_that_show_nothing_are_told(blank, told):
    def found(count):
        return Features(
            px=np.zeros((count, 2)),
            size=np.zeros(count, np.float32),
            descriptors=np.zeros((count, 128), np.uint8),
            scale=1.0,
        )

    notes = blank_notes([found(0)] * blank + [found(300)] * (4 - blank))
    assert bool(notes) == told
    assert not told or notes[0].startswith(f"{blank} of 4 photos show next to nothing")


@pytest.mark.slow
def test_positions_that_most_contradict_do_not_move_the_map():
    """A third of the photos is of a drone with a false base; before, all of them moved and turned
    the map.
    """
    flown = Flown()
    away = set(range(1, len(flown.priors), 3))
    shift = np.array([70.0, 70.0, 0.0])
    told = [replace(p, map_C=p.map_C + shift * (i in away)) for i, p in enumerate(flown.priors)]
    found = Bundle()(flown.photos, FRAME, told, flown.features, flown.links)
    off = np.array([found.poses[i].map_C - flown.truth.C[i] for i in sorted(found.poses)])
    assert np.abs(off[:, :2]).max() < 2.0
    assert any(f"positions of {len(away)} of {len(told)} photos" in note for note in found.notes)


def test_copies_of_one_picture_are_refused_with_the_reason():
    """No point that they share has a place, so none of them has a pose, and no misfit is told."""
    flown = Flown()
    one, all_of_it = flown.features[0], np.arange(len(flown.features[0].px))
    bare = [replace(p, map_C=np.full(3, np.nan), yaw_deg=np.nan) for p in flown.priors[:3]]
    whole = Matches(index_a=all_of_it, index_b=all_of_it)
    links = [Verify()(a, b, one, one, whole, WIDTH) for a, b in ((0, 1), (0, 2), (1, 2))]
    found = Bundle(match_observations=None)(flown.photos[:3], LOCAL, bare, [one] * 3, links)
    assert not found.poses
    with pytest.raises(AlignmentError, match="none of 3 photos could be placed .* copies"):
        placed(found)


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [1.03, 0.75, 0.95, 1.33])
def test_pictures_that_are_stretched_are_taken_as_they_are(aspect):
    """As well as pictures that nobody resized, whose centres are found to 0.35 m."""
    flown = Flown(lens=stretched(aspect))
    found = flown.aligned()
    assert found.cameras["cam"].aspect == pytest.approx(aspect, abs=0.005)
    assert relative_error(flown, found) < 0.35
    (note,) = [n for n in found.notes if "do not fit the camera" in n]
    assert float(note.split("the ratio ")[1].split(" ")[0]) == pytest.approx(aspect, abs=0.005)
    assert not any("anamorphic" in n for n in found.notes)


@pytest.mark.parametrize(
    ("aspect", "by"),
    [
        (1.03, "deviations from 1"),
        pytest.param(0.75, "goes the same way", marks=SLOW),
        pytest.param(1.33, "goes the same way", marks=SLOW),
        pytest.param(0.95, "deviations from 1", marks=SLOW),
    ],
)
def test_stretched_pictures_are_named_where_nothing_is_to_be_repaired(aspect, by):
    found = Flown(lens=stretched(aspect)).aligned(repair=False)
    (note,) = [n for n in found.notes if "anamorphic" in n]
    assert note.startswith("The photos of cam ") and by in note
    if "deviations" in by:
        said = float(note.split("of the ratio ")[1].split(",")[0])
        assert said == pytest.approx(aspect, abs=0.01)


@pytest.mark.slow
def test_a_guessed_focal_length_far_from_the_true_one_is_guessed_again():
    """Without heights, which would tell it; begun once, it ends 85 % off."""
    flown = Flown()
    guess = Focal(px=LENS[0] / 10, sigma_px=LENS[0] / 40, source="guess")
    flown.photos = [replace(p, focal=guess) for p in flown.photos]
    flown.priors = [replace(p, map_C=np.r_[p.map_C[:2], np.nan]) for p in flown.priors]
    found = flown.aligned()
    assert found.cameras["cam"].focal == pytest.approx(LENS[0], rel=0.03)
    (note,) = [n for n in found.notes if "do not tell the focal length of cam" in n]
    assert f"{found.cameras['cam'].focal:.0f} px" in note
    assert not any("shutter" in n for n in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize("times", [0.5, 0.4, 0.65, 1.5, 2.5])
def test_a_focal_length_that_files_tell_falsely_is_not_believed(times, plain):
    """Known to 5 % as they say; believed, one of half the length ended 52 % off."""
    flown = Flown()
    told = Focal(px=times * LENS[0], sigma_px=0.05 * times * LENS[0], source="35mm")
    flown.photos = [replace(p, focal=told) for p in flown.photos]
    found = flown.aligned()
    assert found.cameras["cam"].focal == pytest.approx(LENS[0], rel=0.03)
    assert relative_error(flown, found) < 1.1 * relative_error(*plain)


@pytest.mark.slow
def test_a_camera_told_falsely_beside_one_that_is_not_told():
    """Both are found."""
    flown = Flown()
    of = {
        "short": Focal(px=0.5 * LENS[0], sigma_px=0.025 * LENS[0], source="35mm"),
        "untold": Focal(px=0.4 * LENS[0], sigma_px=0.1 * LENS[0], source="guess"),
    }
    flown.photos = [
        replace(p, camera_key=key, focal=of[key])
        for p, key in zip(flown.photos, [*of] * 9, strict=True)
    ]
    found = flown.aligned()
    for camera in found.cameras.values():
        assert camera.focal == pytest.approx(LENS[0], rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_photos_cropped_towards_a_corner_keep_their_lens(seed):
    """The axis meets them 150 px right and 110 px below the middle; two lines that were flown in
    opposite directions look like displaced positions then.
    """
    lens = np.r_[LENS[0], LENS[1] + 150, LENS[2] + 110, LENS[3:]]
    flown = Flown(seed, lens=lens, lines=2)
    found = flown.aligned()
    camera = found.cameras["cam"]
    assert (camera.cx, camera.cy) == pytest.approx(lens[1:3], abs=8)
    assert relative_error(flown, found) < 0.35
    (note,) = [n for n in found.notes if "optical axis of cam" in n]
    assert " px right of their middle" in note and " px below it" in note
    assert not any("displaced" in n for n in found.notes)


@pytest.mark.slow
def test_ordinary_pictures_are_not_called_stretched(plain):
    notes = " ".join((*plain[1].notes, *Flown(1).aligned().notes))
    assert "anamorphic" not in notes and "do not fit" not in notes


@pytest.mark.slow
def test_a_stretched_picture_that_its_calibration_tells_is_not_named():
    flown = Flown(lens=stretched(0.75))
    told = Camera(width=WIDTH, height=HEIGHT, focal=LENS[0], cx=LENS[1], cy=LENS[2], aspect=0.75)
    flown.photos = [replace(p, calibration=told) for p in flown.photos]
    found = flown.aligned()
    assert found.cameras["cam"].aspect == pytest.approx(0.75, abs=0.002)
    assert not any("anamorphic" in n for n in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [slice(0, 2), 2])
def test_positions_that_are_wrong_by_themselves_do_not_draw_the_block(axis):
    """Two photos that tell each other's place, or heights 40 m too large: what is found is what is
    found without their positions.
    """
    flown = Flown(2, gps=1.0, lines=4, per_line=4, points=250)
    told = list(flown.priors)
    centre = [p.map_C.copy() for p in told]
    if axis == 2:
        centre[3][2] += 40
        centre[10][2] += 40
    else:
        centre[3], centre[10] = centre[10], centre[3]
    flown.priors = [replace(p, map_C=C) for p, C in zip(told, centre, strict=True)]
    found = flown.aligned()
    for i in (3, 10):
        told[i] = replace(told[i], map_C=np.full(3, np.nan))
    flown.priors = told
    without = flown.aligned()
    apart = [found.poses[i].map_C - without.poses[i].map_C for i in without.held]
    assert len(found.held) == 16
    assert np.abs(apart).max() < 0.25
