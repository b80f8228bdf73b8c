import re
import time
from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.outcome import UNSETTLED
from skyquilt.errors import OutputError
from skyquilt.report import CameraResiduals, ReportInput, SeamMark, Shot, build_report, write_report
from skyquilt.report.about import facts_of
from skyquilt.report.attention import attention

from .report_cases import Page, run, shots

SECTIONS = [
    "map",
    "overlap",
    "positions",
    "residuals",
    "seams",
    "surface",
    "cameras",
    "control",
    "conflicts",
    "rejected",
    "notes",
    "time",
    "settings",
]


def test_a_whole_run_fills_every_section():
    page = Page(build_report(run()))
    assert all(page.ids.count(name) == 1 for name in SECTIONS)
    assert len(page.ids) == len(set(page.ids))
    for words in (
        "18 of 19",
        "EPSG:32615",
        "zone 15N",
        "0.60",
        "640 of 800",
        "IMG_9999.JPG",
        "the file ends early",
    ):
        assert words in page.text, words
    for words in (
        "\u2212137.0\u00b0",
        "Two photos share one second.",
        "which is not modelled",
        "focal length, px",
        "feather",
    ):
        assert words in page.text, words


def test_a_clip_that_does_not_tell_when_it_was_filmed_has_no_date():
    told = [replace(s, time="2024-05-01T10:00:00") for s in shots(3)]
    untold = [replace(s, time="1970-01-01T00:00:09") for s in shots(3)]
    assert dict(facts_of(run(shots=tuple(told))))["Captured"] == "2024-05-01 10:00 to 10:00"
    assert "Captured" not in dict(facts_of(run(shots=tuple(untold))))


def test_links_inside_the_page_lead_somewhere():
    page = Page(build_report(run()))
    local = [link[1:] for link in page.links if link.startswith("#")]
    assert local and set(local) <= set(page.ids)
    used = set(re.findall(r"url\(#([^)]+)\)", build_report(run())))
    assert used and used <= set(page.ids)


@pytest.mark.parametrize("data", [run(), ReportInput(metrics={})], ids=["whole", "empty"])
def test_nothing_outside_the_page_is_asked_for(data):
    text = build_report(data)
    assert "http://" not in text and "https://" not in text and "@import" not in text
    assert all(link.startswith(("#", "data:image/")) for link in Page(text).links)


def test_an_empty_run_says_why_and_draws_no_empty_frame():
    page = Page(build_report(ReportInput(metrics={})))
    assert "svg" not in page.tags and "table" not in page.tags and "figure" not in page.tags
    assert all(name in page.ids for name in SECTIONS)
    for words in (
        "no map to draw",
        "No photo reports a position",
        "no residuals to show",
        "not georeferenced",
    ):
        assert words in page.text, words


PARTS = {
    "preview": None,
    "bounds": None,
    "views": None,
    "views_bounds": None,
    "surface": None,
    "surface_bounds": None,
    "shots": (),
    "residuals": (),
    "seams": (),
    "settings": {},
    "metrics": {},
    "crs": None,
    "title": "",
    "metric": False,
}


@pytest.mark.parametrize("part", PARTS)
def test_any_part_may_be_missing(part):
    page = Page(build_report(run(**{part: PARTS[part]})))
    assert set(SECTIONS) <= set(page.ids)


@pytest.mark.parametrize("part", PARTS)
def test_any_part_may_stand_alone(part):
    alone = {name: value for name, value in PARTS.items() if name != part}
    if part in ("preview", "views", "surface"):
        alone.pop(f"{part}_bounds" if part != "preview" else "bounds")
    Page(build_report(run(**alone)))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_photos(n):
    page = Page(build_report(run(n, observations=3, samples=1)))
    assert f"{n} of {n + 1}" in page.text


NASTY = "</script><img src=x onerror=alert(1)>&\"'<b>"


def test_names_and_reasons_are_text_never_markup():
    data = run()
    figures = dict(data.metrics)
    figures |= {
        "method": NASTY,
        "photos_rejected": {NASTY: NASTY},
        "metadata_conflicts": [
            {"photo": NASTY, "field": NASTY, "reported": NASTY, "estimated": NASTY}
        ],
        "control": [{"name": NASTY}],
        "cameras": {NASTY: {NASTY: {"value": NASTY}}},
        "notes": [NASTY],
        "warnings": [NASTY],
        "seconds": {NASTY: 1.0},
    }
    text = build_report(
        run(
            metrics=figures,
            title=NASTY,
            version=NASTY,
            vertical_datum=NASTY,
            settings={NASTY: {NASTY: NASTY}},
            crs=NASTY,
            shots=shots(5, name=NASTY + "{}"),
            residuals=[
                CameraResiduals(
                    camera=NASTY,
                    width=100,
                    height=80,
                    px=np.full((20, 2), 5.0),
                    residual_px=np.ones((20, 2)),
                )
            ],
        )
    )
    page, clean = Page(text), Page(build_report(data))
    assert "<img" not in text and "<b>alert" not in text
    assert text.count("</script>") == build_report(data).count("</script>")
    assert not any(name.startswith("on") for name, _ in page.attributes)
    assert page.tags.count("script") == clean.tags.count("script")
    assert NASTY in page.text


