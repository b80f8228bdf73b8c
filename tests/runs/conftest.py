"""A run to export from: the nine small photos of the command's tests, and heights."""

import pytest

from skyquilt.model.event import Result
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import iter_mosaic
from tests.conftest import Finished
from tests.end_to_end.conftest import flight  # noqa: F401 - a fixture


@pytest.fixture(scope="session")
def finished(flight, tmp_path_factory):  # noqa: F811
    output = tmp_path_factory.mktemp("finished") / "out"
    settings = MosaicSettings(gcp=flight / "gcp_list.txt", features=800, jobs=2)
    events = list(iter_mosaic(flight / "photos", output, settings))
    assert isinstance(events[-1], Result)
    return Finished(output=output, events=events)
