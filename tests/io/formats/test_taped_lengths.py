# SPDX-License-Identifier: Apache-2.0
"""Dimensions that were measured by hand are prior knowledge where their sigma is stated."""

from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.io.robot.robot_file import load_robot

PRINTER = """[printer]
kinematics: delta
delta_radius: 130.25
[stepper_a]
step_distance: 0.0125
position_endstop: 250
arm_length: 269
[stepper_b]
step_distance: 0.0125
[stepper_c]
step_distance: 0.0125
"""
GCODE = "M665 L269 R130 H250 X0 Y0 Z0\nM666 X0 Y0 Z0\n"


@pytest.mark.parametrize(
    ("name", "text"), [("printer.cfg", PRINTER), ("printer.g", GCODE), ("printer.gcode", GCODE)]
)
def test_arms_of_a_delta_are_prior_knowledge_where_their_sigma_is_stated(
    tmp_path, monkeypatch, name, text
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(text)
    arms = [f"arm{k}.length" for k in (1, 2, 3)]
    for words, is_free in (("", False), ("--sigma-tape 0.3mm", True)):
        assert main(["import", name, "-o", "r.yaml", "--force", *words.split()]) == 0
        table = load_robot("r.yaml").parameters
        index = [table.index(arm) for arm in arms]
        assert table.free[index].all() == is_free
        if is_free:
            np.testing.assert_allclose(table.tolerance[index], 0.3e-3, rtol=1e-12)


def test_joint_centers_of_a_hexapod_are_prior_knowledge(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "hexapod-42", "--format", "linuxcnc", "-o", "h.hal"]) == 0
    words = "import h.hal --unit mm --home-z 200mm -o h.yaml --sigma-tape 0.5mm"
    assert main(words.split()) == 0
    table = load_robot("h.yaml").parameters
    centers = [i for i, name in enumerate(table.names) if ".base." in name or ".platform." in name]
    assert len(centers) == 36
    np.testing.assert_allclose(table.tolerance[centers], 0.5e-3, rtol=1e-12)


def test_option_of_another_format_is_refused(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("printer.cfg").write_text(PRINTER)
    assert main(["import", "printer.cfg", "-o", "r.yaml", "--sigma-anchor", "1mm"]) == 1
    assert "--sigma-anchor does not belong to the format klipper" in capsys.readouterr().err
