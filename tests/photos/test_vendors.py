"""Metadata as makers of cameras and other programs write them."""

import io
import struct
import zlib

import numpy as np
import piexif
import pytest
import tifffile
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo

from .conftest import dji_exif, dji_xmp, gps_exif, jpeg_bytes, pixels

RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"


def packet(inside, attributes=""):
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{RDF}">'
        f'<rdf:Description rdf:about="" {attributes}>{inside}</rdf:Description>'
        "</rdf:RDF></x:xmpmeta>"
    )


def angles(photo):
    a = photo.attitude
    return (a.yaw_deg, a.pitch_deg, a.roll_deg)


@pytest.mark.parametrize(
    "uri",
    [
        "http://pix4d.com/camera/1.0",
        "https://pix4d.com/camera/1.0/",
        "http://ns.sensefly.com/Camera/1.0/",
    ],
)
@pytest.mark.parametrize("prefix", ["Camera", "sensefly"])
def test_the_camera_namespace_of_any_maker(make_jpeg, uri, prefix):
    values = {"Yaw": "120.5", "Pitch": "4.25", "Roll": "-3", "GPSXYAccuracy": "0.03"}
    told = " ".join(f'{prefix}:{name}="{value}"' for name, value in values.items())
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=packet("", f'xmlns:{prefix}="{uri}" {told}')))
    assert angles(photo) == (120.5, 4.25, -3)
    assert photo.position.sigma_xy_m == 0.03


def test_a_phone_s_camera_namespace_is_no_autopilot(make_jpeg):
    uri = "http://ns.google.com/photos/1.0/camera/"
    phone = packet("", f'xmlns:Camera="{uri}" Camera:MicroVideo="1"')
    drone = dji_xmp(GpsLatitude="46.5", GpsLongitude="9")
    sigmas = [
        read_photo(make_jpeg(exif=dji_exif(), xmp=x)).position.sigma_xy_m for x in (phone, drone)
    ]
    assert sigmas[0] > 3 * sigmas[1]


SKYDIO = 'xmlns:s="https://www.skydio.com/drone-skydio/1.0/"'
FORMS = {
    "attributes": "<s:{0} {2}/>",
    "description": "<s:{0}><rdf:Description {2}/></s:{0}>",
    "resource": '<s:{0} rdf:parseType="Resource">{1}</s:{0}>',
    "elements": "<s:{0}><rdf:Description>{1}</rdf:Description></s:{0}>",
}


@pytest.mark.parametrize("form", FORMS)
def test_structures_of_skydio(make_jpeg, form):
    """Frames of reference have fields of the same names; only that of the camera counts."""

    def structure(name, **fields):
        elements = "".join(f"<s:{k}>{v}</s:{k}>" for k, v in fields.items())
        attributes = " ".join(f's:{k}="{v}"' for k, v in fields.items())
        return FORMS[form].format(name, elements, attributes)

    inside = (
        structure("VehicleOrientationNED", Roll=1, Pitch=2, Yaw=-3)
        + structure("CameraOrientationNED", Roll="0.0", Pitch="-85.5", Yaw="127.44")
        + structure("CameraOrientationFLU", Roll=7, Pitch=8, Yaw=9)
        + structure("CalibratedFocalLength", X="70.5", Y="70.5")
        + structure("CalibratedOpticalCenter", X="49.5", Y="31")
        + "<s:Latitude>32.5189351</s:Latitude><s:Longitude>-110.9245471</s:Longitude>"
        + "<s:RelativeAltitude>30.25</s:RelativeAltitude>"
        + "<s:GpsHorizontalAccuracy>0.71</s:GpsHorizontalAccuracy>"
        + "<s:GpsVerticalAccuracy>1.25</s:GpsVerticalAccuracy>"
    )
    photo = read_photo(make_jpeg(xmp=packet(inside, SKYDIO)))
    assert angles(photo) == pytest.approx((127.44, 4.5, 0), abs=1e-9)
    assert (photo.calibration.focal, photo.calibration.cx) == (70.5, 49)
    place = photo.position
    assert (place.latitude_deg, place.longitude_deg) == (32.5189351, -110.9245471)
    assert (place.takeoff_m, place.sigma_xy_m, place.sigma_z_m) == (30.25, 0.71, 1.25)


