"""Tables of positions as programs and people write them."""

from datetime import datetime, timedelta

import pyproj
import pytest

from skyquilt.errors import SideFileError
from skyquilt.photos.clips import is_timed
from skyquilt.photos.position_tables import degrees_of
from skyquilt.photos.read import read_photo
from skyquilt.photos.side_files import apply_positions
from skyquilt.photos.survey import read_survey

from .conftest import dji_exif

LAT, LON, HEIGHT = 46.5997551, -92.2997503, 512.25
"""One kilometre and more from where `dji_exif` places the photo would be told."""
EAST, NORTH = pyproj.Transformer.from_crs(4326, 32615, always_xy=True).transform(LON, LAT)
NAME = "DJI 0001.JPG"
WKT = pyproj.CRS(4326).to_wkt("WKT1_GDAL")


@pytest.fixture
def photo(make_jpeg):
    return read_photo(make_jpeg(NAME, exif=dji_exif(GPS={})))


def sexagesimal(value, seconds='"'):
    whole, rest = divmod(abs(value), 1)
    minutes, rest = divmod(rest * 60, 1)
    return f"{int(whole)}°{int(minutes):02d}'{rest * 60:.5f}{seconds}"


N, W = sexagesimal(LAT) + "N", sexagesimal(LON) + "W"
FILES = {
    "pix4d.csv": f"{NAME},{LAT},{LON},{HEIGHT}\n",
    "pix4d_accuracy.csv": f"{NAME},{LAT},{LON},{HEIGHT},0.02,0.03\n",
    "metashape.csv": f"# CoordinateSystem: {WKT}\n"
    "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll"
    f"\n{NAME},{LON},{LAT},{HEIGHT},1,2,3\n# Total Error\n,,,,,,\n",
    "metashape_utm.txt": f"# CoordinateSystem: {pyproj.CRS(32615).to_wkt('WKT1_GDAL')}\n"
    f"#Label,X/Easting,Y/Northing,Z/Altitude\n{NAME},{EAST},{NORTH},{HEIGHT}\n",
    "wingtra.csv": "# WingtraHub\n#image name,latitude [decimal degrees],"
    "longitude [decimal degrees],altitude [meter],accuracy horizontal [meter]\n"
    f"{NAME},{LAT},{LON},{HEIGHT},0.02\n",
    "location.txt": "#name longitude/X latitude/Y height/Z yaw pitch roll SAlt\n"
    f"{NAME} {LON} {LAT} {HEIGHT} 1 2 3 5\n",
    "exiftool.csv": "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n"
    f"./photos/{NAME},{LAT},{LON},{HEIGHT}\n",
    "exiftool_words.csv": "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n"
    f"./photos/{NAME},"
    + ",".join(
        '"' + t.replace("°", " deg ").replace("'", "' ").replace('"', '"" ') + '"' for t in (N, W)
    )
    + f",{HEIGHT} m Above Sea Level\n",
    "ugcs.csv": "File Name,Latitude,Longitude,Altitude AMSL,Altitude AGL\n"
    f"{NAME},{LAT},{LON},{HEIGHT},60\n",
    "german.csv": f"Bild;Breite;Länge;Höhe\r\n{NAME};{LAT};{LON};{HEIGHT}\r\n".replace(
        ".", ","
    ).replace(",JPG", ".JPG"),
    "spanish.csv": f"Nombre,Latitud,Longitud,Altitud\n{NAME},{LAT},{LON},{HEIGHT}\n",
    "minutes.csv": f"name;lat;lon;alt\n{NAME};{N};{W};{HEIGHT} m\n",
    "commas.csv": f"name;lat;lon;alt\n{NAME};{N};{W};{HEIGHT} m\n".replace(".", ",").replace(
        ",JPG", ".JPG"
    ),
    "blanks.csv": f"name lat lon alt\n{NAME} {LAT} {LON} {HEIGHT}\n".replace(".", ",").replace(
        ",JPG", ".JPG"
    ),
    "hemispheres.tsv": f"name\tlat\tlon\talt\n{NAME}\tN {LAT}\t{-LON} W\t{HEIGHT}\n",
    "utm.csv": f"EPSG:32615\nname,easting,northing,height\n{NAME},{EAST},{NORTH},{HEIGHT}\n",
    "text.txt": f"name,lat,lon,alt\n{NAME},{LAT},{LON},{HEIGHT}\n",
    "geo.csv": f"EPSG:4326\n{NAME} {LON} {LAT} {HEIGHT}\n",
    "semicolons.txt": f"EPSG:4326\n{NAME};{LON};{LAT};{HEIGHT}\n",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("name", FILES)
def test_each_gives_the_same_position(tmp_path, photo, name, encoding):
    path = tmp_path / name
    path.write_bytes(FILES[name].encode(encoding))
    ((after,), notes) = apply_positions([photo], path)
    assert after.position.latitude_deg == pytest.approx(LAT, abs=2e-8)
    assert after.position.longitude_deg == pytest.approx(LON, abs=2e-8)
    assert (after.position.sea_level_m, after.position.datum) == (HEIGHT, "sea_level")
    assert notes[0] == f"{name} placed 1 of 1 photos."
    told = {"pix4d.csv": "no header", "pix4d_accuracy.csv": "and 2 more are not read"}
    assert any(told.get(name, "placed") in n for n in notes)
    if name == "wingtra.csv":
        assert after.position.sigma_xy_m == 0.02
    if name in ("metashape.csv", "location.txt"):
        a = after.attitude
        assert (a.yaw_deg, a.pitch_deg, a.roll_deg) == (1, 2, 3)


def test_heights_of_two_kinds(tmp_path, photo):
    path = tmp_path / "klau.csv"
    path.write_text(
        "Filename,Latitude (Deg),Longitude (Deg),Altitude MSL (m),Ellipsoid Height (m),"
        f"HorizontalStdDev (m),VerticalStdDev (m)\n{NAME},{LAT},{LON},{HEIGHT},480.5,0.02,0.03\n"
    )
    ((after,), notes) = apply_positions([photo], path)
    place = after.position
    assert (place.altitude_m, place.datum) == (480.5, "ellipsoid")
    assert (place.sigma_xy_m, place.sigma_z_m) == (0.02, 0.03)
    assert any("not read: Altitude MSL (m)" in n for n in notes)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "a.csv",
            f"name,easting,northing\n{NAME},{EAST},{NORTH}\n",
            "Name their coordinate system",
        ),
        ("a.csv", f"{NAME},{EAST},{NORTH},500\n", "Add a header"),
        ("a.txt", f"{NAME} {LON} {LAT} 500\n" * 2, "must name a coordinate system"),
        ("a.gpx", '<?xml version="1.0"?><gpx></gpx>', "no track points with times"),
        ("a.txt", '<?xml version="1.0"?><gpx></gpx>', "give it the ending .gpx"),
        ("a.xml", '<?xml version="1.0"?><document></document>', "is XML"),
        ("a.json", '{"type": "FeatureCollection"}', "is JSON"),
        ("a.csv", "PK\x03\x04 words", "spreadsheet"),
        ("a.csv", f"name;lat;lon\n{NAME};{W};{N}\n", "expected a number for latitude"),
        ("a.csv", f"name;lat;lon\n{NAME};46°75'N;9\n", "expected a number for latitude"),
    ],
)
def test_what_is_not_understood_is_told(tmp_path, photo, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SideFileError, match=words):
        apply_positions([photo], path)


