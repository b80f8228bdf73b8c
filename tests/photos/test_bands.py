"""Cameras that write a file for each band give a map of one band."""

from dataclasses import replace

import pytest

from skyquilt.errors import UsageError
from skyquilt.model.photo import Survey
from skyquilt.photos.left_out import NAMELESS, band_note, of_one_band
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import survey_notes
from tests.alignment.surveys import photo


def band(name, shot, channels=1):
    return replace(photo(f"{shot}_{name}.tif"), band_name=name, channels=channels, dtype="uint16")


def survey(*photos):
    return Survey(photos=tuple(photos), rejected=(), ignored=(), notes=())


FIVE = survey(*(band(n, k) for k in range(3) for n in ("blue", "green", "red", "nir", "red edge")))


@pytest.mark.parametrize(("wanted", "shown"), [(None, "green"), ("NIR", "nir"), ("red", "red")])
def test_one_band_is_kept_and_the_others_are_named(wanted, shown):
    kept = of_one_band(FIVE, wanted)
    assert {p.band_name for p in kept.photos} == {shown} and len(kept.photos) == 3
    assert len(kept.rejected) == 12
    assert all(f"the map shows {shown}" in r.reason for r in kept.rejected)
    (note,) = band_note(FIVE.photos)
    assert "red edge (3)" in note


def test_a_thermal_band_of_a_rig_is_no_mixture_of_spectra():
    """The Altum has one; a thermal camera of its own beside photos in colours is told."""
    heat = [replace(band("lwir", k), band="thermal") for k in range(3)]
    other = [replace(p, band_name="") for p in heat]
    colours = [photo(f"{k}.jpg") for k in range(3)]
    assert not any("spectra are mixed" in n for n in survey_notes([*FIVE.photos, *heat]))
    assert any("spectra are mixed" in n for n in survey_notes([*colours, *other]))


def test_the_band_of_most_photos_is_shown():
    lost = survey(*(p for p in FIVE.photos if not (p.band_name == "green" and p.name[0] == "1")))
    assert {p.band_name for p in of_one_band(lost, None).photos} == {"red"}


def test_files_of_one_channel_without_a_band_stay():
    grey = [band("", k) for k in range(3)]
    kept = of_one_band(survey(*FIVE.photos, *grey), None)
    assert [p.band_name for p in kept.photos] == ["green"] * 3 + [""] * 3
    plain = survey(*grey)
    assert of_one_band(plain, None) is plain and band_note(grey) == ()


def test_a_few_files_without_a_band_are_left_out():
    """A file in a hundred has lost its XMP: among those of one band it would show another."""
    grey = replace(band("", 1), name="1_lost.tif")
    other = replace(band("", 2), name="2_other.tif", width=333)  # of another camera
    kept = of_one_band(survey(*FIVE.photos, grey, other), None)
    assert [p.band_name for p in kept.photos] == ["green"] * 3 + [""]
    assert {p.name: p.reason for p in kept.rejected}["1_lost.tif"] == NAMELESS
    assert "1_lost.tif" not in {p.name for p in kept.other_bands}


@pytest.mark.parametrize(("wanted", "told"), [("RedEdge", "red edge"), ("re", "red edge")])
def test_a_band_can_be_asked_for_as_its_maker_spells_it(wanted, told):
    assert {p.band_name for p in of_one_band(FIVE, wanted).photos} == {told}


@pytest.mark.parametrize(("number", "wanted"), [(3, None), (3, "nir"), (1, None)])
def test_photos_in_colours_and_bands_are_not_mixed(number, wanted):
    """Drones with a camera in colours beside those of the bands write both into one folder."""
    colours = [band("", k, channels=3) for k in range(number)]
    kept = of_one_band(survey(*FIVE.photos, *colours), wanted)
    shown = {p.band_name for p in kept.photos if p.channels == 1}
    assert shown == ({wanted} if wanted else set() if number == 3 else {"green"})
    assert sum(p.channels == 3 for p in kept.photos) == (0 if shown else number)
    assert {p.band_name for p in kept.other_bands} == {p.band_name for p in FIVE.photos} - shown
    assert {p.name for p in kept.other_bands} <= {r.name for r in kept.rejected}


@pytest.mark.parametrize(("given", "words"), [(FIVE, "blue, green"), (survey(photo()), "none")])
def test_a_band_that_no_photo_shows_is_refused(given, words):
    with pytest.raises(UsageError, match=words):
        of_one_band(given, "thermal")


def test_the_name_is_read_from_xmp(make_jpeg):
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
        ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
        ' xmlns:Camera="http://pix4d.com/camera/1.0/"><Camera:BandName>Red  Edge</Camera:BandName>'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    assert read_photo(make_jpeg(xmp=xmp)).band_name == "red edge"
