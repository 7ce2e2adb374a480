# SPDX-License-Identifier: Apache-2.0
"""`loopcal budget`: the uncertainty of a run by source, on one screen."""

import json
import shutil
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


SPREADS = "expected spreads  "  # begins a row


def test_page_has_one_line_for_each_source_and_fits_a_screen(loopcal, run):
    said = ("Expected error", "instrument: pose", "expected spreads", "all sources", "halved:")
    lines = loopcal(f"budget {run}", *said, "[um]", "[urad]").out.splitlines()
    assert len(lines) < 64
    cells = [line.split() for line in lines if line.startswith("factor on the expected spreads ")]
    assert cells[0][6] == cells[1][-1] == "infinite"  # degrees of freedom in both tables
    assert max(map(len, lines)) <= 132


def test_a_platform_that_does_not_rotate_has_no_column_of_orientations(loopcal):
    kind = "--kind component --components x,y,z"
    loopcal(f"simulate linear-delta -o data.csv {kind} --draw-errors")
    loopcal("calibrate linear-delta data.csv -o run")
    page = loopcal("budget run").out
    assert "orientation" not in page
    rows = [line.split() for line in page.splitlines() if line.startswith((SPREADS, "all "))]
    assert page.count("JCGM 100") == 1
    assert all(float(cell) > 0.0 for cell in rows[0][-4:])
    assert rows[1][-2:] == ["-", "-"]


def test_json_is_what_the_run_folder_holds(loopcal, run):
    shown = loopcal(f"budget {run} --json").json
    stored = json.loads((run / "result.json").read_text())["expected_error"]
    assert shown["sources"] == stored["sources"]
    worst = stored["worst_parameter"]
    total = sum(line["parameters"][worst] for line in stored["sources"])
    assert total**0.5 == pytest.approx(stored["parameters"][worst], rel=1e-9)


def test_the_largest_error_in_a_volume_is_stated_for_all_points_and_for_each(loopcal, run, capsys):
    volume = "--volume x=-20mm..20mm --volume y=-20mm..20mm"
    loopcal(f"accuracy {run} {volume}", "simultaneously at all points", "pointwise, 95 %")
    stated = json.loads(loopcal(f"accuracy {run} {volume} --frame base --json").out)
    assert stated["simultaneous"] >= stated["pointwise"] > 0.0
    assert stated["refinement"] < 0.01
    wrong = {
        "z=1m..9m": "reaches no point",
        "x": "nor a part of a volume. Give x=-40mm..40mm",
        "x=3mm..2mm": "not a range",
        "x=3..4": "no unit",
        "w=1deg..2deg": "x",
        "x=3mm,2deg": "deg",
        "radius=0mm": "above 0",
        "no-file.csv": "neither a file",
    }
    for text, words in wrong.items():
        assert main(["accuracy", str(run), "--volume", text]) == 1
        assert words in capsys.readouterr().err


POINTS = (
    "pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]\na,0,0,200,0,0,0\nb,9,0,200,0,0,3\n"
)


def test_points_of_a_file_and_a_limit_decide_the_exit_code(loopcal, run):
    Path("points.csv").write_text(POINTS)
    loopcal(
        f"accuracy {run} --volume points.csv --limit-position 1mm", "list of 2 points", "conforms"
    )
    failed = loopcal(f"accuracy {run} --volume points.csv --limit-position 1nm", code=2)
    assert "does not conform" in failed.err
    loopcal(f"accuracy {run} --volume points.csv --volume x=1mm", "with other parts", code=1)
    Path("points.csv").write_text(POINTS.replace("roll", "rolle"))
    loopcal(f"accuracy {run} --volume points.csv", "points.csv:1", code=1)


def test_a_volume_is_part_of_the_calibration_and_of_all_that_states_it(loopcal):
    volume = "--volume radius=20mm --volume z=190mm..210mm --volume pitch=0deg,3deg"
    command = f"calibrate hexapod-42 {DATA} -o run --hold-out 0.25 --limit-position 0.1mm {volume}"
    page = " ".join(
        loopcal(command, "cylinder of radius 20 mm about x 0 mm and y 0 mm").out.split()
    )
    result = json.loads(Path("run/result.json").read_text())
    stated = result["volume"]
    assert result["options"]["volume"]["radius"] == pytest.approx(0.02)
    words = [finding["text"] for finding in stated["findings"]]
    assert len(words) == 3
    assert [text in page for text in words] == [True, False, True]  # not its conditions
    assert "pitch 0 deg and 3 deg" in words[0]
    assert "absolute in the base frame" in words[1]
    assert stated["conformity"]["decision"] == "conforms"
    again = loopcal(f"accuracy run {volume} --json").json
    # the run has all that the statement follows from, up to rounding
    assert again["simultaneous"] == pytest.approx(stated["simultaneous"], rel=1e-9)
    loopcal("report run")
    content = json.loads(Path("report.json").read_text())
    assert words[0] in str(content)
    html = Path("report.html").read_text()
    assert all(text in html for text in words)


def test_residuals_that_contradict_the_noise_state_no_error_in_a_volume(loopcal, run):
    shutil.copytree(run, "doubtful")
    path = Path("doubtful/result.json")
    content = json.loads(path.read_text())
    volume = "--volume x=-1mm..1mm"
    path.write_text(json.dumps({**content, "states_expected_error": False}))
    loopcal(f"accuracy doubtful {volume}", "the residuals exceed the given noise", code=1)
    path.write_text(json.dumps({**content, "verdict": "not_calibrated", "reasons": ["residuals"]}))
    loopcal(f"accuracy doubtful {volume}", "doubtful", code=1)
