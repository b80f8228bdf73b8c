from dataclasses import replace

import pytest

from skyquilt.errors import UsageError
from skyquilt.model.photo import Survey
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.survey_input import SurveyInput, check_input
from tests.alignment.surveys import photo


def given(source):
    return SurveyInput(source=source, survey=Survey(photos=()), control=(), distances=(), rank={})


def test_control_points_beside_or_among_what_is_given(tmp_path):
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    file = folders[0] / "gcp_list.txt"
    assert given(folders[0]).control_file(None) is None
    file.write_text("EPSG:4326\n")
    assert given(folders[0]).control_file(None) == file
    assert given(folders).control_file(None) == file
    assert given([folders[1] / "a.jpg", file]).control_file(None) == file
    assert given(folders).control_file(tmp_path / "other.txt") == tmp_path / "other.txt"
    (folders[1] / "gcp_list.txt").write_text("EPSG:4326\n")  # which one is meant?
    assert given(folders).control_file(None) is None


def test_jpeg_of_more_than_8_bits_is_refused_before_anything_is_made(tmp_path):
    jpeg, deep = MosaicSettings(compress="jpeg"), replace(photo(), dtype="uint16", channels=1)
    for photos, refused in (((deep,), True), ((deep, photo()), False)):
        there = replace(given([]), survey=Survey(photos=photos))
        if refused:
            with pytest.raises(UsageError, match="jpeg is for 8-bit pictures; .* uint16, 1 bands"):
                check_input(there, tmp_path, jpeg)
        else:  # the map is of the kind that most photos are of
            check_input(there, tmp_path, jpeg)


def test_titles_count_what_is_given(tmp_path):
    assert given([tmp_path, tmp_path]).title == "2 folders"
    assert given([tmp_path / "a.jpg"]).title == "1 files"
