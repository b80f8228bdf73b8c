"""What is fuzzed: for each reader a function of bytes that may only end in the ways that its
documentation states, and seeds.
"""

import base64
import io
import json
import sqlite3
import struct
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import piexif
import tifffile
from PIL import Image
from shapely import box

from skyquilt.errors import SkyquiltError, UnreadablePhotoError
from skyquilt.model.photo import Focal, Photo, RejectedPhoto
from skyquilt.multispectral.reflectance import Reflectance
from skyquilt.photos.band_tags import read_band_tags
from skyquilt.photos.cameras_json import apply_cameras, read_cameras_json
from skyquilt.photos.distances import read_distances
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.side_files import apply_positions
from skyquilt.photos.tags import parse_exif, parse_xmp
from skyquilt.planning.check import check_mission
from skyquilt.planning.exports import write_missions
from skyquilt.planning.features import read_features
from skyquilt.planning.fleet import read_fleet
from skyquilt.planning.missions import read_mission
from skyquilt.planning.plan_file import read_plan, write_plan
from skyquilt.planning.records import Drone, PicturePoint, Plan, Sortie, Waypoint
from skyquilt.planning.site import make_site, read_site
from skyquilt.planning.terrain import FLAT
from skyquilt.planning.view import find_view
from skyquilt.raster.boundary import read_boundary
from skyquilt.server.layer_endpoints import LayerError, checked
from skyquilt.server.layer_files import layer_of_bytes
from skyquilt.simulate.clip_tracks import add_track, track_in_clip
from skyquilt.simulate.reported import Report
from skyquilt.simulate.settings import InClipLayout, Video
from skyquilt.video.codec_size import codec_sizes
from skyquilt.video.container import read_container
from skyquilt.video.inside import track_inside
from skyquilt.video.positions import places_at
from skyquilt.video.tracks import TRACK_ENDINGS, read_track

HERE = Path(__file__).parent
NAMES = ("SIM_0001.jpg", "SIM_0002.jpg")


@dataclass(frozen=True)
class Target:
    """A reader."""

    run: Callable[[bytes], None]
    """Raises only what nobody foresaw."""
    made: Callable[[], list[bytes]]
    """Seeds that are made."""
    folder: str
    """Folder of further seeds: inputs on which the reader failed once."""

    def seeds(self) -> list[bytes]:
        """All seeds."""
        return _seeds(self)


@cache
def _seeds(target):
    kept = sorted((HERE / "seeds" / target.folder).glob("*"))
    return [*target.made(), *(path.read_bytes() for path in kept)]


@cache
def _folder():
    return tempfile.TemporaryDirectory(prefix="skyquilt-fuzz-")


def _file(name, data):
    path = Path(_folder().name) / name
    path.write_bytes(data)
    return path


# -- photos


def _photo(ending):
    def run(data):
        photo = read_photo(_file(f"a{ending}", data))
        if isinstance(photo, RejectedPhoto):
            assert photo.reason and photo.reason.isprintable(), photo.reason
            assert not photo.trace, photo.trace
            return
        assert all(note.isprintable() for note in photo.notes)
        # decoding is checked up to the size of the seeds: others are as slow as they are large
        if photo.width * photo.height < 4_000_000:
            try:
                pixels = read_color(photo)
            except UnreadablePhotoError:
                return
            assert pixels.shape[:2] == (photo.height, photo.width)

    return run


XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
    b' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description'
    b' xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
    b' xmlns:Camera="http://pix4d.com/camera/1.0/" drone-dji:GpsLatitude="+52.1"'
    b' drone-dji:GpsLongitude="+13.1" drone-dji:RelativeAltitude="+50.0"'
    b' drone-dji:AbsoluteAltitude="+90.5" drone-dji:GimbalYawDegree="+12.5"'
    b' drone-dji:GimbalPitchDegree="-90.0" drone-dji:GimbalRollDegree="0"'
    b' drone-dji:FlightYawDegree="10" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01"'
    b' drone-dji:CalibratedFocalLength="300.0"'
    b' drone-dji:DewarpData="2020-01-01;300,300,1,1,0.1,0.01,0.001,0.001,0.001">'
    b"<Camera:PrincipalPoint>2.4,1.8</Camera:PrincipalPoint>"
    b"<Camera:PerspectiveFocalLength>4.0</Camera:PerspectiveFocalLength>"
    b"<Camera:PerspectiveDistortion><rdf:Seq><rdf:li>0.1</rdf:li><rdf:li>0.2</rdf:li></rdf:Seq>"
    b"</Camera:PerspectiveDistortion></rdf:Description></rdf:RDF></x:xmpmeta>"
)


