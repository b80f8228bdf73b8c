import pytest

from skyquilt.errors import UsageError
from skyquilt.live.settings import LiveSettings


@pytest.mark.parametrize("crs", ["zzz", "", "nan", "EPSG:99999", "\x01"])
def test_an_unknown_system_is_refused_before_photos_are(crs):
    with pytest.raises(UsageError, match="--crs"):
        LiveSettings(crs=crs)


def test_a_known_system_is_taken():
    assert LiveSettings(crs="EPSG:32633").crs == "EPSG:32633"
