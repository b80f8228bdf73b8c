"""All bands of a simulated rig on the grid of its map."""

import shutil

import numpy as np
import pytest
import rasterio
from benchmarks.multispectral import judged

from skyquilt.cli.mosaic import with_bands
from skyquilt.errors import UsageError
from skyquilt.model.event import Note, Result, StageStarted
from skyquilt.multispectral import placing, workflow
from skyquilt.multispectral.workflow import iter_bands
from skyquilt.runs.layers import layers_in
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Multispectral, Reporting, Route
from tests.once import flown_once

SETTINGS = MosaicSettings(gsd_cm=15, jobs=2)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def few_pairs():
    """So that cameras are found sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(placing, "MOST_PAIRS", 3)
        yield


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Nine captures of five bands, beside photos in colours."""
    settings = FlightSettings(
        seed=5,
        lens=Lens().scaled(800, 600),
        route=Route(photos=9),
        reporting=Reporting(rtk=True, gps_noise=0.02),
        control=Control(points=0),
        multispectral=Multispectral(width=480, height=360),
    )
    return flown_once(tmp_path_factory, "multispectral", settings)


@pytest.fixture(scope="module")
def bare(flown):
    """The files of the bands."""
    return flown / "multispectral"


@pytest.fixture(scope="module")
def output(bare, tmp_path_factory):
    """Bands beside a map of the green band."""
    output = tmp_path_factory.mktemp("bands") / "out"
    *_, last = iter_bands(bare, output, SETTINGS)
    assert isinstance(last, Result)
    return output


def values_in(output):
    with rasterio.open(output / "bands.tif") as source:
        return dict(zip(source.descriptions, source.read(), strict=True))


def test_all_bands_lie_on_the_map(bare, output):
    assert {"mosaic", "infrared", "ndvi", "ndre", "gndvi"} <= set(layers_in(output))
    with rasterio.open(output / "bands.tif") as b, rasterio.open(output / "mosaic.tif") as m:
        assert b.descriptions == ("blue", "green", "red", "red edge", "nir")
        assert (b.transform, b.shape, b.crs) == (m.transform, m.shape, m.crs)
        assert b.tags()["VALUES"] == "relative"
        shown = m.dataset_mask() > 0
    values = values_in(output)
    assert (np.isfinite(values["green"]) == shown).mean() > 0.999
    for name, band in values.items():
        assert np.isfinite(band[shown]).mean() > 0.93, name


def test_the_infrared_picture_is_of_three_bands(output):
    """Brighter where a band is, black and white at its ends, and where all three are known."""
    values = values_in(output)
    with rasterio.open(output / "infrared.tif") as source:
        picture, shown = source.read(), source.dataset_mask() > 0
    bands = np.stack([values[name] for name in ("nir", "red", "green")])
    known = np.isfinite(bands).all(0)
    assert (known == shown).all()
    for band, colour in zip(bands, picture, strict=True):
        low, high = np.percentile(band[known], [2, 98])
        assert colour[known & (band <= low)].mean() < 40
        assert colour[known & (band >= high)].mean() > 240
        order = np.corrcoef(band[known] ** (1 / 1.8), colour[known])[0, 1]
        assert order > 0.97


def test_bands_are_those_of_the_truth(flown, output):
    """Exposure times, gains and the light of the day differ, and each camera looks elsewhere."""
    told = judged(output, flown)
    assert told["beside green, median"] < 0.25 and told["90 %"] < 0.6
    assert told["factors differ by"] < 0.03
    assert told["NDVI off, median"] < 0.02 and told["NDVI off, 90 %"] < 0.06


def test_indices_are_those_of_the_bands(output):
    values = values_in(output)
    with rasterio.open(output / "ndvi.tif") as source:
        ndvi = source.read(1)
    a, b = values["nir"], values["red"]
    known = np.isfinite(ndvi)
    np.testing.assert_allclose(ndvi[known], ((a - b) / (a + b))[known], atol=1e-6)
    assert known[np.isfinite(a + b)].mean() > 0.99
    assert np.abs(ndvi[known]).max() <= 1
    low, high = np.percentile(ndvi[known], [10, 90])
    assert high - low > 0.3  # fields and roads


