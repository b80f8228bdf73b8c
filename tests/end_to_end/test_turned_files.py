"""A real survey whose middle line was turned by a viewer, without any metadata."""

import shutil

import pytest

from tests.end_to_end.conftest import relabel

pytestmark = [pytest.mark.real, pytest.mark.slow]


def test_brighton_without_metadata(mosaic, survey_data, tmp_path):
    """The same six files are found as by their headings, and the focal length without its prior."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in sorted(survey_data("brighton").glob("*.JPG")):
        shutil.copy(path, folder)
        relabel(folder / path.name, strip=True)
    m = mosaic(folder, "--surface", "ties", "--gsd", "10").made().metrics
    told = [note for note in m["notes"] if "turned upside down" in note]
    assert len(told) == 1 and told[0].startswith("6 files")
    assert all(f"DJI_00{i}.JPG" in told[0] for i in range(24, 30))
    focal = next(iter(m["cameras"].values()))["focal"]
    assert focal["value"] == pytest.approx(2290, rel=0.08)  # 2706 px if they are not found