def test_names_of_yuneec(make_jpeg):
    names = {"AboveHomeAltitude": "34.4", "GimbalYaw": "73.230003", "GimbalPitch": "-89.00000"}
    names |= {"GimbalRoll": "0.000000", "DroneYaw": "96.699997", "DronePitch": "-3.72"}
    told = " ".join(f'drone-yuneec:{name}="{value}"' for name, value in names.items())
    uri = 'xmlns:drone-yuneec="http://www.yuneec.com/drone-yuneec/1.0/"'
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=packet("", f"{uri} {told}")))
    assert angles(photo) == pytest.approx((73.230003, 1, 0), abs=1e-6)
    assert (photo.flight_yaw_deg, photo.flight_tilt_deg) == (96.699997, (-3.72, 0))
    assert (photo.position.takeoff_m, photo.position.datum) == (34.4, "takeoff")


@pytest.mark.parametrize("zero", ["0/100", "0.000000"])
def test_camera_angles_that_are_all_zero_were_not_measured(make_jpeg, zero):
    """FLIR's cameras for drones write them where no autopilot is connected."""
    told = " ".join(f'Camera:{name}="{zero}"' for name in ("Yaw", "Pitch", "Roll"))
    xmp = packet("", f'xmlns:Camera="http://pix4d.com/camera/1.0" {told}')
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp))
    assert photo.attitude is None and any("not measured" in n for n in photo.notes)


def test_a_sign_and_a_reference_are_one_sign(make_jpeg):
    gps = gps_exif(-33.0, 151.0)
    data = bytearray(jpeg_bytes(pixels(), dji_exif(GPS=gps)))
    south = struct.pack(">6I", 33, 1, 0, 1, 0, 100_000)
    assert data.count(south) == 1
    signed = bytes(data).replace(south, struct.pack(">i5I", -33, 1, 30, 1, 0, 100_000))
    entry = struct.pack(">HHI", 2, 5, 3)  # latitude, three rationals
    assert signed.count(entry) == 1
    path = make_jpeg()
    path.write_bytes(signed.replace(entry, struct.pack(">HHI", 2, 10, 3)))
    assert read_photo(path).position.latitude_deg == pytest.approx(-33.5)


EDITOR = (
    'xmlns:exif="http://ns.adobe.com/exif/1.0/" xmlns:tiff="http://ns.adobe.com/tiff/1.0/" '
    'tiff:Make="SONY" tiff:Model="ILCE-6000" exif:FocalLength="160/10" '
    'exif:FocalLengthIn35mmFilm="24" exif:PixelXDimension="96" exif:PixelYDimension="64" '
    'exif:GPSLatitude="{lat}" exif:GPSLongitude="{lon}" exif:GPSAltitude="4123/10" '
    'exif:GPSAltitudeRef="0" exif:DateTimeOriginal="2024-07-15T10:30:02.25"'
)


@pytest.mark.parametrize(
    ("lat", "lon", "place"),
    [
        ("46,35.98530N", "14,17.98016W", (46.599755, -14.299669333)),
        ("33,30,36S", "9,0,0E", (-33.51, 9.0)),
    ],
)
def test_what_only_xmp_tells(make_jpeg, lat, lon, place):
    """Photoshop and Lightroom write PNGs so."""
    photo = read_photo(make_jpeg(xmp=packet("", EDITOR.format(lat=lat, lon=lon))))
    assert (photo.position.latitude_deg, photo.position.longitude_deg) == pytest.approx(place)
    assert photo.position.sea_level_m == 412.3
    assert photo.camera_key == "sony ilce-6000 96x64 16.0mm"
    assert photo.focal.px == pytest.approx(16 / 23.5 * 96, rel=0.01)
    assert photo.time.isoformat() == "2024-07-15T10:30:02.250000"


