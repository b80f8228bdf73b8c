"""What the thermal chapter leaves beside the rasters."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.atomic import whole_file, write_text

OVERLAYS = ("thermal_checkerboard.png", "thermal_false_colour.png", "thermal_alpha.png")
"""Pictures of both maps on one another; the first of the registration's, side by side, is left out."""


def write_overlays(output: Path, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """RGB pictures in the order of `register_files.OVERLAYS`."""
    for name, picture in zip(OVERLAYS, pictures[1:], strict=True):
        done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
        assert done
        with whole_file(output / name, needed=len(data)) as file:
            file.write(data.tobytes())


def write_figures(output: Path, visual: Mapping[str, Any], figures: Mapping[str, Any]) -> None:
    """metrics.json of the visual map, and under `thermal` how the other lies on it."""
    write_text(output / "metrics.json", json.dumps({**visual, **figures}, indent=1, allow_nan=False))
