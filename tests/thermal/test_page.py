"""The thermal map's section in a finished report."""

import numpy as np

from skyquilt.report.page import with_section
from skyquilt.thermal.page import thermal_section

RECORD = {
    "route": "heights",
    "routes_refused": {"rig": "no <thermal> photo was taken together"},
    "unit": "celsius",
    "photos_used": 4,
    "photos_total": 5,
    "inliers": 12,
    "residual_px": 1.5,
    "residual_m": 0.15,
    "evidence": {"surprise": 9.5, "halves_apart_m": 0.04},
}
PICTURES = [np.full((30, 40, 3), 40 * k, np.uint8) for k in range(4)]


def test_the_section_replaces_a_former_one_and_stays_inside_the_page():
    page = "<html><main>\n<section>map</section>\n</main></html>"
    section = thermal_section(RECORD, PICTURES, (8.0, 31.5))
    once = with_section(page, section)
    assert once.index("map") < once.index('id="thermal"') < once.index("</main>")
    assert once.count("data:image/jpeg") == 4
    assert "8.0 \u00b0C (dark) to 31.5 \u00b0C (bright)" in once
    assert "0.15 m, 1.50 px" in once and "4 of 5" in once
    assert "no &lt;thermal&gt; photo" in once  # words from outside are escaped
    again = with_section(once, thermal_section({**RECORD, "route": "maps"}, PICTURES, (8.0, 31.5)))
    assert again.count('id="thermal"') == 1 and "images of both maps" in again