def test_exif_goes_before_its_copy_in_xmp(make_jpeg):
    xmp = packet("", EDITOR.format(lat="1,0N", lon="2,0E"))
    photo = read_photo(make_jpeg(exif=dji_exif(), xmp=xmp))
    assert photo.position.latitude_deg == pytest.approx(46.5)
    assert photo.camera_key.startswith("dji fc300s")


def chunk(kind, content):
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def hexadecimal(kind, block):
    lines = block.hex()
    lines = "\n".join(lines[i : i + 72] for i in range(0, len(lines), 72))
    return f"\n{kind}\n{len(block):8d}\n{lines}\n".encode()


BLOCK = piexif.dump(dji_exif())
XMP = dji_xmp(GpsLatitude="46.25", GpsLongitude="9.5")
CHUNKS = {
    "exif": chunk(b"eXIf", BLOCK[6:]),
    "imagemagick": chunk(
        b"zTXt", b"Raw profile type exif\0\0" + zlib.compress(hexadecimal("exif", BLOCK))
    ),
    "graphicsmagick": chunk(
        b"tEXt", b"Raw profile type APP1\0" + hexadecimal("generic profile", BLOCK)
    ),
    "xmp": chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + XMP.encode()),
    "xmp packed": chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0en\0\0" + zlib.compress(XMP.encode())),
    "xmp profile": chunk(
        b"zTXt", b"Raw profile type xmp\0\0" + zlib.compress(hexadecimal("xmp", XMP.encode()))
    ),
}


@pytest.mark.parametrize("where", ["before the pixels", "behind them"])
@pytest.mark.parametrize("kind", CHUNKS)
def test_metadata_of_pngs(tmp_path, kind, where):
    """ImageMagick 6 writes hexadecimal digits, ExifTool behind the pixels."""
    buffer = io.BytesIO()
    Image.fromarray(pixels()).save(buffer, "PNG")
    data = buffer.getvalue()
    at = 33 if where == "before the pixels" else len(data) - 12
    path = tmp_path / "a.png"
    path.write_bytes(data[:at] + CHUNKS[kind] + data[at:])
    place = read_photo(path).position
    expected = (46.25, 9.5) if "xmp" in kind else (46.5, -92.0)
    assert (place.latitude_deg, place.longitude_deg) == pytest.approx(expected)


@pytest.mark.parametrize(
    "content",
    [
        b"Raw profile type exif\0\0" + b"no zlib",
        b"Raw profile type exif\0\0" + zlib.compress(b"\nexif\n 12\nno digits"),
        lambda: b"Raw profile type exif\0\0" + zlib.compress(bytes(50_000_000)),
        b"",
    ],
)
def test_broken_metadata_of_pngs_are_none(tmp_path, content):
    info = PngInfo()
    info.add(b"zTXt", content() if callable(content) else content)
    Image.fromarray(pixels()).save(tmp_path / "a.png", pnginfo=info)
    photo = read_photo(tmp_path / "a.png")
    assert isinstance(photo, RejectedPhoto) or photo.position is None


@pytest.mark.parametrize(
    "frame", [b"\xff\xc1\x00\x11\x0c", b"\xff\xc3\x00\x11\x08", b"\xff\xf7\x00\x11\x08"]
)
def test_jpegs_of_many_bits_or_without_loss_are_told(tmp_path, frame):
    data = jpeg_bytes(pixels())
    assert data.count(b"\xff\xc0\x00\x11\x08") == 1
    path = tmp_path / "a.jpg"
    path.write_bytes(data.replace(b"\xff\xc0\x00\x11\x08", frame))
    found = read_photo(path)
    assert isinstance(found, RejectedPhoto) and "more than 8 bits" in found.reason


