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
    assert main(f"calibrate hexapod-42 {DATA} -o {folder} --hold-out 0.25".split()) == 0
    return folder


def test_page_has_one_line_for_each_source_and_fits_a_screen(loopcal, run):
    said = ("Expected error", "instrument: pose", "tolerances", "all sources", "halved:")
    lines = loopcal(f"budget {run}", *said, "[mm]", "[deg]").out.splitlines()
    assert len(lines) < 40
    assert max(map(len, lines)) <= 132


def test_a_platform_that_does_not_rotate_has_no_column_of_orientations(loopcal):
    kind = "--kind component --components x,y,z"
    loopcal(f"simulate linear-delta -o data.csv {kind} --draw-errors")
    loopcal("calibrate linear-delta data.csv -o run")
    page = loopcal("budget run").out
    assert "orientation" not in page
    rows = [line.split() for line in page.splitlines() if line.startswith(("tolerances", "all "))]
    assert all(float(cell) > 0.0 for cell in rows[0][-4:])
    assert rows[-1][-2:] == ["-", "-"]


def test_json_is_what_the_run_folder_holds(loopcal, run):
    shown = loopcal(f"budget {run} --json").json
    stored = json.loads((run / "result.json").read_text())["expected_error"]
    assert shown["sources"] == stored["sources"]
    worst = stored["worst_parameter"]
    total = sum(line["parameters"][worst] for line in stored["sources"])
    assert total**0.5 == pytest.approx(stored["parameters"][worst], rel=1e-9)


def test_a_run_of_an_earlier_version_is_refused_with_what_to_do(loopcal, run):
    path = run / "result.json"
    content = json.loads(path.read_text())
    del content["expected_error"]["sources"]
    path.write_text(json.dumps(content))
    loopcal(f"budget {run}", "contains no uncertainty budget", code=1)


def test_the_largest_error_in_a_volume_is_stated_for_all_points_and_for_each(loopcal, run, capsys):
    volume = "--volume x=-20mm..20mm --volume y=-20mm..20mm"
    loopcal(f"accuracy {run} {volume}", "at all points", "at each single point")
    stated = json.loads(loopcal(f"accuracy {run} {volume} --frame base --json").out)
    assert stated["simultaneous"] >= stated["pointwise"] > 0.0
    assert stated["refinement"] < 0.01
    wrong = {"x=-2mm..9m": "reaches", "x=3mm": "no range", "x=3..4": "no unit", "w=1deg..2deg": "x"}
    for text, words in wrong.items():
        assert main(["accuracy", str(run), "--volume", text]) == 1
        assert words in capsys.readouterr().err
