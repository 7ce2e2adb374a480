# SPDX-License-Identifier: Apache-2.0
"""Calibration of real delta printers by a robot file, probed heights and one command.

The reference is the geometry that the printers' own firmware stored. It was fitted to the same
heights with equal weights.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from tests.cli.delta_printers import (
    list_stored_geometry,
    read_records,
    select_records_without_distances,
    write_files,
)
from tests.cli.printed_tables import read_table_rows
from tests.io.formats.printers import format_printer_cfg

# The heights-only records of the folder; a test below compares this list with the folder.
CALIBRATED = (
    "cupsster/FLSUN-SR---Klipper-Config Configuration/printer.cfg",
    "danorder/Flsun-super-racer-Full-klipper-config- printer.cfg",
    "fzechert/FLSun-V400 printer-config/printer.cfg",
)
FACTORY_DEFAULT = "danorder/Flsun-super-racer-Full-klipper-config- V400 FIXES.txt"
WITH_DISTANCES = "RazorCopter/Klipper_FLSUN_Q5 printer [Post-Calibration].cfg"
TOLERANCES = (
    "tolerances: {radius: {sd: 0.5}, angles: {sd: 0.3}, arms: {sd: 0.3}, stops: {sd: 0.5}}\n"
)
IMPORT = "import printer.cfg -o printer.yaml --data probes.csv --force"
CALIBRATE = "calibrate robot.yaml heights.csv -o run"


@pytest.fixture
def calibrate(tmp_path, monkeypatch, capsys, data_folder):
    """Write the files of a record, run the documented command, and return its output and result."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, options: str = "", **files: float | str) -> tuple[str, dict]:
        write_files(read_records(data_folder)[name], tmp_path, **files)  # type: ignore[arg-type]
        assert main(f"{CALIBRATE} {options}".split()) == 0
        return capsys.readouterr().out, json.loads((tmp_path / "run" / "result.json").read_text())

    return run


def test_list_contains_every_record_without_distances(data_folder) -> None:
    assert sorted(select_records_without_distances(data_folder)) == sorted(
        [*CALIBRATED, FACTORY_DEFAULT]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "stop_offset", [0.0, 40.0, pytest.param(-40.0, marks=pytest.mark.evidence)]
)
@pytest.mark.parametrize("name", CALIBRATED)
def test_calibration_from_wrong_end_stops_gives_the_geometry_of_the_firmware(
    calibrate, data_folder, name, stop_offset
) -> None:
    out, result = calibrate(name, "--noise estimated", stop_offset=stop_offset)
    expected = list_stored_geometry(read_records(data_folder)[name])
    found = {row["name"]: row["estimate"] for row in result["fit"]["parameters"]}
    assert sorted(found) == sorted(expected.keys() - {"tower3.angle"})
    for parameter, value in found.items():
        assert abs(value - expected[parameter]) < 2e-3, f"{parameter} [mm, deg]"
    assert (result["start"]["verdict"] == "best") == (stop_offset == 0.0)
    if stop_offset == 0.0:  # the firmware's geometry cannot be improved on its own heights
        assert result["start"]["before"] / result["start"]["after"] == pytest.approx(1.0, abs=1e-3)
    assert out.startswith("Undecided: printer, 6 parameters from 7 poses.")


def test_calibrate_runs_as_a_shell_command(tmp_path, data_folder) -> None:
    write_files(select_records_without_distances(data_folder)[CALIBRATED[0]], tmp_path)
    command = [str(Path(sys.executable).parent / "loopcal"), *CALIBRATE.split()]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    # residuals of 10 times the stated noise at one degree of freedom: exit code 2
    assert done.returncode == 2
    assert "quality gate not met" in done.stderr
    assert done.stdout.startswith("Not calibrated: printer, 6 parameters")
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "arrays.npz",
        "result.json",
        "robot-not-calibrated.yaml",
    ]


