# SPDX-License-Identifier: Apache-2.0
"""docs/report.md: its commands and its Python code run as printed; its table names the sections."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main


@pytest.mark.slow
@pytest.mark.usefixtures("do_not_draw")
def test_page_runs_as_printed(root, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    page = (root / "docs" / "report.md").read_text("utf-8")
    commands, printed, code = (
        re.findall(rf"^```{kind}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
        for kind in ("sh", "text", "python")
    )
    said = ""
    for command in commands[0].splitlines():
        assert main(command.split()[1:]) == 0, capsys.readouterr().err
        said = capsys.readouterr().out
    assert said == printed[0]
    assert [main(command.split()[1:]) for command in commands[1].splitlines()] == [0, 0]
    assert '<div class="blank"><dt>customer</dt>' in Path("signed.html").read_text("utf-8")
    assert [main(command.split()[1:]) for command in commands[2].splitlines()] == [0]
    assert "radius" in Path("volume.html").read_text("utf-8")
    capsys.readouterr()
    assert [main(command.split()[1:]) for command in commands[3].splitlines()] == [0, 0]
    assert capsys.readouterr().out == printed[1]
    exec(code[0], {})  # noqa: S102
    assert Path("again.html").read_text("utf-8") == Path("may.html").read_text("utf-8")
    assert Path("delta.html").read_text("utf-8") == Path("linear-delta.html").read_text("utf-8")
    sections = [s["title"] for s in json.loads(Path("may.json").read_text("utf-8"))["sections"]]
    listed = re.findall(r"^\| ([A-Z][^|]*) \|", page, re.MULTILINE)
    listed.remove("Pose accuracy and repeatability")  # these poses were not repeated
    assert [title for title in sections if title != "Other findings"] == listed


def test_changed_run_is_refused(root, tmp_path, monkeypatch, capsys, run) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run.path, "run")
    text = Path("run/result.json").read_text("utf-8")
    Path("run/result.json").write_text(text.replace('"findings": [', '"findings": [7,', 1))
    assert main(["report", "run"]) == 1
    said = capsys.readouterr().err
    assert "result.json in this run folder has changed since the calibration. Restore" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_outputs_are_checked_before_any_work(tmp_path, monkeypatch, capsys, run) -> None:
    monkeypatch.chdir(tmp_path)
    Path("report.json").write_text("{}")
    assert main(["report", str(run.path)]) == 1
    assert "report.json: this file exists" in capsys.readouterr().err
    assert main(["report", str(run.path), "-o", "report.txt"]) == 1
    assert "the name of a report ends in .html" in capsys.readouterr().err
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["report", str(run.path), "-o", "other.html", "--pdf"]) == 1
    said = capsys.readouterr().err
    assert said.count("other.pdf: a PDF file needs Chromium or Google Chrome") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.json"]
