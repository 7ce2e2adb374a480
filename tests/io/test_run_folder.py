# SPDX-License-Identifier: Apache-2.0
"""Run folders are written completely or not at all, and only over other run folders."""

import json
import math

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.core.text_file import to_json
from loopcal.io.runs.run_folder import (
    FORMS,
    GROUPS,
    MADE_BY,
    collect_provenance,
    read_run_folder,
    write_run_folder,
)

RESULT = {
    "format": 2,
    "made_by": {"command": [], "inputs": {}},
    "fit": {
        "parameters": [{"name": "x", "plus_minus": 0.1, "estimate": 1.0, "unit": "m"}],
        "status": "converged",
        "local": [],
        "dropped": [],
        **dict.fromkeys(("sigma_scale", "noise_degrees", "p_value", "sigma_uncertainty"), 1.0),
        "noise": "given",
    },
    "verdict": "calibrated",
    "passed": True,
    "reasons": [],
    "split": None,
    "options": {"fit": {}},
}
"""The least that result.json of a run states."""

SIZES = {"p": 1, "a": 1, "u": 0, "e": 0, "s": 1, "c": 1, "d": 1, "2": 2}
TYPES = {"finite": "f8", "number": "f8", "logical": "?", "text": "U1", "whole": "i8"}
ARRAYS = {
    name: np.ones([SIZES[size] for size in form.split()[1:]]).astype(TYPES[form.split()[0]])
    for name, form in FORMS.items()
    if not name.startswith(GROUPS)
}
ARRAYS["posterior_part"] = np.zeros(1, dtype=int)
"""The arrays of a run with one parameter."""


def write(folder, force: bool = False, value: float = 1.5):
    arrays = ARRAYS | {"a": np.arange(3.0)}
    result = {**RESULT, "value": value}
    return write_run_folder(folder, result, arrays, "name: h\n", force)


def test_run_folder_is_read_as_written(tmp_path) -> None:
    (tmp_path / "deep" / "run").mkdir(parents=True)  # an empty folder is used
    folder = write(tmp_path / "deep" / "run")
    result, arrays = read_run_folder(folder)
    assert result["format"] == 2
    assert result["value"] == 1.5
    assert set(result["files"]) == {"arrays.npz", "robot.yaml", "result.json"}
    assert arrays["a"].tolist() == [0.0, 1.0, 2.0]
    assert (folder / "robot.yaml").read_text() == "name: h\n"
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["run"]


def test_force_replaces_only_run_folders(tmp_path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(FileError, match="something other than a run"):
        write(tmp_path, force=True)
    with pytest.raises(FileError, match="this is a file, but the run"):
        write(tmp_path / "thesis.tex", force=True)


def test_failed_write_leaves_no_files(tmp_path) -> None:
    with pytest.raises(ValueError, match="Object arrays"):
        write_run_folder(tmp_path / "run", {}, {"a": np.array([object()])}, "")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_complete_run_is_refused(tmp_path) -> None:
    with pytest.raises(FileError, match="not a run folder"):
        read_run_folder(tmp_path)
    folder = write(tmp_path / "run")
    for text, word in (("{", "damaged"), ('{"format": 99}', "Calibrate again")):
        (folder / "result.json").write_text(text)
        with pytest.raises(FileError, match=word):
            read_run_folder(folder)
    (folder / "arrays.npz").unlink()
    with pytest.raises(FileError, match=r"lacks arrays\.npz. Restore it, or repeat"):
        read_run_folder(folder)
    (folder / "robot.yaml").unlink()
    with pytest.raises(FileError, match=r"arrays\.npz and robot\.yaml"):
        read_run_folder(folder)


def test_json_has_null_with_a_reason_for_numbers_that_are_not_finite() -> None:
    rows = [{"sd": math.inf}, {"sd": np.float64(0.5)}]
    document = json.loads(to_json({"rows": rows, "a": np.array([math.nan])}))
    assert document["rows"] == [{"sd": None}, {"sd": 0.5}]
    assert set(document["nulls"]) == {"rows/0/sd", "a/0"}
    assert document["nulls"]["rows/0/sd"].startswith("infinite")


def test_provenance_contains_inputs_and_versions(tmp_path) -> None:
    data = tmp_path / "data.csv"
    data.write_bytes(b"abc")
    origin = collect_provenance(["loopcal", "calibrate"], {"data": data}, {"split": 1})
    assert set(origin) == set(MADE_BY)
    # SHA-256 of "abc", FIPS 180-2 B.1
    assert origin["inputs"]["data"]["sha256"].startswith("ba7816bf8f01cfea")
    assert set(origin["versions"]) == {"loopcal", "engine", "python", "numpy", "scipy"}
