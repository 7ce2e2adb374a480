# SPDX-License-Identifier: Apache-2.0
"""loopcal regularize: curves of the user's own data, on the screen and as a folder."""

from __future__ import annotations

import csv
import json

import pytest


@pytest.fixture
def do_not_draw() -> None:
    """Draw: the bytes of a picture are compared."""


@pytest.fixture
def loopcal(loopcal):
    """Run a command line in a folder with measurements."""

    options = "--kind position --sigma-position 60um --draw-errors --draw 16"
    loopcal(f"simulate linear-delta {options} -o data.csv")
    return loopcal


def test_page_shows_both_curves_and_what_rules_choose(loopcal) -> None:
    _, out, err = loopcal("regularize linear-delta data.csv")
    assert err == ""
    assert "linear-delta: 16 poses, 9 parameters; each pose left out in turn" in out
    for words in ("given robot", "GCV", "marginal likelihood", "one standard error", "lam", "k ="):
        assert words in out


def test_folder_has_the_points_the_choices_and_the_picture(loopcal, tmp_path) -> None:
    code, out, _ = loopcal("regularize linear-delta data.csv -o curves")
    assert (code, out.splitlines()[-1]) == (
        0,
        "Written to curves: curves.json, curves.csv, curves.png",
    )
    folder = tmp_path / "curves"
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    document = json.loads((folder / "curves.json").read_text())
    assert document["made_by"]["inputs"]["data"]["path"] == "data.csv"
    rows = list(csv.DictReader((folder / "curves.csv").open()))
    points = [float(row["score"]) for row in rows if row["parameter"] == "k"]
    assert points == document["truncation"]["score"]
    assert len(points) == 10
    first = (folder / "curves.png").read_bytes()
    loopcal("regularize linear-delta data.csv -o curves", "curves", code=1)
    loopcal("regularize linear-delta data.csv -o curves --force")
    assert (folder / "curves.png").read_bytes() == first


def test_one_lambda_per_parameter_is_stated_by_pattern_or_in_a_file(loopcal, tmp_path) -> None:
    words = "calibrate linear-delta data.csv --method ridge --json --lam"
    (tmp_path / "weights.yaml").write_text('"*": 0.01\n"*.length": 100\n', "utf-8")
    fits = {}
    for i, lam in enumerate(("0.01", "*.length=100,*=0.01", "weights.yaml")):
        estimate = loopcal(f"{words} {lam} -o run{i}").json["fit"]["parameters"]
        fits[lam] = {p["name"]: p["estimate"] - p["nominal"] for p in estimate}
    alike, named, filed = fits.values()
    assert named == filed
    ratio = {name: abs(named[name] / alike[name]) for name in alike if alike[name]}
    assert max(share for name, share in ratio.items() if name.endswith(".length")) < 0.1
    for wrong in ("*.lengths=1", "*=-1", "*=much", "nofile.yaml", "*"):
        loopcal(
            f"{words} {wrong} -o wrong",
            "--lam" if "lengths" not in wrong else "no parameter",
            code=1,
        )


def test_chosen_values_are_those_of_calibrate(loopcal) -> None:
    out = loopcal("regularize linear-delta data.csv --json").out
    chosen = {c["rule"]: c["value"] for c in json.loads(out)["ridge"]["chosen"]}
    words = "calibrate linear-delta data.csv -o run --method ridge --json"
    fitted = loopcal(words).json["fit"]["regularization"]
    assert chosen["GCV"] == pytest.approx(fitted["value"], rel=2e-2)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("linear-delta", "Missing argument 'DATA...'"),
        ("linear-delta missing.csv", "missing.csv"),
        ("linear-delta data.csv --drop nothing", "nothing"),
        ("linear-delta data.csv --folds 1", "--folds"),
        ("linear-delta robot.yaml", "robot.yaml is a YAML file"),
        ("linear-delta data.csv -o .", "working folder"),
    ],
)
def test_wrong_use_gets_a_sentence(loopcal, words, sentence) -> None:
    assert "Traceback" not in loopcal(f"regularize {words}", sentence, code=1).err
