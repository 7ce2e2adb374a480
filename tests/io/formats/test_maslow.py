# SPDX-License-Identifier: Apache-2.0
"""The log and the configuration of a Maslow lead to its true frame, and back into its file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main

ANCHORS = {"bl": (0, 0), "br": (2953.2, 0), "tr": (2924.3, 2066.5), "tl": (-27.6, 2064.9)}
"""Of the true frame [mm], as in the configuration that FluidNC ships."""
TAPED = """\
name: Maslow
Maslow_tlX: 0
Maslow_tlY: 2050 # taped
Maslow_trX: 2940
Maslow_trY: 2050
Maslow_blX: 0
Maslow_blY: 0
Maslow_brX: 2940
Maslow_brY: 0
Maslow_tlZ: 100
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("maslow.yaml").write_text(TAPED)


def write_log(sigma: float) -> None:
    """Write what the firmware prints: first a part of the waypoints, then all of them."""
    noise, rows = np.random.default_rng(3), []
    for x in (700, 1100, 1480, 1900, 2300):
        for y in (500, 800, 1040, 1300, 1600):
            length = {k: np.hypot(x - a, y - b) for k, (a, b) in ANCHORS.items()}
            cells = ",   ".join(f"{k}:{v + noise.normal(0, sigma):.2f}" for k, v in length.items())
            rows.append(f"{{{cells}}},")
    lines = [f"[MSG:INFO: CLBM:[{''.join(part)}]]" for part in (rows[:9], rows)]
    Path("maslow.log").write_text("\n".join(["[MSG:INFO: Measured waypoint 8]", *lines, ""]))


def test_a_log_leads_to_the_true_frame(capsys) -> None:
    write_log(0.5)
    words = "import maslow.yaml --format maslow --probes maslow.log -o m.yaml --data m.csv"
    assert main([*words.split(), "--sigma-line", "0.5mm"]) == 0
    assert main(["calibrate", "m.yaml", "m.csv", "-o", "run"]) == 0
    robot, result = lc.load_run("run").robot, lc.load_run("run").result
    rows = {row["name"]: row for row in result["fit"]["parameters"]}
    assert len(rows) == 5
    for name, row in rows.items():
        belt, _, axis = name.split(".")
        assert abs(row["estimate"] - ANCHORS[belt]["xy".index(axis)]) < 1.5 * row["plus_minus"]
        assert row["plus_minus"] < 3.0
    capsys.readouterr()
    assert main(["budget", "run"]) == main(["report", "run", "-o", "run.html"]) == 0
    assert "0.5 mm  normal" in capsys.readouterr().out  # not 500 um
    assert (
        main(["export", "run", "--format", "maslow", "--into", "maslow.yaml", "-o", "new.yaml"])
        == 0
    )
    text = Path("new.yaml").read_text()
    value = 1e3 * dict(zip(robot.parameters.names, robot.values, strict=True))["tl.anchor.y"]
    assert f"Maslow_tlY: {value:.6f} # taped" in text
    assert "Maslow_tlZ: 100" in text
    assert "Maslow_blX: 0\n" in text


def test_belts_in_meters_are_refused_by_the_frame(capsys) -> None:
    """Belts alone fit a frame of any size: those in meters one a thousandth as large."""
    write_log(0.8)
    words = "import maslow.yaml --format maslow --probes maslow.log -o m.yaml --data m.csv"
    assert main([*words.split(), "--sigma-line", "1mm"]) == 0
    robot = lc.load_robot("m.yaml")
    data = lc.load_measurements("m.csv", robot)
    for written, said in ((1e-3, "1000 times larger"), (25.4, "25.4 times smaller")):
        with pytest.raises(lc.DataError, match=said):
            lc.calibrate(robot, replace(data, readings=written * data.readings))
    Path("meters.yaml").write_text(re.sub(r": (\d+)", lambda m: f": {int(m[1]) / 1e3}", TAPED))
    assert main(["import", "meters.yaml", "--format", "maslow", "-o", "m.yaml", "--force"]) == 1
    assert "span only 2.94 mm" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("config", "log", "words"),
    [
        (TAPED, "ok\n", "no CLBM:[..]"),
        (TAPED, "CLBM:[{bl:1, br:2, tr:3},]\n", "one is incomplete"),
        (TAPED, "CLBM:[{bl:1, br:nan, tr:3, tl:4},]\n", "m.log:1: a length of CLBM is 'nan'"),
        ("name: x\n", "", "Maslow_blX is missing"),
    ],
)
def test_damaged_files_are_refused(config, log, words, capsys) -> None:
    Path("maslow.yaml").write_text(config)
    Path("m.log").write_text(log)
    words_of_import = "import maslow.yaml --format maslow --probes m.log -o m.yaml --data m.csv"
    assert main(words_of_import.split()) == 1
    assert words in " ".join(capsys.readouterr().err.split())


def test_another_robot_is_not_written_as_a_maslow(capsys) -> None:
    assert main(["export", "linear-delta", "--format", "maslow"]) == 1
    assert "lacks bl.anchor.x" in capsys.readouterr().err