@cache
def _exif():
    return piexif.dump(
        {
            "0th": {piexif.ImageIFD.Make: "DJI", piexif.ImageIFD.Model: "FC330"},
            "Exif": {
                piexif.ExifIFD.DateTimeOriginal: "2020:05:17 10:11:12",
                piexif.ExifIFD.SubSecTimeOriginal: "25",
                piexif.ExifIFD.FocalLength: (361, 100),
                piexif.ExifIFD.FocalLengthIn35mmFilm: 20,
                piexif.ExifIFD.FocalPlaneXResolution: (4000, 6),
                piexif.ExifIFD.FocalPlaneResolutionUnit: 4,
                piexif.ExifIFD.PixelXDimension: 400,
                piexif.ExifIFD.PixelYDimension: 300,
            },
            "GPS": {
                piexif.GPSIFD.GPSLatitudeRef: "N",
                piexif.GPSIFD.GPSLatitude: ((52, 1), (6, 1), (0, 1)),
                piexif.GPSIFD.GPSLongitudeRef: "E",
                piexif.GPSIFD.GPSLongitude: ((13, 1), (6, 1), (0, 1)),
                piexif.GPSIFD.GPSAltitude: (905, 10),
                piexif.GPSIFD.GPSTimeStamp: ((10, 1), (11, 1), (12, 1)),
                piexif.GPSIFD.GPSDateStamp: "2020:05:17",
            },
        }
    )


def _pixels(bands=3):
    rng = np.random.default_rng(1)
    return rng.integers(0, 255, (48, 64, bands), dtype=np.uint8)


def _saved(write):
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def _with_segments(data, *segments):
    more = b"".join(
        b"\xff" + bytes([m]) + struct.pack(">H", len(p) + 2) + p for m, p in segments if p
    )
    return data[:2] + more + data[2:]


def _jpegs():
    xmp = b"http://ns.adobe.com/xap/1.0/\0" + XMP
    plain = _saved(lambda b: Image.fromarray(_pixels()).save(b, "JPEG", exif=_exif()))
    waves = _saved(lambda b: Image.fromarray(_pixels()).save(b, "JPEG", progressive=True))
    grey = _saved(lambda b: Image.fromarray(_pixels()[..., 0]).save(b, "JPEG"))
    counts = np.full((512, 640), 3000, "<u2").tobytes()
    parts = [(0xE3, counts[k : k + 60_000]) for k in range(0, len(counts), 60_000)]
    return [
        _with_segments(plain, (0xE1, xmp)),
        waves,
        grey,
        _with_segments(plain, *parts),
        _with_segments(plain, (0xE1, b"FLIR\0\x01\0\0" + _flir())),
    ]


def _flir():
    raw = struct.pack("<HHH", 2, 64, 48) + bytes(26) + np.full((48, 64), 14000, "<u2").tobytes()
    head = b"FFF\0" + bytes(16) + struct.pack(">III", 101, 64, 1)
    entry = struct.pack(">HHIIII", 1, 0, 0, 96, len(raw), 0)
    return (head.ljust(64, b"\0") + entry.ljust(32, b"\0") + raw)[:64_000]


def _tiffs():
    found = []
    for values, more in (
        (_pixels(), {"photometric": "rgb", "compression": "deflate"}),
        (_pixels(5), {"photometric": "minisblack", "planarconfig": "contig"}),
        (np.full((48, 64), 29_515, np.uint16), {"description": "unit: centikelvin"}),
        (np.full((48, 64), 300.15, np.float32), {"compression": "lzw"}),
        (_pixels(), {"photometric": "rgb", "bigtiff": True}),
        (_pixels(), {"photometric": "rgb", "compression": "jpeg", "tile": (16, 16)}),
    ):
        found.append(_saved(lambda b, v=values, m=more: tifffile.imwrite(b, v, **m)))
    return found


def _pngs():
    grey = Image.fromarray(np.full((48, 64), 29_515, np.uint16))
    return [
        _saved(lambda b: Image.fromarray(_pixels()).save(b, "PNG", exif=_exif())),
        _saved(lambda b: Image.fromarray(_pixels(4)).save(b, "PNG")),
        _saved(lambda b: grey.save(b, "PNG")),
    ]


