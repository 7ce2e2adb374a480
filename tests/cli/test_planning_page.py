# SPDX-License-Identifier: Apache-2.0
"""docs/planning.md: its commands and its Python code run as printed."""

import re
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc


@pytest.fixture
def page(root, tmp_path, monkeypatch) -> str:
    """Work in an empty folder; return the text of the page."""
    monkeypatch.chdir(tmp_path)
    return (root / "docs" / "planning.md").read_text("utf-8")


@pytest.mark.slow
def test_commands_of_the_page_run_and_calibrate_the_machine(loopcal, page) -> None:
    commands = [
        line
        for block in re.findall(r"^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
        for line in block.splitlines()
    ]
    assert len(commands) == 11
    printed = re.search(r"^```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    targets = re.search(r"^```text\n(pose,.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert printed
    assert targets
    Path("targets.csv").write_text(targets[1])
    for command in commands:
        if "nategh-agheli" in command:  # tests/cli/test_planes_and_lines.py
            continue
        assert command.startswith("loopcal ")
        said = loopcal(command.split()[1:]).out
        if "-o plan " in command:
            assert said.startswith(printed[1])
        if " calibrate " in command:
            assert "Errors at 5 held-out poses" in said
            assert said.startswith("Calibrated")
        if "--accuracy" in command:
            ending = "poses, the position error over the workspace (rms) of 9 of 10 machines ends"
            assert f"{ending} below 0.02 mm." in " ".join(said.split())
    nominal, truth, found = (
        lc.load_robot(name).values for name in ("printer.yaml", "truth.yaml", "run/robot.yaml")
    )
    assert np.linalg.norm(found - truth) < 0.3 * np.linalg.norm(nominal - truth)


def test_python_code_of_the_page_runs(loopcal, page, capsys) -> None:
    block = re.search(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert block
    loopcal("new linear-delta -o printer.yaml")
    names: dict = {}
    exec(block[1], names)  # noqa: S102
    assert names["plan"].n_poses == 12
    assert (
        "12 poses of printer for calibration and 5 for validation (component)"
        in capsys.readouterr().out
    )
