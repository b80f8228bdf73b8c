"""A constant of a module that shapes a stored artefact is part of that artefact's key."""

import ast
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from skyquilt import registry
from skyquilt.engine.constants import constants_of, is_data
from skyquilt.engine.store import digest
from skyquilt.model.photo import Focal, Photo, Survey
from skyquilt.ortho.compose import Composer
from skyquilt.papers import aligners
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import Methods, methods_for
from skyquilt.workflows.mosaic import make_map, run_key
from skyquilt.workflows.photo_features import features_key, picture_key
from skyquilt.workflows.survey_input import SurveyInput

WAYS = (
    MosaicSettings(),
    MosaicSettings(surface="sweep"),
    MosaicSettings(surface="dense"),
    MosaicSettings(method="image"),
    MosaicSettings(method="image", image_search="overview"),
    MosaicSettings(method="hybrid"),
    MosaicSettings(method="hybrid", optimiser="anneal"),
    MosaicSettings(method="flightline"),
    *(
        MosaicSettings(method="image", estimator=e)
        for e in ("lmeds", "magsac", "ste", "ste-printed")
    ),
    *(MosaicSettings(method="image", estimator=e) for e in ("ncc", "phase", "ecc", "mi")),
    *(MosaicSettings(detector=d) for d in registry.names("detector")),
    *(MosaicSettings(matcher=m) for m in registry.names("matcher")),
)
STAGES = ["matching", "alignment", "ortho", "imaging", "geometry", "papers"]
IN_NO_KEY = {
    **dict.fromkeys(
        ("SIGMA_YAW_DEG", "SIGMA_COURSE_DEG"),
        "repaired metadata are in the key of the alignment, by value",
    ),
    **dict.fromkeys(
        ("SITES_APART_M", "SITES_LISTED"), "places far from one another are told, no more"
    ),
    "YAW_DEG": "conflicts are told in the report and shape nothing",
    "_EPOCH": "where weeks of GPS begin; positions are in keys by value",
    "CERTAIN": "conflicts are told in the report and shape nothing",
    **dict.fromkeys(
        ("CONTRADICTED_PX", "FEWEST_POSITIONS", "CONTRADICTED_DEVIATIONS", "CONTRADICTED_SHARE")
        + ("MIRRORED", "ENLARGED", "FEWEST_ENLARGED", "ALIKE", "LOOSE_DEG", "LOOSE_SCALE")
        + ("CHANCE", "EVEN"),
        "conflicts are told in the report and shape nothing",
    ),
    **dict.fromkeys(
        ("_WIDTH", "_HEIGHT", "_BITS", "_CODEC", "_SAMPLES", "_STRIPS", "_TILES", "_XMP_TAG")
        + ("_CODECS", "_STRANGE_COLOURS", "_YCBCR", "_JPEGS", "_PNG_BITS", "_CFA"),
        "the numbers that the formats TIFF and PNG give to tags",
    ),
    **dict.fromkeys(
        ("_MOST_PAGES", "_SAME_SHAPE", "_LARGER", "_REDUCED", "_MASK"),
        "which page of a TIFF is the photo changes with the version only, which is in the keys",
    ),
    **dict.fromkeys(
        ("MOST_CHUNKS", "MOST_STRIPS", "MOST_PNG_TEXT", "_LEAST_FOCAL", "_MOST"),
        "limits of files that are refused: they shape no result",
    ),
    **dict.fromkeys(
        ("STRETCH_STEP_M", "STRETCH_TOLD", "STRETCH_REFUSED", "STRETCH_MOST") + ("NORTH_OFF_DEG",),
        "coordinate systems that are refused, or told of: they shape no result",
    ),
    **dict.fromkeys(
        ("NOISE", "TEXTURE", "RIM", "_DERIVE", "_SMOOTH", "RADIUS", "MIN_PEAK", "BROAD_PEAK")
        + ("APART", "MAX_RATIO", "SIDE", "COARSE", "_PLAIN", "_LAPLACIANS"),
        "seams are measured anew by every run",
    ),
    **dict.fromkeys(
        ("SIDES", "SHORTEST", "AZIMUTH_DEG", "ELEVATION_DEG", "CONTOUR_CELL_M"),
        "files of heights are written anew by every run",
    ),
    **dict.fromkeys(
        ("POLL_S", "PATIENCE_S", "ANSWER_S", "START_S", "FAILURES", "AHEAD", "STEPS_KEPT")
        + ("TASK_S", "MOST_ITEMS", "LOOKED"),
        "who computes does not change what is computed",
    ),
    **dict.fromkeys(
        ("SHOWN_SAMPLE_PX", "SHOWN_REACH_PX", "SHOWN_NODES_PX", "SHOWN_RIM_PX"),
        "how much of a photo is kept in memory: more is decoded where it is asked for",
    ),
}
"""Constants of the stages that no method's key holds, and why that is right."""
BY_VALUE = {
    f"skyquilt.ortho.{name}": "what photos show badly is in the key of the seams, by value"
    for name in ("sharpness", "spoilt", "lasting_marks", "veiled")
} | {
    "skyquilt.ortho.palettes": "what is told of palettes is told anew by every run",
    "skyquilt.matching.straightened": "its function is in the recipe of features",
}
"""Modules whose constants no method's key holds, and why that is right."""