def _webps():
    told = {"exif": _exif(), "xmp": XMP}
    return [
        _saved(lambda b: Image.fromarray(_pixels()).save(b, "WEBP", **told)),
        _saved(lambda b: Image.fromarray(_pixels(4)).save(b, "WEBP", lossless=True, **told)),
    ]


@cache
def _clips():
    """An MP4 of two frames, with a camera model and a rotation in its tables."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        code = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 5.0, (64, 64))
        for level in (60, 90):
            writer.write(np.full((64, 64, 3), level, np.uint8))
        writer.release()
        data = path.read_bytes()
    model = b"\xa9mdl\x00\x06\x15\xc7FC3170\x00"
    return [
        data,
        data + struct.pack(">I4s", 8 + len(model), b"udta") + model,
        *(_with_telemetry(data, layout) for layout in get_args(InClipLayout)),
    ]


def _with_telemetry(clip, layout):
    """A clip with two seconds of telemetry in it, as a drone writes it."""
    report = Report(
        latitude=46.6, longitude=14.3, sea_level=480.0, takeoff=50.0, gimbal=(12.0, -90.0, 0.0),
        flight_yaw=12.0, clock=0.0, focal=None, turned=False, lies=(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        path.write_bytes(clip)
        times, video = np.arange(4) / 2, Video(fps=2.0, layout=layout)
        add_track(path, track_in_clip([report] * 4, times, video, datetime(2024, 5, 1, 10)))
        return path.read_bytes()


def _container(data):
    """Boxes of a clip and the telemetry in it; FFmpeg, which decodes it, is fuzzed by others."""
    path = _file("a.mp4", data)
    found = read_container(path)
    assert found is None or all(k.isprintable() for k in (found.model, *found.kinds))
    if (track := track_inside(path)) is not None:
        assert np.isfinite(track.latitude_deg).all() and len(track.time_s) > 0


@cache
def _descriptions():
    """Sample descriptions of the recorded clips: H.264, H.265, MPEG-4."""
    recorded = (HERE.parent / "tests" / "video" / "recorded").glob("*.mp4")
    found = []
    for data in [*_clips()[:1], *(p.read_bytes() for p in sorted(recorded))]:
        at = data.index(b"stsd") - 4
        found.append(data[at + 8 : at + struct.unpack(">I", data[at : at + 4])[0]])
    return found


def _codec(data):
    assert all(min(size) >= 0 and max(size) < 2**40 for size in codec_sizes(data))


TELEMETRY = b"""1
00:00:00,000 --> 00:00:00,033
2024-05-01 10:00:00.000
[focal_len: 24.00] [latitude: 46.600000] [longitude: 14.300000] [rel_alt: 50.0 abs_alt: 480.0]

2
00:00:01,000 --> 00:00:01,033
HOME(14.3,46.6) 2024.05.01 10:00:01
GPS(14.3001,46.6001,16) BAROMETER:50.1

3
00:00:02,000 --> 00:00:02,033
F/5.6, SS 400, GPS (14.300200, 46.600200, 15), D 150.00m, H 50.20m, G.PRY (-90.0, 0.0, 12.3)

