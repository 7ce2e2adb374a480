# SPDX-License-Identifier: Apache-2.0
"""Numbers of a calibration that failed are written for no machine, unless that is demanded."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.formats.import_export import list_formats
from loopcal.io.runs.run_folder import FAILED_ROBOT, ROBOT, find_run_failure

STEP = 0.0125
"""Length of a motor step [mm]."""

ARM, RADIUS, STOP = 269.0, 130.25, 250.0
TRUE_STOPS = (250.4, 249.7, 250.1)
"""[mm]."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Write runs: of noise beyond a stated sigma, of a limit that is missed, and of neither."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "targets.csv").write_text("x [mm],y [mm],z [mm]\n10,20,30\n")
    words = f"simulate linear-delta --kind position --draw-errors -o {folder}/data.csv --seed 3"
    assert main(words.split()) == 0
    words = f"calibrate linear-delta {folder}/data.csv --hold-out"
    # few fitted poses, so that the errors exceed the noise: below it, a limit stays open
    assert main(f"{words} 0.9 --limit-position 0.1um -o {folder}/missed".split()) == 2
    assert main(f"{words} 0.25 --limit-position 1mm -o {folder}/good".split()) == 0
    text = (folder / "data.csv").read_text().replace("10 um", "0.1 um")
    (folder / "optimistic.csv").write_text(text)
    words = f"calibrate linear-delta {folder}/optimistic.csv --hold-out 0.25"
    assert main(f"{words} -o {folder}/failed".split()) == 2
    return folder


