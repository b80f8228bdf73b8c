"""Photos that a batch map leaves out are no part of a live map either."""

import io

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.live import final_map
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from tests.photos.conftest import jpeg_bytes, pixels

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
    ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
    ' xmlns:Camera="http://pix4d.com/camera/1.0/" Camera:BandName="{}"/></rdf:RDF></x:xmpmeta>'
)


def bands(count):
    """Three bands of each shot, in the order in which cameras write them."""
    for shot in range(count):
        for band, name in enumerate(("Blue", "Green", "NIR")):
            grey = pixels(seed=shot)[..., band]
            yield f"{shot}_{band}.jpg", jpeg_bytes(grey, xmp=XMP.format(name))


def states(live):
    return dict(live.ledger.rows("select name, state from photo order by id"))


def worked(live, files):
    """States of all photos after the map has worked on these, too."""
    for name, content in files:
        assert live.intake.take([content], name, "drone")
    for _ in live.drain():
        pass
    return states(live)


@pytest.mark.parametrize(("asked", "shown"), [(None, 0), ("NIR", 2)])
def test_one_band_of_a_multispectral_camera_is_mapped(tmp_path, asked, shown):
    for part in range(2):  # the second time it is continued
        live = LiveMap(tmp_path / "out", LiveSettings(band=asked))
        told = {n: live.intake.take([b], n, "drone") for n, b in bands(2 + part)}
        found = states(live)
        live.close()
    assert {n for n, s in found.items() if s != "kept"} == {f"{k}_{shown}.jpg" for k in range(3)}
    own, other = ("blue", "nir")[:: 1 - shown]
    assert told[f"2_{2 - shown}.jpg"].kept == (
        f"it shows the band {other}; the map shows the band {own} (--band), and the final map may"
        " use it"
    )


def test_photos_in_colours_are_mapped_whatever_band_came_first(tmp_path, monkeypatch):
    """As drones write them that have a camera in colours beside those of the bands. The final map
    takes all.
    """
    live = LiveMap(tmp_path / "out", LiveSettings())
    assert worked(live, bands(1)) == {"0_0.jpg": "waiting", "0_1.jpg": "kept", "0_2.jpg": "kept"}
    found = worked(live, [("colour.jpg", jpeg_bytes(pixels(seed=99)))])
    assert found == {n: "kept" for n, _ in bands(1)} | {"colour.jpg": "waiting"}
    live.close()
    live = LiveMap(tmp_path / "out", LiveSettings())  # continued
    assert [m.photo.name for m in live.members.by_id.values()] == ["colour.jpg"]
    told = live.ledger.rows("select body from event where kind = 'note' and body like '%again%'")
    assert len(told) == 1 and "begun again with the photos in colours" in told[0][0]
    live.close()
    seen = []
    monkeypatch.setattr(final_map, "iter_bands", lambda paths, *_, **__: seen.extend(paths) or ())
    list(final_map.iter_finish(live.folder, live.settings))
    assert {p.name for p in seen} == set(found)


def test_the_band_of_most_files_is_mapped_whatever_came_first(tmp_path):
    """A band file that was left on the card. A file that is written anew replaces the former, of a
    band that the map does not show, too.
    """
    live = LiveMap(tmp_path / "out", LiveSettings())
    files = dict(bands(4))
    worked(live, [(n, files[n]) for n in ("0_2.jpg", "0_0.jpg", "0_1.jpg", "1_0.jpg")])
    found = worked(live, [("2_0.jpg", files["2_0.jpg"])])
    assert [n for n, s in found.items() if s == "waiting"] == ["0_0.jpg", "1_0.jpg", "2_0.jpg"]
    assert found["0_2.jpg"] == found["0_1.jpg"] == "kept"
    live.close()


def test_a_kept_file_that_is_written_anew_replaces_the_former(flight, tmp_path):
    live = LiveMap(tmp_path / "out", LiveSettings(band="red"))
    with Image.open(flight.photos[1]) as photo:
        exif, grey = piexif.load(photo.info["exif"]), np.array(photo.convert("L"))
    for k in range(2):
        file = jpeg_bytes(grey + np.uint8(k), exif=exif, xmp=XMP.format("NIR"))
        assert live.intake.take([file], "a.jpg", "drone").kept
    assert live.ledger.rows("select state from photo order by id") == [("superseded",), ("kept",)]
    live.close()


@pytest.mark.slow
@pytest.mark.parametrize("tone", [3, 252])
def test_a_photo_of_one_tone_is_no_part_of_the_map(flight, tmp_path, tone):
    """A lens cap with a position would be drawn as a hole in the map."""
    with Image.open(flight.photos[1]) as photo:
        exif, size = photo.info["exif"], photo.size
    noise = np.random.default_rng(0).integers(-2, 3, (size[1], size[0], 3))
    file = io.BytesIO()
    Image.fromarray((tone + noise).astype(np.uint8)).save(file, "JPEG", exif=exif)
    (tmp_path / "cap.jpg").write_bytes(file.getvalue())
    live = LiveMap(tmp_path / "out", LiveSettings())
    for path in (flight.photos[0], tmp_path / "cap.jpg", flight.photos[2]):
        live.add(path)
    for _ in live.drain_all():
        pass
    rows = dict(live.ledger.rows("select name, reason from photo where state = 'refused'"))
    assert rows == {"cap.jpg": "it is black or white all over"}
    assert live.canvas.tiles_of(2) == () and len(live.canvas.tiles_of(1)) > 0
    live.close()