"""
TIMED = (
    b"time(millisecond),latitude,longitude,height_above_takeoff(feet),compass_heading(degrees)\n"
)
TIMED += b"0,46.6,14.3,164,12\n200,46.60001,14.3,164.1,12.5\n400,46.60002,14.3,164.2,13\n"
GPX = b"""<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="46.6" lon="14.3"><ele>480</ele><time>2024-05-01T10:00:00Z</time></trkpt>
<trkpt lat="46.6001" lon="14.3"><ele>480.5</ele><time>2024-05-01T10:00:01Z</time></trkpt>
</trkseg></trk></gpx>"""


def _track(data):
    """Positions of a clip, in the three kinds of files."""
    for ending in TRACK_ENDINGS:
        try:
            track = read_track(_file(f"a{ending}", data))
        except SkyquiltError as error:
            _sentence(error)
        else:
            assert np.isfinite(track.latitude_deg).all() and len(track.time_s) > 0
            places_at(track, np.linspace(track.time_s[0] - 5, track.time_s[-1] + 5, 9))


def _exif_only(data):
    found = parse_exif(data)
    for tag in range(0x100, 0x140):
        found.text(tag)
        found.number(tag)


def _xmp_only(data):
    found = parse_xmp((data,))
    for name in ("GpsLatitude", "DewarpData", "Camera:PrincipalPoint"):
        found.text(name)
        found.number(name)
        found.numbers(name)


# -- bands of multispectral cameras


def _bands(data):
    """What a file tells of its band, and counts converted by it."""
    try:
        tags = read_band_tags(_file("band", data))
    except UnreadablePhotoError as error:
        _sentence(error)
        return
    numbers = [v for v in vars(tags).values() if isinstance(v, float)]
    assert np.isfinite(numbers).all(), numbers
    assert all(k.isprintable() for k in (tags.name, tags.capture, *tags.notes))
    counts = np.array([[0, 30_000], [65_000, 65_535]], np.uint16)
    for width, height in ((2, 2), (64, 48)):
        found = Reflectance.of(tags, width, height)
        assert all(note.isprintable() for note in found.notes)
        values = found(counts)
        assert not np.isinf(values).any() and values[0, 0] == 0, values


_NAMES = {
    "Camera": "http://pix4d.com/camera/1.0",
    "MicaSense": "http://micasense.com/MicaSense/1.0/",
    "DLS": "http://micasense.com/DLS/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
}
MAKERS = {
    "MicaSense": {
        "Camera:BandName": "Red",
        "Camera:CentralWavelength": "668",
        "Camera:WavelengthFWHM": "10",
        "Camera:RigCameraIndex": "2",
        "Camera:VignettingCenter": "32,24",
        "Camera:VignettingPolynomial": "-1e-4,1e-6,-1e-8,3e-11,-3e-14,1e-17",
        "MicaSense:RadiometricCalibration": "1.4e-4,1.3e-7,1.1e-5",
        "MicaSense:CaptureId": "DFj0",
        "DLS:HorizontalIrradiance": "118",
        "DLS:IrradianceScaleToSIUnits": "0.01",
    },
    "DJI": {
        "drone-dji:BandName": "NIR",
        "drone-dji:BandFreq": "860(+/-26)nm",
        "drone-dji:SensorIndex": "4",
        "drone-dji:CaptureUUID": "3377fb05",
        "drone-dji:BlackCurrent": "3200",
        "drone-dji:SensorGain": "1.5",
        "drone-dji:SensorGainAdjustment": "1.002",
        "drone-dji:ExposureTime": "1000",
        "drone-dji:Irradiance": "9741.7",
        "drone-dji:CalibratedOpticalCenterX": "32",
        "drone-dji:CalibratedOpticalCenterY": "24",
        "drone-dji:VignettingData": "1e-4, 1e-6, 1e-8, 1e-11, 1e-14, 1e-17",
    },
    "Parrot": {
        "Camera:BandName": "Green",
        "Camera:SensorModel": "1.04,3997.5,180.25",
        "Camera:VignettingPolynomial2DName": "0,0,1,0,0,1",
        "Camera:VignettingPolynomial2D": "0.9,0.05,0.04",
        "Camera:IrradianceCalibrationMeasurement": "0,600,33,17,1,600,820,417",
        "Camera:IrradianceList": base64.b64encode(
            struct.pack("<QHHHHfff", 10**9, 330, 160, 1, 100, 1.5, 0.5, 0.2) * 2
        ).decode(),
    },
}
"""What makers write of a band."""


def _bands_of_makers():
    """As TIFFs; and as JPEGs, which tell the exposure, too."""
    found, counts = [], np.full((48, 64), 20_000, np.uint16)
    for maker, told in MAKERS.items():
        spaces = " ".join(f'xmlns:{name}="{uri}"' for name, uri in _NAMES.items())
        words = " ".join(f'{name}="{value}"' for name, value in told.items())
        xmp = (
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF'
            ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f"<rdf:Description {spaces} {words}/></rdf:RDF></x:xmpmeta>"
        ).encode()
        more = [(700, "B", len(xmp), xmp, True), (50714, "H", 4, [4800] * 4, True)]
        more += [(271, "s", 0, maker, True), (33434, 5, 1, (1, 800), True)]
        more += [(33437, 5, 1, (22, 10), True), (34855, "H", 1, 200, True)]
        found.append(_saved(lambda b, m=more: tifffile.imwrite(b, counts, extratags=m)))
        exif = {
            "0th": {piexif.ImageIFD.Make: maker, piexif.ImageIFD.BlackLevel: (48, 1)},
            "Exif": {
                piexif.ExifIFD.ExposureTime: (1, 800),
                piexif.ExifIFD.FNumber: (22, 10),
                piexif.ExifIFD.ISOSpeedRatings: 200,
            },
        }
        grey = Image.fromarray(_pixels()[..., 0])
        block = piexif.dump(exif)
        plain = _saved(lambda b, g=grey, e=block: g.save(b, "JPEG", exif=e))
        found.append(_with_segments(plain, (0xE1, b"http://ns.adobe.com/xap/1.0/\0" + xmp)))
    return found


# -- side files


def _survey():
    return [
        Photo(
            name=name,
            path=Path(name),
            digest=name,
            width=400,
            height=300,
            channels=3,
            dtype="uint8",
            band="visible",
            camera_key="dji fc330 400x300",
            focal=Focal(px=300, sigma_px=30, source="guess"),
            position=None,
            attitude=None,
            time=None,
        )
        for name in NAMES
    ]


def _positions(ending):
    def run(data):
        try:
            photos, _ = apply_positions(_survey(), _file(f"side{ending}", data))
        except SkyquiltError as error:
            _sentence(error)
            return
        for photo in photos:
            p = photo.position
            if p is not None:
                numbers = (p.latitude_deg, p.longitude_deg, p.altitude_m or 0.0)
                assert np.isfinite(numbers).all(), p
                assert 0 < p.sigma_xy_m < 1e5 and 0 < p.sigma_z_m < 1e5, p

    return run


def _sentence(error):
    assert "\x1b" not in str(error) and "\x00" not in str(error), str(error)
    assert len(str(error)) < 3000, str(error)


def _side(name, read):
    def run(data):
        try:
            read(_file(name, data))
        except SkyquiltError as error:
            _sentence(error)

    return run


def _cameras(path):
    cameras = read_cameras_json(path)
    for camera in cameras.values():
        assert np.isfinite(camera.vector).all(), camera
    apply_cameras(_survey(), cameras, file=path)


GEO = b"EPSG:4326\nSIM_0001.jpg 13.1 52.1 100 10 -90 0 0.1 0.2\nSIM_0002.jpg 13.2 52.1 100\n"
CSV = (
    b"name,lat,lon,alt,yaw,pitch,roll,accuracy,vertical_accuracy\n"
    b"SIM_0001.jpg,52.1,13.1,100,10,-90,0,0.1,0.2\nSIM_0002.jpg,52.1,13.1,100,10,-45,0,0.1,0.2\n"
)
TABLE = (
    b"# CoordinateSystem: EPSG:32633\n#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Accuracy_(m)\n"
    b"SIM_0001.jpg,369850,5773400,100,10,0.1\nSIM_0002.jpg,369860,5773400,100,10,0.1\n"
)
DEGREES = (
    "Bild;Breite;L\u00e4nge;H\u00f6he\nSIM_0001.jpg;52\u00b006'00,5\"N;13 deg 6' E;100,5 m\n"
).encode()
BARE = b"SIM_0001.jpg,52.1,13.1,100\nSIM_0002.jpg,52.1,13.2,100\n"
POS = (
    b"%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n"
    b"2020/05/17 10:11:12.250 52.1 13.1 140.1 1 12 0.01 0.01 0.02\n"
    b"2106 36674.25 52.1 13.2 140.1 1 12 0.01 0.01 0.02\n"
)
MRK = (
    b"1\t348585.1\t[2043]\t   -11,N\t    2,E\t   190,V\t52.1,Lat\t13.1,Lon\t100.1,Ellh\t"
    b"0.011, 0.010, 0.022\t50,Q\n"
)
SRT = (
    b"1\n00:00:00,000 --> 00:00:01,000\n2020-05-17 10:11:12.25 [latitude: 52.1] [longitude: 13.1]"
    b" [rel_alt: 50.0 abs_alt: 90.0] [gb_yaw: 10 gb_pitch: -90 gb_roll: 0]\n\n"
    b"2\n00:00:01,000 --> 00:00:02,000\nGPS(13.1,52.1,15) BAROMETER:12.3\n"
)
GCP = (
    b"WGS84 UTM 33N\n369850 5773400 100 200 150 SIM_0001.jpg one\n"
    b"369860.5 5773410 NaN 20.5 150 SIM_0002.jpg two check\n"
)
DISTANCES = (
    b"point_a,point_b,metres,px_a,py_a,image_a,px_b,py_b,image_b\n"
    b"a,b,10.5,10,20,SIM_0001.jpg,30,40,SIM_0001.jpg\n"
)
CAMERAS = json.dumps(
    {
        "all": {
            "projection_type": "brown",
            "width": 400,
            "height": 300,
            "focal_x": 0.85,
            "focal_y": 0.85,
            "c_x": 0.01,
            "c_y": 0.0,
            "k1": 0.1,
            "k2": 0.01,
            "standard_deviations": {"focal_x": 0.01, "c_x": 0.01},
        }
    }
).encode()
RING = [[13.1, 52.1], [13.2, 52.1], [13.2, 52.2], [13.1, 52.1]]
GEOJSON = json.dumps(
    {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {"name": "area"},
                "geometry": {"type": "Polygon", "coordinates": [RING]},
            }
        ],
    }
).encode()
KML = (
    b'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon>'
    b"<outerBoundaryIs><LinearRing><coordinates>13.1,52.1,0 13.2,52.1,0 13.2,52.2,0 13.1,52.1,0"
    b"</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
)
WKT = b"SRID=4326;POLYGON((13 52,14 52,14 53,13 52))"


def _kmz():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", KML)
    return buffer.getvalue()


def _geopackage():
    from shapely import Polygon, to_wkb

    path = _file("seed.gpkg", b"")
    path.unlink()
    blob = b"GP\0\x01" + struct.pack("<i", 4326) + to_wkb(Polygon(RING))
    with closing(sqlite3.connect(path)) as base:
        base.executescript(
            "pragma page_size=512;"
            "create table gpkg_geometry_columns(table_name, column_name, srs_id);"
            "create table gpkg_spatial_ref_sys(srs_id, organization, organization_coordsys_id,"
            " definition);"
            "insert into gpkg_geometry_columns values ('area', 'geom', 4326);"
            "insert into gpkg_spatial_ref_sys values (4326, 'EPSG', 4326, '');"
            "create table area(geom blob);"
        )
        base.execute("insert into area values (?)", (blob,))
        base.commit()
    return path.read_bytes()


def _shapefile():
    ring = np.array(RING[::-1]).ravel().astype("<f8").tobytes()
    box = struct.pack("<4d", 13.1, 52.1, 13.2, 52.2)
    body = struct.pack("<i", 5) + box + struct.pack("<iii", 1, 4, 0) + ring
    head = struct.pack(">i", 9994) + bytes(20) + struct.pack(">i", (100 + 8 + len(body)) // 2)
    head = (head + struct.pack("<ii", 1000, 5) + box).ljust(100, b"\0")
    return head + struct.pack(">ii", 1, len(body) // 2) + body


def _boundary(ending):
    def read(path):
        found = read_boundary(path, "EPSG:32633" if ending != ".wkt" else None)
        assert np.isfinite(found.bounds).all(), found.bounds

    return _side(f"area{ending}", read)


# -- missions


def _features(ending):
    def read(path):
        for found in read_features(path)[0]:
            assert all(k.isprintable() and v.isprintable() for k, v in found.properties.items())
        site = read_site(path, width_m=20.0)
        assert np.isfinite(site.observe.bounds).all(), site.observe.bounds

    return _side(f"site{ending}", read)


def _zipped():
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        archive.writestr("area.shp", _shapefile())
        archive.writestr("area.prj", 'GEOGCS["GCS_WGS_1984"]')
    return held.getvalue()


def _handed_in(data):
    """A layer as the live map's page sends it."""
    try:
        layer = layer_of_bytes(data, "a.zip")
    except SkyquiltError:
        return
    with suppress(LayerError):
        checked(json.dumps(layer).encode())