def test_factory_default_is_reported_as_not_calibrated(loopcal, calibrate) -> None:
    _, result = calibrate(FACTORY_DEFAULT)
    assert result["start"]["verdict"] == "not calibrated"
    assert result["start"]["before"] / result["start"]["after"] > 5.0
    # a robot file can be judged without a fit, and the corrected one passes where the factory
    # default does not
    loopcal(
        "validate robot.yaml heights.csv --limit-position 0.1mm",
        "(rejection from 139 um). The largest measured error is 262 um, at",
        code=2,
    )
    loopcal("validate run/robot.yaml heights.csv --limit-position 0.1mm")


def test_unknown_sigma_gives_no_verdict_on_the_nominal_geometry(calibrate) -> None:
    _, result = calibrate(FACTORY_DEFAULT, "--noise estimated")
    assert result["start"]["verdict"] == "open"


def test_one_degree_of_freedom_gives_wide_intervals_without_a_stated_sigma(calibrate) -> None:
    out, result = calibrate(CALIBRATED[2], "--noise estimated")
    assert result["fit"]["dof"] == pytest.approx(1.0)
    assert "noise.few-degrees" in {finding["code"] for finding in result["findings"]}
    for row in result["fit"]["parameters"]:  # Student's t
        assert row["plus_minus"] == pytest.approx(12.706 * row["sd"], rel=1e-4)
    exact = "--force --sigma-uncertainty 0"
    out, result = calibrate(CALIBRATED[2], exact, sigma="0.02 mm")
    assert "not given" not in out
    assert all(0.01 < row["plus_minus"] < 1.0 for row in result["fit"]["parameters"])  # [mm, deg]
    wider = calibrate(CALIBRATED[2], exact, sigma="0.04 mm")[1]["fit"]["parameters"]
    for narrow, wide in zip(result["fit"]["parameters"], wider, strict=True):
        assert wide["plus_minus"] == pytest.approx(2 * narrow["plus_minus"], rel=1e-6)


def test_geometry_fitted_to_distances_too_is_not_optimal_for_heights_alone(calibrate) -> None:
    """RazorCopter's firmware also used 12 distances; its heights alone give another geometry."""
    _, result = calibrate(WITH_DISTANCES, "--noise estimated")
    assert result["fit"]["rank"] == 6
    assert result["start"]["verdict"] == "open"
    times = result["start"]["before"] / result["start"]["after"]
    assert times == pytest.approx(1.64, abs=5e-3)


