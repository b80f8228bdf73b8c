"""The figures of a run: everything that goes into metrics.json except times."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.camera import ADJUSTABLE
from skyquilt.model.event import MetadataConflict
from skyquilt.model.features import Link, RejectedLink
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.poses import Accuracy, Alignment, Prior
from skyquilt.model.raster import Grid
from skyquilt.ortho.companions import Drawn
from skyquilt.ortho.ground import Ground
from skyquilt.quality.geolocation import gps_residuals


def _round(value: float | None, digits: int = 4) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), digits)


def xyz(values: Sequence[float] | NDArray[Any] | None) -> dict[str, float | None] | None:
    """Three figures by axis."""
    if values is None or not np.isfinite(np.asarray(values, float)).any():
        return None
    return {axis: _round(v) for axis, v in zip("xyz", values, strict=True)}


def _rms(values: NDArray[np.float64]) -> float:
    """Root mean square; NaN for an empty array."""
    return float(np.sqrt((values**2).mean())) if len(values) else np.nan


def alignment_figures(alignment: Alignment, priors: Sequence[Prior]) -> dict[str, Any]:
    """Blocks, residuals, calibration, control."""
    error = np.linalg.norm(alignment.ties.residual_px, axis=1)
    rms_px = float(np.sqrt((error**2).mean())) if len(error) else None
    residual = gps_residuals(alignment, priors) if alignment.frame.crs else np.zeros((0, 3))
    rms = [_rms(axis[np.isfinite(axis)]) for axis in residual.T]
    loo = alignment.loo_rms_m if alignment.frame.crs else None
    return {
        "blocks": [len(b) for b in alignment.blocks],
        "gps_residual_rms_m": xyz(rms),
        "gps_leave_one_out_rms_m": xyz(
            np.where(np.isfinite(rms), loo, np.nan) if loo is not None else None
        ),
        "reprojection_error_px": {"mean": _round(error.mean()), "rms": _round(rms_px)}
        if len(error)
        else None,
        "tie_points": len(alignment.ties.xyz),
        "sightings": len(alignment.ties.point),
        **control_figures(alignment),
    }


def control_figures(alignment: Alignment) -> dict[str, Any]:
    """Control and check points.

    Where heights refer to the take-off point or to an unknown zero, and no control point connects
    them to the survey's datum, the two differ by a constant. It is estimated as the median and
    reported apart from the errors.
    """
    points = alignment.control
    dz = np.array([c.error_m[2] for c in points], float)
    tied = alignment.frame.vertical_datum not in ("takeoff", "unknown") or any(
        not c.check for c in points
    )
    offset = 0.0 if tied or not np.isfinite(dz).any() else float(np.nanmedian(dz))
    rows = [
        {
            "name": c.name,
            "check": c.check,
            "dx_m": _round(c.error_m[0]),
            "dy_m": _round(c.error_m[1]),
            "dz_m": _round(z - offset),
            "reprojection_px": _round(c.reprojection_px),
            "sightings": c.observations,
            "sigma_m": None if c.sigma_m is None else [_round(s, 4) for s in c.sigma_m],
        }
        for c, z in zip(points, dz, strict=True)
    ]
    return {"control": rows, "control_height_offset_m": _round(offset) if points else None}


def camera_figures(photos: Sequence[Photo], alignment: Alignment) -> dict[str, Any]:
    """Intrinsics with standard deviations, and the focal length reported by the metadata."""
    out: dict[str, Any] = {}
    for i in sorted(alignment.poses):
        key = alignment.camera_of[i]
        if key in out:
            continue
        camera, focal = alignment.cameras[key], photos[i].focal
        sigmas = camera.sigmas or (None,) * len(camera.vector)
        out[key] = {
            name: {"value": _round(value, 6), "sigma": _round(sigma, 6)}
            for name, value, sigma in zip(ADJUSTABLE, camera.vector, sigmas, strict=False)
        }
        out[key]["projection"] = "fisheye" if camera.fisheye else "perspective"
        out[key]["focal"] |= {
            "prior": _round(focal.px, 2),
            "prior_sigma": _round(focal.sigma_px, 2),
            "source": focal.source,
        }
    return out


def shutter_figures(photos: Sequence[Photo], alignment: Alignment) -> dict[str, Any]:
    """How the rows of each camera's photos were exposed, and by how much that shifts them."""
    out: dict[str, Any] = {}
    heights = alignment.ties.xyz[:, 2]
    ground = float(np.median(heights)) if len(heights) else None
    for i in sorted(alignment.poses):
        key, pose, camera = photos[i].camera_key, alignment.poses[i], alignment.camera(i)
        moved = pose.motion
        px = 0.0
        if moved is not None and ground is not None:
            above = max(float(pose.map_C[2]) - ground, 1.0)
            px = camera.focal * float(np.linalg.norm(moved.shift_m)) / above
        entry = out.setdefault(
            key,
            {
                "source": photos[i].shutter.source,
                "readout_ms": _round(1000 * camera.readout_s, 3),
                "sigma_ms": _round(1000 * (camera.sigma_readout_s or 0.0), 3),
                "prior_ms": _round(1000 * photos[i].shutter.readout_s, 3),
                "largest_displacement_px": 0.0,
            },
        )
        entry["largest_displacement_px"] = max(entry["largest_displacement_px"], _round(px, 2))
    return out


