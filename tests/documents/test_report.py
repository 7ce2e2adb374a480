# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: complete, the same from memory and from a run, and safe to open."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.documents import load_record
from loopcal.errors import DataError, FileError
from loopcal.report.calibration_view import build_budget_table, build_share_table
from loopcal.report.document import figures
from loopcal.report.document.elements import Document, Picture, render_html
from loopcal.report.document.figures import thin_rows
from loopcal.report.document.sections import build_calibration_document, build_sections
from loopcal.report.pictures import inline_figure
from loopcal.report.scene.scene import load_script
from loopcal.report.validation_view import view_errors
from loopcal.report.words import say
from loopcal.results.tables import Table
from loopcal.units import find_unit
from tests.io.test_certificate import write_facts

pytestmark = pytest.mark.slow

ORDER = (
    *("summary", "verdict", "errors", "workspace", "budget", "parameters", "determined"),
    *("outliers", "residuals", "controller", "provenance", "poses"),
)
HOSTILE = "<script>alert(1)</script>=1+1\x1b[31m\u202e$\\frac{"


def build(record, *names: str) -> Document:
    """Return the document of a record with some sections only."""
    sections = build_sections(record, names)
    return Document("Report", record.verdict.name.lower(), "Summary", "loopcal", sections)


def test_sections_are_in_the_order_in_which_readers_ask(page) -> None:
    document = json.loads(page.with_suffix(".json").read_text("utf-8"))
    assert tuple(section["name"] for section in document["sections"]) == ORDER
    text = page.read_text("utf-8")
    assert tuple(re.findall(r'<h2 id="([a-z]+)">', text)) == ORDER
    assert text.startswith('<!doctype html>\n<html lang="en">')
    assert len(re.findall("<h1>", text)) == 1
    for words in (
        "Calibrated: hexapod-42, 42 parameters from 30 poses.",
        "Expected error over the workspace: position",
        "Share of each source in the variance of the expected error",
        "The data determine all 42 parameters.",
        "Errors at 10 held-out poses",
        "degrees of freedom",
        "setp genhexkins.base.0.x",
        "30 fitted poses: 1, 2, 4,",
        "10 held-out poses: 3, 6, 9,",
        hashlib.sha256(
            (Path(__file__).parents[2] / "examples/hexapod-42/measurements.csv").read_bytes()
        ).hexdigest(),
    ):
        assert words in text, words


def test_page_runs_only_the_script_of_the_view_and_loads_nothing(page) -> None:
    text = page.read_text("utf-8")
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)
    assert style is not None
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)
    assert script is not None
    assert script[1] == load_script()
    digests = [
        base64.b64encode(hashlib.sha256(part[1].encode()).digest()).decode()
        for part in (script, style)
    ]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    allowed = policy[1].replace("&#39;", "'")
    sources = f"script-src 'sha256-{digests[0]}'; style-src 'sha256-{digests[1]}'"
    assert allowed.startswith(f"default-src 'none'; {sources}; img-src data:;")
    assert re.findall(r"<script[^>]*>", text) == ['<script type="application/json">', "<script>"]
    text = text.replace(script[1], "")
    assert re.search(r"\sstyle=|\son[a-z]+=", text) is None  # blocked by the policy
    addresses = re.findall(r'(?:href|src)="([^"]*)"', text)
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in addresses)
    assert "@import" not in style[1]
    assert "url(" not in style[1]
    assert page.stat().st_size < 2e6


def test_identifiers_are_unique_and_references_lead_somewhere(page) -> None:
    text = page.read_text("utf-8")
    names = re.findall(r'\bid="([^"]*)"', text)
    assert len(names) == len(set(names))
    targets = re.findall(r'href="#([^"]*)"', text) + re.findall(r"url\(#([^)]*)\)", text)
    targets += re.findall(r'aria-labelledby="([^"]*)"', text)
    assert set(targets) <= set(names)


def test_pictures_have_descriptions_and_tables_have_scopes(page) -> None:
    text = page.read_text("utf-8")
    pictures = re.findall(r"<figure[^>]*>\s*(?:<script.*?</script>\s*)?(<svg.*?</svg>)", text, re.S)
    names = ("validation", "scene", "accuracy", "budget", "volume", "parameter", "correlation")
    for name, picture in zip((*names, "residual"), pictures, strict=True):
        assert f'role="img" aria-labelledby="{name}-figure-description"' in picture
        assert "<text" in picture  # text, not outlines
        described = re.search(f'id="{name}-figure-description">([^<]+)</span>', text)
        assert described is not None
        assert described[1].endswith(".")
    assert len(re.findall("<th ", text)) == len(re.findall('<th scope="(?:col|row)"', text))
    assert "<th>" not in text