def test_figures_that_are_no_numbers_are_left_out():
    nan = float("nan")
    bad = {
        "photos_used": None,
        "photos_total": 0,
        "gsd_m": nan,
        "blocks": "many",
        "gps_residual_rms_m": {"x": nan, "y": 1},
        "gps_leave_one_out_rms_m": nan,
        "reprojection_error_px": {"mean": nan, "rms": None},
        "seam_disparity_px": None,
        "metadata_conflicts": [None, {}],
        "seconds": {"total": nan, "a": nan},
        "cpu_seconds": "?",
        "peak_memory_mb": nan,
        "cameras": {"a": {"focal": {"value": nan}}},
        "control": [{"name": "x", "dx_m": nan}],
        "notes": None,
        "warnings": None,
    }
    empty = np.full(3, nan)
    lost = [Shot(name="a", xyz=empty, reported_xyz=empty, footprint=np.zeros((0, 2)))]
    page = Page(
        build_report(
            run(
                metrics=bad,
                shots=[*lost, *shots(3)],
                surface=np.full((4, 4), np.nan, np.float32),
                views=np.zeros((4, 4), int),
                seams=[
                    SeamMark(x=0.0, y=0.0, disparity_px=None),
                    SeamMark(x=1.0, y=1.0, disparity_px=nan),
                ],
                residuals=[
                    CameraResiduals(
                        camera="a",
                        width=9,
                        height=9,
                        px=np.full((4, 2), nan),
                        residual_px=np.ones((4, 2)),
                    )
                ],
            )
        )
    )
    assert not re.search(r"\b(nan|NaN|None|inf)\b", page.text)
    Page(
        build_report(run(shots=lost, preview=None, bounds=None, views=None, surface=None, seams=()))
    )


def test_drawings_hold_finite_numbers_only():
    assert not re.search(r'(?:d|x|y|width|height|transform)="[^"]*nan', build_report(run()))


@pytest.mark.slow
def test_two_thousand_photos_stay_small_and_quick():
    data = run(2000, observations=400_000, samples=20_000)
    start = time.process_time()
    text = build_report(data)
    assert time.process_time() - start < 3
    assert len(text) < 5e6
    Page(text)


def test_eighteen_photos_cost_little():
    data = run()
    build_report(data)  # the template is compiled once
    costs = []
    for _ in range(3):
        start = time.process_time()
        build_report(data)
        costs.append(time.process_time() - start)
    assert min(costs) < 0.15


def test_verdicts_follow_the_stated_thresholds():
    weak = dict(run().metrics) | {
        "reprojection_error_px": {"mean": 2.5},
        "seam_disparity_px": {"median": 1.0, "p95": 2.0, "measured": 10, "attempted": 100},
        "blocks": [12, 6],
    }
    page = Page(build_report(run(metrics=weak)))
    assert "Reprojection error poor 2.50" in page.text
    assert "Only 10% of the samples could be measured" in page.text
    assert "Blocks of 12, 6 photos" in page.text


def test_the_file_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "report.html"
    write_report(target, run())
    assert target.read_text(encoding="utf-8") == build_report(run())
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(OutputError, match="cannot be written"):
        write_report(tmp_path / "nowhere" / "report.html", run())


def test_the_head_says_when_how_high_and_with_what_and_links_the_files():
    from dataclasses import replace

    taken = [
        replace(s, time=f"2024-05-01T10:0{k % 10}:00", above_ground_m=55.0 + k % 3, tilt_deg=1.5)
        for k, s in enumerate(shots(18))
    ]
    files = ["mosaic.tif", "dsm.tif", "metrics.json"]
    data = run(shots=taken, processed="2026-01-02T03:04:05", files=files)
    page = Page(build_report(data))
    assert "2024-05-01 10:00 to 10:09" in page.text and "2026-01-02 03:04" in page.text
    assert "56 m above ground" in page.text.replace("\u00a0", " ")
    outside = [link for link in page.links if not link.startswith(("#", "data:"))]
    assert outside == files
    assert page.text.count("IMG_0004.JPG") >= 1 and "18 photos" in page.text


def attended(**changes):
    return [words for words, _ in attention(run(**changes))]


