"""Photos that a batch map leaves out are no part of a live map either."""

import io

import numpy as np
import pytest
from PIL import Image

from skyquilt.live.live_map import LiveMap
from skyquilt.live.photo_intake import Accepted, Refused
from skyquilt.live.settings import LiveSettings
from tests.photos.conftest import jpeg_bytes, pixels

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
    ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
    ' xmlns:Camera="http://pix4d.com/camera/1.0/" Camera:BandName="{}"/></rdf:RDF></x:xmpmeta>'
)


def shots(count):
    """Three bands of each shot, in the order in which cameras write them, and a colour photo."""
    for shot in range(count):
        for band, name in enumerate(("Blue", "Green", "NIR")):
            grey = pixels(seed=shot)[..., band]
            yield f"{shot}_{band}.jpg", jpeg_bytes(grey, xmp=XMP.format(name))
    yield "colour.jpg", jpeg_bytes(pixels(seed=99))


@pytest.mark.parametrize(("asked", "shown"), [(None, 0), ("NIR", 2)])
def test_one_band_of_a_multispectral_camera_is_mapped(tmp_path, asked, shown):
    for part in range(2):  # the second time it is continued
        live = LiveMap(tmp_path / "out", LiveSettings(band=asked))
        told = {n: live.intake.take([b], n, "drone") for n, b in shots(2 + part)}
        live.close()
    taken = {n for n, t in told.items() if isinstance(t, Accepted)}
    assert taken == {f"{shot}_{shown}.jpg" for shot in range(3)}
    other = told["1_1.jpg"]
    assert isinstance(other, Refused)
    assert (
        other.reason
        == f"it shows the band green; the map shows {['blue', '', 'nir'][shown]} (--band)"
    )


def test_photos_in_colours_that_come_first_are_mapped_without_bands(tmp_path):
    """As drones write them that have a camera in colours beside those of the bands."""
    live = LiveMap(tmp_path / "out", LiveSettings())
    photos = [("colour.jpg", jpeg_bytes(pixels(seed=99))), *shots(1)]
    told = {n: live.intake.take([b], n, "drone") for n, b in dict(photos).items()}
    notes = live.ledger.rows("select body from event where kind = 'note'")
    live.close()
    assert {n for n, t in told.items() if isinstance(t, Accepted)} == {"colour.jpg"}
    assert isinstance(told["0_0.jpg"], Refused)
    assert "the map shows the photos in colours (--band)" in told["0_0.jpg"].reason
    assert not any("came first" in body for (body,) in notes)


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
