"""What the bands add to a finished run: figures, and a section of the report with pictures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from skyquilt.coregistration.page import picture
from skyquilt.model.photo import RejectedPhoto
from skyquilt.multispectral.composite import INFRARED, composed, ends_of, reduced
from skyquilt.multispectral.draw import BANDS_FILE, PlacedBand
from skyquilt.multispectral.indices import INDICES, Index, indices_of
from skyquilt.multispectral.placing import Placing
from skyquilt.photos.left_out import told_left_out
from skyquilt.raster.colours import coloured
from skyquilt.report.numbers import DASH, fixed, number, plain
from skyquilt.report.page import add_section
from skyquilt.report.parts import Block, Section, Sentences, Table

LONGEST = 1000
"""Longer side in px of pictures in the page."""
_VALUES = {
    "reflectance": "Values are reflectances, 0 to 1, by the camera's calibration and its sun"
    " sensor, or a panel.",
    "relative": "Values are proportional to reflectance, with one factor for all bands, by the"
    " camera's calibration and its sun sensor.",
    "by-band": "Values are proportional to reflectance, with a factor of each band's own that files"
    " do not tell: indices compare places of this map, not this map with others.",
    "radiance": "Values are proportional to the light that came from the ground: the files tell no"
    " usable irradiance, so indices depend on the light of the day.",
    "counts": "Values are counts as recorded: the files do not tell how they came about, so indices"
    " are not comparable with those of other maps.",
}
_COMPOSITES = (
    (
        INFRARED,
        "Colour infrared",
        "Near infrared, red and green as red, green and blue: plants are red.",
    ),
    (("red", "green", "blue"), "Colours", "Red, green and blue bands, each stretched."),
)


def band_figures(
    bands: Sequence[PlacedBand], placed: Placing, lost: Sequence[RejectedPhoto]
) -> dict[str, Any]:
    """The entry `bands` of metrics.json."""
    return {
        "values": placed.kind,
        "shown": [_figures(b) for b in bands],
        "refused": placed.refused,
        "indices": [index.name for index in indices_of([b.files.name for b in bands])],
        "photos_rejected": {p.name: p.reason for p in lost},
        "notes": [
            *placed.notes[len(placed.refused) :],
            *([placed.panel.text] if placed.panel else []),
            *sorted({n for b in bands for c in b.files.converts for n in c.notes}),
        ],
    }


def _figures(band: PlacedBand) -> dict[str, Any]:
    """Figures of one band; those of the camera are null where it is the map's own. Of several
    cameras, rotation and focal length are those of the first, the others those of the worst.
    """
    files, rigs = band.files, list(dict.fromkeys(band.rigs.values()))
    saved = {
        "name": files.name,
        "wavelength_nm": files.wavelength_nm,
        "unit": files.photos[0].unit,
        "photos": len(band.of_photo),
        "photos_total": len(files.photos),
        "saturated": round(band.saturated, 4),
        "detail": None if band.detail is None else round(band.detail, 3),
        "cameras": max(len(rigs), 1),
    }
    if not rigs:
        of_camera = ("band_R_map_photo", "beside_m", "delay_s", "focal_px", "off_px", "agree")
        return saved | dict.fromkeys(of_camera)
    off = max(r.off_px for r in rigs)
    return {
        **saved,
        "band_R_map_photo": rigs[0].b_R_a.tolist(),
        "beside_m": rigs[0].a_t_b.round(4).tolist(),
        "delay_s": round(rigs[0].delay_s, 3),
        "focal_px": round(rigs[0].camera.focal, 2),
        "off_px": round(off, 3) if np.isfinite(off) else None,
        "agree": round(min(r.share for r in rigs), 3),
    }


def write_section(output: Path, record: Mapping[str, Any]) -> None:
    """Adds a section to the report, from the entry `bands` of metrics.json."""
    add_section(output, bands_section(record, pictures_of(output) if record["shown"] else []))


def pictures_of(output: Path) -> list[tuple[NDArray[np.uint8], str, str]]:
    """RGB (h, w, 3), title and caption of each picture in the page."""
    found = []
    with rasterio.open(output / BANDS_FILE) as source:
        names = [name or "" for name in source.descriptions]
        small = reduced(source, LONGEST)
    for wanted, title, caption in _COMPOSITES:
        if set(wanted) <= set(names):
            found.append((_composite([small[names.index(n)] for n in wanted]), title, caption))
    for index in INDICES:
        if {index.a, index.b} <= set(names):
            values = index(small[names.index(index.a)], small[names.index(index.b)])
            found.append(_index_picture(values, index))
    return found


def _composite(bands: Sequence[NDArray[np.float32]]) -> NDArray[np.uint8]:
    rgb, known = composed(bands, [ends_of(values) for values in bands])
    rgb[~known] = 255
    return rgb


def _index_picture(values: NDArray[np.float32], index: Index) -> tuple[NDArray[np.uint8], str, str]:
    known = np.isfinite(values)
    low, high = np.percentile(values[known], [2, 98]) if known.any() else (-1.0, 1.0)
    rgb = coloured(np.nan_to_num(values)[..., None], (float(low), float(high)), "plants")
    rgb[~known] = 255
    bright, dark = index.a, index.b
    return (
        np.ascontiguousarray(rgb),
        index.title,
        f"({bright} - {dark}) / ({bright} + {dark}), {fixed(low, 2)} (brown) to {fixed(high, 2)}"
        " (green).",
    )


def bands_section(
    record: Mapping[str, Any], pictures: Sequence[tuple[NDArray[np.uint8], str, str]]
) -> Section:
    """The section from the entry `bands` of metrics.json, and its pictures."""
    blocks: list[Block] = [_table(record["shown"])] if record["shown"] else []
    blocks += [picture(*p) for p in pictures]
    said = [f"The band {n} is left out: {why}." for n, why in record["refused"].items()]
    files = [RejectedPhoto(name=n, reason=why) for n, why in record["photos_rejected"].items()]
    said += [f"{sentence}." for sentence in told_left_out(files)]
    said += record["notes"]
    if said:
        blocks.append(Sentences(items=tuple(said)))
    return Section(
        id="bands",
        title="Bands",
        lead=_VALUES[str(record["values"])] if record["shown"] else "No band lies on the map.",
        blocks=tuple(blocks),
    )


def _table(shown: Sequence[Mapping[str, Any]]) -> Table:
    def cell(value: Any, digits: int) -> str:
        return DASH if number(value) is None else fixed(value, digits)

    rows = tuple(
        (
            plain(b["name"]),
            cell(b["wavelength_nm"], 0),
            f"{b['photos']} of {b['photos_total']}",
            cell(b["off_px"], 2),
            cell(None if b["agree"] is None else 100 * b["agree"], 0),
            cell(None if b["detail"] is None else 100 * b["detail"], 0),
        )
        for b in shown
    )
    return Table(
        title="Bands of bands.tif",
        head=("band", "wavelength, nm", "photos", "off, px", "patches that agree, %", "detail, %"),
        rows=rows,
        numeric="tntnnn",
        note="Off: median distance of patches of half of the captures from where the camera found"
        " from the other half has them, scatter of the matches included. A dash: the map's own"
        " band. Detail: fine detail of its files over that of the middle one of all bands.",
    )
