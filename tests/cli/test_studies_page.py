# SPDX-License-Identifier: Apache-2.0
"""docs/studies.md: its commands and its Python code run as printed, and lead to a figure."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.studies.specification import MOST_TRIALS
from tests.cli.page_commands import list_commands

TRIALS = 18
"""Of each cell, so that trial 17 exists."""

COMPUTING = ("run", "extend")


@pytest.fixture
def page(root, tmp_path, monkeypatch) -> str:
    """Work in an empty folder; return the text of the page."""
    monkeypatch.chdir(tmp_path)
    return (root / "docs" / "studies.md").read_text("utf-8")


def shrink(file: Path) -> None:
    """Leave few trials and poses in a study file."""
    text = file.read_text().replace("replicates: 1000", f"replicates: {TRIALS}\nblock: {TRIALS}")
    file.write_text(text.replace("poses: [10, 20, 40]", "poses: [10, 20]"))


@pytest.mark.slow
def test_commands_and_code_of_the_page_lead_from_a_new_file_to_figures(page, capsys) -> None:
    commands = list_commands(page)
    names = {words[1] for words in commands}
    assert names == {
        *("new", "check", "run", "status", "summary", "export"),
        *("replay", "extend", "merge", "ask"),
    }
    for words in commands:
        line = " ".join(words).replace("5000", str(2 * TRIALS))
        options = ["--workers", "1"] if words[1] in COMPUTING else []
        code = main([*line.split(), *options])
        out, err = capsys.readouterr()
        assert code in ((0, 2) if words[1] == "replay" else (0,)), f"{line}: {err}"
        if words[1] == "new":
            shrink(Path("study.yaml"))
        if words[1] == "ask":
            assert "no trials" not in out
    assert len(lc.load_study("study.yaml").cells) == 8
    assert Path("results/position.png").read_bytes().startswith(b"\x89PNG")
    assert Path("trials.csv").read_text().count("\n") == 8 * TRIALS + 1
    assert Path("trial/result.json").exists()
    assert Path("trial-input/truth.yaml").exists()
    assert Path("joined/study.sqlite").exists()

    pytest.importorskip("pandas")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    names_of_code: dict = {"__name__": "__main__"}
    exec(code.replace("workers=2", "workers=1"), names_of_code)  # noqa: S102
    assert capsys.readouterr().out.startswith("Interval(value=1.0")
    assert len(names_of_code["table"]) == 8 * TRIALS


def test_the_rule_for_the_size_of_blocks_is_true_of_the_evidence(page, root) -> None:
    file = root / "docs" / "evidence" / "study_workers.json"
    document = json.loads(file.read_text("utf-8"))
    assert 0.5 < 5e-3 / document["seconds_per_block"] < 2.0  # 5 ms for each worker
    for name, seconds in document["seconds_per_trial"].items():
        row = next(row for row in document["tables"]["trials"]["rows"] if row[1] == name)
        assert row[3] == pytest.approx(1000 * document["seconds_per_block"] / seconds, rel=0.1)
    assert document["tables"]["trials"]["rows"][0][3] > MOST_TRIALS == 2000
    stored = next(row[3] for row in document["tables"]["blocks"]["rows"] if row[0] == 1000)
    assert f"The store of a million trials has {1e-3 * stored:.2f} GB." in page


def test_the_question_of_the_page_is_one_of_a_study_file(loopcal, page, tmp_path) -> None:
    (block,) = re.findall(r"^```yaml\n(questions:.*?)^```", page, re.MULTILINE | re.DOTALL)
    loopcal("study new study.yaml")
    file = tmp_path / "study.yaml"
    text = file.read_text()
    file.write_text(re.sub(r"^questions:\n(  .*\n)+", "", text, flags=re.MULTILINE) + "\n" + block)
    questions = lc.load_study(file).questions
    assert {question.wanted for question in questions.values()} == {"smallest", "largest"}
