"""Intermediate results on disk, with keys made from inputs and method. A resumed run finds them by
key.
"""

import dataclasses
import hashlib
import json
import os
import platform
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import is_
from pathlib import Path, PurePath
from types import FunctionType
from typing import Any, TypeVar

import numpy as np

from skyquilt.engine.codec import Registry, read, write
from skyquilt.engine.constants import constants_of
from skyquilt.engine.folder import refusal
from skyquilt.engine.kept import Keep
from skyquilt.engine.workers import HERE, Workers
from skyquilt.outside import open_regular, put_in_place, remove_folder

T = TypeVar("T")


def digest(*parts: Any) -> str:
    """Hash (hex) of what an artefact is made from, by value.

    Parts are strings, numbers, paths, arrays, tuples, lists, sets, dicts and dataclasses of these,
    and methods, classes and functions. A method (a dataclass that can be called) counts with its
    fields, its version and the constants of the modules that it computes with (`constants_of`);
    classes and functions count with their name and these constants.

    Raises:
        TypeError: a part is none of these, so that nobody can say when it has changed.
    """
    return hashlib.blake2b(
        json.dumps(_plain(parts), sort_keys=True).encode(), digest_size=16
    ).hexdigest()


def _plain(value: Any) -> Any:
    """The value in JSON's types."""
    if isinstance(value, type | FunctionType):
        return [_name(value), getattr(value, "version", 0), _constants(value)]
    if dataclasses.is_dataclass(value):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        method = _constants(type(value)) if callable(value) else ""
        return [type(value).__name__, getattr(type(value), "version", 0), fields, method]
    return _plain_data(value, _plain)


def _plain_data(value: Any, inside: Callable[[Any], Any]) -> Any:
    """The same for what is neither code nor record; `inside` does it for parts of containers."""
    if isinstance(value, Mapping):
        return {"dict": _sorted([inside(k), inside(v)] for k, v in value.items())}
    if isinstance(value, list | tuple):
        return [inside(v) for v in value]
    if isinstance(value, set | frozenset):
        return {"set": _sorted(inside(v) for v in value)}
    if isinstance(value, np.generic):
        return _plain_data(value.item(), inside)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    if isinstance(value, bytes):
        return {"bytes": value.hex()}
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = hashlib.blake2b(value.tobytes(), digest_size=16).hexdigest()
        return [value.dtype.str, value.shape, content]
    raise TypeError(f"a key cannot be made of {type(value).__name__}: {value!r:.80}")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Counted:
    """The number of a module's constants, and what tells whether it still holds."""

    values: dict[str, Any]
    """The constants by name."""
    copies: list[tuple[Any, Any]]
    """Containers that can be changed in place, each with a copy."""
    others: list[tuple[Any, str]]
    """What else can be changed in place, such as arrays, each with its text."""
    number: str
    """Hash (hex) of all."""

    def holds(self, values: dict[str, Any]) -> bool:
        """Whether these are the same constants with the same content."""
        return (
            self.values.keys() == values.keys()
            and all(map(is_, self.values.values(), values.values()))
            and all(value == copy for value, copy in self.copies)
            and all(_text(value) == text for value, text in self.others)
        )


_counted: dict[str, _Counted] = {}  # by module


def _constants(thing: type | FunctionType) -> str:
    """One number for all constants that a class or a function computes with."""
    values = constants_of(thing)
    known = _counted.get(thing.__module__)
    if known is not None and known.holds(values):
        return known.number
    parts = [f"{json.dumps(name)}: {_text(v)}" for name, v in sorted(values.items())]
    content = f"{{{', '.join(parts)}}}".encode()
    number = hashlib.blake2b(content, digest_size=16).hexdigest()
    counted = _Counted(values=values, copies=[], others=[], number=number)
    for value in values.values():
        if id(value) not in _texts:
            try:
                counted.copies.append((value, _copied(value)))
            except TypeError:
                counted.others.append((value, _text(value)))
    _counted[thing.__module__] = counted
    return number


_texts: dict[int, tuple[Any, str]] = {}  # by identity: constants that cannot change, as JSON


def _text(value: Any) -> str:
    """A constant as JSON."""
    known = _texts.get(id(value))
    if known is not None:  # it is held there, so that nothing else has this identity
        return known[1]
    text = json.dumps(_constant(value), sort_keys=True)
    if _fixed(value):
        _texts[id(value)] = value, text
    return text