def _mission(ending):
    def read(path):
        mission = read_mission(path)
        assert np.isfinite(mission.places).all() and np.isfinite(mission.heights).all()
        check_mission(mission, None, None, FLAT, views=1, clearance=0)

    return _side(f"mission{ending}", read)


FLEET = (
    b'[[drone]]\nname = "a"\nstart = {latitude = 52.1, longitude = 13.1}\nendurance_min = 20\n'
    b'speed = 6\nformats = ["dji"]\ncamera = "FC330"\n'
)
WAYPOINTS = (
    b"QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t52.1\t13.1\t50\t1\n"
    b"1\t0\t3\t16\t0\t0\t0\t90\t52.1\t13.1\t50\t1\n2\t0\t3\t206\t10\t0\t1\t0\t0\t0\t0\t1\n"
    b"3\t0\t3\t16\t0\t0\t0\t0\t52.101\t13.1\t50\t1\n4\t0\t3\t203\t0\t0\t0\t0\t1\t0\t0\t1\n"
)


@cache
def _planned():
    """A small plan and its files by ending."""
    points = tuple(
        PicturePoint(id=k, x=370_000.0 + 20 * k, y=5_773_000.0, z=50.0, ground=0.0, yaw=0.0)
        for k in (1, 2)
    )
    place = (370_000.0, 5_773_000.0)
    drone = Drone(name="a", start=place, landing=place, view=find_view("FC330"))
    way = tuple(Waypoint(x=p.x, y=p.y, z=p.z, time_s=float(p.id), point=p.id) for p in points)
    ground = Waypoint(x=place[0], y=place[1], z=0.0, time_s=0.0)
    plan = Plan(
        site=make_site(box(370_000, 5_773_000, 370_040, 5_773_020), (), "EPSG:32633"),
        drones=(drone,),
        points=points,
        sorties=(Sortie(drone=0, number=1, way=(ground, *way, replace(ground, time_s=9.0))),),
        options={},
        terrain=False,
    )
    folder = Path(_folder().name)
    write_plan(folder / "seed.json", plan)
    write_missions(folder, plan)
    found = {e: (folder / f"01-a{e}").read_bytes() for e in (".plan", ".waypoints", ".kmz")}
    return {**found, ".json": (folder / "seed.json").read_bytes()}


