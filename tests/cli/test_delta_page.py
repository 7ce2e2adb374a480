# SPDX-License-Identifier: Apache-2.0
"""docs/delta-printers.md: its robot file and its numbers are those of the example."""

import re
import shutil

import numpy as np
import pytest

import loopcal as lc


@pytest.fixture
def page(root, tmp_path, monkeypatch) -> str:
    """Work in a copy of the example's folder; return the text of the page."""
    shutil.copytree(root / "examples" / "delta-printer", tmp_path / "delta-printer")
    monkeypatch.chdir(tmp_path)
    return (root / "docs" / "delta-printers.md").read_text("utf-8")


def test_robot_file_of_the_page_equals_that_of_the_example(page, tmp_path) -> None:
    text = re.search(r"^```yaml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert text
    (tmp_path / "page.yaml").write_text(text[1])
    ours, shipped = lc.load_robot("page.yaml"), lc.load_robot("delta-printer/printer.yaml")
    assert ours.parameters.names == shipped.parameters.names
    np.testing.assert_array_equal(ours.values, shipped.values)
    np.testing.assert_array_equal(ours.parameters.free, shipped.parameters.free)


def test_truth_lies_within_3_5_standard_deviations_of_the_estimate(loopcal, page) -> None:
    loopcal("calibrate delta-printer/printer.yaml delta-printer/heights.csv -o run")
    sd = np.load("run/arrays.npz")["sd"]
    free = lc.load_robot("delta-printer/printer.yaml").parameters.free
    truth = lc.load_robot("delta-printer/truth.yaml").values
    errors = (lc.load_robot("run/robot.yaml").values - truth)[free] / sd
    assert np.abs(errors).max() < 3.5  # six values, in standard deviations


def test_identifiability_of_a_list_of_points_gives_the_values_of_the_page(loopcal, page) -> None:
    command = re.search(r"^loopcal (identifiability .*)$", page, re.MULTILINE)
    assert command
    left = _read_relative_uncertainties(loopcal(command[1]).out)
    assert {name: value for name, value in left.items() if "tower" in name} == {
        "tower1.angle": 0.26, "tower2.angle": 0.26,
        "tower1.stop": 0.05, "tower2.stop": 0.05, "tower3.stop": 0.05,
    }  # fmt: skip


def test_13_heights_hardly_determine_the_arm_lengths(loopcal, page, tmp_path) -> None:
    lines = (tmp_path / "delta-printer" / "printer.yaml").read_text().splitlines(keepends=True)
    (tmp_path / "nine.yaml").write_text(
        "".join(line for line in lines if not line.startswith("fixed"))
    )
    out = loopcal(
        "identifiability nine.yaml delta-printer/heights.csv", "9 of 9 parameter combinations"
    ).out
    assert "0.92 to 0.94 of their expected spread" in " ".join(page.split())
    assert {
        value for name, value in _read_relative_uncertainties(out).items() if "arm" in name
    } == {0.92, 0.94}


def _read_relative_uncertainties(out: str) -> dict[str, float]:
    """Return the last column of the table of parameters: sd divided by the tolerance."""
    rows = re.findall(r"^(\S+)\s+yes\s+(\d\.\d\d)$", out, re.MULTILINE)
    return {name: float(value) for name, value in rows}
