# SPDX-License-Identifier: Apache-2.0
"""loopcal view: the scene of a robot and of a calibration as a page, and how it is opened."""

from __future__ import annotations

import base64
import json
import re
import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.documents import load_record, open_page
from loopcal.errors import FileError
from loopcal.report.document.elements import render_html
from loopcal.report.document.sections import build_calibration_view
from loopcal.report.words import say


def read_scene(page: Path) -> dict:
    """Return the scene of a page."""
    text = page.read_text("utf-8")
    matched = re.search(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)
    assert matched is not None
    return json.loads(matched[1])


def test_view_of_a_robot_shows_its_home_and_its_picture(tmp_path) -> None:
    page = lc.save_view(lc.load_robot("five-bar"), tmp_path / "view.html")
    scene = read_scene(page)
    assert scene["planar"]
    assert scene["unit"] == "mm"
    assert [name["text"] for name in scene["names"]] == ["west", "east", "x", "y"]
    assert scene["poses"]["labels"] == []
    assert scene["map"] is None
    text = page.read_text("utf-8")
    assert text.count("<svg") == 1
    assert "five-bar at its home pose." in text
    assert "<nav" not in text


def test_view_of_a_run_has_its_poses_errors_and_map(
    run, calibration, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(run.path), "--no-browser"]) == 0
    scene = read_scene(Path("view.html"))
    assert len(scene["poses"]["labels"]) == 30
    assert len(scene["map"]["colors"]) == 200
    meanings = " ".join(row["text"] for row in scene["legend"])
    assert re.search(r"before calibration, [0-9]+ times magnified", meanings)
    assert re.search(r"over the workspace, [0-9.]+ to [0-9.]+ um", meanings)
    assert len(scene["map"]["hull"]) % 3 == 0
    assert max(scene["map"]["hull"]) < len(scene["map"]["colors"])
    assert re.fullmatch(r"largest: [0-9.]+ um", scene["map"]["largest"]["text"])
    assert [motion["name"] for motion in scene["motions"]] == ["before calibration"]
    again = lc.save_view(calibration, "again.html")
    assert read_scene(again) == scene


def test_view_shows_what_undetermined_combinations_do(tmp_path, monkeypatch, capsys) -> None:
    """Positions of the tool do not tell how the platform frame is turned about it."""
    monkeypatch.chdir(tmp_path)
    simulate = "simulate hexapod-42 --draw-errors --kind component --components x,y,z -o m.csv"
    assert main(simulate.split()) == 0
    assert main(["calibrate", "hexapod-42", "m.csv", "-o", "run", "--method", "least-squares"]) == 0
    assert main(["view", "run", "--no-browser"]) == 0
    capsys.readouterr()
    scene = read_scene(Path("view.html"))
    before, *combinations = scene["motions"]
    assert before["name"] == "before calibration"
    assert len(combinations) == 3
    robot, tool = lc.load_run("run").robot, [part["role"] for part in scene["parts"]].index("tool")
    first = sum(part["count"] for part in scene["parts"][:tool])
    for motion in combinations:
        assert motion["name"].startswith("not determined: leg")
        assert "platform frame about" in motion["text"]
        shift = np.frombuffer(base64.b64decode(motion["shift"]), "<f4").reshape(-1, 3)
        lengths = np.linalg.norm(shift, axis=1) * 1e-3 / robot.size
        assert 0.05 < lengths.max() <= 0.15 + 1e-6
        assert lengths[first] < 1e-4  # what was measured stays


def test_view_of_a_fit_that_did_not_converge_shows_the_robot_before(run) -> None:
    record = load_record(run)
    fit = {**record.result["fit"], "status": "out_of_iterations"}
    result = {**record.result, "verdict": "not_calibrated", "fit": fit, "headline": "Failed."}
    text = render_html(build_calibration_view(replace(record, result=result)))
    assert say("scene-figure.not-converged") in text
    assert "The robot at home." in text
    assert '<header class="not_calibrated">' in text


def test_wrong_use_is_refused_and_writes_nothing(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for words, sentence in (
        ("five-bar -o view.png", "the name of a view ends in .html, but this one has '.png'"),
        ("nowhere --no-browser", "nowhere"),
    ):
        assert main(["view", *words.split()]) == 1
        assert sentence in " ".join(capsys.readouterr().err.split())
    with pytest.raises(FileError, match="ends in"):
        lc.save_view(lc.load_robot("five-bar"), "view")
    assert list(tmp_path.iterdir()) == []
    Path("view.html").write_text("mine")
    assert main(["view", "five-bar", "--no-browser"]) == 1
    assert Path("view.html").read_text() == "mine"


def test_page_opens_in_a_browser_only_where_there_is_a_display(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", "five-bar"]) == 0
    assert capsys.readouterr().out == "Written to view.html, but no browser starts here\n"
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["view", "five-bar", "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["opened"] is True
    assert opened == [(tmp_path / "view.html").as_uri()]

    def fail(address: str) -> bool:
        raise webbrowser.Error(address)

    monkeypatch.setattr(webbrowser, "open", fail)
    assert not open_page("file:///nowhere.html")