def test_figures_and_report(bare, output):
    *_, last = iter_bands(bare, output, SETTINGS)
    told = last.metrics["bands"]
    assert [b["photos"] for b in told["shown"]] == [9] * 5 and told["refused"] == {}
    assert told["indices"] == ["ndvi", "ndre", "gndvi"] and told["values"] == "relative"
    own = [b["name"] for b in told["shown"] if b["off_px"] is None]
    assert own == ["green"]
    assert all(b["off_px"] < 0.4 for b in told["shown"] if b["off_px"] is not None)
    assert last.metrics["photos_total"] == 9  # files of other bands are drawn, not left out
    page = (output / "report.html").read_text(encoding="utf-8")
    assert "Bands of bands.tif" in page and "Colour infrared" in page and page.count("NDVI") > 1


def test_the_summary_names_the_files(bare, output):
    *_, last = iter_bands(bare, output, SETTINGS)
    assert with_bands(last).splitlines()[-1] == (
        f"bands:  {output / 'bands.tif'} (blue, green, red, red edge, nir; values: relative),"
        " ndvi.tif, ndre.tif, gndvi.tif, infrared.tif"
    )


def test_the_same_command_does_nothing_or_mends(bare, output):
    events = list(iter_bands(bare, output, SETTINGS))
    texts = [e.text for e in events if isinstance(e, Note)]
    assert f"{output} already contains these bands; nothing to do" in texts
    assert not any(isinstance(e, StageStarted) and e.stage == "bands" for e in events)
    whole = (output / "ndvi.tif").read_bytes()
    (output / "ndvi.tif").write_bytes(whole[: len(whole) // 2])
    events = list(iter_bands(bare, output, SETTINGS))
    assert any(isinstance(e, StageStarted) and e.stage == "bands" for e in events)
    assert (output / "ndvi.tif").read_bytes() == whole


def test_photos_in_colours_are_the_map_where_there_are_any(flown, bare, tmp_path):
    shutil.copytree(bare, tmp_path / "photos")
    shutil.copytree(flown / "photos", tmp_path / "photos", dirs_exist_ok=True)
    (tmp_path / "photos" / "SIM_0009.jpg").unlink()
    *before, last = iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
    with rasterio.open(tmp_path / "out" / "mosaic.tif") as source:
        assert source.count == 3
    told = last.metrics["bands"]["shown"]
    assert [b["name"] for b in told] == ["blue", "green", "red", "red edge", "nir"]
    assert all(b["off_px"] is not None and b["photos"] == 8 for b in told)
    alone = last.metrics["bands"]["photos_rejected"]
    assert len(alone) == 5 and all(name.startswith("SIM_0009_MS_") for name in alone)
    assert set(alone.values()) == {"no photo of the map was taken together with it"}
    assert any(isinstance(e, Note) and "5 files are left out" in e.text for e in before)
    told = judged(tmp_path / "out", flown)
    assert told["beside green, median"] < 0.25 and told["factors differ by"] < 0.03


def test_a_lost_file_and_a_band_of_other_ground_are_left_out(bare, tmp_path, monkeypatch):
    shutil.copytree(bare, tmp_path / "photos")
    """A file of the map's own band, too, without which all values were raw counts."""
    gone, drawing = tmp_path / "photos" / "SIM_0005_MS_NIR.TIF", workflow._drawing
    own, sorted_out = tmp_path / "photos" / "SIM_0002_MS_G.TIF", placing.bands_of_files

    def drawn(*arguments):
        gone.unlink(missing_ok=True)
        return drawing(*arguments)

    def begun(*arguments):
        own.unlink(missing_ok=True)
        return sorted_out(*arguments)

    monkeypatch.setattr(workflow, "_drawing", drawn)
    monkeypatch.setattr(placing, "bands_of_files", begun)
    for seed, path in enumerate(sorted((tmp_path / "photos").glob("*_MS_B.TIF"))):
        raw = bytearray(path.read_bytes())
        noise = np.random.default_rng(seed).integers(4000, 9000, 480 * 360, dtype=np.uint16)
        raw[-2 * noise.size :] = noise.tobytes()
        path.write_bytes(raw)
    *before, last = iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
    texts = [e.text for e in before if isinstance(e, Note)]
    told = last.metrics["bands"]
    assert list(told["refused"]) == ["blue"]
    assert any("The band blue is left out" in text for text in texts)
    assert [b["name"] for b in told["shown"]] == ["green", "red", "red edge", "nir"]
    assert [b["photos"] for b in told["shown"]] == [8, 9, 9, 8] and told["values"] == "relative"
    assert told["photos_rejected"] == dict.fromkeys((own.name, gone.name), "its file is gone")
    assert f"{own.name} is left out: its file is gone" in texts and not told["key"]
    assert "SIM_0005_MS_NIR.TIF is left out: its file is gone" in texts


def test_two_drones_and_black_files(flown, bare, tmp_path):
    """Files of the last captures say that another camera took them; two files are black. Values
    stay those of the truth.
    """
    shutil.copytree(bare, tmp_path / "photos")
    for path in sorted((tmp_path / "photos").iterdir()):
        raw = path.read_bytes()
        if path.name >= "SIM_0006":
            assert raw.count(b"MSP001") == 1
            raw = raw.replace(b"MSP001", b"MSP002")
        if path.name in ("SIM_0003_MS_NIR.TIF", "SIM_0007_MS_R.TIF"):
            raw = raw[: -2 * 480 * 360] + np.full(480 * 360, 3200, np.uint16).tobytes()
        path.write_bytes(raw)
    *before, last = iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
    told = last.metrics["bands"]
    assert told["refused"] == {}
    assert [b["photos"] for b in told["shown"]] == [9, 9, 8, 9, 8]
    assert [b["cameras"] for b in told["shown"]] == [2, 1, 2, 2, 2]
    assert sorted(told["photos_rejected"]) == ["SIM_0003_MS_NIR.TIF", "SIM_0007_MS_R.TIF"]
    texts = [e.text for e in before if isinstance(e, Note)]
    assert any("2 files are left out, SIM_0007_MS_R.TIF for one: all its" in t for t in texts)
    judgement = judged(tmp_path / "out", flown)
    assert judgement["beside green, median"] < 0.25 and judgement["factors differ by"] < 0.04
    assert judgement["NDVI off, median"] < 0.02
    again = [
        e.text
        for e in iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
        if isinstance(e, Note)
    ]
    assert any("already contains these bands" in text for text in again)


def test_a_band_of_other_captures_is_left_out(bare, tmp_path):
    """None of its files was taken together with one of the map's."""
    shutil.copytree(bare, tmp_path / "photos")
    for path in (tmp_path / "photos").glob("*_MS_B.TIF"):
        raw = path.read_bytes().replace(b"2024:07:15", b"2023:07:15")
        assert raw.count(b'CaptureUUID="0') == 1
        path.write_bytes(raw.replace(b'CaptureUUID="0', b'CaptureUUID="9'))
        path.rename(path.with_name(path.name.replace("SIM_00", "SIM_11")))
    *before, last = iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
    told = last.metrics["bands"]
    assert list(told["refused"]) == ["blue"]
    assert told["refused"]["blue"].startswith("0 of its photos were taken together with one")
    assert [b["name"] for b in told["shown"]] == ["green", "red", "red edge", "nir"]


def test_where_no_band_lies_on_the_map_it_is_finished_and_told(flown, bare, tmp_path):
    """Photos in colours, and two files of a band, which are too few to find its camera."""
    shutil.copytree(flown / "photos", tmp_path / "photos")
    for path in sorted(bare.glob("*_MS_NIR.TIF"))[:2]:
        shutil.copy(path, tmp_path / "photos")
    (tmp_path / "out").mkdir()
    *before, last = iter_bands(tmp_path / "photos", tmp_path / "out", SETTINGS)
    texts = [e.text for e in before if isinstance(e, Note) and e.warning]
    assert "No band lies on the map, so there is no bands.tif." in texts
    assert last.metrics["bands"]["shown"] == [] and "nir" in last.metrics["bands"]["refused"]
    assert (tmp_path / "out" / "mosaic.tif").exists()
    assert not (tmp_path / "out" / "bands.tif").exists()
    assert "No band lies on the map." in (tmp_path / "out" / "report.html").read_text("utf-8")
    assert with_bands(last).endswith("bands:  none")


def test_photos_without_bands_are_refused(flown, tmp_path):
    with pytest.raises(UsageError, match="--all-bands needs files that each show one band"):
        list(iter_bands(flown / "photos", tmp_path / "out", SETTINGS))
    assert not (tmp_path / "out" / "mosaic.tif").exists()
