"""Options without effect: each is refused, and what is not refused changes the result."""

import hashlib
import json
import re
import shutil

import pytest
import typer

import skyquilt
from skyquilt import registry
from skyquilt.cli.app import app
from skyquilt.cli.idle import RULES
from skyquilt.effects import MOSAIC, OF_METHODS
from skyquilt.errors import SkyquiltError, UsageError
from skyquilt.settings import DEFAULTS, MosaicSettings
from tests.end_to_end.conftest import named
from tests.end_to_end.conftest import skyquilt as command

METHODS = registry.names("alignment")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"blend": "first", "feather_px": 9.0}, "--feather would have no effect: --blend first"),
        ({"method": "flightline", "feather_px": 9.0}, "--blend average"),
        ({"compress": "deflate", "quality": 60}, "--quality would have .*deflate is lossless"),
        ({"method": "pose", "surface": "dense"}, "--surface is for --method auto or bundle"),
        ({"method": "hybrid", "dtm": True}, "--dtm is for --method auto or bundle"),
        ({"method": "image", "contours_m": 1.0}, "--contours is for"),
        (
            {"method": "position", "distortion": "2"},
            "--distortion is for --method auto or bundle or",
        ),
        ({"method": "flightline", "repair": False}, "--trust-metadata is for"),
        ({"method": "flightline", "height_m": 60.0}, "--height is for"),
        ({"method": "bundle", "height_m": 60.0}, "--height would have .* --matcher guided"),
        ({"method": "bundle", "seed": 3}, "--seed is for --method image or hybrid or flightline"),
        ({"method": "hybrid", "seed": 3}, "--seed would have .* anneal does"),
        (
            {"method": "pose", "repair": False, "features": 900},
            "--features would have .*compares no",
        ),
        ({"method": "pose", "repair": False, "detector": "orb"}, "--detector would have"),
        ({"method": "image", "estimator": "ncc", "features": 900}, "--features .*compares pixels"),
        (
            {"method": "image", "estimator": "ecc", "matcher": "one-way"},
            "--matcher .*compares pixels",
        ),
        (
            {"method": "image", "estimator": "ncc", "levelled": False},
            "--levelled .*compares pixels",
        ),
        ({"method": "image", "estimator": "ncc", "seed": 3}, "--seed .*compares pixels"),
        ({"method": "image", "levelled": False, "relief_m": 3.0}, "--relief .*--no-levelled"),
        ({"method": "flightline", "features": 900}, "--features would have .*at least 4000"),
        ({"scheduler": "local:2", "jobs": 2}, "--jobs would have .*--scheduler"),
    ],
    ids=str,
)
def test_settings_without_effect_are_refused(asked, words):
    with pytest.raises(UsageError, match=words):
        MosaicSettings(**asked)


def test_settings_with_effect_are_taken():
    for asked in (
        {"blend": "feather", "feather_px": 9.0},
        {"method": "flightline", "blend": "feather", "feather_px": 9.0},
        {"compress": "jpeg", "quality": 60},
        {"method": "bundle", "matcher": "guided", "height_m": 60.0},
        {"method": "hybrid", "optimiser": "anneal", "seed": 3},
        {"blend": "first", "feather_px": DEFAULTS["feather_px"]},
    ):
        MosaicSettings(**asked)


CHANGES = {
    "feather_px": 20.0,
    "quality": 40,
    "features": 500,
    "detector": "orb",
    "estimator": "lmeds",
    "distortion": "2",
    "height_m": 91.0,
    "surface": "sweep",
    "repair": False,
    "dtm": True,
    "contours_m": 1.0,
    "seed": 5,
    "relief_m": 0.4,
    "levelled": False,
}
"""Another value of each setting that a rule names."""
RARE = ("image", "hybrid", "flightline")
BESIDE = (
    {},
    {"method": "image", "levelled": False},
    pytest.param({"method": "image", "estimator": "ncc"}, marks=pytest.mark.long),
    pytest.param({"method": "hybrid", "optimiser": "anneal"}, marks=pytest.mark.long),
    {"method": "pose", "repair": False},
    pytest.param({"blend": "first"}, marks=pytest.mark.long),
    {"compress": "deflate"},
    *(
        pytest.param({"method": name}, marks=pytest.mark.long if name in RARE else ())
        for name in METHODS
        if name not in ("auto", "bundle")
    ),
)
LATENT = {("auto", "height_m"), ("image", "height_m"), ("image", "relief_m")}
"""Of use where photos say less than these do."""
FEW = {"ncc": 3, "anneal": 4, "hybrid": 4, "flightline": 7}
"""Photos that tell as much as nine where those take long; seven are two lines."""


def test_every_setting_of_a_rule_is_tried():
    ruled = {name for rule in MOSAIC for name in rule.settings} | set(OF_METHODS)
    words = {"matcher", "transform", "image_search", "optimiser", "lines", "heading_deg"}
    assert ruled - words - {"vertical_datum", "jobs"} == set(CHANGES)


@pytest.mark.slow
@pytest.mark.parametrize("beside", BESIDE, ids=str)
def test_what_is_not_refused_changes_the_result(flight, tmp_path, beside):
    """The rules against the results: a setting is refused exactly where nothing depends on it. Each
    run finds what the first one stored: a setting without effect on a stage must not be in its key,
    and one that is missing in a key changes nothing, which is found here too.
    """
    photos, number = tmp_path / "photos", min([9, *(FEW.get(str(v), 9) for v in beside.values())])
    photos.mkdir()
    for path in named(flight / "photos")[:number]:
        shutil.copy(path, photos)
    base = made(photos, tmp_path / "base", beside)
    wrong = []
    for name, value in CHANGES.items():
        if name in beside:
            continue
        try:
            MosaicSettings(**beside, **{name: value})
        except UsageError:
            continue
        if (tmp_path / "base").is_dir():
            shutil.copytree(tmp_path / "base", tmp_path / name)
        now = made(photos, tmp_path / name, beside | {name: value})
        if now == base and (beside.get("method", "auto"), name) not in LATENT:
            wrong.append(name)
    assert wrong == []


