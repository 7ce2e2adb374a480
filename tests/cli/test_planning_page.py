# SPDX-License-Identifier: Apache-2.0
"""docs/planning.md: its commands and its Python code run as printed."""

import re

import numpy as np
import pytest

import loopcal as lc
from tests.cli.page_commands import run_page


@pytest.mark.slow
def test_commands_and_code_of_the_page_run_and_calibrate_the_machine(
    root, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = (root / "docs" / "planning.md").read_text("utf-8")
    of_surfaces = r"^## Planes and lines.*?^(?=## )"  # runs in tests/cli/test_planes_and_lines.py
    page, cut = re.subn(of_surfaces, "", page, flags=re.MULTILINE | re.DOTALL)
    assert cut == 1
    names = run_page(page)
    assert names["plan"].n_poses == 12
    nominal, truth, found = (
        lc.load_robot(name).values for name in ("printer.yaml", "truth.yaml", "run/robot.yaml")
    )
    assert np.linalg.norm(found - truth) < 0.3 * np.linalg.norm(nominal - truth)
