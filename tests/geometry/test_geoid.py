"""The geoid against the published test values of its authors and against PROJ's interpolation."""

import struct

import numpy as np
import pytest
from pyproj import Transformer

from skyquilt.geometry.geoid import COLUMNS, ROWS, STEP_DEG, egm96_grid, geoid_height

PUBLISHED = [  # WW15MGH's README: the sample output OUTINTPT.DAT, interpolated by splines
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
]


@pytest.mark.parametrize(("latitude", "longitude", "height"), PUBLISHED)
def test_published_heights(latitude, longitude, height):
    """Lines instead of splines over 15 minutes cost up to 6 cm, an eighth of EGM96's own error."""
    assert geoid_height(latitude, longitude) == pytest.approx(height, abs=0.06)


def test_poles_extremes_and_seams():
    assert geoid_height(90.0, 12.0) == pytest.approx(13.606, abs=5e-4)
    assert geoid_height(-90.0, -77.0) == pytest.approx(-29.534, abs=5e-4)
    assert egm96_grid().min() == -106991  # south of India
    assert egm96_grid().max() == 85391  # New Guinea
    ends = geoid_height(np.array([10.0, 10, 10]), np.array([-180.0, 180, 540]))
    assert ends == pytest.approx(ends[0])
    assert geoid_height(10.0, 179.99) == pytest.approx(float(ends[0]), abs=0.02)


def test_interpolation_is_that_of_proj(tmp_path):
    """PROJ reads the same grid as a GTX file and adds it to heights."""
    file = tmp_path / "egm96.gtx"
    header = struct.pack(">ddddii", -90.0, -180.0, STEP_DEG, STEP_DEG, ROWS, COLUMNS)
    file.write_bytes(header + (egm96_grid() / 1000).astype(">f4").tobytes())
    shifted = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
        f" +step +proj=vgridshift +grids={file} +multiplier=1"
        " +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    rng = np.random.default_rng(5)
    longitude = rng.uniform(-179.9, 179.7, 3000)
    latitude = np.degrees(np.arcsin(rng.uniform(-1, 1, 3000)))
    _, _, z = shifted.transform(longitude, latitude, np.zeros(3000))
    np.testing.assert_allclose(geoid_height(latitude, longitude), z, atol=1e-4)
