"""What `import skyquilt` promises."""

import subprocess
import sys

import pytest

import skyquilt


def test_every_public_name_is_there_and_listed():
    for name in skyquilt.__all__:
        assert getattr(skyquilt, name) is not None
        assert name in dir(skyquilt)


def test_there_are_thirteen_and_nothing_else_is_shown():
    assert len(skyquilt.__all__) == 13
    shown = [n for n in dir(skyquilt) if not n.startswith("__")]
    assert shown == skyquilt.__all__
    assert sorted(skyquilt.__all__) == skyquilt.__all__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'moasic'"):
        _ = skyquilt.moasic


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import sys, skyquilt; print(*(m for m in ('numpy', 'cv2', 'scipy', 'rasterio') if m in"
        " sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == ""


def test_the_commands_are_listed_without_loading_numpy():
    """`skyquilt --help` and `--version` answer at once: each command imports its work when run."""
    code = (
        "import sys, skyquilt.cli.app;"
        " print(*(m for m in ('numpy', 'cv2', 'rich.table', 'pydantic') if m in sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == ""


def test_a_small_survey_waits_for_nothing_it_does_not_need():
    """SciPy alone takes a third of a second to load: large surveys ask for it, small ones do not
    wait for it.
    """
    code = (
        "import sys, skyquilt.workflows.mosaic as m; from skyquilt.workflows.methods import *;"
        " methods_for(MosaicSettings());"
        "print(*(m for m in ('scipy', 'rasterio', 'shapely', 'tifffile') if m in sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == ""


@pytest.mark.slow
def test_a_mosaic_imports_nothing_of_the_papers_nor_of_viewer_and_exports():
    """Not even while it runs: their methods are named by strings, from above."""
    code = (
        "import sys, tempfile, pathlib, skyquilt, skyquilt.simulate as s;"
        "from skyquilt.simulate.settings import Route;"
        "from skyquilt.simulate.camera import Lens;"
        "home = pathlib.Path(tempfile.mkdtemp());"
        "flight = s.FlightSettings(lens=Lens().scaled(320, 240), route=Route(photos=3));"
        "list(s.simulate(flight, home / 'f'));"
        "skyquilt.mosaic(home / 'f' / 'photos', home / 'o', skyquilt.MosaicSettings(gsd_cm=50));"
        "above = ('skyquilt.papers', 'skyquilt.runs', 'skyquilt.server', 'fastapi', 'xarray');"
        "above = (*above, 'distributed');"
        "print(*(m for m in sys.modules if m.startswith(above)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == ""