@pytest.fixture
def import_record(tmp_path, monkeypatch, capsys, data_folder):
    """Write a record as printer.cfg, import it, and return what was printed."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, options: str = "") -> str:
        (tmp_path / "printer.cfg").write_text(
            format_printer_cfg(read_records(data_folder)[name]), "utf-8"
        )
        assert main(f"{IMPORT}{options}".split()) == 0
        return " ".join(capsys.readouterr().out.split())

    return run


def test_import_reports_a_stored_geometry_that_is_not_optimal(import_record) -> None:
    """Two stored arms of this record differ from the optimum for its heights and distances."""
    out = import_record(WITH_DISTANCES)
    assert "the optimum of the firmware's" in out
    assert "0.6477 mm^2" in out
    assert "0.6160 mm^2" in out
    assert "arm1.length 217.6266 -> 217.4260" in out
    assert "arm3.length 215.7964 -> 215.6702" in out


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [1 / 25.4, 0.1])
def test_import_of_distances_in_another_unit_shows_no_warnings_of_numpy(
    loopcal, data_folder, factor
) -> None:
    """The fit to such distances passes radii that are longer than the arms."""
    text = format_printer_cfg(read_records(data_folder)[WITH_DISTANCES])
    lines = [
        f"{line.split(' = ')[0]} = {factor * float(line.split(' = ')[1])}"
        if re.match(r"#\*# distance\d+ = ", line)
        else line
        for line in text.splitlines()
    ]
    Path("printer.cfg").write_text("\n".join(lines) + "\n")
    loopcal(IMPORT)


def test_page_shows_the_numbers_of_the_real_printer(loopcal, import_record, root) -> None:
    page = (root / "docs" / "delta-printers.md").read_text("utf-8")
    quoted = page.split("compares the numbers of these lines -->\n```none\n")[1].split("```")[0]
    printed = import_record(WITH_DISTANCES, " --sigma-height 0.05mm --sigma-distance 0.3mm")
    numbers = re.findall(r"\d+\.\d{4}", quoted)
    assert len(numbers) == 6
    assert re.findall(r"\d+\.\d{4}", printed) == numbers
    words = "calibrate printer.yaml probes.csv -o run --method ls --sigma-uncertainty 0 --verbose"
    out = loopcal(words).out
    # heights and distances mixed in millimeters increase, though chi-square decreases from 18.9
    assert "larger after calibration" not in out
    assert "Error divided by sigma (rms): within the noise before and after calibration" in out
    rows = read_table_rows(out)
    table = read_table_rows(page.split("for each kind and for all:")[1].split("\n## ")[0])
    assert len(table) == 3
    assert all(row in rows for row in table)
    result = json.loads(Path("run/result.json").read_text())
    assert result["fit"]["chi_square"] == pytest.approx(12.909, abs=5e-4)
    assert result["fit"]["degrees"] == pytest.approx(10.0, abs=1e-6)
    assert result["start"]["verdict"] == "within noise"
    half = {row["name"]: row["plus_minus"] for row in result["fit"]["parameters"]}  # [mm, deg]
    assert all(2.05 < half[f"arm{k}.length"] < 2.45 for k in (1, 2, 3))
    assert half["radius"] == pytest.approx(0.53, abs=0.005)


def test_import_reports_a_factory_default_but_not_a_calibrated_printer(import_record) -> None:
    out = import_record(FACTORY_DEFAULT)
    assert "0.1179 mm^2" in out
    assert "0.0019 mm^2" in out
    assert "radius 161.7500 ->" in out
    for name in CALIBRATED:
        assert "tored geometry is the optimum of the firmware's" in import_record(name), name


@pytest.mark.parametrize(
    ("name", "height", "times"),
    [
        (CALIBRATED[0], None, 10.0),
        (CALIBRATED[1], None, 4.39),
        (CALIBRATED[2], 1, 3.51),
        (CALIBRATED[2], 2, 5.72),
        (CALIBRATED[2], 6, 7.0),
    ],
)
def test_seven_contradictory_heights_fail_without_naming_an_outlier(
    loopcal, import_record, name, height, times
) -> None:
    """Two printers as probed, and one with an error of 0.3 mm (15 sigma) in one height."""
    import_record(name, " --sigma-height 0.02mm")
    lines = Path("probes.csv").read_text().split("\n")
    for i, line in enumerate(lines):
        if line.startswith(f"height{height},"):
            *cells, z = line.split(",")
            lines[i] = ",".join([*cells, str(float(z) + 0.3)])
    Path("probes.csv").write_text("\n".join(lines))
    assert loopcal(
        "calibrate printer.yaml probes.csv -o run --sigma-uncertainty 0", code=2
    ).out.startswith("Not calibrated: ")
    checked = json.loads(Path("run/result.json").read_text())["examination"]["outliers"]
    assert checked["outliers"] == []
    (conflict,) = checked["undecided"]
    assert len(conflict["poses"]) == 7
    assert conflict["times"] == pytest.approx(times, rel=5e-3)


@pytest.mark.parametrize(
    ("name", "times"), [(CALIBRATED[0], 10.0), (CALIBRATED[1], 4.39), (CALIBRATED[2], 0.838)]
)
def test_assumed_sigma_of_few_heights_is_a_note_that_asks_for_it(
    loopcal, import_record, name, times
) -> None:
    """With one degree of freedom the noise cannot be estimated, and no gate depends on it."""
    import_record(name)
    assert "# noise_source: assumed" in Path("probes.csv").read_text()
    assert loopcal("calibrate printer.yaml probes.csv -o run").out.startswith("Undecided: ")
    result = json.loads(Path("run/result.json").read_text())
    (noise,) = [f for f in result["findings"] if f["code"].startswith("noise.")]
    assert (noise["code"], noise["severity"]) == ("noise.assumed", "warning")
    assert noise["data"]["ratio"] == pytest.approx(times, rel=5e-3)
    (sigma,) = noise["data"]["sigmas"]
    assert sigma["assumed"] == {"value": pytest.approx(0.02), "unit": "mm"}
    assert sigma["estimated"]["value"] == pytest.approx(0.02 * times, rel=5e-3)


def test_assumed_sigma_is_estimated_where_the_data_can(loopcal, import_record) -> None:
    """Ten degrees of freedom: heights and distances are 3.2 times as bad as assumed."""
    import_record(WITH_DISTANCES)
    words = "calibrate printer.yaml probes.csv -o run --method ls"
    loopcal(words)
    result = json.loads(Path("run/result.json").read_text())
    assert result["fit"]["noise"] == "estimated"
    assert result["fit"]["sigma_scale"] == pytest.approx(3.18, rel=5e-3)
    (noise,) = [f for f in result["findings"] if f["code"] == "noise.assumed-replaced"]
    assert noise["severity"] == "info"
    assert [s["kind"] for s in noise["data"]["sigmas"]] == ["component", "separation"]
    # an exact sigma is tested: the gate is not met
    import_record(WITH_DISTANCES, " --sigma-height 0.02mm --sigma-distance 0.1mm")
    loopcal([*words.split(), "--sigma-uncertainty", "0", "--force"], code=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(name, marks=pytest.mark.evidence) for name in CALIBRATED[:2]),
        CALIBRATED[2],
        pytest.param(FACTORY_DEFAULT, marks=pytest.mark.evidence),
        WITH_DISTANCES,
    ],
)
def test_nine_parameters_from_heights_alone_are_refused_with_a_suggestion(
    loopcal, import_record, tmp_path, data_folder, name
) -> None:
    import_record(name)
    text = (tmp_path / "printer.yaml").read_text()
    (tmp_path / "nine.yaml").write_text(
        "".join(s for s in text.splitlines(keepends=True) if not s.startswith("fixed"))
    )
    write_files(read_records(data_folder)[name], tmp_path)
    document = loopcal("identifiability nine.yaml heights.csv --json").json
    assert (document["rank"], document["n_parameters"], document["n_equations"]) == (7, 9, 7)
    suggestion = "distances between two poses (ball bar; calipers on a printed part)"
    assert len(document["unidentifiable"]) == 2
    assert [cure["cures"][0]["words"] for cure in document["remedies"]] == [suggestion, suggestion]
    # calibrate refuses by default, and says the same
    loopcal(
        "calibrate nine.yaml heights.csv -o run",
        "7 equations cannot determine 9 parameters",
        suggestion,
        "Hint: use --method map",
        code=1,
    )
    # where stated spreads fill the gap, the note is printed and kept in the run
    (tmp_path / "nine.yaml").write_text((tmp_path / "nine.yaml").read_text() + TOLERANCES)
    assert (
        "Suggested measurement"
        not in loopcal("calibrate nine.yaml heights.csv -o run --method map", code=(0, 2)).out
    )  # only with --verbose
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["fit"]["rank"] == 7
    assert [cure["cures"][0]["words"] for cure in result["remedies"]] == [suggestion, suggestion]


def test_run_of_a_chosen_set_of_parameters_is_read_back_and_exported(
    loopcal, tmp_path, root
) -> None:
    heights, run = root / "examples" / "delta-printer" / "heights.csv", tmp_path / "run"
    loopcal(f"calibrate linear-delta {heights} -o {run} --choose-model")
    stated = json.loads((run / "result.json").read_text("utf-8"))["fit"]["parameters"]
    assert len(stated) < sum(lc.load_run(run).robot.parameters.free)
    posterior = lc.load_run(run).load_posterior()
    table = posterior.robot.parameters
    assert [table.names[i] for i in posterior.places] == [row["name"] for row in stated]
    loopcal(f"sample {run} --region")
    loopcal(f"export {run} -o {tmp_path / 'printer.cfg'}")
