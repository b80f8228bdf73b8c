"""Make a map from a folder of photos, and print the workflow's events as they occur.

python examples/01_folder_to_cog.py PHOTOS OUT [GSD_CM]
"""

import sys
from pathlib import Path

import rasterio

import skyquilt
from skyquilt.model.event import Note, StageFinished


def main(photos: Path, output: Path, gsd_cm: float | None = None) -> None:
    settings = skyquilt.MosaicSettings(gsd_cm=gsd_cm, blend="feather")
    for event in skyquilt.iter_mosaic(photos, output, settings):
        if isinstance(event, Note):
            print(f"  {event.text}")
        elif isinstance(event, StageFinished):
            print(
                f"{event.stage}: {event.seconds:.1f}"
                f" s{' (from an earlier run)' if event.reused else ''}"
            )
        elif isinstance(event, skyquilt.Result):
            figures = event.metrics
            print(
                f"{figures['photos_used']} of {figures['photos_total']} photos by"
                f" {figures['method']}:"
            )
            print(f"  {figures['why']}")
            for conflict in figures["metadata_conflicts"]:
                print(f"  {conflict['photo']}: {conflict['meaning']}")
    with rasterio.open(output / "mosaic.tif") as mosaic:
        print(f"{mosaic.width} x {mosaic.height} px, {mosaic.crs}, overviews {mosaic.overviews(1)}")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        main(
            Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) == 4 else None
        )
    except skyquilt.SkyquiltError as error:  # everything a user can mend
        sys.exit(str(error))