def accuracy_figures(
    accuracy: Accuracy | None, seen: NDArray[np.bool_], grid: Grid, *, placed: bool = True
) -> dict[str, Any] | None:
    """Predicted deviations of the map's ground points in m, in the median and at the worst place;
    what the positions' common error adds is given apart, of maps that have a place (`placed`).

    Points count where the map is drawn (`seen`, on `grid`): those near a horizon in the picture
    may be off by kilometres, and are in no map.
    """
    if accuracy is None or not len(accuracy.sigma_m):
        return None
    column, row = (np.rint(at) for at in grid.pixel(accuracy.xyz[:, 0], accuracy.xyz[:, 1]))
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    inside[inside] = seen[row[inside].astype(int), column[inside].astype(int)]
    sigma = accuracy.sigma_m[inside] if inside.any() else accuracy.sigma_m
    shared = accuracy.shared_m if placed else (None, None)
    flat, up = np.sqrt((sigma[:, :2] ** 2).mean(1)), sigma[:, 2]
    return {
        "horizontal_m": {"median": _round(np.median(flat), 4), "worst": _round(flat.max(), 4)},
        "vertical_m": {"median": _round(np.median(up), 4), "worst": _round(up.max(), 4)},
        "shared_horizontal_m": _round(shared[0], 4),
        "shared_vertical_m": _round(shared[1], 4),
        "focal_sigma_after_over_before": _round(accuracy.focal_share, 4),
        "design_effect": _round(accuracy.design_effect, 2),
    }


def _unseen(photos: Sequence[Photo], alignment: Alignment, ground: Ground) -> dict[str, str]:
    """Why placed photos have no part in the map, by name: those without a view."""
    seen = {v.photo for v in ground.views}
    why = (
        "it could be placed, but shows no ground of known height at less than"
        f" {ground.limits.angle_deg:g} degrees from the vertical (--max-view-angle)"
    )
    return {photos[i].name: why for i in sorted(alignment.poses.keys() - seen)}


def figures(
    *,
    photos: Sequence[Photo],
    total: int,
    rejected: Sequence[RejectedPhoto],
    priors: Sequence[Prior],
    links: Sequence[Link],
    refused: Sequence[RejectedLink],
    alignment: Alignment,
    ground: Ground,
    drawn: Drawn,
    seams: Mapping[str, Any],
    looks: Mapping[str, Any],
    conflicts: Sequence[MetadataConflict],
    warnings: Sequence[str],
    notes: Sequence[str],
) -> dict[str, Any]:
    """The figures of a run, without times."""
    seen = drawn.views > 0
    cell = drawn.views_grid.gsd**2
    return {
        "method": alignment.method,
        "why": alignment.why,
        "photos_total": total,
        "photos_used": len(ground.views),
        "photos_rejected": {r.name: r.reason for r in rejected}
        | _unseen(photos, alignment, ground),
        "gsd_m": ground.grid.gsd,
        "native_gsd_m": _round(ground.native_gsd, 5),
        "crs": alignment.frame.crs,
        "georeferenced": alignment.frame.crs is not None,
        "vertical_datum": alignment.frame.vertical_datum,
        "size_px": [ground.grid.width, ground.grid.height],
        "area_m2": _round(float(seen.sum()) * cell, 1),
        **_holes(seen, cell),
        "views_per_cell_mean": _round(float(drawn.views[seen].mean()) if seen.any() else None, 2),
        **alignment_figures(alignment, priors),
        "links": len(links),
        "pairs_rejected": _reasons([r.reason for r in refused]),
        "seam_disparity_px": seams,
        **looks,
        "metadata_conflicts": [asdict(c) for c in conflicts],
        "warnings": list(warnings),
        "cameras": camera_figures(photos, alignment),
        "shutter": shutter_figures(photos, alignment),
        "accuracy": accuracy_figures(
            alignment.accuracy, seen, drawn.views_grid, placed=alignment.frame.crs is not None
        ),
        "notes": list(notes),
    }


def _holes(seen: NDArray[np.bool_], cell_m2: float) -> dict[str, float]:
    """Places inside the map that no photo shows: their number and their area in m2."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        np.pad(~seen, 1, constant_values=True).astype(np.uint8), connectivity=4
    )
    outside = labels[0, 0]
    sizes = [int(stats[k, cv2.CC_STAT_AREA]) for k in range(1, count) if k != outside]
    return {"holes": len(sizes), "holes_m2": round(sum(sizes) * cell_m2, 1)}


def _reasons(reasons: Sequence[str]) -> dict[str, int]:
    """How often each reason occurs, ignoring details in brackets."""
    short = [r.split(" (")[0] for r in reasons]
    return {r: short.count(r) for r in sorted(set(short))}