def test_what_the_alignment_warned_of_is_worth_a_look_once():
    metrics = {"accuracy": {"focal_sigma_after_over_before": 0.97, "vertical_m": {"median": 1.1}}}
    (own,) = [w for w in attended(metrics=metrics) if "focal length" in w]
    told = (f"{UNSETTLED} of a camera: 1.1 m.", "The photos of <b> seem to be stretched")
    found = attended(metrics=metrics, doubts=told)
    assert own not in found and [w for w in found if "focal" in w] == [told[0]]
    assert any("seem to be stretched" in w for w in found)
    page = build_report(run(metrics=metrics, doubts=told))
    assert "seem to be stretched" in page and "photos of <b>" not in page


def test_worth_a_look_names_what_is_worst_and_nothing_where_all_is_well():
    views = np.full((20, 20), 7)
    good = {"metrics": {"photos_used": 9, "photos_total": 9, "blocks": [9]}, "views": views}
    assert attended(**good, crs="EPSG:32633") == []
    views = views.copy()
    views[:8] = 1
    metrics = {
        **good["metrics"],
        "seam_disparity_px": {"median": 6.1, "p95": 20.0, "measured": 30, "attempted": 100},
        "shutter": {
            "a": {"source": "table", "readout_ms": 33.0, "largest_displacement_px": 0.0},
            "b": {"source": "unknown", "readout_ms": 0.0, "largest_displacement_px": 0.0},
            "c": {"source": "table", "readout_ms": 33.0, "largest_displacement_px": 4.0},
        },
        "thermal_values": {"unit": "counts"},
        "accuracy": {"focal_sigma_after_over_before": 0.97, "vertical_m": {"median": 1.14}},
        "metadata_conflicts": [{"photo": "x", "field": "yaw", "meaning": "the compass is off"}],
    }
    told = attended(metrics=metrics, views=views, crs="EPSG:32633")
    starts = [
        "Poor overlap: 40%", "Photos disagree at the seams by 6.1 px",
        "Few seams measured: 30 of 100",
        "Shutter not modelled: nothing says how b exposes.", "Shutter not modelled: that of a",
        "Thermal values are sensor counts", "The flight does not determine the focal length",
        "1 metadata conflict (yaw)",
    ]  # fmt: skip
    assert len(told) == len(starts)
    for start, words in zip(starts, told, strict=True):
        assert words.startswith(start), words
    page = Page(build_report(run(metrics=metrics, views=views)))
    assert "the compass is off" in page.text  # the cause as metrics.json gives it


def test_sizes_of_one_camera_are_told_in_one_sentence_about_shutters():
    unknown = {"source": "unknown", "readout_ms": 0.0, "largest_displacement_px": 0.0}
    still = {"source": "table", "largest_displacement_px": 0.0}
    shutter = {
        **{f"camera {n}": unknown for n in range(30)},
        **{f"slow {n}": {**still, "readout_ms": 33.0} for n in range(2)},
        "fast": {**still, "readout_ms": 8.0},
    }
    metrics = {"photos_used": 9, "photos_total": 9, "blocks": [9], "shutter": shutter}
    told = [w for w in attended(metrics=metrics) if w.startswith("Shutter not modelled")]
    assert [words.split(":")[1][:40] for words in told] == [
        " nothing says how camera 0, camera 1, ca",
        " that of slow 0, slow 1 is rolling (33 m",
        " that of fast is rolling (8 ms), and not",
    ]
    assert "more expose. If their shutter is rolling" in told[0] and len(told[0]) < 400, told


def test_a_guessed_readout_is_told_beside_what_was_found_and_not_where_it_moves_nothing():
    guess = {"source": "guess", "prior_ms": 20.0}
    shutter = {
        "a": {**guess, "readout_ms": 18.42, "sigma_ms": 17.33, "largest_displacement_px": 1.14},
        "b": {**guess, "readout_ms": 0.02, "sigma_ms": 0.4, "largest_displacement_px": 0.01},
        "c": {**guess, "readout_ms": 0.02, "sigma_ms": 0.4, "largest_displacement_px": 0.0},
    }
    metrics = {"photos_used": 9, "photos_total": 9, "blocks": [9], "shutter": shutter}
    (told,) = attended(metrics=metrics, views=np.full((20, 20), 7), crs="EPSG:32633")
    assert "a guess of 20 ms was adjusted to 18.4 \u00b1 17.3 ms" in told
    assert "of a, whose shutter" in told


def test_measured_values_have_a_legend_with_their_unit():
    page = Page(build_report(run(values=(12.3, 35.1, "\u00b0C"))))
    assert "12.3 \u00b0C" in page.text and "35.1 \u00b0C" in page.text
    assert "12.3 \u00b0C" not in Page(build_report(run())).text