def photo() -> Photo:
    return Photo(
        name="a.jpg",
        path=Path("a.jpg"),
        digest="0",
        width=640,
        height=480,
        channels=3,
        dtype="uint8",
        band="visible",
        camera_key="c",
        focal=Focal(px=500.0, sigma_px=50.0, source="guess"),
        position=None,
        attitude=None,
        time=None,
    )


def given() -> SurveyInput:
    survey = Survey(photos=(photo(),))
    return SurveyInput(source=Path(), survey=survey, control=(), distances=(), rank={})


def used() -> Methods:
    return methods_for(MosaicSettings())


KEYS = {
    "features": lambda: features_key(photo(), used().detector),
    "pictures": lambda: picture_key(photo()),
    "links": lambda: digest(used().detector, used().matcher, used().verify),
    "alignment": lambda: digest(used().align),
    "surface": lambda: digest(used().surface),
    "swept": lambda: digest(used().sweep),
    "map": lambda: run_key(given(), MosaicSettings(), used()),
}


@pytest.mark.parametrize(
    ("artefact", "constant"),
    [
        ("features", "DESCRIPTOR_UNIT"),
        ("features", "PICTURE"),
        ("features", "THUMBNAIL"),
        ("pictures", "PICTURE"),
        ("links", "DESCRIPTOR_UNIT"),
        ("alignment", "INDEPENDENT"),
        ("alignment", "GROSS_DEG"),
        ("alignment", "MOST_PAIRS"),
        ("alignment", "NOMINAL_HEIGHT_M"),
        ("alignment", "HALF_TURN"),
        ("alignment", "ELIMINATED"),
        ("surface", "_SINGLE_TREE"),
        ("swept", "BORDER_PX"),
        ("swept", "TILE"),
        ("map", "MOST_PADDED"),
        ("map", "STILL"),
        ("map", "PROVENANCE"),
        ("map", "INDEPENDENT"),
        ("map", "LEAST_WHITE"),
        ("map", "SPOILT_SHARE"),
    ],
)
def test_another_constant_is_another_key(artefact, constant, monkeypatch):
    before = KEYS[artefact]()
    assert KEYS[artefact]() == before
    places = [
        tuple(place.rsplit(".", 1))
        for place in constants_of(make_map)
        if place.endswith(f".{constant}")
    ]
    for module, name in places:
        monkeypatch.setattr(sys.modules[module], name, getattr(sys.modules[module], name) * 2)
    assert KEYS[artefact]() != before


