"""The bench: rows, the truth, the thesis's tables; and the requirements on the real pairs."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from skyquilt.errors import OutputError, SideFileError, UsageError
from skyquilt.papers.pair_list import COLUMNS, read_pairs
from skyquilt.papers.spectral_bench import iter_spectral_bench
from tests.coregistration.scenes import pair, turned

SHAPE = (400, 480)
REAL = Path(__file__).parents[2].parent / "shared" / "data" / "spectral" / "pairs.csv"


def line(kind, source, a, b, tolerance, h):
    return ",".join([kind, source, a, b, str(tolerance), *(f"{v:.9g}" for v in np.ravel(h))])


@pytest.fixture(scope="module")
def listed(tmp_path_factory):
    """Three pairs: one right, one whose truth in the list is wrong by 7 px, one without its
    picture.
    """
    folder = tmp_path_factory.mktemp("pairs")
    truth = turned(1.0, 10.0, SHAPE, SHAPE)
    a, b = pair(truth, seed=13)
    cv2.imwrite(str(folder / "a.png"), a)
    cv2.imwrite(str(folder / "b.png"), b)
    off = np.array([[1, 0, 7.0], [0, 1, 0], [0, 0, 1]]) @ truth
    rows = [
        line("fields", "good", "a.png", "b.png", 2, truth),
        line("fields", "lie", "a.png", "b.png", 2, off),
        line("lost", "gone", "a.png", "none.png", 2, truth),
    ]
    (folder / "pairs.csv").write_text(",".join(COLUMNS) + "\n" + "\n".join(rows) + "\n")
    return folder / "pairs.csv"


def test_a_missing_picture_is_named(listed, tmp_path):
    with pytest.raises(UsageError, match=r"none\.png is not a file"):
        list(iter_spectral_bench(listed, tmp_path / "out", ("usurf",)))


@pytest.fixture(scope="module")
def bench(listed, tmp_path_factory):
    kept = listed.with_name("kept.csv")
    kept.write_text("\n".join(listed.read_text().splitlines()[:3]) + "\n")
    output = tmp_path_factory.mktemp("bench") / "out"
    events = list(iter_spectral_bench(kept, output, ("auto", "usurf")))
    return output, events


@pytest.mark.slow
def test_rows_are_held_against_the_truth(bench):
    output, _ = bench
    rows = json.loads((output / "bench.json").read_text())["pairs"]
    assert [(r["source"], r["method"]) for r in rows] == [
        ("good", "auto"),
        ("good", "usurf"),
        ("lie", "auto"),
        ("lie", "usurf"),
    ]
    good, lie = rows[0], rows[2]
    wanted = {
        "class",
        "source",
        "method",
        "accepted",
        "right",
        "error_px",
        "corner_px",
        "stated_px",
        "q",
        "inliers",
        "seconds",
        "reason",
    }
    assert all(set(r) == wanted for r in rows)
    assert good["accepted"] and good["right"] and good["error_px"] < 0.3
    assert good["error_px"] <= good["corner_px"] <= good["stated_px"] < 3
    assert rows[1]["stated_px"] is None  # by features: nothing is stated
    assert lie["accepted"] and not lie["right"] and lie["error_px"] == pytest.approx(7, abs=0.3)
    assert all(
        r["accepted"] or (r["error_px"] is None and r["q"] == 0 and r["reason"]) for r in rows
    )
    assert all(r["seconds"] > 0 for r in rows)


@pytest.mark.slow
def test_tables_count(bench):
    output, events = bench
    page = (output / "report.html").read_text()
    assert "1 right, 1 wrong of 2" in page
    assert "Stated errors" in page and "1 of 2; " in page  # the lie is not within its bound
    assert "Table 6.4" in page and "2/2" in page and "Table 6.5" in page
    notes = [e.text for e in events if type(e).__name__ == "Note"]
    assert notes[0].startswith("auto: 2 of 2 accepted, 1 right, 1 wrong")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("class,source\nx,y\n", "lacks the columns a, b, tolerance_px"),
        (",".join(COLUMNS) + "\n", "names no pairs"),
        (",".join(COLUMNS) + "\nx,y,a,b,2,1,0,0,0,one,0,0,0,1\n", "line 2: a number"),
        (",".join(COLUMNS) + "\nx,y,a,b,2,1,0,0,2,0,0,0,0,1\n", "line 2: h11 to h33"),
        (",".join(COLUMNS) + "\nx,y,a,b,2\n", "line 2: a number"),
    ],
)
def test_malformed_lists(tmp_path, text, reason):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(SideFileError, match=reason):
        read_pairs(tmp_path / "p.csv")


def test_unknown_methods_and_taken_outputs(listed, tmp_path):
    with pytest.raises(UsageError, match="magic"):
        list(iter_spectral_bench(listed, tmp_path / "out", ("magic",)))
    (tmp_path / "x").write_text("")
    with pytest.raises(OutputError):
        list(iter_spectral_bench(listed, tmp_path, ("usurf",)))


@pytest.mark.long
@pytest.mark.real
@pytest.mark.slow
def test_auto_on_the_real_pairs(tmp_path):
    """What is asked for: four fifths right over all, nine tenths of the satellite classes, one
    wrong at most.
    """
    if not REAL.is_file():
        pytest.skip(f"real pairs missing: {REAL}")
    list(iter_spectral_bench(REAL, tmp_path / "out", ("auto",)))
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["pairs"]
    satellite = [r for r in rows if r["class"].startswith(("satellite", "srif-infrared"))]
    right = sum(r["right"] for r in rows)
    assert len(rows) == 34 and right >= 30  # 31 when this was written
    assert sum(r["right"] for r in satellite) >= 0.9 * len(satellite)
    assert not [r["source"] for r in rows if r["accepted"] and not r["right"]]
    assert (
        right < 34
    )  # three night and indoor pairs are beyond it: all right would mean that the truth leaked
    assert max(r["seconds"] for r in rows) < 4


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.long
def test_stated_errors_hold_where_only_a_part_of_a_picture_is_left():
    """Asked of 300: bounds of 95 % hold in 90 to 99 %, and are at most twice the actual error in
    the median (docs/spectral.md has five seeds). A sample of 60 scatters by 3 % and 0.15.
    """
    from benchmarks.spectral import stated_errors

    if not REAL.is_file():
        pytest.skip(f"real pairs missing: {REAL}")
    rows = stated_errors(read_pairs(REAL), 60, 0.0, np.random.default_rng(16))
    told, actual = np.array([r[1:3] for r in rows], float).T
    assert 0.83 <= np.mean(actual <= told) and 1.4 < np.median(told / actual) < 2.4


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.long
def test_mirrored_real_pairs_are_refused():
    """The same pictures and places, but no transform of the family exists."""
    from skyquilt.coregistration.methods import registration_method
    from skyquilt.model.registration import Picture

    if not REAL.is_file():
        pytest.skip(f"real pairs missing: {REAL}")
    auto = registration_method("auto")
    for listed in read_pairs(REAL)[::2]:
        a, b = (cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in (listed.a, listed.b))
        assert not auto(Picture(values=a), Picture(values=np.ascontiguousarray(b[:, ::-1]))), (
            listed.source
        )
