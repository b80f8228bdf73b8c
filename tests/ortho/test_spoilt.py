"""What is overexposed yields to other photos, together with marks and blur."""

import io
from dataclasses import replace

import numpy as np
import piexif
import pytest
import rasterio
from PIL import Image

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.blank import around, joined
from skyquilt.imaging.views import make_views, native_gsd
from skyquilt.ortho.lasting_marks import _hardly_varying, _is_mark
from skyquilt.ortho.spoilt import _spots, coarser_parts, spoilt_parts
from skyquilt.ortho.tie_surface import level
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import preset, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Route
from skyquilt.workflows.mosaic import mosaic
from tests.ortho.scenes import photograph, textured
from tests.ortho.test_sharpness import flight, seen


def shown(alignment, thumbnails, fixed=None):
    details = seen(alignment)
    names = [f"{k}.jpg" for k in range(len(details))]
    return spoilt_parts(alignment, lambda k: details[k], thumbnails, names, fixed or {})


@pytest.mark.slow
def test_white_frames_are_neither_overexposed_nor_marks_nor_fog():
    """They are not drawn at all (`imaging.blank`); one photo is overexposed besides."""
    alignment = flight(12, apart=6.0)
    framed = pictures(alignment)
    for p in framed.values():
        p[:30] = p[-30:] = p[:, :30] = p[:, -30:] = 255
    assert shown(alignment, framed) == ({}, ())
    framed[4][50:110, 100:190] = 255
    marks, notes = shown(alignment, framed)
    assert list(marks) == [4] and len(notes) == 1 and "One photo is overexposed" in notes[0]
    u, v = np.array([[140.0, 80.0], [15.0, 15.0]]).T
    assert (marks[4].at(u, v) < 0).tolist() == [True, False]


def plain(count):
    return {k: np.full((192, 256, 3), 120, np.uint8) for k in range(count)}


def test_white_parts_yield_and_are_named():
    alignment, thumbnails = flight(12), plain(12)
    thumbnails[4][50:100, 20:120, 0] = 252  # one band is enough
    thumbnails[7][:3, :3] = 255  # a white car
    marks, notes = shown(alignment, thumbnails)
    assert list(marks) == [4]
    px = np.array([[20.0, 120.0], [110.0, 120.0], [300.0, 250.0]])  # of 400 x 300
    assert (marks[4].at(*px.T) < 0).tolist() == [False, True, False]
    assert notes == (
        "One photo is overexposed in part (4.jpg): what is white there is drawn only where no other"
        " photo shows the ground.",
    )


def test_values_of_more_than_eight_bits_are_not_judged():
    alignment = flight(12)
    thumbnails = {k: np.full((192, 256), 65535, np.uint16) for k in range(12)}
    assert shown(alignment, thumbnails) == ({}, ())


def test_marks_stay_beside_what_is_white():
    alignment, thumbnails = flight(12), plain(12)
    thumbnails[4][50:100, 20:120] = 255
    logo = np.zeros((30, 40), bool)
    logo[22:26, 25:30] = True
    fixed = {k: around(logo, (400, 300)) for k in range(12)}
    marks, _ = shown(alignment, thumbnails, fixed)
    assert sorted(marks) == list(range(12))
    px = np.array([[110.0, 120.0], [275.0, 240.0], [330.0, 60.0]])
    assert (marks[4].at(*px.T) < 0).tolist() == [True, True, False]
    assert (marks[5].at(*px.T) < 0).tolist() == [False, True, False]
    # what is white may show ground, a text does not
    assert (marks[4].written.at(*px.T) < 0).tolist() == [False, True, False]


def test_parts_joined_are_those_of_either_at_any_resolution():
    left, top = np.zeros((30, 40), bool), np.zeros((60, 80), bool)
    left[:, :10], top[:15] = True, True
    both = joined(around(left, (400, 300)), around(top, (400, 300)))
    u, v = np.meshgrid(np.arange(0, 400, 5.0), np.arange(0, 300, 5.0))
    away = (np.abs(u - 100) > 25) & (np.abs(v - 75) > 25)  # not at their rims
    assert np.array_equal((both.at(u, v) < 0)[away], ((u < 100) | (v < 75))[away])


