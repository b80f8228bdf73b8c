"""Files of multispectral cameras as their makers write them, with a TIFF's directories by hand."""

import base64
import struct

import numpy as np
import tifffile

RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
SPACES = {
    "Camera": "http://pix4d.com/camera/1.0",
    "MicaSense": "http://micasense.com/MicaSense/1.0/",
    "DLS": "http://micasense.com/DLS/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
}
_PLACE = 65001, 4, 1, 0x7ABCDEF1
"""An entry in place of that of the directory of EXIF, which tifffile does not write."""


def write_tiff(path, counts, xmp, image=(), exif=()):
    """A TIFF with an XMP packet, more tags (number, value) in its directory and in that of EXIF:
    text, whole numbers or a list of these, and real numbers.
    """
    more = [(700, "B", len(xmp.encode()), xmp.encode(), True), (65001, "I", 1, _PLACE[3], True)]
    for number, value in image:
        kind = "s" if isinstance(value, str) else "H"
        more.append((number, kind, 0 if kind == "s" else np.size(value), value, True))
    tifffile.imwrite(path, counts, extratags=more, metadata=None, software=False)
    data = path.read_bytes()
    assert data.count(struct.pack("<HHII", *_PLACE)) == 1
    data += b"\0" * (len(data) % 2)
    at = len(data)
    behind = at + 2 + 12 * len(exif) + 4
    entries, values = b"", b""
    for number, value in sorted(exif):
        if isinstance(value, int):
            entries += struct.pack("<HHIHH", number, 3, 1, value, 0)
        else:
            entries += struct.pack("<HHII", number, 5, 1, behind + len(values))
            values += struct.pack("<II", round(value * 10**7), 10**7)
    directory = struct.pack("<H", len(exif)) + entries + bytes(4) + values
    entry = struct.pack("<HHII", 34665, 4, 1, at)
    path.write_bytes(data.replace(struct.pack("<HHII", *_PLACE), entry) + directory)
    return path


def packet(form="elements", **values):
    """An XMP packet of `prefix__Name=value`; a tuple is a sequence."""
    spaces = " ".join(f'xmlns:{p}="{uri}"' for p, uri in SPACES.items())
    told = {k.replace("__", ":").replace("dji:", "drone-dji:"): v for k, v in values.items()}
    simple = {k: v for k, v in told.items() if form == "attributes" and not isinstance(v, tuple)}
    attributes = " ".join(f'{k}="{v}"' for k, v in simple.items())
    inside = ""
    for name, value in told.items():
        if name not in simple:
            items = (
                "".join(f"<rdf:li>{v}</rdf:li>" for v in value) if isinstance(value, tuple) else ""
            )
            inside += f"<{name}>{f'<rdf:Seq>{items}</rdf:Seq>' if items else value}</{name}>"
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{RDF}"><rdf:Description'
        f' rdf:about="" {spaces} {attributes}>{inside}</rdf:Description></rdf:RDF></x:xmpmeta>'
    )


MICASENSE = {
    "Camera__BandName": "Red edge",
    "Camera__CentralWavelength": "717",
    "Camera__WavelengthFWHM": "12",
    "Camera__RigCameraIndex": "4",
    "Camera__VignettingCenter": (98.5, 61.25),
    "Camera__VignettingPolynomial": (-1.1e-4, 1.3e-6, -1.1e-7, 3.1e-10, -3.8e-13, 1.7e-16),
    "MicaSense__RadiometricCalibration": (0.00014576, 1.394e-07, 1.171e-05),
    "MicaSense__CaptureId": "DFj0YDYQsRJd6hDUj7qZ",
    "DLS__SpectralIrradiance": "101.5",
    "DLS__HorizontalIrradiance": "118.25",
    "DLS__IrradianceScaleToSIUnits": "0.01",
}
"""As a RedEdge-MX writes them."""


def micasense(path, counts, exposure=0.0004, model="RedEdge-M", software="v7.5.0", **changes):
    """A file of a MicaSense camera; a change to None leaves a tag out."""
    values = {k: v for k, v in (MICASENSE | changes).items() if v is not None}
    image = [(271, "MicaSense"), (272, model), (305, software), (50714, [4800, 4816, 4784, 4800])]
    exif = [(0x829A, exposure), (0x829D, 2.8), (0x8833, 200)]
    return write_tiff(path, counts, packet(**values), image, exif)


DJI = {
    "dji__BandName": "RedEdge",
    "dji__BandFreq": "730(+/-16)nm",
    "dji__SensorIndex": "3",
    "dji__CaptureUUID": "3377fb05-b357-448f-b87b-7023daebbaed",
    "dji__BlackCurrent": "3200",
    "dji__SensorGain": "2.5",
    "dji__SensorGainAdjustment": "0.9375",
    "dji__ExposureTime": "800",
    "dji__Irradiance": "9741.75",
    "dji__CalibratedOpticalCenterX": "101.5",
    "dji__CalibratedOpticalCenterY": "66.5",
    "dji__VignettingData": "1e-04, 2e-06, 1e-08, 1e-11, 1e-14, 1e-17",
}
"""As a Mavic 3M writes them."""


def dji(path, counts, model="M3M", image=(), **changes):
    """A file of a multispectral camera of DJI's."""
    values = {k: v for k, v in (DJI | changes).items() if v is not None}
    xmp = packet("attributes", **values)
    return write_tiff(path, counts, xmp, [(271, "DJI"), (272, model), *image])


def reading(count, index=1, ms=100, time_us=10**9):
    """One of the readings of the Sequoia's sun sensor."""
    return struct.pack("<QHHHHfff", time_us, count, count // 2, index, ms, 1.5, -0.5, 0.25)


SEQUOIA = {
    "Camera__BandName": "NIR",
    "Camera__CentralWavelength": "790",
    "Camera__WavelengthFWHM": "40",
    "Camera__RigCameraIndex": "3",
    "Camera__CaptureUUID": "B9A2F3676304A83F92261B5245124F28",
    "Camera__SensorModel": ("1.04,3997.5,180.25",),
    "Camera__VignettingPolynomial2DName": "0,0,1,0,0,1,2,0,1,1,0,2",
    "Camera__VignettingPolynomial2D": "0.55,0.9,0.85,-0.91,0.01,-0.84",
    "Camera__IrradianceCalibrationMeasurement": "0,600,33,17,1,600,820,417,2,600,13526,6824,3,"
    "600,65535,65535",
}
"""As a Sequoia writes them."""


def sequoia(path, counts, readings=(), **changes):
    """A file of Parrot's Sequoia; a reading of three is an outlier unless others are given."""
    readings = readings or (reading(330), reading(331), reading(9))
    listed = base64.b64encode(b"".join(readings)).decode()
    values = SEQUOIA | {"Camera__IrradianceList": listed} | changes
    values = {k: v for k, v in values.items() if v is not None}
    exif = [(0x829A, 0.00125), (0x829D, 2.2), (0x8827, 100)]
    return write_tiff(
        path, counts, packet("attributes", **values), [(271, "Parrot"), (272, "Sequoia")], exif
    )
