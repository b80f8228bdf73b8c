"""A thermal camera beside a visible one: two layers over one ground."""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from PIL import Image

from skyquilt.live.ledger import Ledger
from skyquilt.live.settings import LiveSettings
from skyquilt.live.thermal_notes import ThermalNotes
from skyquilt.live.tile_drawing import layer_of
from skyquilt.raster.map_source import TileSource
from skyquilt.raster.tile_store import TileStore
from skyquilt.server.survey import LiveSurvey
from tests.live.conftest import served
from tests.live.test_http import middle, tile_of
from tests.ortho.test_palettes import frames, photo


@pytest.mark.slow
def test_two_spectra_are_two_layers_and_temperatures_stay_temperatures(both, tmp_path):
    frames = sorted((both.folder / "thermal").glob("*.tif"))
    assert len(frames) >= 4
    with served(tmp_path / "out", LiveSettings(features=800)) as site:
        for pair in zip(both.photos, frames, strict=False):
            for path in pair:  # by turns
                assert site.send(path).is_success
        site.until(lambda: all(p["ring"] for p in site.web.get("/photos").json()["photos"]))
        live = site.live
        site.until(lambda: not live.queues.untried and not live.redraw.dirty)
        names = [n["name"] for n in site.web.get("/info").json()["layers"]]
        assert names[0] == "visible"
        assert "thermal" in names
        linked = live.ledger.rows("select a, b from link where body is not null")
        band = {m.id: m.photo.band for m in live.members.by_id.values()}
        assert linked
        assert all(band[a] == band[b] for a, b in linked)
        x, y = tile_of(*middle(site), 19)
        answer = site.web.get(f"/tiles/19/{x}/{y}", params={"layer": "thermal"})
        with Image.open(io.BytesIO(answer.content)) as image:
            assert np.asarray(image.convert("RGBA"))[..., 3].max() == 255
        swiped = site.web.get(f"/tiles/19/{x}/{y}", params={"layer": "visible"})
        assert swiped.content != answer.content
        measured(live, both)


def measured(live, both):
    """Temperatures of the map against the simulator's, where both know them."""
    frame = live.members.frame
    source = TileSource(
        tiles=live.tiles, layer="thermal", crs=frame.crs, origin=frame.origin, gsd=live.canvas.gsd
    )
    part = source.part(source.bounds(), live.canvas.gsd)
    assert part.pixels.dtype == np.float32
    rows, columns = np.nonzero(part.shown)
    chosen = np.random.default_rng(0).choice(len(rows), 4000)
    rows, columns = rows[chosen], columns[chosen]
    x, y = part.west + (columns + 0.5) * part.gsd, part.north - (rows + 0.5) * part.gsd
    with rasterio.open(both.folder / "truth" / "truth_thermal.tif") as truth:
        true = (
            np.array(list(truth.sample(zip(x, y, strict=True))))[:, 0].astype(float) / 100 - 273.15
        )
    known = true > -100
    assert known.mean() > 0.5
    seen = part.pixels[rows, columns, 0].astype(float)
    off = seen[known] - true[known]
    # places are off by the positions' 2 m, frames by 0.2 K: over fields, half of all points hardly
    # notice
    assert abs(np.median(off)) < 0.4
    assert np.corrcoef(seen[known], true[known])[0, 1] > 0.6


@pytest.mark.parametrize(
    "band, unit, layer",
    [
        ("visible", "", "visible"),
        ("thermal", "celsius", "thermal"),
        ("thermal", "counts", "thermal-counts"),
        ("thermal", "", "thermal-colours"),
    ],
)
def test_no_layer_joins_degrees_counts_and_colours(band, unit, layer, tmp_path):
    """Each has its own unit on the page, and colours have none: they are no measurements."""
    member = SimpleNamespace(photo=SimpleNamespace(band=band, unit=unit))
    assert layer_of(member) == layer
    Ledger(tmp_path, write=True).close()
    TileStore(tmp_path / "tiles.db", write=True).close()
    survey = LiveSurvey(tmp_path)
    for name in (layer, f"{layer}-newest"):
        assert survey.unit(name) == {"celsius": "°C", "counts": "counts"}.get(unit, "")
        assert survey.styles()[name].measured == bool(unit)


def test_measured_frames_have_no_palettes_to_tell_of(tmp_path):
    """A flight of radiometric photos alone: each had been refused, from the second on."""
    ledger = Ledger(tmp_path, write=True)
    members = SimpleNamespace(by_id={}, ledger=ledger)
    notes = ThermalNotes(SimpleNamespace(members=members, thumbnail={}.__getitem__))
    for k in range(3):
        one = replace(photo(), name=f"{k}.jpg", unit="celsius")
        members.by_id[k] = SimpleNamespace(id=k, photo=one, tried=k + 1, state="refined")
        notes.look(members.by_id[k])
    assert not ledger.rows("select body from event")
    ledger.close()


def test_palettes_and_units_are_told_once_each(tmp_path):
    """With the sentences of whole flights, as photos come one by one, and not again after a
    restart.
    """
    small = frames(["iron"] * 8 + ["rainbow"] * 4)
    known = [replace(photo(), name=f"{k:02d}.jpg", dtype="uint8") for k in range(12)]
    counts = [replace(known[0], name=f"{k}.tif", dtype="uint16", unit="counts") for k in range(3)]
    ledger = Ledger(tmp_path, write=True)
    members = SimpleNamespace(by_id={}, ledger=ledger)
    links = SimpleNamespace(members=members, thumbnail=small.__getitem__)
    notes = ThermalNotes(links)
    for k, one in enumerate([*known, *[replace(p, stored="counts") for p in counts]]):
        if k == 10:
            notes = ThermalNotes(links)
        member = SimpleNamespace(id=k, photo=one, tried=k + 1, state="refined")
        members.by_id[k] = member
        notes.look(member)
    told = [json.loads(b)["text"] for (b,) in ledger.rows("select body from event")]
    ledger.close()
    assert len(told) == 3, told
    assert "So far: 2 thermal photos hold a palette's colours" in told[0]
    assert "2 different palettes" in told[1]
    assert "Thermal TIFFs are read as counts" in told[2]
    visible = SimpleNamespace(id=99, photo=photo("visible"), tried=1, state="refined")
    notes.look(visible)  # nothing to tell, and the ledger is closed
