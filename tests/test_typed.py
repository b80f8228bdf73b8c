"""What a program passes is refused by name where it cannot be meant."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import skyquilt
from skyquilt.calibration.workflow import CalibrateSettings
from skyquilt.coregistration.methods import RegisterSettings
from skyquilt.errors import UsageError
from skyquilt.live.settings import LiveSettings
from skyquilt.planning.settings import PlanSettings
from skyquilt.runs.export import Wanted
from skyquilt.settings import GROUP_OF, MosaicSettings
from skyquilt.typed import KINDS, as_kind, typed


@dataclass(frozen=True, kw_only=True)
class Record:
    truth: bool = False
    count: int = 1
    length: float | None = None
    word: str = "a"
    place: Path | None = None
    three: tuple[float, float, float] | None = None
    words: tuple[str, ...] = ()
    thing: object = None

    def __post_init__(self) -> None:
        typed(self)


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({"truth": np.True_}, True),
        ({"count": np.int16(7)}, 7),
        ({"count": 7.0}, 7),
        ({"length": 2}, 2.0),
        ({"length": np.float32(0.5)}, 0.5),
        ({"length": None}, None),
        ({"place": "a/b"}, Path("a/b")),
        ({"three": np.array([1, 2, 3])}, (1.0, 2.0, 3.0)),
        ({"three": [1, 2, 3]}, (1.0, 2.0, 3.0)),
        ({"words": ["a", "b"]}, ("a", "b")),
        ({"thing": 5}, 5),
    ],
    ids=str,
)
def test_what_means_the_same_is_converted(given, kept):
    (name,) = given
    found = getattr(Record(**given), name)
    assert found == kept and type(found) is type(kept)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"truth": "no"}, r"truth is 'no' \(str\); True or False is expected"),
        ({"truth": 1}, "truth is 1"),
        ({"count": True}, "count is True"),
        ({"count": 1.5}, r"count is 1.5 \(float\); a whole number is expected"),
        ({"count": None}, "count is None"),
        ({"count": float("nan")}, "count is nan"),
        ({"count": float("inf")}, "count is inf"),
        ({"length": "2"}, r"length is '2' \(str\); a number is expected"),
        ({"length": 1j}, "length is 1j"),
        ({"length": 10**400}, "length is 1000"),
        ({"length": np.zeros(1)}, "length is array"),
        ({"length": np.zeros((4, 4))}, "length is array[^\n]* is expected"),
        ({"word": b"a"}, "word is b'a'"),
        ({"place": ""}, "place is empty; a path is expected"),
        ({"place": b"a"}, "place is b'a'"),
        ({"three": (1, 2)}, "three has 2 values; 3 are expected"),
        ({"three": "123"}, "three is '123'"),
        ({"three": (1, 2, "x")}, r"three\[2\] is 'x'"),
        ({"three": 5}, "three is 5"),
        ({"words": "ab"}, "words is 'ab'"),
        ({"words": ("a", 5)}, r"words\[1\] is 5"),
    ],
    ids=str,
)
def test_what_cannot_be_meant_is_refused_by_name(given, words):
    with pytest.raises(UsageError, match=words):
        Record(**given)


WRONG = {bool: "no", int: 1.5, float: "2", str: 5, Path: 5}
"""A value that is not of the kind."""


@pytest.mark.parametrize("name", [*GROUP_OF])
def test_every_setting_of_a_mosaic_is_checked(name):
    with pytest.raises(UsageError, match=rf"^{name} (is|has)"):
        MosaicSettings(**{name: object()})


def test_values_of_other_kinds_are_refused_for_each_kind():
    for kind, wrong in WRONG.items():
        with pytest.raises(UsageError, match=f"it is .*{KINDS[kind]} is expected"):
            as_kind("it", wrong, kind)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: RegisterSettings(use_metadata="no"), "use_metadata"),
        (lambda: CalibrateSettings(columns=7.5, rows=6, square_m=0.1), "columns"),
        (lambda: LiveSettings(gsd_cm="3"), "gsd_cm"),
        (lambda: PlanSettings(gsd_cm="3"), "gsd_cm"),
        (lambda: Wanted(what="png"), "what"),
        (lambda: MosaicSettings(picture={"gsd_cm": 3}), "picture"),
    ],
)
def test_settings_of_other_work_are_checked(make, name):
    with pytest.raises(UsageError, match=f"^{name} is"):
        make()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: skyquilt.mosaic(p, None), "output is None"),
        (lambda p: skyquilt.mosaic(p, ""), "output is empty"),
        (lambda p: skyquilt.mosaic(5, p / "o"), "^5 is neither a folder nor a list of photos"),
        (lambda p: skyquilt.mosaic(p, p / "o", {}), r"settings is \{\}; MosaicSettings"),
        (lambda p: skyquilt.read_survey(b"x"), "^b'x' is neither"),
        (lambda p: skyquilt.read_survey(""), "^'' is neither"),
        (lambda p: skyquilt.read_survey([p, None]), "is neither a folder nor a list of photos"),
        (lambda p: skyquilt.read_survey(p, geo=5), "geo is 5"),
        (lambda p: skyquilt.read_survey(p, max_mp=float("nan")), "--max-mp nan"),
        (lambda p: skyquilt.read_survey(p, thermal_unit="x"), "--thermal-unit 'x'"),
        (lambda p: skyquilt.open_run(None), "folder is None"),
        (lambda p: skyquilt.register(None, p, p / "o"), "a is None"),
        (lambda p: skyquilt.register(p, p, p / "o", "auto"), "settings is 'auto'; Register"),
    ],
)
def test_public_functions_name_the_argument(call, words, tmp_path):
    with pytest.raises(UsageError, match=words):
        call(tmp_path)
    assert not (tmp_path / "o").exists()