# -- HTTP


@cache
def _application():
    from starlette.testclient import TestClient

    from skyquilt.live.live_map import LiveMap
    from skyquilt.server.access import Guard
    from skyquilt.server.app import make_app
    from skyquilt.server.survey import LiveSurvey

    folder = Path(_folder().name) / "served"
    live = LiveMap(folder)
    live.add(_file("SIM_0001.jpg", _jpegs()[0]))
    app = make_app(LiveSurvey(folder), Guard(), live, folder)
    return TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False), folder


def _http(data):
    """`METHOD path?query`, then lines of headers, an empty line and the body."""
    head, _, body = data.partition(b"\n\n")
    first, *lines = head.decode("latin-1").split("\n")
    method, _, target = first.partition(" ")
    if method not in ("GET", "POST", "PATCH", "DELETE", "HEAD", "OPTIONS", "PUT"):
        method = "GET"
    if target.split("?")[0].rstrip("/") == "/events" and method == "GET":
        return  # it never ends; its numbers are checked by `events`
    headers = {}
    for line in lines:
        name, _, value = line.partition(":")
        if name.isascii() and name.replace("-", "").isalnum():
            headers[name] = "".join(c for c in value if " " < c < "\x7f")
    headers.pop("Host", None)
    client, folder = _application()
    try:
        url = "/" + target.lstrip("/")
        answer = client.request(method, url, headers=headers, content=body, follow_redirects=False)
    except Exception as error:
        if type(error).__module__.startswith(("httpx", "h11", "idna")):
            return  # no client can send that
        raise
    assert answer.status_code not in (500, 501, 502), (answer.status_code, answer.text[:300])
    if answer.content and "json" in answer.headers.get("content-type", ""):
        json.loads(answer.content, parse_constant=_never)
    assert not (folder / "errors.log").exists(), (folder / "errors.log").read_text()


