"""Made-up runs, and a parser that accepts well-formed pages only."""

from html.parser import HTMLParser

import numpy as np

from skyquilt.report import CameraResiduals, ReportInput, SeamMark, Shot

VOID = {"meta", "input", "br", "hr", "img", "link"}


class Page(HTMLParser):
    """Fails on tags that do not nest; collects ids, references and text."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.ids, self.links, self.tags, self.words, self.attributes = (
            [],
            [],
            [],
            [],
            [],
            [],
        )
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self._note(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        self._note(tag, attrs)

    def _note(self, tag, attrs):
        names = [k for k, _ in attrs]
        assert len(names) == len(set(names)), (tag, names)
        self.tags.append(tag)
        self.attributes += attrs
        self.ids += [v for k, v in attrs if k == "id"]
        self.links += [v for k, v in attrs if k in ("href", "src")]

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, (tag, self.open[-4:])
        self.open.pop()

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("script", "style"):
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def shots(n, *, name="IMG_{:04d}.JPG", rng=None):
    rng = rng or np.random.default_rng(1)
    side = int(np.ceil(np.sqrt(n)))
    corners = np.array([[-40.0, -30], [40, -30], [40, 30], [-40, 30]])
    made = []
    for k in range(n):
        xyz = np.array([20.0 * (k % side), 25.0 * (k // side), 60.0])
        made.append(
            Shot(
                name=name.format(k),
                xyz=xyz,
                reported_xyz=xyz + rng.normal(0, 1.5, 3),
                block=int(k > 0.9 * n),
                method="bundle",
                footprint=corners + xyz[:2],
            )
        )
    return made


def run(n=18, *, observations=6000, samples=800, **changes):
    """A whole run of n photos."""
    rng = np.random.default_rng(0)
    taken = shots(n, rng=rng)
    xy = np.array([s.xyz[:2] for s in taken])
    west, south, east, north = (*(xy.min(0) - 40), *(xy.max(0) + 40))
    bounds = (float(west), float(south), float(east), float(north))
    width, height = 600, max(2, int(600 * (north - south) / (east - west)))
    y, x = np.mgrid[:height, :width]
    preview = np.dstack([x % 256, y % 256, (x + y) % 256, np.full_like(x, 255)]).astype(np.uint8)
    preview[:20, :30, 3] = 0
    px = rng.uniform(0, 1, (observations, 2)) * (4000, 2250)
    made = {
        "metrics": metrics(n),
        "preview": preview,
        "bounds": bounds,
        "origin": (576_700.0, 5_188_100.0),
        "crs": "EPSG:32615",
        "views": rng.integers(0, 12, (60, 80)),
        "views_bounds": bounds,
        "surface": rng.normal(3, 1, (50, 60)).astype(np.float32),
        "surface_bounds": bounds,
        "vertical_datum": "takeoff",
        "shots": taken,
        "residuals": [
            CameraResiduals(
                camera="dji fc300s",
                width=4000,
                height=2250,
                px=px,
                residual_px=rng.normal(0, 0.5, px.shape),
            )
        ],
        "seams": [
            SeamMark(
                x=float(rng.uniform(west, east)),
                y=float(rng.uniform(south, north)),
                disparity_px=None if k % 5 == 0 else float(rng.gamma(1.5, 0.7)),
            )
            for k in range(samples)
        ],
        "settings": {"method": "auto", "render": {"blend": "feather", "width_px": 4}, "gsd": None},
        "title": "North field",
        "version": "0.1.0",
    }
    return ReportInput(**(made | changes))


def metrics(n):
    return {
        "method": "bundle",
        "photos_total": n + 1,
        "photos_used": n,
        "photos_rejected": {"IMG_9999.JPG": "the file ends early"},
        "gsd_m": 0.02,
        "crs": "EPSG:32615",
        "blocks": [n],
        "gps_residual_rms_m": {"x": 0.3, "y": 0.2, "z": 0.4},
        "gps_leave_one_out_rms_m": {"x": 0.4, "y": 0.3, "z": 0.5},
        "reprojection_error_px": {"mean": 0.6, "rms": 0.8},
        "tie_points": 2307,
        "seam_disparity_px": {"median": 0.9, "p95": 3.0, "measured": 640, "attempted": 800},
        "metadata_conflicts": [
            {"photo": "IMG_0003.JPG", "field": "yaw", "reported": -137.0, "estimated": 43.0},
            {
                "photo": "IMG_0004.JPG",
                "field": "position",
                "reported": [1.0, 2.0],
                "estimated": [3.0, 4.0],
            },
        ],
        "seconds": {"photos": 0.1, "features": 4.6, "render": 5.1, "total": 11.0},
        "cpu_seconds": 12.0,
        "peak_memory_mb": 812.0,
        "control": [
            {
                "name": "g1",
                "check": False,
                "dx_m": 0.01,
                "dy_m": 0.02,
                "dz_m": None,
                "reprojection_px": 0.5,
                "sightings": 4,
            },
            {
                "name": "g2",
                "check": True,
                "dx_m": 0.03,
                "dy_m": 0.04,
                "dz_m": 0.1,
                "reprojection_px": 0.7,
                "sightings": 5,
            },
        ],
        "cameras": {
            "dji fc300s": {
                "focal": {"value": 2286.0, "sigma": 17.8, "prior": 2310.0, "prior_sigma": 5.0},
                "k1": {"value": -0.00487, "sigma": 0.00115, "prior": None, "prior_sigma": None},
            }
        },
        "notes": ["The shutter rolls, which is not modelled."],
        "warnings": ["Two photos share one second."],
    }
