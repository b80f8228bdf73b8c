"""What a run hands to its report."""

import shutil

import numpy as np
import pytest

from skyquilt.settings import MosaicSettings
from skyquilt.workflows import run_report
from skyquilt.workflows.mosaic import iter_mosaic


@pytest.mark.slow
def test_large_surveys_hand_over_some_residuals(finished, flight, tmp_path, monkeypatch):
    output = shutil.copytree(finished.output, tmp_path / "out")
    settings, told = MosaicSettings(gcp=next(flight.rglob("gcp_list.txt")), jobs=2), []
    write = run_report.write_report

    def watched(target, page):
        told.append(page.residuals)
        write(target, page)

    monkeypatch.setattr(run_report, "write_report", watched)
    pages = []
    for most in (run_report.MOST_RESIDUALS, 1000):
        monkeypatch.setattr(run_report, "MOST_RESIDUALS", most)
        for _ in iter_mosaic(
            flight / "photos", output, settings, overwrite=True, rerun_from="report"
        ):
            pass
        pages.append((output / "report.html").read_text())
    (whole,), (some,) = told
    every = 1 + len(whole.px) // 1000
    assert whole.every == 1 < every == some.every and len(some.px) <= 1000
    assert np.array_equal(some.px, whole.px[::every])
    assert np.array_equal(some.residual_px, whole.residual_px[::every])
    said = f"One of {every} observations is taken."
    assert said in pages[1] and "observations is taken" not in pages[0]


@pytest.mark.slow
def test_large_maps_hand_over_some_of_their_cells(finished, flight, tmp_path, monkeypatch):
    """Views and heights of every cell would fill the memory; the report shows a small picture."""
    output = shutil.copytree(finished.output, tmp_path / "out")
    settings, told = MosaicSettings(gcp=next(flight.rglob("gcp_list.txt")), jobs=2), []
    write = run_report.write_report

    def watched(target, page):
        told.append(page)
        write(target, page)

    monkeypatch.setattr(run_report, "write_report", watched)
    for most in (run_report.MOST_CELLS, 25):
        monkeypatch.setattr(run_report, "MOST_CELLS", most)
        for _ in iter_mosaic(
            flight / "photos", output, settings, overwrite=True, rerun_from="report"
        ):
            pass
    whole, some = told
    every = 1 + max(whole.views.shape) // 25
    assert 1 < every and max(some.views.shape) <= 25
    assert np.array_equal(some.views, whole.views[::every, ::every])
    assert np.array_equal(some.surface, whole.surface[::every, ::every], equal_nan=True)
    assert np.isfinite(some.surface).any() and some.views_bounds == whole.views_bounds
