"""The tests here are about what follows SIFT."""

from tests.once import pictures_seen_before  # noqa: F401 - a fixture