def test_report_in_memory_and_run_folder_give_the_same_page(calibration, run) -> None:
    first, second = (load_record(source) for source in (calibration, run))
    names = ("verdict", "determined", "outliers", "budget", "findings")
    assert build(first, *names) == build(second, *names)
    assert first.validation is not None
    assert second.validation is not None
    assert view_errors(first.validation, "held-out") == view_errors(second.validation, "held-out")
    assert [c.text for c in first.controllers] == [c.text for c in second.controllers]
    assert first.fitted_labels == second.fitted_labels


def test_hostile_names_are_text(run) -> None:
    record = load_record(run)
    (rows,) = record.residuals
    labels = (HOSTILE, *rows.poses[1:])
    arrays = {**record.arrays, "poses": np.array([HOSTILE, "=1+1"], str)}
    record = replace(record, residuals=(replace(rows, poses=labels),), arrays=arrays)
    text = render_html(build(record, "residuals", "poses"))
    assert "<script" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert text.count("&lt;script&gt;alert(1)&lt;/script&gt;=1+1\\x1b[31m\\u202e$") >= 1
    assert "=1+1." in text


def test_hostile_labels_are_text_in_the_scene_of_the_view(run) -> None:
    record = load_record(run)
    count = len(record.arrays["frames_readings"])
    labels = np.array([f"</script>{HOSTILE}", *("p" * (count - 1))], str)
    record = replace(record, arrays={**record.arrays, "poses": labels})
    text = render_html(build(record, "workspace")).replace(load_script(), "")
    scene = re.search(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)
    assert scene is not None
    shown = json.loads(scene[1])["poses"]["labels"]
    assert shown[0] == "</script><script>alert(1)</script>=1+1\\x1b[31m\\u202e$\\frac{"
    assert len(shown) == count
    assert "alert(1)" not in text.replace(scene[1], "")


@pytest.mark.usefixtures("do_not_draw")
def test_what_a_run_lacks_is_stated_in_one_sentence(run) -> None:
    record = load_record(run)
    result = {k: v for k, v in record.result.items() if k not in ("split", "validation")}
    lacking = replace(
        record,
        result={**result, "expected_error": None, "next_step": None},
        arrays={k: v for k, v in record.arrays.items() if k != "frames_readings"},
        validation=None,
    )
    text = re.sub(r"\s+", " ", render_html(build_calibration_document(lacking)))
    for name in (
        "errors.not-held-out",
        "scene-figure.no-readings",
        "accuracy-figure.unknown",
        "budget.none",
        "poses.none",
    ):
        assert say(name) in text, name


def test_failed_fit_has_no_values_for_a_machine(run) -> None:
    record = load_record(run)
    fit = {**record.result["fit"], "status": "out_of_iterations", "rank": None, "degrees": None}
    failed = replace(
        record,
        result={**record.result, "verdict": "not_calibrated", "fit": fit, "headline": "Failed."},
        validation=None,
    )
    text = render_html(build_calibration_document(failed))
    assert "setp genhexkins" not in text
    assert "the report has no values for a controller" in text
    assert "A quality gate fails. Do not write these values to a machine." in text
    assert "Values at the end of the iteration (no estimates)" in text
    assert "the calibrated geometry is missing" in text
    assert "that of the calibrated geometry at the same readings" not in text


def test_many_rows_are_thinned_and_the_report_says_so(run) -> None:
    record = load_record(run)
    (rows,) = record.residuals
    times = 1000
    many = replace(
        rows,
        poses=tuple(f"p{i}" for i in range(len(rows.raw) * times)),
        raw=np.tile(rows.raw, (times, 1)),
        whitened=np.tile(rows.whitened, (times, 1)),
        measured=np.tile(rows.measured, (times, 1)),
        readings=np.tile(rows.readings, (times, 1)),
    )
    arrays = {**record.arrays, "poses": np.array(many.poses)}
    arrays["frames_readings"] = np.tile(record.arrays["frames_readings"], (times, 1))
    lengthened = replace(record, residuals=(many,), arrays=arrays)
    text = render_html(build(lengthened, "residuals", "poses", "workspace"))
    assert "The figure shows 3,000 of 30,000 fitted poses." in text
    assert "The 3-D view can show the robot at 1,025 of these poses, evenly spread." in text
    assert "than every measured pose of 3,000, evenly spread." in text
    assert "The figure shows 3,000 of 30,000 rows." in text
    assert "30,000 fitted poses, here the first 3,000" in text
    assert len(text) < 5e6
    assert thin_rows(rows, len(rows.raw)) is rows


