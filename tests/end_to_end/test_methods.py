"""Every method of alignment by its name, from photos to map, and what it refuses."""

import json
import math

import numpy as np
import pytest

from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from tests.end_to_end.conftest import HIGH, WIDE, keep, named, relabel, skyquilt
from tests.once import flown_once

METHODS = ("position", "pose", "image", "hybrid", "flightline")


@pytest.fixture(scope="session")
def lines(tmp_path_factory):
    """Twelve photos in three lines of four, with their truth."""
    route = Route(site=(45.0, 60.0), overlap=0.7, sidelap=0.5, height=60.0)
    settings = FlightSettings(
        seed=5, lens=Lens().scaled(WIDE, HIGH), route=route, control=Control(points=4, checks=0)
    )
    return flown_once(tmp_path_factory, "lines", settings)


def places(folder):
    """True positions (n, 3) in the output CRS by name."""
    return {
        p["name"]: np.array(p["position"])
        for p in json.loads((folder / "truth" / "truth.json").read_text())["photos"]
    }


def solved(told):
    shots = json.loads((told.output / "shots.geojson").read_text())["features"]
    return {s["properties"]["filename"]: np.array(s["properties"]["translation"]) for s in shots}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_makes_a_map(mosaic, lines, method):
    told = mosaic(lines / "photos", "--method", method).made()
    m, q = told.metrics, told.metrics["quality"]
    n = len(named(lines / "photos"))
    assert m["method"] == method and m["photos_used"] == n and m["crs"] == "EPSG:32633"
    assert 0.5 < q["lambda_corr"] <= 1 and len(q["correlation_with_last_of_photo"]) == n == len(
        q["photos"]
    )
    truth, found = places(lines), solved(told)
    off = np.array([found[k][:2] - truth[k][:2] for k in found])
    # positions are reported with 2 m; an alignment may average or keep that, and no more is lost
    assert np.sqrt((off**2).sum(1).mean()) < 5.0


@pytest.mark.slow
def test_hybrid_fits_better_than_pose_and_image_too(mosaic, lines, tmp_path):
    corr = {}
    for method in ("pose", "image", "hybrid"):
        told = mosaic(lines / "photos", "--method", method, output=tmp_path / method).made()
        corr[method] = told.metrics["quality"]["lambda_corr"]
    assert corr["pose"] < corr["hybrid"] - 0.02 and corr["pose"] < corr["image"] - 0.02


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ("--method", "image", "--image-search", "overview"),
        ("--method", "image", "--transform", "homography", "--no-levelled"),
        ("--method", "image", "--relief", "3", "--height", "60", "--sequence", "name"),
        ("--method", "hybrid", "--optimiser", "anneal", "--seed", "4"),
        ("--method", "hybrid", "--alpha", "0.9", "--trust-metadata"),
        ("--method", "flightline", "--blend", "feather", "--distortion", "4"),
        ("--method", "position", "--heading", "20"),
    ],
)
def test_options_of_methods(mosaic, lines, options):
    told = mosaic(lines / "photos", *options).made()
    assert told.metrics["photos_used"] == len(named(lines / "photos"))


@pytest.mark.long
@pytest.mark.slow
def test_equal_seeds_give_equal_maps(mosaic, lines, tmp_path):
    found = [
        solved(
            mosaic(
                lines / "photos",
                "--method",
                "hybrid",
                "--optimiser",
                "anneal",
                "--seed",
                seed,
                output=tmp_path / k,
            ).made()
        )
        for k, seed in (("a", "1"), ("b", "1"), ("c", "2"))
    ]
    a, b, c = (np.array([f[k] for k in sorted(f)]) for f in found)
    assert np.array_equal(a, b) and not np.array_equal(a, c)