def test_raw_pictures_are_not_taken_for_grey_ones(tmp_path):
    raw = pixels()[..., 1].astype(np.uint16) * 60
    pattern = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\0\1\1\2", True)]
    tifffile.imwrite(tmp_path / "a.tif", raw, photometric=32803, extratags=pattern)
    found = read_photo(tmp_path / "a.tif")
    assert isinstance(found, RejectedPhoto) and "raw picture" in found.reason


FLIR = (
    'xmlns:FLIR="http://ns.flir.com/xmp/1.0/" xmlns:Camera="http://pix4d.com/camera/1.0" '
    '{prefix}:TlinearGain="{gain}" {prefix}:BandName="LWIR"'
)


@pytest.mark.parametrize("prefix", ["FLIR", "Camera"])
@pytest.mark.parametrize(
    ("gain", "counts", "said", "degrees"),
    [
        ("0.04", 7329, None, 20.01),
        ("0.4", 733, None, 20.05),
        ("0.01", 29315, None, 20.0),
        ("0.00", 29315, None, 20.0),  # not linear: derived from the values
        ("0.04", 29315, "centikelvin", 20.0),
    ],
)
def test_counts_of_flir_are_linear_in_kelvins(tmp_path, prefix, gain, counts, said, degrees):
    """The maker's manual: counts * 0.04 - 273.15, or 0.40 with the wide range."""
    frame = np.full((128, 160), counts, np.uint16)
    frame[40:60, 50:80] += 100
    frame[0, 0] = 0
    xmp = packet("", FLIR.format(prefix=prefix, gain=gain)).encode()
    path = tmp_path / "a.tiff"
    tifffile.imwrite(path, frame, extratags=[(700, "B", len(xmp), xmp, True)])
    photo = read_photo(path, thermal_unit=said)
    assert (photo.band, photo.unit) == ("thermal", "celsius")
    values = read_color(photo)
    assert np.nanmedian(values) == pytest.approx(degrees, abs=0.01)
    step = {None: float(gain) or 0.01, "centikelvin": 0.01}[said]
    assert values[50, 60] - values[0, 90] == pytest.approx(100 * step, abs=1e-3)
    assert np.isnan(values[0, 0]) and np.isfinite(values[0, 1])


@pytest.mark.parametrize(("width", "band"), [(4000, "visible"), (640, "thermal")])
def test_a_visible_picture_of_a_rig_that_says_lwir(make_jpeg, width, band):
    """FLIR's Duo Pro R writes the band of its thermal eye into both files."""
    xmp = packet("", FLIR.format(prefix="Camera", gain="0"))
    image = np.zeros((width * 3 // 4, width, 3), np.uint8)
    assert read_photo(make_jpeg(xmp=xmp, image=image)).band == band


@pytest.mark.parametrize(
    ("source", "band"), [("InfraredCamera", "thermal"), ("WideCamera", "visible"), ("", "visible")]
)
def test_a_picture_of_djis_infrared_camera(make_jpeg, source, band):
    """Models that no table lists, without raw data: they say which camera took it."""
    space = 'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
    xmp = packet("", f'{space} drone-dji:ImageSource="{source}"')
    photo = read_photo(make_jpeg(xmp=xmp, image=np.zeros((512, 640, 3), np.uint8)))
    assert photo.band == band
    # the guess for a lens that nothing tells is that for such cameras
    assert photo.focal.px == pytest.approx({"thermal": 1.15, "visible": 0.75}[band] * 640)


def test_a_date_of_gps_with_a_time(make_jpeg):
    gps = gps_exif(46.5, 9.0) | {7: ((15, 1), (28, 1), (54, 1)), 29: "2017:09:16 15:28:54"}
    exif = {"0th": {}, "Exif": {}, "GPS": gps}
    assert read_photo(make_jpeg(exif=exif)).time.isoformat() == "2017-09-16T15:28:54+00:00"