@pytest.mark.usefixtures("do_not_draw")
def test_a_volume_that_is_asked_for_later_is_in_report_and_certificate(
    run, calibration, tmp_path, capsys
) -> None:
    """It replaces the volume of the calibration, and a limit that it misses is a failure."""
    wanted = lc.bound_errors(calibration.identification, {"y": (-0.03, 0.03)})
    facts = str(write_facts(tmp_path))
    volume = ["--volume", "y=-30mm..30mm", "--limit-position", "0.1um"]
    page = tmp_path / "later.html"
    assert main(["report", str(run.path), "-o", str(page), *volume]) == 2
    first = json.loads(page.with_suffix(".json").read_text())["sections"][0]["elements"]
    bound, *_ = first[1]["rows"]
    assert "in the working volume" in bound[0]
    value, unit = bound[2].split()
    assert float(value) * find_unit(unit).factor_to_si == pytest.approx(
        wanted.simultaneous, rel=5e-3
    )
    assert bound[4] == "does not conform"
    assert [row["text"].count("does not conform") for row in first[2]["list"]] == [1]
    assert "Working volume: box y -30 mm to 30 mm" in first[3]["sentence"]
    place = f"largest at y {1e3 * wanted.worst['y']:g} mm"
    assert page.read_text("utf-8").count(place) == 2  # the sentence, and the picture's caption
    capsys.readouterr()
    assert main(["certificate", str(run.path), facts, *volume]) == 2
    text = capsys.readouterr().out
    assert "box y -30 mm to 30 mm" in text
    assert "box x" not in text
    assert main(["report", str(run.path), "-o", f"{page}.html", *volume[2:]]) == 1
    assert "no effect without --volume" in capsys.readouterr().err


def test_a_report_of_a_run_draws_the_decision_on_its_limit(root, tmp_path) -> None:
    data = str(root / "examples" / "hexapod-42" / "measurements.csv")
    words = ["-o", str(tmp_path / "run"), "--hold-out", "0.25", "--limit-position", "20um"]
    assert main(["calibrate", "hexapod-42", data, *words]) == 0
    section = render_html(build(load_record(lc.load_run(tmp_path / "run")), "errors"))
    assert re.search("largest position error [^<]*, limit 20 um: conforms<", section)


def test_first_screen_leaves_the_conditions_of_accuracy_to_the_report(calibration, page) -> None:
    screen = str(calibration)
    assert "simultaneously" in screen
    for words in ("k = 1", "Compared:", "of platform coordinates"):
        assert words not in screen
        assert words in page.read_text()


def test_errors_below_a_tenth_of_a_millimeter_are_in_micrometers(run) -> None:
    record = load_record(run)
    volume = {**record.result["volume"], "simultaneous": 1.79e-5}
    result = {**record.result, "volume": volume, "validation": None}
    assert "17.9 um" in render_html(build(replace(record, result=result), "summary"))


