"""Figures of the finished map."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from skyquilt.model.poses import Accuracy, ControlResidual
from skyquilt.model.raster import Grid
from skyquilt.quality.run_metrics import _holes, accuracy_figures, control_figures


@pytest.mark.parametrize(
    ("datum", "controls", "offset"),
    [("takeoff", 0, -440.0), ("unknown", 0, -440.0), ("sea_level", 0, 0.0), ("control", 1, 0.0)],
)
def test_a_constant_between_two_height_datums_is_no_error(datum, controls, offset):
    """Check points of known errors, seen from a map whose heights count from elsewhere."""
    errors = np.array([(0.1, -0.2, 0.03), (0.0, 0.1, 0.0), (-0.3, 0.0, -0.05)])
    points = [
        ControlResidual(
            name=f"p{k}",
            check=k >= controls,
            error_m=e + (0, 0, -440.0),
            reprojection_px=0.3,
            observations=4,
        )
        for k, e in enumerate(errors)
    ]
    said = control_figures(
        SimpleNamespace(control=points, frame=SimpleNamespace(vertical_datum=datum))
    )
    assert said["control_height_offset_m"] == offset
    assert [r["dz_m"] for r in said["control"]] == pytest.approx(
        errors[:, 2] - 440.0 - offset, abs=1e-9
    )
    assert [r["dx_m"] for r in said["control"]] == pytest.approx(errors[:, 0])


def test_points_without_heights_have_no_offset():
    lone = ControlResidual(
        name="p",
        check=True,
        error_m=np.array([0.1, 0.2, np.nan]),
        reprojection_px=0.3,
        observations=2,
    )
    said = control_figures(
        SimpleNamespace(control=[lone], frame=SimpleNamespace(vertical_datum="takeoff"))
    )
    assert (said["control"][0]["dz_m"], said["control_height_offset_m"]) == (None, 0.0)
    nobody = SimpleNamespace(control=[], frame=SimpleNamespace(vertical_datum="takeoff"))
    assert control_figures(nobody) == {"control": [], "control_height_offset_m": None}


def test_holes_are_what_the_map_encloses():
    seen = np.zeros((20, 30), bool)
    seen[2:18, 3:27] = True
    seen[5:7, 5:8] = False  # six cells
    seen[10, 10] = seen[11, 11] = False  # two, that touch at a corner only
    seen[2:5, 20] = False  # open to the outside: a bay, not a hole
    assert _holes(seen, 4.0) == {"holes": 3, "holes_m2": 32.0}


def test_holes_against_scipy():
    rng = np.random.default_rng(0)
    for _ in range(20):
        seen = rng.random((40, 50)) > 0.4
        enclosed = ndimage.binary_fill_holes(seen) & ~seen
        assert _holes(seen, 1.0) == {
            "holes": ndimage.label(enclosed)[1],
            "holes_m2": float(enclosed.sum()),
        }


def test_no_holes():
    assert _holes(np.ones((4, 4), bool), 1.0) == {"holes": 0, "holes_m2": 0.0}
    assert _holes(np.zeros((4, 4), bool), 1.0) == {"holes": 0, "holes_m2": 0.0}


def test_the_accuracy_is_that_of_the_ground_that_the_map_shows():
    grid = Grid(west=10.0, north=30.0, gsd=1.0, width=20, height=20)
    seen = np.zeros((20, 20), bool)
    seen[:, :10] = True  # eastings 10 to 20
    told = Accuracy(
        xyz=np.array([[12.0, 20, 0], [18.0, 12, 0], [25.0, 20, 0], [9000.0, 20, 0], [12.0, -5, 0]]),
        sigma_m=np.array([[1.0, 1, 2], [2.0, 2, 5], [7.0, 7, 7], [9e3, 9e3, 9e3], [8.0, 8, 8]]),
        shared_m=(1.5, 3.0),
        focal_shares={"a": 0.5},
        design_effect=2.0,
    )
    found = accuracy_figures(told, seen, grid)
    assert found["horizontal_m"] == {"median": 1.5, "worst": 2.0}
    assert found["vertical_m"] == {"median": 3.5, "worst": 5.0}
    nowhere = accuracy_figures(told, ~np.ones((20, 20), bool), grid)
    assert nowhere["horizontal_m"]["worst"] == 9000  # a map without a point is told of all
    assert accuracy_figures(None, seen, grid) is None
    assert (found["shared_horizontal_m"], found["shared_vertical_m"]) == (1.5, 3.0)
    unplaced = accuracy_figures(told, seen, grid, placed=False)  # positions err, but it has none
    assert unplaced == found | {"shared_horizontal_m": None, "shared_vertical_m": None}
