"""The methods of this package by name. Addresses only: a module is imported when its method is
used.

The rows of `skyquilt.papers` are added here, from above, so that nothing below knows them.
"""

from skyquilt.effects import BY_PIXELS
from skyquilt.registry import register

DETECTORS = {
    "sift": "skyquilt.matching.sift:Sift",
    "sift-all": "skyquilt.papers.sift_all:sift_all",
    "surf": "skyquilt.papers.surf:Surf",
    "usurf": "skyquilt.papers.surf:upright_surf",
    "harris": "skyquilt.papers.harris:Harris",
    "orb": "skyquilt.matching.binary_features:Orb",
    "akaze": "skyquilt.matching.binary_features:Akaze",
}
MATCHERS = {
    "mutual": "skyquilt.matching.matchers:Mutual",
    "guided": "skyquilt.matching.matchers:Guided",
    "one-way": "skyquilt.matching.matchers:OneWay",
}
ESTIMATORS = {
    "ransac": "skyquilt.matching.ransac:Ransac",
    "lmeds": "skyquilt.papers.lmeds:Lmeds",
    "magsac": "skyquilt.papers.magsac:Magsac",
    "ste": "skyquilt.papers.ste:RansacSte",
    "ste-printed": "skyquilt.papers.ste:literal",
    "ncc": "skyquilt.papers.direct:by_ncc",
    "phase": "skyquilt.papers.direct_refinement:by_phase",
    "ecc": "skyquilt.papers.direct_refinement:by_ecc",
    "mi": "skyquilt.papers.direct_refinement:by_mutual_information",
}
REGISTRATIONS = {
    "auto": "skyquilt.coregistration.methods:auto",
    "sift": "skyquilt.papers.rfae:sift",
    "surf": "skyquilt.papers.rfae:surf",
    "usurf": "skyquilt.papers.rfae:usurf",
    "sift-octave0": "skyquilt.papers.rfae:sift_from_own_size",
    "surf-lobe": "skyquilt.papers.rfae:surf_by_lobe",
    "rfae": "skyquilt.papers.rfae:rfae",
    "rfae-sift": "skyquilt.papers.rfae:rfae_sift",
    "rfae-printed": "skyquilt.papers.rfae:rfae_as_printed",
    "rfae-refined": "skyquilt.papers.rfae:rfae_refined",
    "surf+rfae": "skyquilt.papers.rfae:surf_and_rfae",
    "structure": "skyquilt.coregistration.methods:structure",
    "shapes": "skyquilt.coregistration.methods:shapes",
}
TRANSFORMS = ("translation", "similarity", "affine", "homography")
_ANY = tuple(DETECTORS)
_LINKS = {
    "detector": _ANY,
    "matcher": ("mutual", "guided", "one-way"),
    "estimator": ("ransac", "lmeds", "magsac"),
}
"""What methods take that verify links between photos; the estimator is that of their epipolar
geometry.
"""
_HEIGHT: dict[str, tuple[str, ...]] = {"height": ()}
_REPAIRED: dict[str, tuple[str, ...]] = {"trust-metadata": ()}
_HEIGHTS: dict[str, tuple[str, ...]] = dict.fromkeys(
    ("distortion", "surface", "dtm", "contours", "vertical-datum"), ()
)
"""What methods take that find the heights of the ground."""
_PLANE: dict[str, tuple[str, ...]] = {"distortion": (), "seed": ()}
ALIGNMENTS: dict[str, tuple[str, dict[str, tuple[str, ...]]]] = {
    "auto": ("skyquilt.workflows.methods:auto", _LINKS | _REPAIRED | _HEIGHT | _HEIGHTS),
    "bundle": ("skyquilt.workflows.methods:bundle", _LINKS | _REPAIRED | _HEIGHT | _HEIGHTS),
    "position": (
        "skyquilt.workflows.methods:position",
        _LINKS | _REPAIRED | _HEIGHT | {"heading": ()},
    ),
    "pose": ("skyquilt.workflows.methods:pose", _LINKS | _REPAIRED | _HEIGHT),
    "image": (
        "skyquilt.papers.aligners:image",
        {
            "detector": _ANY,
            "matcher": ("mutual", "one-way"),
            "estimator": ("ransac", "lmeds", "magsac", "ste", "ste-printed", *BY_PIXELS),
            "transform": TRANSFORMS,
            "relief": (),
            "levelled": (),
            "image-search": ("chain", "loop", "overview"),
            **_HEIGHT,
            **_PLANE,
        },
    ),
    "hybrid": (
        "skyquilt.papers.aligners:hybrid",
        _LINKS | _REPAIRED | _HEIGHT | {"optimiser": ("anneal", "surfaces"), "seed": ()},
    ),
    "flightline": (
        "skyquilt.papers.aligners:flightline",
        {
            "detector": _ANY,
            "matcher": ("mutual",),
            "estimator": ("ste", "ste-printed", "ransac", "lmeds", "magsac"),
            "transform": TRANSFORMS,
            "lines": ("heading", "distance"),
            **_PLANE,
        },
    ),
}

NOTEBOOK = {
    "result": "skyquilt.runs.notebook:result_html",
    "survey": "skyquilt.runs.notebook:survey_html",
}
"""How records are shown in notebooks."""


def _register() -> None:
    tables = {
        "notebook": NOTEBOOK,
        "detector": DETECTORS,
        "matcher": MATCHERS,
        "estimator": ESTIMATORS,
        "registration": REGISTRATIONS,
    }
    for stage, table in tables.items():
        for name, make in table.items():
            register(stage, name, make)
    for name, (make, takes) in ALIGNMENTS.items():
        register("alignment", name, make, takes)


_register()