def test_limits_of_calls_are_sentences(calibration, tmp_path) -> None:
    with pytest.raises(FileError, match=r"the name of a report ends in \.html, but this one has"):
        lc.save_report(calibration, tmp_path / "report.pdf")
    with pytest.raises(FileError, match="does not exist"):
        lc.save_report(calibration, tmp_path / "nowhere" / "report.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("do_not_draw")
def test_report_of_a_cable_robot_names_its_repeatability_and_judges_no_sigma_by_residuals(
    tmp_path, monkeypatch
) -> None:
    """83 % of the expected error is the repeatability of the motors: no instrument reduces it."""
    monkeypatch.chdir(tmp_path)
    simulated = ["simulate", "cable-4", "--draw", "32", "--draw-errors", "--seed", "3"]
    assert main([*simulated, "-o", "data.csv"]) == 0
    limit = ["--hold-out", "0.25", "--limit-position", "0.05mm"]
    assert main(["calibrate", "cable-4", "data.csv", "-o", "run", *limit]) == 2
    record = load_record(lc.load_run("run"))
    text = render_html(build(record, "verdict", "residuals"))
    assert "Calibration cannot reduce it" in text
    assert "better instrument" not in text
    assert say("residual-figure.description", has_readings=True) in text


def test_report_explains_the_stated_frame_and_small_residuals(page) -> None:
    text = page.read_text("utf-8")
    assert say("errors.baseline", is_stated_frame=True) in text
    assert say("residual-figure.description", has_readings=False) in text


def test_orientations_have_one_unit_and_coverage_factors_two_places(page) -> None:
    """The sentence on the expected error is in degrees."""
    assert "mrad" not in page.read_text("utf-8")
    document = json.loads(page.with_suffix(".json").read_text("utf-8"))
    (section,) = (part for part in document["sections"] if part["name"] == "parameters")
    (table,) = (e for e in section["elements"] if e.get("table") == "Identified parameters")
    place = table["columns"].index("k")
    assert all(re.fullmatch(r"[0-9]+[.][0-9]{2}", row[place]) for row in table["rows"])


def test_report_of_a_printer_shows_the_heights_over_the_bed(root, tmp_path) -> None:
    robot = lc.load_robot(root / "examples" / "delta-printer" / "printer.yaml")
    data = lc.load_measurements(root / "examples" / "delta-printer" / "heights.csv", robot)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.4))
    lc.save_run(report, tmp_path / "run")
    for source in (report, lc.load_run(tmp_path / "run")):
        section = build(load_record(source), "heights").sections[0]
        assert section.title == "Height errors"
        sentence, summary, picture, by_point = section.elements
        assert isinstance(sentence, str)
        assert isinstance(summary, Table)
        assert isinstance(by_point, Table)
        assert "predicts at the recorded readings minus the measured one" in sentence
        assert [row[:3] for row in summary.rows[::2]] == [
            ("fitted", "rms", "8"),
            ("held-out", "rms", "5"),
        ]
        assert isinstance(picture, Picture)
        assert picture.name == "height-figure"
        assert len(by_point.rows) == 13


def test_budget_of_a_platform_that_does_not_rotate_states_no_orientation(root) -> None:
    """Its orientation has an uncertainty of 6e-19 rad by rounding."""
    robot = lc.load_robot(root / "examples" / "delta-printer" / "printer.yaml")
    data = lc.load_measurements(root / "examples" / "delta-printer" / "heights.csv", robot)
    report = lc.calibrate(robot, data)
    assert report.budget is not None
    assert report.budget.orientation is not None
    budget = report.budget.to_dict()
    assert 0.0 < report.budget.orientation.rms < 1e-15
    for table in (build_share_table(budget), build_budget_table(budget, robot)):
        assert "position" in [column.title for column in table.columns]
        assert not any("orientation" in column.title for column in table.columns)


@pytest.mark.usefixtures("do_not_draw")
def test_noise_floor_of_uncertain_readings_is_called_a_lower_bound(page, root) -> None:
    lower_bound = say("errors.reading-noise")
    assert lower_bound not in page.read_text("utf-8")  # the readings of this example are exact
    machine = lc.load_robot("cable-4")
    kind = lc.Position(places=np.zeros((1, 3)))
    instrument = lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.full(3, 1e-3))),))
    poses = lc.sample_workspace(machine, 16, seed=2).coordinates
    data = lc.simulate(machine, poses, instrument, seed=3)
    report = lc.calibrate(machine, data, lc.CalibrationOptions(hold_out=0.4))
    assert report.reading_errors is not None
    assert lower_bound in str(build(load_record(report), "errors").sections[0].elements[0])
    assert lower_bound in report._repr_html_()


def test_a_decorated_function_adds_a_figure_to_its_section(run, monkeypatch) -> None:
    monkeypatch.setattr(figures, "FIGURES", dict(figures.FIGURES))

    @figures.report_figure("poses")
    def draw_count(record):
        figure = Figure()
        figure.suptitle(f"{len(record.fitted_labels)} poses")
        svg = inline_figure(figure, "count-figure")
        yield Picture("count-figure", svg, "Number of poses.", "It is a number.")

    (section,) = build(load_record(run), "poses").sections
    *_, picture = section.elements
    assert isinstance(picture, Picture)
    assert (picture.name, picture.caption) == ("count-figure", "Number of poses.")


def test_a_figure_for_a_section_that_does_not_exist_is_refused(run, monkeypatch) -> None:
    monkeypatch.setitem(figures.FIGURES, figures.draw_height_picture, "height")
    with pytest.raises(DataError, match=r"section 'height', .*did you mean 'heights'"):
        build(load_record(run), "poses")
