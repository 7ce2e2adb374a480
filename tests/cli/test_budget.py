# SPDX-License-Identifier: Apache-2.0
"""`loopcal budget`: the uncertainty of a run by source, on one screen."""

import json
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main

DATA = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run folder of a calibration."""
    folder = tmp_path_factory.mktemp("budget") / "run"
    assert (
        main(["calibrate", "hexapod-42", str(DATA), "-o", str(folder), "--hold-out", "0.25"]) == 0
    )
    return folder


def test_page_has_one_line_for_each_source_and_fits_a_screen(run, capsys):
    capsys.readouterr()
    assert main(["budget", str(run)]) == 0
    page = capsys.readouterr().out
    for words in ("Expected error", "instrument: pose", "tolerances", "all sources", "halved:"):
        assert words in page
    assert "[mm]" in page
    assert "[deg]" in page
    lines = page.splitlines()
    assert len(lines) < 40
    assert max(map(len, lines)) <= 132


def test_a_platform_that_does_not_rotate_has_no_column_of_orientations(tmp_path, capsys):
    data, folder = str(tmp_path / "data.csv"), str(tmp_path / "run")
    kind = ["--kind", "component", "--components", "x,y,z"]
    assert main(["simulate", "linear-delta", "-o", data, *kind, "--draw-errors"]) == 0
    assert main(["calibrate", "linear-delta", data, "-o", folder]) == 0
    capsys.readouterr()
    assert main(["budget", folder]) == 0
    page = capsys.readouterr().out
    assert "orientation" not in page
    rows = [line.split() for line in page.splitlines() if line.startswith(("tolerances", "all "))]
    assert all(float(cell) > 0.0 for cell in rows[0][-4:])
    assert rows[-1][-2:] == ["-", "-"]


def test_json_is_what_the_run_folder_holds(run, capsys):
    capsys.readouterr()
    assert main(["budget", str(run), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    stored = json.loads((run / "result.json").read_text())["expected_error"]
    assert shown["sources"] == stored["sources"]
    worst = stored["worst_parameter"]
    total = sum(line["parameters"][worst] for line in stored["sources"])
    assert total**0.5 == pytest.approx(stored["parameters"][worst], rel=1e-9)


def test_a_run_of_an_earlier_version_is_refused_with_what_to_do(run, capsys):
    path = run / "result.json"
    content = json.loads(path.read_text())
    del content["expected_error"]["sources"]
    path.write_text(json.dumps(content))
    assert main(["budget", str(run)]) == 1
    assert "contains no uncertainty budget" in capsys.readouterr().err
