# SPDX-License-Identifier: Apache-2.0
"""Unmet quality gates of `loopcal calibrate`: exit code 2, with the reason in text and JSON."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.findings import report_finding

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"


@pytest.fixture
def folder_with_wrong_cell(tmp_path, monkeypatch) -> Path:
    """Return a folder with the example's measurements and a copy with one rz set to 12 degrees."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(EXAMPLE / "measurements.csv", tmp_path)
    lines = (tmp_path / "measurements.csv").read_text().split("\n")
    head = next(i for i, line in enumerate(lines) if line.startswith("pose,"))
    column = next(i for i, name in enumerate(lines[head].split(",")) if name.startswith("rz"))
    cells = lines[head + 5].split(",")
    cells[column] = "12"
    lines[head + 5] = ",".join(cells)
    (tmp_path / "bad.csv").write_text("\n".join(lines))
    return tmp_path


def test_wrong_cell_fails_the_quality_gate_and_widens_the_intervals(
    loopcal, folder_with_wrong_cell
) -> None:
    loopcal("calibrate hexapod-42 measurements.csv -o good")
    _, out, err = loopcal("calibrate hexapod-42 bad.csv -o bad", code=2)
    assert "loopcal: quality gate not met: The residuals" in err
    assert out.count("Not calibrated: ") == 1
    good, bad = (
        json.loads((folder_with_wrong_cell / name / "result.json").read_text())
        for name in ("good", "bad")
    )
    assert (good["passed"], good["reasons"]) == (True, [])
    assert (bad["passed"], bad["verdict"]) == (False, "not_calibrated")
    assert good["verdict"] == "undecided"  # nothing was held out
    scale = bad["fit"]["sigma_scale"]
    assert scale > 100  # 12 degrees against 5 urad in one of 240 equations
    assert scale == pytest.approx(
        np.sqrt(bad["fit"]["chi_square"] / bad["fit"]["degrees"]), rel=1e-12
    )
    wide, narrow = (np.array([p["sd"] for p in r["fit"]["parameters"]]) for r in (bad, good))
    assert (wide > 5 * narrow).all()


def test_larger_errors_on_held_out_poses_fail_the_quality_gate(
    folder_with_wrong_cell, capsys
) -> None:
    code = main(["calibrate", "hexapod-42", "bad.csv", "-o", "run", "--hold-out", "0.25", "--json"])
    document = json.loads(capsys.readouterr().out)
    grown = [
        index
        for index in ("position", "orientation")
        if document["validation"]["after"][index]["rms"]
        > 1.1 * document["validation"]["before"][index]["rms"]
    ]
    assert grown
    assert code == 2
    grew = [f["data"] for f in document["findings"] if f["code"] == "gates.errors-grew"]
    assert [data["quantity"] for data in grew] == grown
    assert all(data["times"] > 1.1 for data in grew)


@pytest.mark.parametrize("hold_out", ["", "--hold-out 0.25"])
def test_unreachable_poses_fail_the_quality_gate_without_a_user_error(
    loopcal, folder_with_wrong_cell, monkeypatch, hold_out
) -> None:
    def raise_data_error(*_, **__):
        code = "residuals.calibrated-out-of-reach"
        raise lc.DataError(report_finding(code, robot="hexapod-42", poses=10, before=10, after=0))

    monkeypatch.setattr("loopcal.apply.calibration.validate", raise_data_error)
    _, out, err = loopcal(
        ["calibrate", "hexapod-42", "measurements.csv", "-o", "run", *hold_out.split()], code=2
    )
    assert err.startswith("loopcal: quality gate not met: ")
    assert err.count("\n") == 1
    assert out.endswith("Written to run: result.json, arrays.npz, robot-not-calibrated.yaml\n")
    result = json.loads((folder_with_wrong_cell / "run" / "result.json").read_text())
    assert result["passed"] is False
    (failure,) = [f for f in result["findings"] if f["severity"] == "failure"]
    assert failure["code"] == "gates.poses-unreachable"
    assert "The two geometries of hexapod-42 reach different poses" in failure["data"]["reason"]
    assert result["reasons"] == [failure["text"]]
