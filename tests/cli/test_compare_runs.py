# SPDX-License-Identifier: Apache-2.0
"""loopcal compare: sessions, machines and methods side by side, and what is refused."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.report.pictures import _render_svg
from tests.findings.expectations import expect_refusal

DRAW = "--draw 16 --kind position --sigma-position 10um"


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Return a folder with runs of one machine, of the same machine moved, and of other methods."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        call(f"simulate linear-delta {DRAW} --draw-errors --truth truth.yaml -o may.csv --seed 4")
        machine = lc.load_robot("truth.yaml")
        change = 60e-6 * (np.array(machine.parameters.names) == "tower2.stop")
        lc.save_robot(machine.with_values(machine.values + change), "moved.yaml")
        for name, machine, seed in (
            ("june", "truth", 5),
            ("july", "moved", 6),
            ("new", "truth", 7),
        ):
            call(f"simulate {machine}.yaml {DRAW} -o {name}.csv --seed {seed}")
        for name in ("may", "june", "july"):
            call(f"calibrate linear-delta {name}.csv -o {name} --hold-out 0.25")
        call("calibrate linear-delta may.csv -o plain --hold-out 0.25 --method ls")
        call("calibrate linear-delta june.csv -o joint --prior may")
    return folder


def call(words: str) -> None:
    assert main(words.split()) == 0, words


@pytest.fixture
def loopcal(loopcal, runs, monkeypatch):
    """Compare runs in their folder."""
    monkeypatch.chdir(runs)
    return lambda words, *said, **code: loopcal(f"compare {words}", *said, **code)


def test_sessions_of_one_machine_and_of_a_moved_one(loopcal) -> None:
    printed = loopcal(
        "may june july",
        "The machines of may and june agree within the noise",
        "The machine of july differs from the machine of may",
        "A change of tower2.stop alone explains it: +0.0",
        "The runs share no held-out pose",
    )
    assert printed.err == ""
    comparison = lc.compare_runs([lc.load_run(name) for name in ("may", "june", "july")])
    assert comparison.moved is True
    assert [pair.moved for pair in comparison.pairs] == [False, True]
    second = comparison.pairs[1]
    assert (second.cause.kind, second.cause.names) == ("parameter", ("tower2.stop",))
    assert abs(second.cause_shift[0] - 60e-6) < 4.0 * second.cause_sd[0]
    assert second.significant[second.names.index("tower2.stop")]
    assert "july differs" in str(comparison)


def test_methods_of_the_same_rows_are_not_tested(loopcal) -> None:
    out = loopcal("may plain", "may and plain use identical rows (12 rows)").out
    assert "differs from" not in out
    assert "Errors after calibration at 4 poses that are common to all runs" in out
    assert "Shifts from" not in out


def test_a_run_that_is_the_prior_of_another_shares_its_rows(loopcal) -> None:
    loopcal("may joint", "have 12 of 28 fitted rows in common")


def test_errors_at_other_measurements(loopcal) -> None:
    words = "Errors after calibration at 16 poses that are common to all runs"
    assert loopcal("may july --data new.csv", words).err == ""
    loopcal("may june --data may.csv", "not an independent validation", code=1)


def test_json_and_csv(loopcal, tmp_path, runs) -> None:
    document = loopcal("may july --json").json
    assert document["moved"] is True
    assert document["pairs"][0]["cause"]["names"] == ["tower2.stop"]
    path = tmp_path / "table.csv"
    assert loopcal(f"may july -o {path}").words.endswith(f"Written to {path}")
    rows = list(csv.DictReader(path.open()))
    assert len(rows) == 2 * 9
    (moved,) = [r for r in rows if r["run"] == "july" and r["parameter"] == "tower2.stop"]
    assert moved["significant"] == "yes"
    assert moved["unit"] == "mm"
    assert float(moved["estimate"]) == pytest.approx(
        lc.load_run(runs / "july").robot.values[6] * 1e3, abs=1e-6
    )
    loopcal(f"may july -o {path}", code=1)


def test_a_hostile_name_is_text(loopcal, runs, tmp_path) -> None:
    shutil.copytree(runs / "june", runs / "=1+1", dirs_exist_ok=True)
    path = tmp_path / "table.csv"
    loopcal(f"may =1+1 -o {path}")
    assert not any(line.startswith("=") for line in path.read_text().splitlines())


def test_what_is_no_comparison_is_refused(loopcal, runs) -> None:
    loopcal("may", "1 run given", code=1)
    loopcal("may ./may", "appears twice", code=1)
    loopcal("may linear-delta", code=1)
    with pytest.raises(lc.DataError, match="give a list of runs"):
        lc.compare_runs(["may", "june"])  # type: ignore[list-item]


def rewrite_robot(runs: Path, name: str, old: str, new: str) -> None:
    """Calibrate the data of june with a changed robot file, as the run `name`."""
    text = (runs / "truth.yaml").read_text().partition("identified:")[0]
    assert old in text
    (runs / f"{name}.yaml").write_text(text.replace(old, new))
    words = f"calibrate {name}.yaml june.csv -o {name} --force --allow-implausible"
    assert main(words.split()) in (0, 2)


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("fixed", "stroke:", "fixed: [arm3.length]\nstroke:", "arm3.length is free in may only"),
        ("turned", "angles: [210, 330, 90]", "angles: [211, 331, 91]", "tower3.angle is fixed at"),
    ],
)
def test_runs_that_mean_something_else_are_refused(loopcal, runs, name, old, new, words) -> None:
    rewrite_robot(runs, name, old, new)
    loopcal(f"may {name}", words, code=1)


def test_another_mechanism_is_refused(loopcal, runs) -> None:
    call("simulate five-bar --draw 16 --kind position --draw-errors -o bars.csv --force")
    call("calibrate five-bar bars.csv -o bars --force")
    loopcal("may bars", "may and bars are calibrations of different mechanisms", code=1)


def test_a_run_whose_prior_lists_no_rows_is_shown_without_a_test(runs) -> None:
    first, second = (lc.load_run(runs / name) for name in ("may", "july"))
    arrays = {k: v for k, v in second.arrays.items() if not k.startswith("fitted_")}
    unknown = lc.Run(second.path, second.result, second.robot, second.initial_robot, arrays=arrays)
    comparison = lc.compare_runs([first, unknown])
    assert comparison.moved is None
    assert comparison.findings[0].data["reason"] == "rows"
    assert np.isnan(comparison.pairs[0].p_value)


@pytest.mark.parametrize(
    "change", ["missing key", "huge index", "target more", "list", "text", "number"]
)
def test_a_run_with_another_validation_is_refused_by_name(runs, tmp_path, change) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(runs / "june", damaged)
    result = json.loads((damaged / "result.json").read_text("utf-8"))
    if change == "missing key":
        del result["validation"]["after"]["position"]["targets"]
    elif change == "huge index":
        result["validation"]["after"]["position"]["rows"] = [10**30]
    elif change == "target more":
        result["validation"]["after"]["position"]["targets"] += [""]
    else:
        result["validation"] = {"list": [1], "text": "x", "number": 1.5}[change]
    (damaged / "result.json").write_text(json.dumps(result), "utf-8")
    with expect_refusal("files.run-damaged", lc.FileError):
        lc.compare_runs([lc.load_run(runs / "may"), lc.load_run(damaged)])


HOSTILE = "<script>alert(1)</script>=1+1\x1b[31m$\\frac{"


def read_policy(text: str) -> str:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    return policy[1].replace("&#39;", "'")


def test_page_shows_the_comparison_without_programs_and_requests(loopcal, monkeypatch) -> None:
    monkeypatch.setattr("loopcal.report.pictures._render_svg", _render_svg)  # drawn, not left out
    assert loopcal("may june july -o page.html", "Written to page.html").err == ""
    text = Path("page.html").read_text("utf-8")
    headings = re.findall(r'<h2 id="([a-z]+)">', text)
    assert headings == ["result", "parameters", "shifts", "errors"]
    for words in (
        "Comparison of calibrations: may, june, july",
        "A machine differs from may by more than the noise.",
        "A change of tower2.stop alone explains it",
        "linear-delta: undecided, MAP",
        "The runs share no held-out pose",
    ):
        assert words in text
    assert len(re.findall(r"<figure[^>]*>\s*<svg", text)) == 3
    assert "<script" not in text
    assert re.search(r"\sstyle=|\son[a-z]+=|https?://", text) is None
    assert read_policy(text).startswith("default-src 'none'; style-src 'sha256-")
    loopcal("may plain -o methods.html")
    text = Path("methods.html").read_text("utf-8")
    assert "There is no test of a change." in text
    assert "needs independent runs" in text
    assert "4 common poses" in text


def test_ending_of_the_file_chooses_its_format(loopcal) -> None:
    loopcal("may june -o both.json")
    printed = loopcal("may june --json").json
    assert json.loads(Path("both.json").read_text("utf-8")) == printed
    loopcal("may june -o both.csv")
    assert Path("both.csv").read_text("utf-8").startswith("run,parameter,")
    loopcal(
        "may june -o both.xlsx", "ends in .html or .json or .csv, but this one has '.xlsx'", code=1
    )
    assert not Path("both.xlsx").exists()
    loopcal("may june -o both.csv", "--force", code=1)


def test_hostile_names_are_text_in_all_formats(runs, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    comparison = lc.compare_runs([lc.load_run(runs / name) for name in ("may", "june")])
    first = replace(comparison.runs[0], name=HOSTILE, robot=HOSTILE)
    (pair,) = comparison.pairs
    changed = replace(
        comparison,
        runs=(first, comparison.runs[1]),
        pairs=(replace(pair, first=HOSTILE),),
        errors=(replace(comparison.errors[0], run=HOSTILE), comparison.errors[1]),
    )
    for name in ("page.html", "rows.csv", "all.json"):
        lc.save_comparison(changed, name)
        text = Path(name).read_text("utf-8")
        assert "\x1b" not in text
    page = Path("page.html").read_text("utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert all(not row.startswith("=") for row in Path("rows.csv").read_text("utf-8").splitlines())
