"""Whose drift is balanced: temperatures unless values are wanted as recorded, counts only when
asked, pictures never.
"""

import numpy as np
import pytest

from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.radiometry import balances_drift, recorded_tags, value_tags
from skyquilt.settings import PictureSettings


@pytest.mark.parametrize(
    ("unit", "asked", "balance", "done"),
    [
        ("celsius", None, True, True),
        ("celsius", False, True, False),
        ("celsius", None, False, False),
        ("celsius", True, False, True),
        ("counts", None, True, False),
        ("counts", True, True, True),
        ("", True, True, False),
    ],
)
def test_whose_drift_is_balanced(unit, asked, balance, done):
    settings = PictureSettings(balance_thermal=asked, balance=balance)
    assert balances_drift(settings, unit) is done


def test_a_raster_says_what_was_done_to_its_values():
    even = Exposure(gains={}, fields={}, offsets={0: 0.1})
    assert value_tags("celsius", even) == {"UNIT": "celsius", "DRIFT": "balanced on overlaps"}
    assert value_tags("counts", NEUTRAL) == {"UNIT": "counts", "DRIFT": "as recorded"}
    assert value_tags("", NEUTRAL) == {} and recorded_tags({}) == {}
    told = {"thermal_values": {"unit": "celsius", "balanced": np.bool_(True)}}
    assert recorded_tags(told) == value_tags("celsius", even)
