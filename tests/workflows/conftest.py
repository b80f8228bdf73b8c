"""The tests here are about what follows SIFT."""

from tests.end_to_end.conftest import flight as small_flight  # noqa: F401 - a fixture
from tests.once import pictures_seen_before  # noqa: F401 - a fixture
