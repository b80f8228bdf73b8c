"""The module-level constants that a method computes with, so that they can be part of its key."""

import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

PACKAGE = __name__.partition(".")[0]
"""Only modules of this package are searched; methods of other packages state their own version."""
_SCALARS = (bool, int, float, complex, str, bytes, np.generic, np.ndarray)


def constants_of(thing: Any) -> dict[str, Any]:
    """Current values of the upper-case names in the modules on which `thing` depends.

    `thing` is a class or a function. The modules are its own module and, recursively, all modules
    of this package that are imported at module level. That is more than it uses. A constant too
    many only causes an artefact to be computed again; a missing constant could leave a wrong
    artefact in use. Imports inside functions and literals in code are not found; changes of these
    need a new `version` of the method.
    """
    values = {}
    for module in _modules(thing.__module__):
        space = vars(sys.modules[module])
        values.update({f"{module}.{name}": space[name] for name in _names(module)})
    return values


def is_data(value: Any) -> bool:
    """Whether a value consists of numbers, strings, arrays, records, and functions or classes that
    are identified by name.
    """
    if isinstance(value, Mapping):
        return all(is_data(part) for pair in value.items() for part in pair)
    if isinstance(value, tuple | list | set | frozenset):
        return all(is_data(part) for part in value)
    if isinstance(value, FunctionType | type):
        return True
    if is_dataclass(value):
        return all(is_data(getattr(value, f.name)) for f in fields(value))
    return value is None or isinstance(value, _SCALARS)


@cache
def _names(module: str) -> tuple[str, ...]:
    """The module's upper-case names that contain data, including imported ones."""
    held = vars(sys.modules[module]).items()
    return tuple(sorted(name for name, value in held if name.isupper() and _constant(value)))


def _constant(value: Any) -> bool:
    return is_data(value) and not isinstance(value, FunctionType | type)


@cache
def _modules(first: str) -> tuple[str, ...]:
    """The module and those of this package that it imports, directly or not, in order of name."""
    found: set[str] = set()
    todo = [first] if _ours(first) else []
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            todo += _imported(sys.modules[name])
    return tuple(sorted(found))


def _imported(module: ModuleType) -> Iterator[str]:
    """The modules of this package in which a module's names are defined.

    Submodules of a package are left out, since which of them are present depends on what was loaded
    before.
    """
    for value in list(vars(module).values()):
        name = value.__name__ if isinstance(value, ModuleType) else _home(value)
        inside = isinstance(value, ModuleType) and name.startswith(f"{module.__name__}.")
        if _ours(name) and not inside:
            yield name


def _home(value: Any) -> str:
    """The module in which a class, a function or the class of an object is defined."""
    home = getattr(value, "__module__", None)
    return home if isinstance(home, str) else ""


def _ours(name: str) -> bool:
    return name.partition(".")[0] == PACKAGE and name in sys.modules