def _never(name):
    raise AssertionError(f"{name} is served as JSON")


def _requests():
    point = base64.b64encode(b"a.jpg").decode()
    tus = "Tus-Resumable: 1.0.0"
    return [
        b"GET /info",
        b"GET /tiles/18/140000/85000?layer=visible",
        b"GET /tiles.json",
        b"GET /wms?SERVICE=WMS&VERSION=1.3.0&REQUEST=GetCapabilities",
        b"GET /wms?VERSION=1.3.0&REQUEST=GetMap&LAYERS=visible&CRS=EPSG:4326&BBOX=52,13,52.2,13.2"
        b"&WIDTH=64&HEIGHT=64&FORMAT=image/png&TRANSPARENT=TRUE",
        b"GET /wms?VERSION=1.1.1&REQUEST=GetFeatureInfo&LAYERS=visible&SRS=EPSG:4326"
        b"&BBOX=13,52,13.2,52.2&WIDTH=64&HEIGHT=64&X=12&Y=13",
        b"GET /photos?lon=13.1&lat=52.1",
        b"GET /photos/1",
        b"GET /photos/1/file",
        b"GET /layers",
        b"GET /layers/a",
        b"GET /export?bbox=13,52,13.2,52.2",
        b"POST /layers?name=a\nContent-Type: application/json\n\n" + GEOJSON,
        b"DELETE /layers/a",
        b"POST /photos?name=a.jpg&source=x\n\nhello",
        b"POST /photos?name=a.jpg\n\n" + _jpegs()[2],
        f"POST /photos/uploads\n{tus}\nUpload-Length: 10\nUpload-Metadata: filename {point}\n\n"
        "".encode(),
        f"PATCH /photos/uploads/00112233445566778899aabbccddeeff\n{tus}\nUpload-Offset: 0\n"
        "Content-Type: application/offset+octet-stream\n\nhello".encode(),
        f"HEAD /photos/uploads/00112233445566778899aabbccddeeff\n{tus}\n\n".encode(),
        b"GET /openapi.json",
    ]


