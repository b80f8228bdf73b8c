import io
import math
import zipfile
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skyquilt.engine.codec import decode, encode


@dataclass(frozen=True, kw_only=True, eq=False)
class Leaf:
    name: str
    values: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    leaves: tuple[Leaf, ...]
    by_number: dict[Any, Any]
    more: Any


REGISTRY = {"Leaf": Leaf, "Branch": Branch}
DTYPES = st.sampled_from(["u1", "u2", "<i8", ">i4", "f2", "<f4", ">f8", "c8", "c16", "?", "<U5"])
ARRAYS = DTYPES.flatmap(
    lambda d: hnp.arrays(
        np.dtype(d), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
    )
)
TEXT = st.text(max_size=8)
HASHABLE = st.none() | st.booleans() | st.integers() | st.floats() | st.complex_numbers() | TEXT
SCALARS = (
    HASHABLE
    | st.floats(width=32).map(np.float32)
    | st.integers(0, 255).map(np.uint8)
    | st.booleans().map(np.bool_)
)
LEAVES = st.builds(Leaf, name=TEXT, values=ARRAYS)


def _nested(inner: st.SearchStrategy) -> st.SearchStrategy:
    keys = HASHABLE | st.tuples(st.integers(), TEXT)
    lists = st.lists(inner, max_size=3)
    leaves = st.lists(LEAVES, max_size=2).map(tuple)
    records = st.builds(
        Branch,
        leaves=leaves,
        by_number=st.dictionaries(st.integers(), inner, max_size=2),
        more=inner,
    )
    sets = st.frozensets(st.integers(), max_size=3)
    return lists | lists.map(tuple) | st.dictionaries(keys, inner, max_size=3) | sets | records


VALUES = st.recursive(SCALARS | ARRAYS | LEAVES, _nested, max_leaves=6)


def same(a: Any, b: Any) -> bool:
    """Equal in value and kind; NaN equals NaN; numpy's scalars come back as Python's."""
    if isinstance(a, np.generic):
        return same(a.item(), b)
    if isinstance(a, np.ndarray):
        if a.dtype.kind in "fc":
            return (
                a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b, equal_nan=True)
            )
        return a.dtype == b.dtype and np.array_equal(a, b)
    if type(a) is not type(b):
        return False
    if isinstance(a, Leaf | Branch):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, complex):
        return same(a.real, b.real) and same(a.imag, b.imag)
    if isinstance(a, float):
        return (math.isnan(a) and math.isnan(b)) or (
            a == b and math.copysign(1, a) == math.copysign(1, b)
        )
    return a == b


@settings(max_examples=60, deadline=None)
@given(VALUES)
def test_what_goes_in_comes_out(value):
    assert same(value, decode(encode(value), REGISTRY))


@settings(max_examples=60, deadline=None)
@given(LEAVES, st.data())
def test_torn_bytes_are_a_value_error(leaf, data):
    whole = encode(leaf)
    torn = whole[: data.draw(st.integers(0, len(whole) - 1))]
    with pytest.raises(ValueError, match="stored record"):
        decode(torn, REGISTRY)


@pytest.mark.slow
@settings(max_examples=120, deadline=None)
@given(LEAVES, st.data())
def test_changed_bytes_are_a_value_error_or_a_value(leaf, data):
    changed = bytearray(encode(leaf))
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ValueError):
        decode(bytes(changed), REGISTRY)


def test_thousands_of_small_arrays_take_one_place_in_the_file():
    many = {k: np.full(3, k, np.float32) for k in range(5000)} | {-1: np.arange(400.0)}
    data = encode(many)
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        assert len(file.namelist()) == 3
    assert same(many, decode(data, {}))


@given(st.binary(max_size=200))
def test_noise_is_a_value_error(noise):
    with pytest.raises(ValueError, match="stored record"):
        decode(noise, REGISTRY)


def test_unknown_records_and_changed_fields_are_value_errors():
    data = encode(Leaf(name="a", values=np.zeros(2)))
    with pytest.raises(ValueError, match="Leaf"):
        decode(data, {})
    with pytest.raises(ValueError, match="stored record"):
        decode(data, {"Leaf": Branch})


def test_nothing_is_ever_pickled():
    with pytest.raises(TypeError, match="object"):
        encode(np.array([{"a": 1}], dtype=object))
    with pytest.raises(TypeError, match="cannot store"):
        encode(lambda: 1)
