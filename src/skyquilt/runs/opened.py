"""Opens a finished run in Python: poses, cameras, observations, rasters."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.folder import STATE
from skyquilt.engine.store import Store
from skyquilt.errors import SideFileError, UsageError
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import Camera
from skyquilt.model.event import Result
from skyquilt.model.poses import Alignment, Motion, Pose
from skyquilt.outside import read_bounded
from skyquilt.photos.cameras_json import read_cameras_json
from skyquilt.raster.map_source import FileSource
from skyquilt.runs.layers import RunLayer, figures_of, layers_in, unit_of
from skyquilt.runs.rasters import Raster, as_xarray, read_raster
from skyquilt.typed import as_path

if TYPE_CHECKING:
    import xarray

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Tie points and the pixels at which photos show them."""

    points: NDArray[np.float64]
    """(P, 3) easting, northing, height in m in the run's CRS."""
    point: NDArray[np.int64]
    """(N,) index into `points` of each observation, ascending."""
    photo: NDArray[np.str_]
    """(N,) name of the photo of each observation."""
    px: NDArray[np.float64]
    """(N, 2) observed pixel, centres at integers."""
    residual_px: NDArray[np.float64]
    """(N, 2) projected minus observed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A finished run. What is large is read when it is asked for."""

    path: Path
    """Its folder."""
    metrics: Mapping[str, Any]
    """The content of metrics.json."""

    @property
    def crs(self) -> str | None:
        """Its coordinate system, as pyproj reads it; None if the map is not georeferenced."""
        found = self.metrics.get("crs")
        return None if found is None else str(found)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """Calibrations by name."""
        return read_cameras_json(self.path / "cameras.json")

    @cached_property
    def _shots(self) -> list[dict[str, Any]]:
        try:
            features = json.loads(read_bounded(self.path / "shots.geojson"))["features"]
            return [dict(f["properties"]) for f in features]
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise SideFileError(
                f"{self.path / 'shots.geojson'} cannot be read ({error}); make the map again"
            ) from error

    @cached_property
    def poses(self) -> dict[str, Pose]:
        """Poses by the photo's name: centres in m in the run's CRS (easting, northing, height), and
        rotations from its axes (east, north, up) to the camera's; those of the middle row where
        the camera moved while its rows were read out (`Pose.motion`).
        """
        return {
            s["filename"]: Pose(
                cam_R_map=rotation_from_vector(np.array(s["rotation"], float)),
                map_C=np.array(s["translation"], float),
                motion=_motion(s),
            )
            for s in self._shots
        }

    @cached_property
    def camera_of(self) -> dict[str, str]:
        """Name of each photo's calibration."""
        return {s["filename"]: str(s["camera"]) for s in self._shots}

    @cached_property
    def observations(self) -> Observations:
        """Tie points and their observations, from the run's folder `.skyquilt`.

        Raises:
            UsageError: that folder has been deleted, or holds those of another map.
        """
        alignment, names = self._alignment()
        ties = alignment.ties
        return Observations(
            points=ties.xyz + np.array([*alignment.frame.origin, 0.0]),
            point=ties.point.astype(np.int64),
            photo=np.array([names[i] for i in ties.photo.tolist()], dtype=str),
            px=ties.px.astype(np.float64),
            residual_px=ties.residual_px.astype(np.float64),
        )

    def _alignment(self) -> tuple[Alignment, dict[int, str]]:
        """The alignment as it was stored, and the names of its photos."""
        from skyquilt.workflows.artefacts import REGISTRY  # slow to load
        from skyquilt.workflows.finished import NAME, STAGE

        store = Store(folder=self.path / STATE / "store", registry=REGISTRY)
        made = store.get(STAGE, NAME)
        found = None if made is None else store.get("alignment", made.alignment)
        if made is None or found is None:
            raise UsageError(
                f"{self.path} has no observations: they are in its folder {STATE}, which has been"
                " deleted; make the map again"
            )
        names = dict(enumerate(made.names))
        if not self._shows(found, names):
            raise UsageError(
                f"the observations in {self.path / STATE} are not those of the map, whose run may"
                " have been interrupted; run the command that made it again"
            )
        return found, names

    def _shows(self, alignment: Alignment, names: Mapping[int, str]) -> bool:
        """Whether the files of the run have these poses."""
        origin = np.array([*alignment.frame.origin, 0.0])
        centres = {names[i]: p.map_C + origin for i, p in alignment.poses.items() if i in names}
        return self.poses.keys() <= centres.keys() and all(
            np.allclose(p.map_C, centres[n], rtol=0, atol=1e-3) for n, p in self.poses.items()
        )

    @cached_property
    def layers(self) -> dict[str, RunLayer]:
        """Rasters of the run by name: mosaic, thermal, heights, hillshade, ground, views,
        provenance, as far as there are.
        """
        return layers_in(self.path)

    def raster(
        self, name: str = "mosaic", *, bounds: Bounds | None = None, gsd_m: float | None = None
    ) -> Raster:
        """A raster, or a part of it, as an array.

        `bounds`: west, south, east, north in the run's CRS; `gsd_m`: pixel size in m, by default
        the file's own, else the nearest multiple of it. A whole map at its own resolution may need
        gigabytes.

        Raises:
            UsageError: there is no such raster, or it has no content there.
        """
        return read_raster(self.source(name), name, bounds, gsd_m)

    def xarray(
        self, name: str = "mosaic", *, bounds: Bounds | None = None, gsd_m: float | None = None
    ) -> "xarray.DataArray":
        """The same as an `xarray.DataArray` (y, x, band), NaN or 0 where there is nothing.

        Raises:
            UsageError: as for `raster`; or xarray, of the extra `xarray`, is not installed.
        """
        found = self.raster(name, bounds=bounds, gsd_m=gsd_m)
        return as_xarray(found, name, unit_of(self.layers[name], self.metrics))

    def source(self, name: str) -> FileSource:
        """A raster as a source of parts.

        Raises:
            UsageError: there is no such raster.
        """
        if name not in self.layers:
            raise UsageError(f"{self.path} has no raster {name!r}; it has {', '.join(self.layers)}")
        return FileSource(path=self.path / self.layers[name].file)

    @property
    def result(self) -> Result:
        """The run as `mosaic` returned it."""
        return Result(output=self.path, metrics=self.metrics)

    def __repr__(self) -> str:
        return "Run" + repr(self.result).removeprefix("Result")

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def _motion(shot: Mapping[str, Any]) -> Motion | None:
    if "readout_shift" not in shot:
        return None
    shift, turn = (np.array(shot[k], float) for k in ("readout_shift", "readout_turn"))
    return Motion(shift_m=shift, turn_rad=turn)


def open_run(folder: Path | str) -> Run:
    """Opens a finished run: the folder that was given to `mosaic` as output.

    Raises:
        UsageError: it holds no finished run.
    """
    path = as_path("folder", folder)
    metrics = figures_of(path)
    if not metrics or "mosaic" not in layers_in(path):
        raise UsageError(
            f"{path} holds no finished run (mosaic.tif and metrics.json); name the folder given"
            " to -o"
        )
    return Run(path=path, metrics=metrics)