def prepare(name: str) -> None:
    """What a target needs before its first input, so that no input seems slow for it."""
    if name == "http":
        _application()


TARGETS = {
    "jpeg": Target(_photo(".jpg"), _jpegs, "jpeg"),
    "tiff": Target(_photo(".tif"), _tiffs, "tiff"),
    "png": Target(_photo(".png"), _pngs, "png"),
    "webp": Target(_photo(".webp"), _webps, "webp"),
    "bands": Target(_bands, _bands_of_makers, "bands"),
    "mp4": Target(_container, _clips, "mp4"),
    "codec": Target(_codec, _descriptions, "codec"),
    "track": Target(_track, lambda: [TELEMETRY, TIMED, GPX], "track"),
    "exif": Target(_exif_only, lambda: [_exif()[6:]], "exif"),
    "xmp": Target(_xmp_only, lambda: [XMP], "xmp"),
    "geo_txt": Target(_positions(".txt"), lambda: [GEO], "geo_txt"),
    "csv": Target(_positions(".csv"), lambda: [CSV, TABLE, DEGREES, BARE], "csv"),
    "pos": Target(_positions(".pos"), lambda: [POS], "pos"),
    "mrk": Target(_positions(".MRK"), lambda: [MRK], "mrk"),
    "srt": Target(_positions(".srt"), lambda: [SRT], "srt"),
    "gcp_list": Target(
        _side("gcp_list.txt", lambda p: read_gcp_list(p, NAMES)), lambda: [GCP], "gcp_list"
    ),
    "distances": Target(
        _side("d.csv", lambda p: read_distances(p, NAMES)), lambda: [DISTANCES], "distances"
    ),
    "sequence": Target(
        _side("s.txt", lambda p: sequence_of(NAMES, str(p))),
        lambda: ["\n".join(NAMES).encode()],
        "sequence",
    ),
    "cameras_json": Target(_side("cameras.json", _cameras), lambda: [CAMERAS], "cameras_json"),
    "geojson": Target(_boundary(".geojson"), lambda: [GEOJSON], "geojson"),
    "kml": Target(_boundary(".kml"), lambda: [KML], "kml"),
    "kmz": Target(_boundary(".kmz"), lambda: [_kmz()], "kmz"),
    "wkt": Target(_boundary(".wkt"), lambda: [WKT], "wkt"),
    "geopackage": Target(_boundary(".gpkg"), lambda: [_geopackage()], "geopackage"),
    "shapefile": Target(_boundary(".shp"), lambda: [_shapefile()], "shapefile"),
    "site_geojson": Target(_features(".geojson"), lambda: [GEOJSON], "site_geojson"),
    "site_kml": Target(_features(".kml"), lambda: [KML], "site_kml"),
    "site_gpkg": Target(_features(".gpkg"), lambda: [_geopackage()], "site_gpkg"),
    "site_shp": Target(_features(".shp"), lambda: [_shapefile()], "site_shp"),
    "layer_zip": Target(_handed_in, lambda: [_zipped()], "layer_zip"),
    "mission_plan": Target(_mission(".plan"), lambda: [_planned()[".plan"]], "mission_plan"),
    "mission_waypoints": Target(
        _mission(".waypoints"), lambda: [WAYPOINTS, _planned()[".waypoints"]], "mission_waypoints"
    ),
    "mission_kmz": Target(_mission(".kmz"), lambda: [_planned()[".kmz"]], "mission_kmz"),
    "plan_json": Target(_side("plan.json", read_plan), lambda: [_planned()[".json"]], "plan_json"),
    "fleet": Target(
        _side("fleet.toml", lambda path: read_fleet(path, "EPSG:32633", None)),
        lambda: [FLEET],
        "fleet",
    ),
    "http": Target(_http, _requests, "http"),
}
"""By name."""
