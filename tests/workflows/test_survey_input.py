from skyquilt.model.photo import Survey
from skyquilt.workflows.survey_input import SurveyInput


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


def test_titles_count_what_is_given(tmp_path):
    assert given([tmp_path, tmp_path]).title == "2 folders"
    assert given([tmp_path / "a.jpg"]).title == "1 files"