@pytest.fixture
def folder(runs, tmp_path, monkeypatch, capsys) -> Path:
    """Return a copy of the runs to work in."""
    shutil.copytree(runs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    return tmp_path


def test_robot_of_a_failed_calibration_has_another_name(loopcal, folder) -> None:
    assert sorted(p.name for p in Path("failed").iterdir()) == sorted(
        ["arrays.npz", "result.json", FAILED_ROBOT]
    )
    assert Path("failed", FAILED_ROBOT).read_text().startswith("# NOT CALIBRATED")
    assert Path("good", ROBOT).is_file()
    failed, good = lc.load_run("failed"), lc.load_run("good")
    np.testing.assert_allclose(failed.robot.values, good.robot.values, atol=1e-3)  # [m]
    assert good.failure is None
    assert failed.failure is not None
    assert failed.failure.code == "gates.run-not-calibrated"
    loopcal("validate failed data.csv --allow-fitted-data")
    words = "calibrate linear-delta optimistic.csv --hold-out 0.25 -o failed"
    loopcal(f"{words} --force", "arrays.npz, robot.yaml", code=2)
    assert Path("failed", ROBOT).is_file()
    assert not Path("failed", FAILED_ROBOT).exists()
    loopcal("export failed -o c.json", code=2)  # the verdict stays


def test_values_of_a_calibration_that_misses_a_limit_alone_are_written(loopcal, folder) -> None:
    """A missed limit says nothing against values that are better than the current ones."""
    missed = lc.load_run("missed")
    assert missed.failure is None
    assert missed.result["passed"] is False
    assert missed.result["recommendation"]["code"] == "values.apply"
    assert Path("missed", ROBOT).is_file()
    loopcal("export missed -o c.json")
    loopcal("compensate missed targets.csv -o new.csv")


@pytest.mark.parametrize("name", list_formats("write"))
def test_no_format_is_written_from_a_failed_calibration(loopcal, folder, name) -> None:
    for source in ("failed", f"failed/{FAILED_ROBOT}", "./failed/"):
        loopcal(
            f"export {source} --format {name} -o out.txt",
            "quality gate not met: failed is not calibrated: The residuals exceed",
            "use --force to write them",
            code=2,
        )
        assert not Path("out.txt").exists()
    if name in ("linuxcnc", "linuxcnc-ini", "urdf", "sdf", "mjcf", "hangprinter", "maslow"):
        return  # of other machines
    loopcal(f"export failed --format {name} -o out.txt --force", "failed is not calibrated", code=2)
    loopcal(f"export good --format {name} -o good.txt")
    written, good = (Path(n).read_text().splitlines() for n in ("out.txt", "good.txt"))
    assert len(written) == len(good)


def test_refused_export_is_one_json_document(loopcal, folder) -> None:
    document = loopcal("export failed -o out.json --json", code=2).json
    assert document["output"] is None
    assert [r["code"] for r in document["reasons"]] == ["gates.run-not-calibrated"]


def test_failed_calibration_computes_no_commands(loopcal, folder) -> None:
    for words in ("", "-o new.csv", "--mode commands -o new.csv"):
        _, out, err = loopcal(f"compensate failed targets.csv {words}", code=2)
        assert out == ""
        assert "failed is not calibrated" in err
        assert not Path("new.csv").exists()
    loopcal("compensate failed targets.csv -o new.csv --force", code=2)
    loopcal("compensate good targets.csv -o good.csv")
    assert len(Path("new.csv").read_text()) > 0.5 * len(Path("good.csv").read_text())


def test_robot_file_states_elsewhere_that_its_calibration_failed(loopcal, folder) -> None:
    shutil.copy(Path("failed", FAILED_ROBOT), "taken.yaml")
    for words in ("compensate taken.yaml targets.csv", "export taken.yaml -o taken.json"):
        _, out, err = loopcal(words, code=2)
        assert "taken.yaml is not calibrated. Do not load its values into a machine" in err
        assert "pose" not in out
        loopcal(f"{words} --force", code=2)


def test_forced_name_does_not_hide_that_the_calibration_failed(loopcal, folder) -> None:
    words = "calibrate linear-delta optimistic.csv --hold-out 0.25 -o failed"
    loopcal(f"{words} --force", code=2)
    assert Path("failed", ROBOT).read_text().startswith("# NOT CALIBRATED")
    shutil.copy(Path("failed", ROBOT), "taken.yaml")
    loopcal("compensate taken.yaml targets.csv", code=2)


def test_good_calibration_of_a_failed_robot_file_is_good(loopcal, folder) -> None:
    shutil.copy(Path("failed", FAILED_ROBOT), "start.yaml")
    words = "calibrate start.yaml data.csv --hold-out 0.25 --limit-position 1mm -o again"
    loopcal(words)
    assert "NOT CALIBRATED" not in Path("again", ROBOT).read_text()
    loopcal("compensate again/robot.yaml targets.csv")
    loopcal(f"{words.replace('data', 'optimistic')} --force", code=2)
    assert Path("again", ROBOT).read_text().count("NOT CALIBRATED") == 1
    robot = lc.load_robot("start.yaml")
    lc.save_robot(robot, "same.yaml")
    assert Path("same.yaml").read_text().startswith("# NOT CALIBRATED")
    lc.save_robot(robot.with_values(robot.values + 1e-6), "other.yaml")
    assert "NOT CALIBRATED" not in Path("other.yaml").read_text()


CONVERGED = {"status": "converged"}


@pytest.mark.parametrize(
    ("result", "code"),
    [
        ({}, None),
        ({"verdict": "calibrated", "fit": CONVERGED}, None),
        ({"verdict": "undecided", "fit": CONVERGED}, None),
        ({"verdict": "not_calibrated", "fit": CONVERGED}, "gates.run-not-calibrated"),
        ({"verdict": "calibrated", "fit": {"status": "stopped"}}, "gates.run-not-calibrated"),
    ],
)
def test_a_run_fails_by_its_verdict_or_a_fit_that_stopped(result, code) -> None:
    failure = find_run_failure(Path("run"), result and result | {"reasons": []})
    assert (None if failure is None else failure.code) == code


def write_printer(wrong: float = 0.0) -> None:
    """Write a printer.cfg whose end stops are off, with 13 probed heights, one of them wrong."""
    lines = [
        "[printer]", "kinematics: delta", f"delta_radius: {RADIUS}", "[stepper_a]",
        f"step_distance: {STEP}", f"position_endstop: {STOP}", f"arm_length: {ARM}",
        "[stepper_b]", f"step_distance: {STEP}", "[stepper_c]", f"step_distance: {STEP}",
    ]  # fmt: skip
    Path("printer.cfg").write_text("\n".join(lines) + "\n")
    assert main(["import", "printer.cfg", "-o", "nominal.yaml", "--force"]) == 0
    nominal = lc.load_robot("nominal.yaml")
    values = nominal.values.copy()
    for k, stop in enumerate(TRUE_STOPS, 1):
        values[nominal.parameters.index(f"tower{k}.stop")] = stop * 1e-3
    rng = np.random.default_rng(5)
    turns = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    points = [(0, 0), *((r * np.cos(a), r * np.sin(a)) for r in (0.04, 0.08) for a in turns)]
    heights = rng.normal(0, 1e-5, len(points))
    at = np.column_stack([points, heights])
    steps = np.round(lc.inverse(nominal.with_values(values), at).q * 1e3 / STEP, 3)
    probed = heights * 1e3 + rng.normal(0, 0.01, len(points))  # [mm]
    probed[4] += wrong
    lines += ["#*# <---------------------- SAVE_CONFIG ---------------------->"]
    lines += ["#*# [delta_calibrate]"]
    for i, (height, stable) in enumerate(zip(probed, steps, strict=True)):
        lines += [f"#*# height{i} = {height:.6f}"]
        lines += [f"#*# height{i}_pos = {','.join(f'{s:.3f}' for s in stable)}"]
    Path("printer.cfg").write_text("\n".join(lines) + "\n")


IMPORT = (
    "import printer.cfg -o p.yaml --data heights.csv --corrected corrected.cfg "
    "--sigma-height 0.01mm"
)


def test_import_corrects_a_file_where_the_calibration_passes(loopcal) -> None:
    write_printer()
    loopcal(IMPORT)
    loopcal("import corrected.cfg -o again.yaml")
    again = lc.load_robot("again.yaml")
    for k, stop in enumerate(TRUE_STOPS, 1):
        # [m]: ten times the noise of the probe
        assert abs(again.values[again.parameters.index(f"tower{k}.stop")] - stop * 1e-3) < 1e-4


def test_import_does_not_correct_a_file_where_the_calibration_failed(loopcal, capsys) -> None:
    write_printer(wrong=3.0)
    capsys.readouterr()
    _, out, err = loopcal(IMPORT, code=2)
    assert "loopcal did not write corrected.cfg" in err
    assert "residuals exceed the given noise" in err
    assert "use --force" in err
    assert "Written" not in out
    assert not Path("corrected.cfg").exists()
    assert Path("p.yaml").is_file()
    assert Path("heights.csv").is_file()
    document = loopcal(f"{IMPORT} --force --json", code=2).json
    assert document["corrected"] == "corrected.cfg"
    assert document["verdict"] == "not_calibrated"
    assert [r["code"] for r in document["reasons"]] == ["noise.residuals-too-large"]
    assert Path("corrected.cfg").is_file()