@pytest.mark.parametrize(
    ("constant", "change", "back"),
    [
        (7, None, None),
        ({"a": [1, 2]}, lambda v: v["a"].append(3), lambda v: v["a"].pop()),
        ({"a": 1}, lambda v: v.update(b=2), lambda v: v.pop("b")),
        ([1.5, 2.5], list.reverse, list.reverse),
        ({4, 5}, lambda v: v.add(6), lambda v: v.remove(6)),
        (np.arange(4.0), lambda v: v.__setitem__(2, 9.0), lambda v: v.__setitem__(2, 2.0)),
        (({"a": 1}, 2), lambda v: v[0].update(a=3), lambda v: v[0].update(a=1)),
    ],
    ids=["number", "nested", "dict", "list", "set", "array", "tuple"],
)
def test_a_constant_that_is_changed_in_place_is_another_key(monkeypatch, constant, change, back):
    """Keys are remembered while all constants are what they were, not the same objects only."""
    module = sys.modules["skyquilt.ortho.compose"]
    name = next(n for n in vars(module) if f"{module.__name__}.{n}" in constants_of(Composer))
    before = digest(Composer)
    monkeypatch.setattr(module, name, constant)
    first = digest(Composer)
    assert first == digest(Composer) != before
    if change:
        change(constant)
        assert digest(Composer) != first
        back(constant)
        assert digest(Composer) == first
    monkeypatch.undo()
    assert digest(Composer) == before


def test_code_in_tables_counts_by_name():
    assert is_data({"a": (len.__class__, photo)})
    assert not is_data([object()])
    assert constants_of(np.linalg.norm) == {}


def test_every_number_of_the_stages_is_in_a_key():
    """What a default map imports, functions included, read from the sources."""
    covered = set(constants_of(make_map))
    made = {name for way in WAYS for name in _of_methods(methods_for(way))}
    made |= {*constants_of(Composer)}
    lacking = [
        f"{module}.{name}"
        for module in sorted(_road(make_map.__module__) | _road(aligners.__name__))
        for name in _numbers(module)
        if name not in IN_NO_KEY
        and module not in BY_VALUE
        and f"{module}.{name}" not in (made if _of_a_stage(module) else covered)
        and not _of_figures(module)
    ]
    assert not lacking, "\n".join(lacking)
    assert len(covered) > 200


def _of_a_stage(module: str) -> bool:
    """Whether a module belongs to a method, and not to the workflow that draws the map."""
    drawing = module.split(".")[-1] in (
        "ground",
        "orthomosaic",
        "companions",
        "radiometry",
        "earlier",
    )
    return module.split(".")[1] in STAGES and not drawing


def _of_figures(module: str) -> bool:
    """Whether a module serves what is measured and told after the map is drawn, or writes it."""
    return module.split(".")[1] in ("quality", "report", "raster")


def _of_methods(value: object) -> Iterator[str]:
    """Constants in the digest of a method and of the methods that are its fields."""
    if is_dataclass(value):
        if callable(value):
            yield from constants_of(type(value))
        for field in fields(value):
            yield from _of_methods(getattr(value, field.name))


@cache
def _tree(module: str) -> ast.Module:
    found = find_spec(module)
    assert found is not None
    assert found.origin is not None
    return ast.parse(Path(found.origin).read_text())


def _road(first: str) -> set[str]:
    """Modules of ours that one imports, also inside functions, and those that these import."""
    found: set[str] = set()
    todo = [first]
    while todo:
        module = todo.pop()
        if module not in found and find_spec(module) is not None:
            found.add(module)
            todo += _imported(module)
    return found


@cache
def _imported(module: str) -> list[str]:
    return list(_imports(_tree(module)))


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.expr):
            continue  # no statement is part of one
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("skyquilt"):
            yield str(node.module)
            inside = (f"{node.module}.{name.name}" for name in node.names)
            yield from (name for name in inside if _is_module(name))
        yield from _imports(node)


@cache
def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def _numbers(module: str) -> Iterator[str]:
    """Upper-case names that a module sets to something with a number in it."""
    for node in _tree(module).body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.AnnAssign):
            targets = [node.target]
        names = [n for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        value = getattr(node, "value", None)
        if value is not None and any(
            isinstance(n, ast.Constant) and isinstance(n.value, int | float)
            for n in ast.walk(value)
        ):
            yield from (n.id for n in names if n.id.isupper())