def lightened(path, factor):
    """The photo as a longer exposure shows it, with its metadata."""
    image = Image.open(path)
    linear = (np.asarray(image) / 255.0) ** 2.2 * factor
    pixels = (255 * np.minimum(linear, 1) ** (1 / 2.2)).astype(np.uint8)
    held = io.BytesIO()
    xmp = image.info.get("xmp")
    Image.fromarray(pixels).save(
        held, "JPEG", quality=92, exif=piexif.dump(piexif.load(image.info["exif"])), xmp=xmp
    )
    path.with_name(f"{path.stem}_over.jpg").write_bytes(held.getvalue())


@pytest.mark.slow
def test_the_map_of_a_bracket_is_not_white_where_the_ground_is_not(tmp_path):
    settings = replace(
        preset("default"),
        seed=74,
        lens=Lens().scaled(640, 480),
        route=Route(photos=12),
        thermal=None,
    )
    list(simulate(settings, tmp_path / "flight"))
    photos = tmp_path / "flight" / "photos"
    for path in sorted(photos.glob("*.jpg")):
        lightened(path, 5.0)
    mosaic(photos, tmp_path / "map", MosaicSettings(jobs=1))
    with rasterio.open(tmp_path / "map" / "mosaic.tif") as source:
        bands, inside = source.read([1, 2, 3]).astype(float), source.read_masks(1) > 0
    h, w = (n // 8 * 8 for n in inside.shape)
    squares = bands[:, :h, :w].reshape(3, h // 8, 8, w // 8, 8).std((2, 4)).min(0)
    whole = inside[:h, :w].reshape(h // 8, 8, w // 8, 8).all((1, 3))
    # a band that is clipped has no noise: 0.003 of the squares without the mend
    assert (squares[whole] < 0.7).mean() < 0.001


def pictures(alignment, ground=None):
    """What each photo of a flight shows of a ground, (300, 400, 3)."""
    views = make_views(alignment, level(0.0))
    grey = {v.photo: photograph(v, ground) for v in views}
    return {i: np.rint(np.dstack([g] * 3)).astype(np.uint8) for i, g in grey.items()}


@pytest.mark.slow
def test_dust_yields_where_all_photos_show_it():
    """Two discs of 30 and 22 px (of 400 x 300), 30 and 20 % darker, in all photos but at no place
    of the ground: they are found, and little else of the picture.
    """
    alignment = flight(12, apart=6.0)
    clean = pictures(alignment)
    v, u = np.mgrid[:300, :400]
    away = [
        (np.hypot(u - x, v - y), r, k) for x, y, r, k in ((130, 90, 15, 0.3), (290, 200, 11, 0.2))
    ]
    dust = np.prod([1 - k * np.clip(1.5 - d / r, 0, 1) for d, r, k in away], axis=0)
    spotted = {i: np.rint(p * dust[..., None]).astype(np.uint8) for i, p in clean.items()}
    marks, notes = shown(alignment, spotted)
    assert sorted(marks) == list(range(12))
    yields = marks[0].at(u, v) < 0
    for d, r, _ in away:
        assert yields[d < r].all()
    assert not yields[np.min([d - 3 * r for d, r, _ in away], axis=0) > 20].any()
    assert len(notes) == 1 and "darkened at the same place of every picture" in notes[0]
    assert shown(alignment, clean) == ({}, ())


def written(picture):
    """A picture with a cross of thin lines and the even scale of a palette."""
    picture = picture.copy()
    picture[149:151, 188:213] = picture[138:163, 199:201] = 255
    picture[70:230, 380:390] = np.linspace(250, 5, 160)[:, None, None]
    return picture


@pytest.mark.slow
def test_a_cross_and_a_scale_yield_though_they_have_few_features():
    alignment = flight(12, apart=6.0)
    clean = pictures(alignment)
    marks, notes = shown(alignment, {i: written(p) for i, p in clean.items()})
    assert sorted(marks) == list(range(12))
    v, u = np.mgrid[:300, :400]
    changed = (written(np.full((300, 400, 3), 1, np.uint8)) != 1).any(2)
    yields = marks[3].at(u, v) < 0
    assert yields[changed].all()
    assert (yields & ~changed).mean() < 0.015  # a margin of a few px
    assert len(notes) == 1 and "on 1.4 % of it" in notes[0] and "a cross, a scale" in notes[0]


def covered(picture):
    """A picture with an even disc, a third of its height wide."""
    v, u = np.mgrid[:300, :400]
    return np.where((np.hypot(u - 320, v - 220) < 50)[..., None], [110, 120, 115], picture)


def scratched(picture):
    """A picture with a line of 3 px that the ground shines through."""
    v, u = np.mgrid[:300, :400]
    line = (np.abs(u - 60 - 0.5 * v) < 1.7)[..., None]
    return np.where(line, 0.5 * picture + 110, picture)


@pytest.mark.slow
@pytest.mark.parametrize(("mark", "part"), [(covered, 0.98), (scratched, 1.0)])
def test_wide_marks_and_those_that_the_ground_shines_through_yield(mark, part):
    alignment = flight(12, apart=6.0)
    clean = pictures(alignment)
    marks, notes = shown(alignment, {i: mark(p).astype(np.uint8) for i, p in clean.items()})
    assert sorted(marks) == list(range(12)) and "marks at the same place" in notes[0]
    v, u = np.mgrid[:300, :400]
    changed = (mark(np.full((300, 400, 3), 1)) != 1).any(2)
    yields = marks[3].at(u, v) < 0
    assert yields[changed].mean() >= part
    assert (yields & ~changed).mean() < 0.035  # a margin, and that of the blur in a disc


@pytest.mark.slow
def test_a_road_that_the_drone_follows_is_no_mark():
    """It hardly varies while the fields beside it do, but other photos show it, too."""
    ground = textured().copy()
    ground[1560:1640] = 230
    alignment = flight(12, apart=6.0)
    views = make_views(alignment, level(0.0))[:10]
    seen = pictures(alignment, ground)
    grey = np.stack([seen[v.photo][..., 0] for v in views])
    label = _hardly_varying(grey)
    assert label.max() > 0
    parts = range(1, label.max() + 1)
    assert not any(_is_mark(label, k, views, grey, level(0.0)) for k in parts)
    assert shown(alignment, seen) == ({}, ())


def test_white_is_warm_in_thermal_photos_and_tells_no_overexposure():
    alignment, thumbnails = flight(12), plain(12)
    thumbnails[4][50:100, 20:120, 0] = 252
    details, names = seen(alignment), [f"{k}.jpg" for k in range(12)]
    of_heat = spoilt_parts(alignment, lambda k: details[k], thumbnails, names, {}, None, range(12))
    assert of_heat == ({}, ())


@pytest.mark.slow
def test_what_a_hover_shows_at_one_place_is_no_dust():
    """Twelve photos of one place beside twelve of a line: they alone show a dark car."""
    alignment = flight(12, apart=6.0)
    rng = np.random.default_rng(3)
    hover = {
        k: replace(alignment.poses[2], map_C=alignment.poses[2].map_C + [*rng.normal(0, 0.2, 2), 0])
        for k in range(12, 24)
    }
    poses = {**alignment.poses, **hover}
    camera_of = dict.fromkeys(poses, "one")
    alignment = replace(alignment, poses=poses, camera_of=camera_of, blocks=(tuple(poses),))
    taken = pictures(alignment)
    for k in hover:
        taken[k][130:160, 190:240] //= 2
    assert shown(alignment, taken) == ({}, ())


@pytest.mark.slow
def test_what_photos_circle_around_is_no_dust():
    """Sixteen photos around a dark tower, whose top each shows before the ground beyond it."""
    alignment = flight(16, apart=6.0)
    middle = np.mean([p.map_C for p in alignment.poses.values()], axis=0)
    high = middle[2]
    poses = {}
    for k in range(16):
        turn = np.radians(22.5 * k)
        C = middle + 0.5 * high * np.array([np.sin(turn), np.cos(turn), 0.0])
        tilt = float(np.degrees(np.arctan(0.5)))
        R = cam_R_map_from_angles(22.5 * k + 180.0, tilt)
        poses[k] = replace(alignment.poses[k], cam_R_map=R, map_C=C)
    alignment = replace(alignment, poses=poses)
    taken = pictures(alignment)
    assert shown(alignment, taken) == ({}, ())
    for picture in taken.values():
        picture[95:135, 180:220] //= 2
    assert shown(alignment, taken) == ({}, ())


def test_chance_is_no_dust_where_few_values_tell_of_each_cell():
    """Nine values in a cell, of ground that looks different from two directions patch by patch, as
    trees do: where all nine of two neighbours agree by chance, their scatter tells nothing.
    """
    for seed in range(20):
        rng = np.random.default_rng(seed)
        place = rng.uniform(-0.5, 0.5, (11_000, 2)) * [1.7, 1.0]
        row, column = ((place + [0.85, 0.5]) * [100 / 1.7, 60]).astype(int).T
        off = rng.normal(0, 0.25, (100, 60))[row, column] + rng.laplace(0, 0.1, len(place))
        assert not _spots(place, off, (2000, 1176)).any()


@pytest.mark.parametrize("apart", [30.0, 70.0])
def test_ground_that_two_photos_show_or_one_tells_of_no_spots(apart):
    alignment = flight(12, apart=apart)
    grey = {i: np.full((300, 400, 3), 120, np.uint8) for i in range(12)}
    grey[3][:, 200:] = 60
    assert shown(alignment, grey) == ({}, ())


@pytest.mark.slow
def test_a_road_in_the_middle_of_every_picture_is_no_dust():
    """One line flown along a dark road: each photo has it at the same place, as has the ground."""
    ground = textured().copy()
    ground[1540:1660] *= 0.6  # 3 m wide, along the line
    along = pictures(flight(10, apart=4.0), ground)
    middle = np.mean([p[140:160, 50:350].mean() / p.mean() for p in along.values()])
    assert middle < 0.8  # it is there
    assert shown(flight(10, apart=4.0), along) == ({}, ())


def of_two_cameras(alignment, odd, factor):
    """The alignment with its odd photos, and one tie point below each, by a camera whose pictures
    are smaller by a factor, from the heights `odd` above them.
    """
    small = alignment.cameras["one"].rescaled(round(400 / factor), round(300 / factor))
    camera_of = {k: "small" if k % 2 else "one" for k in alignment.poses}
    poses = {
        k: replace(p, map_C=p.map_C + [0, 0, odd if k % 2 else 0.0])
        for k, p in alignment.poses.items()
    }
    places = np.array([p.map_C * [1, 1, 0] for p in alignment.poses.values()])
    number = np.arange(len(places))
    ties = replace(
        alignment.ties,
        xyz=places,
        point=number,
        photo=number,
        px=np.zeros((len(places), 2)),
        residual_px=np.zeros((len(places), 2)),
    )
    cameras = {**alignment.cameras, "small": small}
    return replace(alignment, poses=poses, cameras=cameras, camera_of=camera_of, ties=ties)


@pytest.mark.parametrize(("odd", "factor"), [(0.0, 2.0), (40.0, 1.0), (20.0, 1.33)])
def test_photos_yield_where_others_are_much_finer(odd, factor):
    """Every other photo of a line is smaller or higher up, or both: it yields where the others show
    the ground, and they to none.
    """
    alignment = of_two_cameras(flight(10, apart=9.0), odd, factor)
    views = make_views(alignment, level(0.0))
    fine = native_gsd(views[::2], level(0.0))
    assert coarser_parts(alignment, views, "abcdefghij", 1.3 * fine) == ({}, ())  # on such a map
    marks, notes = coarser_parts(alignment, views, "abcdefghij", 1.1 * fine)
    assert sorted(marks) == [1, 3, 5, 7, 9]
    yields = marks[5].at(np.full(3, 200 / factor), np.array([10.0, 150.0, 290.0]) / factor) < 0
    assert yields[1] and (odd == 0 or not (yields[0] or yields[2]))  # higher up, it sees more
    assert len(notes) == 1 and "pixels 2.0 times as large" in notes[0]


def test_photos_along_a_slope_are_equally_fine():
    """Lines 40 m above a slope of 30 degrees, 12 m apart: those farther up do not make others
    yield.
    """
    alignment = flight(50)
    rise = np.array([0, np.tan(np.radians(30)), 0.0])
    poses = {
        k: replace(p, map_C=p.map_C + [0, 0, rise @ p.map_C]) for k, p in alignment.poses.items()
    }
    number = np.arange(50)
    below = np.array([p.map_C - [0, 0, 40.0] for p in poses.values()])
    none = np.zeros((50, 2))
    ties = replace(alignment.ties, xyz=below, point=number, photo=number, px=none, residual_px=none)
    alignment = replace(alignment, poses=poses, ties=ties)
    views = make_views(alignment, level(14.0))
    assert coarser_parts(alignment, views, [f"{k}" for k in range(50)]) == ({}, ())
