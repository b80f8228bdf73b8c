"""run.toml says what was asked for, in valid TOML, whatever the folder is called."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt import __version__
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.run_files import source_commit, write_run


def written(folder, settings, photos="photos"):
    write_run(folder / "run.toml", settings.as_table(), photos, "0" * 40, "bundle")
    return tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))


def test_defaults(tmp_path):
    found = written(tmp_path, MosaicSettings())
    assert found["version"] == __version__
    assert found["method_used"] == "bundle"
    assert found["settings"]["method"] == "auto"
    assert found["settings"]["feather_px"] == 6.0
    assert "gsd_cm" not in found["settings"]


def test_every_setting_comes_back(tmp_path):
    asked = MosaicSettings(
        method="auto",
        gsd_cm=2.5,
        crs="EPSG:32633",
        gcp=Path("a b/gcp_list.txt"),
        geo=Path("geo.txt"),
        cameras=Path("cameras.json"),
        bounds=(1.5, 2.0, 3.0, 4.0),
        boundary=Path("c.geojson"),
        surface="ties",
        blend="multiband",
        balance=False,
        compress="jpeg",
        quality=70,
        distortion="6t",
        height_m=60.0,
        repair=False,
        features=4000,
        jobs=2,
        memory_gb=4.0,
    )
    found = written(tmp_path, asked)["settings"]
    assert found == {k: list(v) if isinstance(v, tuple) else v for k, v in asked.as_table().items()}
    assert found["bounds"] == [1.5, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    "name",
    ["C:\\photos\\new", 'a "quoted" one', "línea", "\u822a\u7a7a", "\U0001f681 flight", "a\tb\x7f"],
)
def test_any_name_of_a_folder(tmp_path, name):
    assert written(tmp_path, MosaicSettings(), name)["photos"] == name


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=30))
def test_any_text(tmp_path_factory, name):
    assert written(tmp_path_factory.getbasetemp(), MosaicSettings(), name)["photos"] == name


def test_a_name_that_is_no_text(tmp_path):
    assert written(tmp_path, MosaicSettings(), "a\udcffb")["photos"] == "a?b"


def test_the_commit_is_one_or_unknown():
    commit = source_commit()
    assert commit is None or len(commit) == 40