def _fixed(value: Any) -> bool:
    """Whether a constant's content cannot change while it is the same object."""
    if isinstance(value, tuple | frozenset):
        return all(map(_fixed, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        frozen = type(value).__dataclass_params__.frozen  # type: ignore[attr-defined]
        return frozen and all(_fixed(getattr(value, f.name)) for f in dataclasses.fields(value))
    plain = type | FunctionType | np.generic | bool | int | float | complex | str | bytes
    return value is None or isinstance(value, plain)


def _copied(value: Any) -> Any:
    """A copy that equals the value until that is changed in place.

    Raises:
        TypeError: there is none that a comparison tells of, as of arrays.
    """
    if _fixed(value):
        return value
    if type(value) is dict:
        return {k: _copied(v) for k, v in value.items()}
    if type(value) is list:
        return [_copied(v) for v in value]
    if type(value) is set:
        return set(value)
    raise TypeError(type(value).__name__)


def _constant(value: Any) -> Any:
    """A constant in JSON's types; code in it (a table of functions) counts by name."""
    if isinstance(value, type | FunctionType):
        return {"code": f"{value.__module__}.{value.__qualname__}"}
    if dataclasses.is_dataclass(value):
        return [_constant(getattr(value, f.name)) for f in dataclasses.fields(value)]
    return _plain_data(value, _constant)


def _name(code: type | FunctionType) -> str:
    if "<" in code.__qualname__:
        raise TypeError(f"a key cannot be made of {code.__qualname__}: its name says too little")
    return code.__qualname__


def _sorted(parts: Iterable[Any]) -> list[Any]:
    return sorted(parts, key=lambda part: json.dumps(part, sort_keys=True))


@dataclass(kw_only=True)
class Store:
    """A folder of intermediate results: `folder/stage/key.npz`."""

    folder: Path
    """The folder."""
    registry: Registry
    """Record types that may be stored."""
    within: Path | None = None
    """A folder around it that is never made anew: what was moved away for a while shall find its
    place free.
    """
    hits: int = 0
    """Number of results found."""
    misses: int = 0
    """Number of results computed."""
    _made: set[str] = field(default_factory=set)

    def get(self, stage: str, key: str) -> Any | None:
        """The stored result, or None when there is none or the file is damaged, or another's."""
        path = self.folder / stage / f"{key}.npz"
        try:
            with open_regular(path) as file:
                value = read(file, self.registry, f"{stage}/{key}")
        except (OSError, ValueError, TypeError):
            return None
        self.hits += 1
        return value

    def has(self, stage: str, key: str) -> bool:
        """Whether there is a stored result; one that is damaged is made again when it is read."""
        try:
            there = (self.folder / stage / f"{key}.npz").stat().st_size > 0
        except OSError:
            return False
        self.hits += there
        return there

    def put(self, stage: str, key: str, value: Any) -> None:
        """Stores a result atomically: the file appears complete or not at all.

        Raises:
            OutputError: the disk is full or the folder read-only, or that around it is gone.
        """
        self.misses += 1
        path = self.folder / stage / f"{key}.npz"
        # another process or thread may make the same at the same time
        maker = f"{platform.node()}-{os.getpid()}-{threading.get_ident()}"
        partial = path.with_suffix(f".{maker}.partial")
        try:
            if self.within is not None:
                self.within.stat()
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                write(file, value, f"{stage}/{key}")
            put_in_place(partial, path)
        except OSError as error:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise refusal(path.parent, error) from error

    def get_or(self, stage: str, key: str, make: Callable[[], T]) -> T:
        """The stored result; computed and stored if there is none."""
        value: T | None = self.get(stage, key)
        if value is None:
            value = make()
            self.put(stage, key, value)
        return value

    def parts(self, stage: str, key: str, workers: Workers = HERE) -> Keep:
        """Keeps the parts of a result that has this key; `workers` make them."""

        def held(part: str, make: Callable[[], T], /) -> T:
            return self.get_or(stage, digest(key, part), make)

        def has(part: str) -> bool:
            return (self.folder / stage / f"{digest(key, part)}.npz").exists()

        return Keep(held=held, has=has, workers=workers)

    def tidy(self) -> None:
        """Removes what processes that were killed left of results."""
        for partial in self.folder.glob("*/*.partial"):
            partial.unlink(missing_ok=True)

    def forget(self, stages: Sequence[str]) -> None:
        """Removes all results of these stages."""
        for stage in stages:
            remove_folder(self.folder / stage)
