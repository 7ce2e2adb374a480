# SPDX-License-Identifier: Apache-2.0
"""loopcal study summary and ask: answers, figures and files of a study that was run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import loopcal as lc

TEXT = """\
format: 1
title: How many poses?
seed: 3
replicates: 60
block: 30
robots: [five-bar]
instruments:
  tracker: {kinds: [position], sigma_position: 20 um}
poses: [8, 40]
methods: [least-squares]
scores: {held_out: 3}
questions:
  how many: {factor: poses, score: position, limit: 30 um, share: 0.8}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("questions")
    (base / "study.yaml").write_text(TEXT)
    return lc.study(base / "study.yaml", base / "results").folder


def test_summary_answers_the_questions_of_the_file_and_writes_figures(loopcal, folder) -> None:
    loopcal(
        f"study summary {folder}",
        "how many: smallest level of poses with position up to 30 um on 80 % of machines",
        "summary.json, summary.csv, position.png, covered_parameters.png",
    )
    assert (folder / "position.png").read_bytes().startswith(b"\x89PNG")
    (answered,) = json.loads((folder / "summary.json").read_text())["questions"]
    (answer,) = answered["answers"]
    assert (answer["certainty"], answer["best"]) == ("certain", "40")
    assert [share["trials"] for share in answer["shares"]] == [60, 60]


def test_a_question_is_asked_after_the_run(loopcal, folder) -> None:
    words = ["study", "ask", str(folder), "--smallest", "poses", "--limit", "30um"]
    loopcal([*words, "--share", "0.8"], "40", "position up to 30 um on 80 % of machines")
    assert loopcal([*words, "--share", "0.8", "--json"]).json["answers"][0]["best"] == "40"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("--limit 30um", "give --smallest FACTOR or --largest FACTOR, one of them"),
        ("--smallest poses --largest noise --limit 3um", "one of them"),
        ("--smallest posses --limit 30um", "factor is 'posses'"),
        ("--smallest poses --limit 30", "limit: '30' has no unit"),
        ("--smallest poses --limit 30um --score rank", "score is 'rank'"),
        ("--smallest poses --limit 30um --share 95", "--share"),
        ("--smallest poses --limit 30um --share nan", "--share"),
    ],
)
def test_wrong_questions_get_a_sentence(loopcal, folder, words, sentence) -> None:
    loopcal(["study", "ask", str(folder), *words.split()], sentence, code=1)


def test_figures_against_an_unknown_factor_are_refused(loopcal, folder) -> None:
    loopcal(f"study summary {folder} --against pose", "factor is 'pose'", code=1)
