"""The step between levels against the plain definition, pixel by pixel."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.raster.halving import halve

TOLERANCE = {"uint8": 0.5, "uint16": 0.5, "int16": 0.5, "float32": 1e-4}
"""OpenCV rounds halves up or to even, depending on type and bands."""


def expected(values, how):
    if how == "average":
        mean = np.mean([float(v) for v in values])
        return np.floor(mean + 0.5) if values[0].dtype == np.uint32 else mean
    if how == "max":
        return max(values)
    if how == "nearest":
        return values[0]
    counts = Counter(v.item() for v in values)
    return next(v for v in values if counts[v.item()] == max(counts.values()))


@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.sampled_from(["uint8", "uint16", "uint32", "int16", "float32"]),
    st.sampled_from(["average", "mode", "nearest", "max"]),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_halve(height, width, dtype, how, holes, seed):
    rng = np.random.default_rng(seed)
    top = {"uint8": 255, "int16": 3000, "uint16": 65535, "uint32": 2**32 - 1, "float32": 100}[dtype]
    values = rng.choice(rng.integers(0, top, 3, endpoint=True), (height, width, 2)).astype(dtype)
    valid = rng.random((height, width)) < 0.6 if holes else None
    got, got_valid = halve(values, valid, how)
    assert got.shape == ((height + 1) // 2, (width + 1) // 2, 2)
    assert got.dtype == values.dtype
    for row, col, band in np.ndindex(got.shape):
        places = [
            (min(2 * row + i, height - 1), min(2 * col + j, width - 1))
            for i in (0, 1)
            for j in (0, 1)
        ]
        inside = [values[(*place, band)] for place in places if valid is None or valid[place]]
        if valid is not None:
            assert got_valid[row, col] == bool(inside)
        if inside:
            tolerance = TOLERANCE.get(dtype, 0) if how == "average" else 0
            assert got[row, col, band] == pytest.approx(expected(inside, how), abs=tolerance, rel=0)


def test_nan_does_not_spread():
    values = np.arange(16, dtype=np.float32).reshape(4, 4, 1)
    values[0, 0] = np.nan
    got, valid = halve(values, np.isfinite(values[..., 0]), "average")
    np.testing.assert_allclose(got[..., 0], [[10 / 3, 4.5], [10.5, 12.5]])
    assert valid.all()
