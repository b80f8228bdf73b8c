import math

import pytest

from skyquilt.errors import UsageError
from skyquilt.planning.check_file import check_file


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ({"views": 0}, "--views"),
        ({"views": -1}, "--views"),
        ({"views": 10**23}, "--views"),
        ({"width_m": math.nan}, "--width"),
        ({"width_m": -1.0}, "--width"),
        ({"width_m": 1e308}, "--width"),
        ({"clearance": math.inf}, "--clearance"),
        ({"clearance": math.nan}, "--clearance"),
        ({"clearance": -1.0}, "--clearance"),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused_before_the_file_is_read(tmp_path, given, option):
    asked = {"area": None, "camera": None, "terrain": None, "views": None, "width_m": None}
    with pytest.raises(UsageError, match=option):
        check_file(tmp_path / "plan.json", **{**asked, "clearance": 10.0, **given})
