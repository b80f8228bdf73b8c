"""Measure the error of a map against the true orthophoto of a simulated flight, or against any more
accurate map.

python examples/04_map_against_truth.py MOSAIC.tif TRUTH.tif
"""

import sys
from pathlib import Path

from skyquilt.quality.map_error import map_error


def main(mosaic: Path, truth: Path) -> None:
    found = map_error(mosaic, truth)
    if found.absolute is None or found.relative is None:
        sys.exit(f"none of {found.attempted} places could be found again")
    print(f"against the truth, at {found.measured} of {found.attempted} places:")
    print(
        f"  the map as a whole lies {found.bias_x_m:+.2f} m east and {found.bias_y_m:+.2f} m north"
        " of it,"
    )
    print("  which is what the photos' positions have in common (control points take it away)")
    print(
        f"  within the map: median {found.relative.median_m:.2f} m, 95 % below"
        f" {found.relative.p95_m:.2f} m"
    )


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
