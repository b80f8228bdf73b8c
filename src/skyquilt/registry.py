"""Methods by name: which function makes the method that a word on a command line names.

A row is a name and an address, `module:function`. Nothing is imported before it is needed, and
nothing here knows which methods exist: `skyquilt.catalogue` adds those of this package, and another
package may add its own with `register`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

STAGES = ("detector", "matcher", "estimator", "alignment", "registration", "notebook")
"""Kinds of methods that are chosen by name; `notebook`: how a record is shown as HTML."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One named method."""

    make: str
    """`module:function` that makes it."""
    takes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """For an alignment: the options that it takes (without `--`) and the words each may have; an
    empty tuple stands for any value.
    """


_rows: dict[str, dict[str, Row]] = {stage: {} for stage in STAGES}


def register(
    stage: str, name: str, make: str, takes: Mapping[str, tuple[str, ...]] | None = None
) -> None:
    """Adds a method, or replaces the one of that name.

    Raises:
        ValueError: there is no such stage, or `make` is not `module:function`.
    """
    if stage not in _rows or ":" not in make:
        raise ValueError(
            f"a stage of {', '.join(STAGES)} and module:function expected, got {stage} and {make}"
        )
    _rows[stage][name] = Row(make=make, takes=dict(takes or {}))


def names(stage: str) -> tuple[str, ...]:
    """Names of a stage's methods, in the order of their registration."""
    return tuple(_rows[stage])


def row(stage: str, name: str) -> Row:
    """The row of a name.

    Raises:
        KeyError: there is none.
    """
    return _rows[stage][name]


def load(stage: str, name: str) -> Callable[..., Any]:
    """The function that makes a method; its module is imported now."""
    module, _, attribute = row(stage, name).make.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), attribute)
    return found