@pytest.mark.parametrize(
    ("text", "axis", "degrees"),
    [
        ("46.5", "latitude", 46.5),
        ("-46.5", "latitude", -46.5),
        ("46°30'S", "latitude", -46.5),
        ("46°30'36,00\"N", "latitude", 46.51),
        ("46 deg 30' 36.00\" N", "latitude", 46.51),
        ("W 9°15'", "longitude", -9.25),
        ("9d15m36sE", "longitude", 9.26),
        ("9.25 O", "longitude", None),  # east in German, west in Spanish
        ("-9.25 W", "longitude", None),
        ("N 46.5 N", "latitude", None),
        ("46°30'61\"N", "latitude", None),
        ("46 30 36", "latitude", None),
        ("north", "latitude", None),
    ],
)
def test_degrees(text, axis, degrees):
    assert degrees_of(text, axis) == (degrees if degrees is None else pytest.approx(degrees))


START = datetime(2024, 7, 15, 12, 30)
STEPS = [0, 2.2, 4.5, 6.7, 14.9, 17.1]
"""Seconds from the first photo to each."""


@pytest.fixture
def flight(make_jpeg):
    from dataclasses import replace

    found = [read_photo(make_jpeg(f"p{k}.jpg", seed=k)) for k in range(len(STEPS))]
    times = [START + timedelta(seconds=int(s)) for s in STEPS]
    return [replace(p, time=t) for p, t in zip(found, times, strict=True)][::-1]


