# SPDX-License-Identifier: Apache-2.0
"""docs/delta-printers.md: the commands for Marlin and RepRapFirmware, on simulated reports."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.io.formats.probe_reports import read_reports
from tests.io.test_probe_reports import MARLIN, POINTS, REPRAP, make_truth, probe, write_points

NOISE = 0.02
"""Of the simulated probe [mm], as the command for Marlin states it."""


@pytest.fixture
def commands(root, tmp_path, monkeypatch) -> list[str]:
    """Work in an empty folder; return the commands of the section, without the program's name."""
    monkeypatch.chdir(tmp_path)
    page = (root / "docs" / "delta-printers.md").read_text("utf-8")
    section = page.split("## Import the probe report")[1].split("\n## ")[0]
    found = re.findall(r"^loopcal (.*)$", section, re.MULTILINE)
    assert len(found) == 3
    return found


def add_noise(heights: list[float]) -> list[float]:
    noise = NOISE * np.random.default_rng(7).standard_normal(len(heights))
    return list(np.add(heights, noise))


def check_recommendation(truth, code: str, accuracy: float = 0.2e-3) -> None:
    """Check that the run recommends new values, and that they are the true ones."""
    result = json.loads(Path("run/result.json").read_text())
    assert result["recommendation"]["code"] == code
    fit = lc.load_run("run").robot
    place = fit.parameters.names.index("radius")
    assert fit.values[place] == pytest.approx(truth.values[place], abs=accuracy)


def test_commands_for_marlin_lead_to_a_recommendation(loopcal, commands) -> None:
    Path("m503.gcode").write_text(MARLIN)
    robot, truth = make_truth("m503.gcode")
    write_points(POINTS, add_noise(probe(robot, truth, POINTS)), "g30.txt")
    importing, calibrating = commands[:2]
    assert importing.startswith("import m503.gcode")
    loopcal(importing)
    loopcal(calibrating)
    check_recommendation(truth, "values.apply")  # five of 13 points are held out


def test_commands_for_reprapfirmware_lead_to_a_recommendation(loopcal, commands) -> None:
    Path("config-override.g").write_text(REPRAP)
    robot, truth = make_truth("config-override.g")
    cells = " ".join(f"{h:.3f}" for h in add_noise(probe(robot, truth, POINTS)))
    Path("g32.txt").write_text(f"G32 bed probe heights: {cells}, mean 0, deviation 0")
    bed = [f"G30 P{i} X{x:.3f} Y{y:.3f} Z-99999" for i, (x, y) in enumerate(POINTS)]
    Path("bed.g").write_text("\n".join(bed) + " S-1\n")
    loopcal(commands[2])
    loopcal("calibrate printer.yaml heights.csv -o run")
    check_recommendation(truth, "values.apply-fitted")
    # nobody stated the noise: eight fitted points leave two degrees of freedom to estimate it, and
    # the assumed one, which may be wrong by half, counts as two more
    words = ["calibrate", "printer.yaml", "heights.csv", "-o", "run", "--hold-out", "0.4"]
    loopcal([*words, "--force"])
    check_recommendation(truth, "values.apply", 0.4e-3)


def test_lines_of_the_page_probe_its_thirteen_points(root, tmp_path) -> None:
    page = (root / "docs" / "delta-printers.md").read_text("utf-8")
    section = page.split("## Probe thirteen points")[1].split("\n## ")[0]
    marlin, reprap, klipper = re.findall(r"```none\n(.*?)```", section, re.DOTALL)
    sent = re.findall(r"^G30 X(\S+) Y(\S+)$", marlin, re.MULTILINE)
    options = klipper.split("points:")[1]
    stored = re.findall(r"^ +(\S+), (\S+)$", options, re.MULTILINE)
    for points in (sent, stored):
        np.testing.assert_allclose(np.array(points, float), POINTS, atol=0.006)  # [mm]
    heights = " ".join(["0.010", *["0.020"] * 12])
    (tmp_path / "bed.g").write_text(reprap)
    (tmp_path / "g32.txt").write_text(f"G32 bed probe heights: {heights}, mean 0.019")
    read, _ = read_reports([tmp_path / "g32.txt", tmp_path / "bed.g"], "reprap", {})
    np.testing.assert_allclose([(p.x, p.y) for p in read], POINTS, atol=0.006)
    assert reprap.strip().endswith(" S-1")
    typed = page.split("## Type the numbers")[1].split("\n## ")[0]
    assert re.findall(r"^loopcal (.*)$", typed, re.MULTILINE) == [
        f"export run --format {name}" for name in ("marlin", "reprap", "klipper")
    ]
