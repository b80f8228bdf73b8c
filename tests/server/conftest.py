"""A finished run, served as `skyquilt view` serves it."""

import httpx
import pytest

from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey


@pytest.fixture(scope="module")
def web(finished):
    """A client of the viewer of the session's finished run."""
    survey = open_survey(finished.output)
    serving = ServerThread(survey=survey, guard=Guard(), folder=finished.output)
    with serving, httpx.Client(base_url=serving.url, timeout=60, verify=False) as client:
        yield client
