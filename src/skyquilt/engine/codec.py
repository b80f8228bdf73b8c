"""Serialises records to bytes and back without executing stored code: JSON for structure, npz for
arrays.
"""

import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

Registry = Mapping[str, type]
SMALL_BYTES = 512
"""Arrays up to this size are joined to one by type: of thousands of them, each by itself takes
longer to find in a file than to read.
"""
_NUMBERS = "biufc"
"""Kinds of arrays that are joined."""


def encode(value: Any) -> bytes:
    """Encodes dataclasses, tuples, lists, dicts, sets, arrays and scalars as bytes."""
    buffer = io.BytesIO()
    write(buffer, value)
    return buffer.getvalue()


def write(file: BinaryIO, value: Any, name: str = "") -> None:
    """The same into a file, one array after another: large ones are not copied as a whole. `name`
    says whose value it is, so that it is not taken for another one.
    """
    arrays = _Arrays()
    tree = _down(value, arrays)
    tree = {"!": "named", "n": name, "v": tree} if name else tree
    np.savez(file, __tree__=np.frombuffer(json.dumps(tree).encode(), np.uint8), **arrays.named())


@dataclass
class _Arrays:
    """Arrays of a value that is written."""

    large: dict[str, NDArray[Any]] = field(default_factory=dict)
    """By name."""
    small: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    """Flat ones, by type."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Length of those of a type."""

    def add(self, array: NDArray[Any]) -> dict[str, Any]:
        """What stands for it in the tree."""
        numbers = array.dtype.kind in _NUMBERS and array.dtype.isnative
        if array.nbytes > SMALL_BYTES or not numbers:
            name = f"a{len(self.large)}"
            self.large[name] = array
            return {"!": "array", "v": name}
        kind = array.dtype.str
        start = self.sizes.get(kind, 0)
        self.small.setdefault(kind, []).append(array.ravel())
        self.sizes[kind] = start + array.size
        return {"!": "small", "v": [f"s{kind[1:]}", start, array.shape]}

    def named(self) -> dict[str, Any]:
        """All arrays by name."""
        return self.large | {f"s{k[1:]}": np.concatenate(parts) for k, parts in self.small.items()}


class _Read:
    """Arrays of a file, read when they are asked for; joined ones only once."""

    def __init__(self, file: Mapping[str, NDArray[Any]]) -> None:
        self._file = file
        self._joined: dict[str, NDArray[Any]] = {}

    def part(self, name: str, start: int, shape: Sequence[int]) -> NDArray[Any]:
        """A small array."""
        if name not in self._joined:
            self._joined[name] = self._file[name]
        return self._joined[name][start : start + math.prod(shape)].reshape(shape).copy()

    def whole(self, name: str) -> NDArray[Any]:
        """A large one."""
        return self._file[name]


def decode(data: bytes, registry: Registry) -> Any:
    """Decodes a value; `registry` names the dataclasses that may occur.

    Raises:
        ValueError: the bytes are damaged, or name an unknown record.
    """
    return read(io.BytesIO(data), registry)


def read(file: BinaryIO, registry: Registry, name: str = "") -> Any:
    """The same from a file; `name` as it was written.

    Raises:
        ValueError: it is damaged, has another name, or names an unknown record.
    """
    try:
        with np.load(file, allow_pickle=False) as arrays:
            tree = json.loads(bytes(arrays["__tree__"]).decode())
            tree = tree if not name else _named(tree, name)
            return _up(tree, _Read(arrays), registry)
    except (
        Exception
    ) as error:  # damaged zip, npy and JSON raise many exceptions; all mean: no valid record
        raise ValueError(f"not a stored record: {error}") from error


def _named(tree: Any, name: str) -> Any:
    """What was written under a name."""
    if not isinstance(tree, dict) or tree["!"] != "named" or tree["n"] != name:
        raise ValueError("it holds another result")
    return tree["v"]


def _down(value: Any, arrays: _Arrays) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"!": "float", "v": repr(value)}
    if isinstance(value, complex):
        return {"!": "complex", "v": [repr(value.real), repr(value.imag)]}
    if isinstance(value, np.generic):
        return _down(value.item(), arrays)
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("cannot store an array of object type")
        return arrays.add(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _down(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {"!": "record", "c": type(value).__name__, "v": fields}
    if isinstance(value, Mapping):
        return {"!": "dict", "v": [[_down(k, arrays), _down(v, arrays)] for k, v in value.items()]}
    if isinstance(value, tuple | list | frozenset | set):
        kind = "list" if isinstance(value, list) else "tuple" if isinstance(value, tuple) else "set"
        return {"!": kind, "v": [_down(v, arrays) for v in value]}
    raise TypeError(f"cannot store {type(value).__name__}")


def _up(tree: Any, arrays: _Read, registry: Registry) -> Any:
    if not isinstance(tree, dict):
        return tree
    kind, v = tree["!"], tree["v"]
    if kind == "float":
        return float(v)
    if kind == "complex":
        return complex(float(v[0]), float(v[1]))
    if kind == "array":
        return arrays.whole(v)
    if kind == "small":
        return arrays.part(*v)
    if kind == "record":
        if tree["c"] not in registry:
            raise ValueError(f"unknown record {tree['c']}")
        return registry[tree["c"]](**{k: _up(x, arrays, registry) for k, x in v.items()})
    if kind == "dict":
        return {_up(k, arrays, registry): _up(x, arrays, registry) for k, x in v}
    items = [_up(x, arrays, registry) for x in v]
    return items if kind == "list" else tuple(items) if kind == "tuple" else frozenset(items)