def pos(steps, week=False):
    """Events two hours before the photos' clock, each further north."""
    lines = []
    for k, step in enumerate(steps):
        moment = START - timedelta(hours=2) + timedelta(seconds=step + 0.4)
        since = (moment - datetime(1980, 1, 6)).total_seconds()
        when = (
            f"{int(since // 604800)} {since % 604800:.3f}"
            if week
            else f"{moment:%Y/%m/%d %H:%M:%S.%f}"
        )
        lines.append(
            f"{when}   {46 + k / 1000:.9f}   9.000000000   512.2500   1  12"
            " 0.0100 0.0200 0.0300 0 0 0 0.0 9"
        )
    return "% program   : RTKLIB\n%  GPST   latitude(deg) longitude(deg) height(m) Q\n" + "\n".join(
        lines
    )


@pytest.mark.parametrize("week", [False, True])
@pytest.mark.parametrize(("before", "behind"), [([], []), ([-310.0, -300.0], [40.0])])
def test_events_are_given_in_order_of_capture(tmp_path, flight, before, behind, week):
    path = tmp_path / "a_events.pos"
    path.write_text(pos([*before, *STEPS, *behind], week))
    after, notes = apply_positions(flight, path)
    found = {p.name: p.position for p in after}
    assert [round((found[f"p{k}.jpg"].latitude_deg - 46) * 1000) for k in range(len(STEPS))] == [
        k + len(before) for k in range(len(STEPS))
    ]
    place = found["p0.jpg"]
    assert (place.altitude_m, place.datum) == (512.25, "ellipsoid")
    assert (place.sigma_xy_m, place.sigma_z_m) == (0.02, 0.03)
    assert any("in order of capture" in n for n in notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (pos(STEPS[:-1]), "5 positions, and there are 6 photos"),
        (pos([0, 2, 4, 6, 8, 10]), "do not go together"),
        (pos([0.2 * k for k in range(200)]), "do not go together"),
        (pos(STEPS).replace("latitude(deg)", "x-ecef(m)"), "Lat/Lon/Height"),
        (pos(STEPS).replace("46.001", "north"), "line 4: expected RTKLIB"),
        ("%  GPST latitude(deg)\n", "no positions"),
        (pos(STEPS).replace("/07/15", "/17/15"), "is no time"),
    ],
)
def test_events_that_do_not_match_are_refused(tmp_path, flight, text, words):
    path = tmp_path / "a.pos"
    path.write_text(text)
    with pytest.raises(SideFileError, match=words):
        apply_positions(flight, path)


@pytest.mark.parametrize(
    ("header", "timed"),
    [
        ("SourceFile,GPSLatitude,GPSLongitude,Time", False),
        ("Bild;Latitude;Longitude;Time", False),
        ("Time,Latitude,Longitude", True),
    ],
)
def test_a_table_that_names_photos_is_not_that_of_a_video(tmp_path, header, timed):
    path = tmp_path / "a.csv"
    path.write_text(header + "\n")
    assert is_timed(path) == timed


def test_a_table_beside_photos_without_positions_is_pointed_at(make_jpeg):
    folder = make_jpeg("a.jpg").parent
    (folder / "flight.csv").write_text("name,lat,lon\n")
    assert any("flight.csv may hold them" in n for n in read_survey(folder).notes)
    make_jpeg("a.jpg", exif=dji_exif())
    assert not any("may hold" in n for n in read_survey(folder).notes)
