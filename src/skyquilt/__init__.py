"""Skyquilt: drone photos, visible and thermal, to a georeferenced, orthorectified mosaic.

The public names. They are imported when first used, so that `import skyquilt` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import skyquilt.catalogue  # noqa: F401  names the methods
from skyquilt.version import __version__ as __version__

if TYPE_CHECKING:
    from skyquilt import simulate
    from skyquilt.coregistration.workflow import register
    from skyquilt.errors import SkyquiltError
    from skyquilt.model.camera import Camera
    from skyquilt.model.event import Result
    from skyquilt.model.photo import Photo, Survey
    from skyquilt.model.poses import Alignment
    from skyquilt.photos.survey import read_survey
    from skyquilt.runs.opened import open_run
    from skyquilt.settings import MosaicSettings
    from skyquilt.workflows.mosaic import iter_mosaic, mosaic

_HOME = {
    "Alignment": "skyquilt.model.poses",
    "Camera": "skyquilt.model.camera",
    "MosaicSettings": "skyquilt.settings",
    "Photo": "skyquilt.model.photo",
    "Result": "skyquilt.model.event",
    "SkyquiltError": "skyquilt.errors",
    "Survey": "skyquilt.model.photo",
    "iter_mosaic": "skyquilt.workflows.mosaic",
    "mosaic": "skyquilt.workflows.mosaic",
    "open_run": "skyquilt.runs.opened",
    "read_survey": "skyquilt.photos.survey",
    "register": "skyquilt.coregistration.workflow",
}
"""Public name -> module that defines it."""

__all__ = [
    "Alignment",
    "Camera",
    "MosaicSettings",
    "Photo",
    "Result",
    "SkyquiltError",
    "Survey",
    "iter_mosaic",
    "mosaic",
    "open_run",
    "read_survey",
    "register",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name == "simulate":
        return import_module("skyquilt.simulate")
    if name not in _HOME:
        raise AttributeError(f"module 'skyquilt' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(["__doc__", "__file__", "__name__", "__version__", *__all__])
