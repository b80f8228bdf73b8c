"""Methods by name and methods of one's own, in the real flow; the oracle is the simulator."""

import json
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest

from skyquilt import catalogue, registry
from skyquilt.errors import UsageError
from skyquilt.matching.sift import Sift
from skyquilt.model.features import Features
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import mosaic

QUICK = {"surface": "ties", "gsd_cm": 30.0, "jobs": 2}


def off_m(flight, output):
    """Median distance in m of the placed cameras from the true ones, less what all have in common:
    the height that goes with the focal length.
    """
    truth = json.loads((flight / "truth" / "truth.json").read_text())
    at = {p["name"]: np.array(p["position"]) for p in truth["photos"]}
    shots = json.loads((output / "shots.geojson").read_text())["features"]
    found = [(s["properties"]["filename"], s["properties"]["translation"]) for s in shots]
    off = np.array([np.array(c) - at[name] for name, c in found])
    return float(np.median(np.linalg.norm(off - off.mean(0), axis=1)))


def placed(flight, tmp_path, **asked):
    gcp = next(flight.rglob("gcp_list.txt"))
    quick = {k: v for k, v in QUICK.items() if k != "surface" or "method" not in asked}
    result = mosaic(flight / "photos", tmp_path / "out", MosaicSettings(gcp=gcp, **quick, **asked))
    assert result.metrics["photos_used"] == 9
    return result


@pytest.mark.slow
@pytest.mark.parametrize("detector", ["orb", "sift", "surf", "akaze"])
def test_bundle_by_every_detector_that_turns_with_the_photos(flight, tmp_path, detector):
    made = placed(flight, tmp_path, detector=detector, features=1500)
    assert made.metrics["blocks"] == [9]
    assert 0.005 < off_m(flight, tmp_path / "out") < 0.3  # four map pixels of the photos


@pytest.mark.slow
@pytest.mark.parametrize("detector", [pytest.param("usurf", marks=pytest.mark.long), "harris"])
def test_upright_features_link_photos_of_one_heading_only(flight, tmp_path, detector):
    """Lines are flown to and fro: every line hangs together, none with the next."""
    made = placed(flight, tmp_path, detector=detector, features=1500)
    assert len(made.metrics["blocks"]) > 1
    assert max(made.metrics["blocks"]) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("matcher", ["guided", "one-way"])
def test_bundle_by_every_matcher(flight, tmp_path, matcher):
    made = placed(flight, tmp_path, matcher=matcher)
    assert made.metrics["blocks"] == [9]
    assert 0.005 < off_m(flight, tmp_path / "out") < 0.3  # four map pixels of the photos


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ransac", "lmeds", "magsac"])
def test_bundle_by_every_estimator(flight, tmp_path, estimator):
    made = placed(flight, tmp_path, estimator=estimator)
    assert made.metrics["blocks"] == [9]
    assert 0.005 < off_m(flight, tmp_path / "out") < 0.3  # four map pixels of the photos


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    "estimator", ["ransac", "lmeds", "magsac", "ste", "ncc", "phase", "ecc", "mi"]
)
def test_image_by_every_estimator(flight, tmp_path, estimator):
    """Level ground and small tilts: neighbours differ by little more than a similarity."""
    made = placed(flight, tmp_path, method="image", estimator=estimator)
    assert max(made.metrics["blocks"]) >= 3
    assert made.metrics["quality"]["lambda_corr"] > 0.7


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ste", "ransac", "lmeds", "magsac"])
def test_flight_lines_by_every_estimator(flight, tmp_path, estimator):
    made = placed(flight, tmp_path, method="flightline", estimator=estimator)
    assert made.metrics["quality"]["lambda_corr"] > 0.7


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"detector": "sift2"},
            "'sift2' is not one of sift, sift-all, surf, usurf, harris, orb, akaze",
        ),
        ({"matcher": "best"}, "'best' is not one of mutual, guided, one-way"),
        ({"estimator": "x"}, "is not one of ransac, lmeds, magsac, ste, ste-printed, ncc"),
        ({"estimator": "ste"}, "takes --estimator ransac, lmeds, magsac, not ste"),
        ({"method": "image", "matcher": "guided"}, "takes --matcher mutual, one-way, not guided"),
        ({"method": "flightline", "estimator": "ncc"}, "not ncc"),
        ({"method": "pose", "repair": False, "detector": "orb"}, "compares no photos"),
        ({"optimiser": "anneal"}, "--optimiser is for --method hybrid; the method here is auto"),
        ({"lines": "distance"}, "--lines is for --method flightline"),
        ({"levelled": False}, "--levelled is for --method image"),
        ({"heading_deg": 3.0}, "--heading is for --method position"),
        ({"method": "image", "estimator": "ncc", "detector": "orb"}, "compares pixels"),
        ({"method": "image", "estimator": "ncc", "transform": "affine"}, "similarity or"),
        ({"method": "image", "estimator": "mi", "image_search": "overview"}, "chain"),
    ],
)
def test_what_a_method_does_not_take_is_refused(asked, said):
    with pytest.raises(UsageError, match=said):
        methods_for(MosaicSettings(**asked))


def test_every_combination_that_is_taken_can_be_made():
    for name in registry.names("alignment"):
        for option, words in registry.row("alignment", name).takes.items():
            for word in words:
                setting = option.replace("-", "_")
                methods_for(MosaicSettings(method=name, **{setting: word}))


def test_every_row_of_the_catalogue_names_something():
    for stage in registry.STAGES:
        assert registry.names(stage)
        for name in registry.names(stage):
            assert callable(registry.load(stage, name))
    assert tuple(catalogue.DETECTORS) == registry.names("detector")


def test_settings_come_in_groups_and_by_name():
    by_name = MosaicSettings(method="image", gsd_cm=2.0, relief_m=5.0, jobs=3)
    by_group = MosaicSettings(
        method="image",
        picture=replace(MosaicSettings().picture, gsd_cm=2.0),
        image=replace(MosaicSettings().image, relief_m=5.0),
        running=replace(MosaicSettings().running, jobs=3),
    )
    assert by_name == by_group
    assert by_name.changed(gsd_cm=None, relief_m=None, jobs=0, method="auto") == MosaicSettings()
    with pytest.raises(TypeError, match="no setting gsd"):
        MosaicSettings(gsd=2.0)


@dataclass(frozen=True, kw_only=True)
class Counting:
    """SIFT that keeps account of its pictures."""

    inner: Sift = field(default_factory=Sift)
    version: ClassVar[int] = 7
    seen: ClassVar[list[tuple[int, ...]]] = []

    @property
    def longest(self) -> int:
        return self.inner.longest

    def of_shrunken(self, small: np.ndarray, full: tuple[int, int]) -> Features:
        self.seen.append(small.shape)
        return self.inner.of_shrunken(small, full)


@pytest.mark.slow
def test_a_detector_of_ones_own_takes_part_in_the_real_flow(flight, tmp_path):
    settings = MosaicSettings(**QUICK)
    own = replace(methods_for(settings), detector=Counting())
    usual = mosaic(flight / "photos", tmp_path / "usual", settings)
    made = mosaic(flight / "photos", tmp_path / "own", settings, methods=own)
    assert len(Counting.seen) == 9 and max(Counting.seen[0]) <= 512
    assert made.metrics["tie_points"] == usual.metrics["tie_points"]
    # another method is another run: nothing is taken over from the usual one
    again = mosaic(flight / "photos", tmp_path / "own", settings, methods=own)
    assert again.metrics == made.metrics and len(Counting.seen) == 9
