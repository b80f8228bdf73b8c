"""Values that a program passes: those of another kind than stated are refused by name, before
something far below stumbles over them, or takes them for something else ("no" for True).
"""

import os
from collections.abc import Iterable
from dataclasses import fields
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin

from skyquilt.errors import UsageError

T = TypeVar("T")
KINDS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
}
"""What is checked, and what it is called."""


def typed(record: Any) -> None:
    """Checks the fields of a frozen dataclass by their annotations; what means the same (an array
    of numpy for a tuple, a text for a path) is converted. Called in `__post_init__`.

    Raises:
        UsageError: a field holds something else; the sentence names it.
    """
    for field in fields(record):
        value = getattr(record, field.name)
        found = as_kind(field.name, value, field.type)
        if found is not value:
            object.__setattr__(record, field.name, found)


def as_kind(name: str, value: Any, kind: Any) -> Any:
    """The value as what an annotation states: one of `KINDS`, tuples of these, or None beside them.
    Anything is taken for other annotations.

    Raises:
        UsageError: it is something else.
    """
    kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
    if value is None and NoneType in kinds:
        return None
    kinds = tuple(k for k in kinds if k is not NoneType)
    if len(kinds) != 1:
        return value
    (one,) = kinds
    if get_origin(one) is tuple:
        return _tuple(name, value, get_args(one))
    if one not in KINDS:
        return value
    found = _one(value, one)
    if found is None:
        empty = one is Path and isinstance(value, str)
        told = "empty" if empty else f"{_told(value)} ({type(value).__name__})"
        raise UsageError(f"{name} is {told}; {KINDS[one]} is expected")
    return found


def as_path(name: str, value: Any) -> Path:
    """The value as a path.

    Raises:
        UsageError: it is none.
    """
    found: Path = as_kind(name, value, Path)
    return found


def instance(name: str, value: T | None, kind: type[T]) -> T:
    """The value, or an instance made without arguments in place of None.

    Raises:
        UsageError: it is of another type.
    """
    if value is None:
        return kind()
    if not isinstance(value, kind):
        raise UsageError(f"{name} is {_told(value)}; {kind.__name__}(...) is expected")
    return value


def _one(value: Any, kind: type) -> Any:
    """The value as one of `KINDS`; None where it is not."""
    if kind is Path:
        able = isinstance(value, (str, os.PathLike)) and os.fspath(value)
        return Path(value) if able and isinstance(os.fspath(value), str) else None
    if kind is str:
        return value if isinstance(value, str) else None
    truth = isinstance(value, bool) or type(value).__name__ in ("bool_", "bool")
    if kind is bool:
        return bool(value) if truth else None
    if truth or not isinstance(value, Real):
        return None
    if kind is int:
        number: Any = value
        same = isinstance(value, Integral) or float(number).is_integer()
        return int(number) if same else None
    try:
        return float(value)
    except OverflowError:
        return None


def _tuple(name: str, value: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    more = kinds[-1:] == (Ellipsis,)
    wanted = f"{'' if more else f'{len(kinds)} '}values"
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
        raise UsageError(
            f"{name} is {_told(value)} ({type(value).__name__}); {wanted} are expected"
        )
    parts = tuple(value)
    if not more and len(parts) != len(kinds):
        raise UsageError(f"{name} has {len(parts)} values; {len(kinds)} are expected")
    each = kinds[:1] * len(parts) if more else kinds
    return tuple(
        as_kind(f"{name}[{k}]", p, e) for k, (p, e) in enumerate(zip(parts, each, strict=True))
    )


def _told(value: Any) -> str:
    return " ".join(repr(value).split())[:60]