@pytest.mark.slow
def test_known_distances_are_measured_on_the_map(mosaic, lines, tmp_path):
    """Between the control points: known to 2 cm."""
    rows = [r.split("\t") for r in (lines / "gcp_list.txt").read_text().splitlines()[1:]]
    first = {r[6]: r for r in reversed(rows)}
    names = sorted(first)[:3]
    text = "point_a,point_b,metres,px_a,py_a,image_a,px_b,py_b,image_b\n"
    for a, b in ((names[0], names[1]), (names[1], names[2])):
        p, q = first[a], first[b]
        metres = np.hypot(float(p[0]) - float(q[0]), float(p[1]) - float(q[1]))
        text += f"{a},{b},{metres:.4f},{p[3]},{p[4]},{p[5]},{q[3]},{q[4]},{q[5]}\n"
    (tmp_path / "known.csv").write_text(text)
    q = mosaic(lines / "photos", "--distances", tmp_path / "known.csv").made().metrics["quality"]
    assert (
        all(abs(d["on_map"] / d["metres"] - 1) < 0.05 for d in q["distances"])
        and len(q["distances"]) == 2
    )
    assert 0.9 < q["lambda_spat_of_table"] < q["lambda_spat"] < 1
    assert q["lambda"] == pytest.approx((q["lambda_spat"] + q["lambda_corr"]) / 2, abs=1e-4)


@pytest.mark.slow
def test_where_photos_do_not_overlap_a_new_piece_begins_and_is_said(mosaic, photos):
    keep(photos, 0, 1, 2, 3, 5)
    told = mosaic(photos, "--method", "image").made()
    rest = named(photos)
    if len(told.metrics["blocks"]) > 1:
        assert "a new piece begins there" in told.notes
    assert sum(told.metrics["blocks"]) == len(rest)


@pytest.mark.slow
def test_strangers_begin_a_piece_of_their_own(mosaic, photos, lines):
    """Two flights in one folder, one after the other: the sequence breaks between them."""
    import shutil

    for k, path in enumerate(named(lines / "photos")[:3]):
        shutil.copy(path, photos / f"ZZ_{k}.jpg")
    told = mosaic(photos, "--method", "image", "--sequence", "name").made()
    assert len(told.metrics["blocks"]) >= 2
    assert "ZZ_0.jpg does not match SIM_0009.jpg, the photo before it" in told.notes


@pytest.mark.slow
def test_what_methods_need_is_said_when_it_is_missing(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["position"])
    mosaic(photos, "--method", "flightline").refused(
        4, "positions of at least two flight lines", "--method image"
    )
    two, three, four = (photos.parent / name for name in ("two", "three", "four"))
    mosaic(photos, "--method", "hybrid", "--height", "60", output=two).refused(
        4, "places photos by their metadata", "no position"
    )
    mosaic(photos, "--method", "position", "--height", "60", output=three).refused(4, "no position")
    told = mosaic(photos, "--method", "image", output=four).made()
    assert told.metrics["crs"] is None and told.metrics["photos_used"] == 9


@pytest.mark.slow
def test_headings_missing(mosaic, photos):
    for path in named(photos):
        relabel(path, drop=["xmp"])
    mosaic(photos, "--method", "hybrid", "--trust-metadata").refused(4, "--height")
    two, three = photos.parent / "two", photos.parent / "three"
    mosaic(photos, "--method", "hybrid", "--trust-metadata", "--height", "60", output=two).refused(
        4, "no heading"
    )
    assert (
        mosaic(photos, "--method", "hybrid", output=three).made().metrics["photos_used"] == 9
    )  # links tell both


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "point_a,point_b,metres,px_a,py_a,image_a,px_b,py_b,image_b\n"
            "A,B,3,1,1,nine.jpg,2,2,SIM_0001.jpg\n",
            ("names nine.jpg", "no photo of the survey"),
        ),
        ("point_a,point_b,metres\nA,B,3\n", ("there is no observation of point 'A'",)),
        ("hello\n", ("expected a header with point_a, point_b, metres",)),
    ],
)
def test_distances_that_cannot_be_used(mosaic, flight, tmp_path, text, words):
    (tmp_path / "known.csv").write_text(text)
    mosaic(flight / "photos", "--distances", tmp_path / "known.csv").refused(6, *words)