def made(photos, output, asked):
    """What a run tells of its results, or why there is none."""
    quick = {"features": 300, "surface": "ties", "gsd_cm": 30.0, "jobs": 2}
    for name in list(quick):
        try:
            MosaicSettings(**(asked | {name: quick[name]}))
        except UsageError:
            quick.pop(name)
    try:
        settings = MosaicSettings(**(quick | asked))
        skyquilt.mosaic(photos, output, settings, overwrite=True)
    except SkyquiltError as error:
        return str(error)
    files = [p for p in sorted(output.iterdir()) if p.is_file()]
    told = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    figures = json.loads((output / "metrics.json").read_text())
    told["metrics.json"] = json.dumps(
        {k: v for k, v in figures.items() if not re.search("seconds|memory", k)}
    )
    return {k: v for k, v in told.items() if k not in ("run.toml", "report.html")}


@pytest.mark.slow
def test_what_the_photos_make_idle_is_said(mosaic, flight):
    """Whether there are videos and measured values is known when the photos are read."""
    told = mosaic(
        flight / "photos", "--frame-overlap", "60", "--write-frames", "--balance-thermal",
        "--thermal-unit", "celsius", "--quality", "80",
    ).made()  # fmt: skip
    notes = [n for n in told.metrics["notes"] if "has no effect here" in n]
    assert [n.split()[0] for n in notes] == [
        "--frame-overlap", "--write-frames", "--thermal-unit", "--balance-thermal",
    ]  # fmt: skip
    assert all(n in told.err for n in notes)


# commands


def parameters():
    """(name of the command, its parameters) of all commands."""
    group = typer.main.get_command(app)
    for name, found in group.commands.items():
        for below, one in getattr(found, "commands", {name: found}).items():
            yield below, {p.name for p in one.params}


def test_rules_name_options_that_there_are():
    known = dict(parameters())
    for name, rules in RULES.items():
        assert {s for rule in rules for s in rule.settings} <= known[name], name


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("export OUT --what heights --layer views", "--layer would have no effect: --what heights"),
        ("export OUT --what footprints --gsd 5", "--gsd would have .*no pixels"),
        ("export OUT --what kmz,tiles --crs EPSG:32633", "--crs would have .*system of its own"),
        ("compare IN -o OUT --known g.txt --distances d.csv", "--known .*--distances judges"),
        ("depth IN -o OUT --route reconstruction --relief 3", "--relief would have"),
        ("depth a.jpg b.jpg c.jpg -o OUT --relief 3", "--relief would have"),
        (
            "calibrate IN -o OUT --board 7x6 --square 1 --series views --weights printed",
            "--weights",
        ),
        ("fly IN --to IN --token x", "--token would have .*is a folder"),
        ("fly IN --to IN --seed 3", "--seed would have .*--loss and --reorder"),
        ("simulate OUT --no-focal --focal-error 3", "--focal-error would"),
        ("simulate OUT --aspect-untold", "--aspect-untold would .*--dewarp"),
        ("simulate OUT --thermal-hour 8", "--thermal-hour would .*--thermal"),
        ("simulate OUT --preset thermal --no-thermal --thermal-season winter", "--thermal-season"),
        (
            "plan a.geojson -o OUT --camera FC6310 --gsd 2 --separation 9",
            "--separation .*one drone",
        ),
        ("simulate OUT --plan p.json --height 80", "--height would .*p.json says it"),
        ("simulate OUT --plan p.json --lose 2", "--lose would .*p.json says it"),
        ("plan a.geojson -o OUT --gsd 2 --fleet f.toml --drones 3", "--drones .*f.toml says it"),
        ("plan IN -o OUT --camera FC6310 --gsd 2 --width 9", "--width would have .*no lines"),
        ("plan check p.json --area a.geojson", "--area would have .*of its own"),
        ("plan check p.json --camera FC6310", "--camera would have .*of its own"),
        ("plan check m.plan --views 3", "--views would have .*--camera"),
        ("plan check m.plan --camera FC6310 --width 3", "--width would have .*--area"),
        ("plan check m.plan --clearance 3", "--clearance would have .*--terrain"),
    ],
)
def test_commands_refuse_options_without_effect(words, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "IN").mkdir()
    code, out, err = command(*words.split())
    assert (code, out) == (2, "") and re.search(said, err), err
    assert not (tmp_path / "OUT").exists()


@pytest.mark.parametrize(
    "words",
    [
        "export OUT --what heights,png --layer views",
        "export OUT --what kmz --crs EPSG:32633 --bounds 1,2,3,4",
        "depth a.jpg b.jpg -o OUT --relief 3",
        "fly IN --to http://127.0.0.1:1 --token x",
        "fly IN --to IN --seed 3 --loss 0.1",
    ],
)
def test_commands_take_options_with_effect(words, tmp_path, monkeypatch):
    """They fail for another reason: nothing is there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "IN").mkdir()
    code, _, err = command(*words.split())
    assert code != 0 and "no effect" not in err and "Traceback" not in err
