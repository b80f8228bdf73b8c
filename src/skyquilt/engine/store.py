"""Intermediate results on disk, with keys made from inputs and method. A resumed run finds them by
key.
"""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skyquilt.engine.codec import Registry, decode, encode
from skyquilt.engine.folder import refusal

T = TypeVar("T")


def digest(*parts: Any) -> str:
    """Hash (hex) of anything made of strings, numbers, paths, tuples, dicts and dataclasses, by
    value.
    """
    return hashlib.blake2b(
        json.dumps(_plain(parts), sort_keys=True).encode(), digest_size=16
    ).hexdigest()


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return [type(value).__name__, getattr(type(value), "version", 0), fields]
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return [
            value.dtype.str,
            value.shape,
            hashlib.blake2b(value.tobytes(), digest_size=16).hexdigest(),
        ]
    if isinstance(value, np.generic):
        return _plain(value.item())
    return str(value)


@dataclass(kw_only=True)
class Store:
    """A folder of intermediate results: `folder/stage/key.npz`."""

    folder: Path
    """The folder."""
    registry: Registry
    """Record types that may be stored."""
    hits: int = 0
    """Number of results found."""
    misses: int = 0
    """Number of results computed."""
    _made: set[str] = field(default_factory=set)

    def get(self, stage: str, key: str) -> Any | None:
        """The stored result, or None when there is none or the file is damaged."""
        path = self.folder / stage / f"{key}.npz"
        try:
            value = decode(path.read_bytes(), self.registry)
        except (OSError, ValueError, TypeError):
            return None
        self.hits += 1
        return value

    def put(self, stage: str, key: str, value: Any) -> None:
        """Stores a result atomically: the file appears complete or not at all.

        Raises:
            OutputError: the disk is full or the folder read-only.
        """
        self.misses += 1
        path = self.folder / stage / f"{key}.npz"
        partial = path.with_suffix(".partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(encode(value))
            partial.replace(path)
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

    def forget(self, stages: Sequence[str]) -> None:
        """Removes all results of these stages."""
        for stage in stages:
            shutil.rmtree(self.folder / stage, ignore_errors=True)