def test_a_sequence_that_cannot_be_used(mosaic, flight, tmp_path):
    (tmp_path / "order.txt").write_text("SIM_0001.jpg\nSIM_0099.jpg\n")
    mosaic(flight / "photos", "--method", "image", "--sequence", tmp_path / "order.txt").refused(
        6, "SIM_0099.jpg"
    )
    mosaic(flight / "photos", "--method", "image", "--sequence", "backwards").refused(
        6, "backwards cannot be read"
    )


@pytest.mark.slow
def test_photos_that_a_sequence_does_not_name_are_left_out(mosaic, flight, tmp_path):
    (tmp_path / "order.txt").write_text("".join(f"SIM_000{k}.jpg\n" for k in (3, 2, 1)))
    told = mosaic(
        flight / "photos", "--method", "image", "--sequence", tmp_path / "order.txt"
    ).made()
    assert told.metrics["photos_used"] == 3
    assert told.metrics["photos_rejected"]["SIM_0005.jpg"] == "it is not listed in the sequence"


@pytest.mark.long
@pytest.mark.slow
def test_compare_sets_methods_side_by_side(lines, tmp_path):
    out = tmp_path / "out"
    code, told, err = skyquilt(
        "compare",
        lines / "photos",
        "-o",
        out,
        "--methods",
        "pose,image,hybrid,bundle",
        "--gsd",
        "30",
        "--known",
        lines / "gcp_list.txt",
        "--jobs",
        "2",
    )
    assert code == 0, err
    record = json.loads((out / "compare.json").read_text())
    assert list(record["methods"]) == ["pose", "image", "hybrid", "bundle"]
    assert "gcp_list.txt" in record["judged_by"] and "hybrid" in told
    for column in record["methods"].values():
        assert column["lambda"] == pytest.approx(
            (column["lambda_spat"] + column["lambda_corr"]) / 2, abs=1e-3
        )
        assert len(column["distances"]) == 6 and all(d["on_map"] for d in column["distances"])
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == 4 and "http" not in page.replace("http-equiv", "")
    assert "Table 6.1" in page and "Fig. 6.4" in page and "A Table 2" in page
    again = skyquilt("compare", lines / "photos", "-o", out)
    assert again[0] == 5 and "--overwrite" in again[2]


@pytest.mark.slow
def test_compare_judges_by_baselines_where_nothing_is_known(lines, tmp_path):
    code, _, err = skyquilt(
        "compare",
        lines / "photos",
        "-o",
        tmp_path / "out",
        "--methods",
        "pose,flightline,bundle",
        "--gsd",
        "30",
        "--first",
        "8",
        "--lines",
        "distance",
    )
    assert code == 0, err
    record = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert "baselines" in record["judged_by"] and len(record["photos"]) == 8
    # what the bundle says of its own tie points is no judge: those distances are gone
    assert not (tmp_path / "out" / "distances.csv").exists()
    truth = json.loads((lines / "truth" / "truth.json").read_text())["photos"]
    place = {p["name"]: p["position"] for p in truth}
    bundle, pose = (record["methods"][m] for m in ("bundle", "pose"))
    assert len(bundle["distances"]) == len(pose["distances"]) == 15
    for d in bundle["distances"]:
        true = math.dist(place[d["a"]][:2], place[d["b"]][:2])
        assert d["on_map"] == pytest.approx(true, rel=0.05)  # reported ones are off by up to 36 %
    assert pose["lambda_spat"] is None is pose["distances"][0]["on_map"]  # it repeats them
    assert 0.9 < bundle["lambda_spat"] < 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--methods", "magic"), ("--methods magic", "flightline")),
        (("--first", "1"), ("--first 1", "two photos")),
        (("--alpha", "2"), ("--alpha 2",)),
        (("--quiet", "--json"), ("exclude one another",)),
    ],
)
def test_compare_with_wrong_options(flight, tmp_path, options, words):
    code, _, err = skyquilt("compare", flight / "photos", "-o", tmp_path / "out", *options)
    assert code == 2 and all(w in err for w in words), err
