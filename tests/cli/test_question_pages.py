# SPDX-License-Identifier: Apache-2.0
"""Studies of examples/studies: commands run, and pages state what is true of their evidence."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import loopcal as lc
from evidence.questions.example_studies import find_cell
from loopcal.cli.entry_point import main
from tests.cli.page_commands import list_commands

PAGES = {"instruments": "instruments", "poses": "planning", "methods": "calibration"}
"""From a study to the page of docs/ with its answer."""


def read_evidence(root: Path, name: str) -> dict[str, Any]:
    return json.loads((root / "docs" / "evidence" / f"study_{name}.json").read_text("utf-8"))


def read_page(root: Path, name: str) -> str:
    """Return the text of the page of a study, in one line."""
    text = (root / "docs" / f"{PAGES[name]}.md").read_text("utf-8")
    return " ".join(text.split())


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_commands_of_the_study_run(name, root, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    text = (root / "examples" / "studies" / f"{name}.yaml").read_text("utf-8")
    text = re.sub(r"^ *block: \d+\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"replicates: \d+", "replicates: 2", text)
    Path(f"{name}.yaml").write_text(text.replace("seed: 14", "seed: 14\nblock: 2"))
    page = (root / "examples" / "studies" / "README.md").read_text("utf-8")
    commands = [words for words in list_commands(page) if words[2].startswith(name)]
    assert len(commands) >= 3
    for words in commands:
        if words[1] == "check":  # takes some seconds; it reads what `run` reads
            continue
        options = ["--workers", "1"] if words[1] == "run" else []
        assert main([*words, *options]) == 0, capsys.readouterr().err
    scores = [score for words in commands for score in words if words[1] == "summary"]
    drawn = [after for option, after in pairwise(scores) if option == "--score"]
    assert sorted(path.stem for path in Path(name).glob("*.png")) == sorted(drawn)


@pytest.mark.parametrize("name", PAGES)
def test_the_evidence_is_of_the_study_file_and_its_figures_are_shown(name, root) -> None:
    document = read_evidence(root, name)
    study = lc.load_study(root / "examples" / "studies" / f"{name}.yaml")
    assert document["replicates"] == study.replicates
    assert [cell["levels"] for cell in document["cells"]] == [dict(c.levels) for c in study.cells]
    shown = re.findall(r"\((?:\.\./)?evidence/(study_[\w.-]+)\)", read_page(root, name))
    assert sorted(shown) == document["figures"]
    assert all((root / "docs" / "evidence" / figure).exists() for figure in shown)
    assert f"examples/studies/{name}.yaml" in read_page(root, name)


def find_answers(document: dict[str, Any]) -> dict[tuple[str, ...], dict[str, Any]]:
    """Return the answers by the levels of the other factors, and the chain where there are some."""
    (question,) = document["questions"]
    return {
        (*answer["levels"].values(), *([answer["chain"]] if answer["chain"] else [])): answer
        for answer in question["answers"]
    }


def test_page_of_instruments_is_true_of_the_evidence(root) -> None:
    document = read_evidence(root, "instruments")
    answers = find_answers(document)
    for instrument in ("pose probe", "reflector"):
        assert answers[instrument, "40"]["certainty"] == "certain"
        assert answers[instrument, "40"]["best"] == "4"
        assert answers[instrument, "20"]["candidates"] == ["4", "2"]
        assert answers[instrument, "20"]["best"] == "2"
    for instrument in ("height gauge", "level"):
        for poses in ("20", "40"):
            assert answers[instrument, poses]["certainty"] == "none"
        few, many = (100 * answers[instrument, n]["shares"]["1"][0] for n in ("20", "40"))
        row = f"| {instrument} | does not suffice ({few:.0f} % of machines) | does not suffice"
        row = row if instrument == "height gauge" else row.replace(" of machines", "")
        assert f"{row} ({many:.0f} %) |" in read_page(root, "instruments")
    assert "base frame" in document["frame"]
    assert "on 95 % of machines, in the base frame." in read_page(root, "instruments")


def test_page_of_poses_is_true_of_the_evidence(root) -> None:
    document = read_evidence(root, "poses")
    answers = find_answers(document)
    assert answers["1", "choice random"]["best"] == "30 random"
    assert answers["1", "choice random"]["certainty"] == "certain"
    assert answers["1", "choice planned"]["candidates"] == ["10 planned", "20 planned"]
    share = 100 * answers["1", "choice planned"]["shares"]["10 planned"][0]
    row = f"| 20 um | 30 | 20 (with 10: {share:.1f} % of machines, not yet certain) |"
    assert row in read_page(root, "poses")
    assert answers["2", "choice random"]["candidates"] == ["60 random", "80 random"]
    assert answers["2", "choice planned"]["candidates"] == ["30 planned", "40 planned"]

    def find_median(poses: str, noise: str) -> list[float]:
        cell = find_cell(document, poses=poses, noise=noise)
        return cell["scores"]["position_max"]["median"]

    for noise in ("1", "2"):
        planned, random = find_median("20 planned", noise), find_median("40 random", noise)
        assert planned[1] < random[2]  # as good as 40 random ones, within the intervals
        for few, many in (("10", "40"), ("20", "80")):
            ratio = (
                find_median(f"{few} planned", noise)[0] / find_median(f"{many} planned", noise)[0]
            )
            assert 1.8 < ratio < 2.2  # four times as many poses halve it
    assert "exclude motions of frames" in document["frame"]


def test_page_of_methods_is_true_of_the_evidence(root) -> None:
    document = read_evidence(root, "methods")
    methods = list(dict.fromkeys(cell["levels"]["method"] for cell in document["cells"]))

    def find(method: str, errors: str, effects: str, score: str, kind: str) -> list[float]:
        cell = find_cell(document, method=method, errors=errors, effects=effects)
        return cell["scores"][score][kind]

    stated, worse, outliers = "as stated", "4 times as large", "5 % outliers"
    for errors in (stated, worse):
        low = find("default", errors, "none", "position", "median")[1]
        medians = [find(m, errors, "none", "position", "median") for m in methods]
        assert all(low < median[2] for median in medians)
        covered = find("default", errors, "none", "covered_position", "mean")
        assert covered[1] < 0.95 < covered[2]
        huber = "default, Huber loss"
        ratio = (
            find(huber, errors, outliers, "position", "median")[0]
            / find("default", errors, outliers, "position", "median")[0]
        )
        assert 0.4 < ratio < 0.6
        assert find(huber, errors, "none", "covered_position", "mean")[1] > 0.95
        for effects in ("none", outliers):
            truncated = find("truncated SVD", errors, effects, "position", "median")[0]
            assert truncated > find("default", errors, effects, "position", "median")[0]
            assert find("truncated SVD", errors, effects, "covered_position", "mean")[0] > 0.99
    default = [find("default", e, "none", "position", "median")[0] for e in (stated, worse)]
    prior = find("spreads as given", worse, "none", "position", "median")[0]
    assert 1.4 < prior / default[1] < 1.6
    assert 0.6 < find("spreads as given", worse, "none", "covered_position", "mean")[0] < 0.73
    plain = find("least squares", stated, "none", "position", "median")[0]
    assert 1.4 < plain / default[0] < 1.6
    narrow = find("ridge", worse, outliers, "covered_position", "mean")
    percents = [f"{100 * share:.0f}" for share in narrow]
    assert narrow[2] < 0.95
    assert f"U covers {percents[0]} % of the errors" in read_page(root, "methods")
    for method, errors, sentence in (
        ("default", stated, "U (95 %) covers {} % of the errors"),
        ("default", worse, "and {} % if machines are four times as bad"),
        ("spreads as given", worse, "errors are larger by half and U covers {} %"),
    ):
        covered = 100 * find(method, errors, "none", "covered_position", "mean")[0]
        assert sentence.format(f"{covered:.0f}") in read_page(root, "methods")
