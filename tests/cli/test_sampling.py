# SPDX-License-Identifier: Apache-2.0
"""`loopcal bootstrap` and `loopcal sample` from a run folder and from files."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.runs.result_files import format_draws
from loopcal.io.runs.run_folder import read_run_folder, write_run_folder
from loopcal.units import find_unit

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42" / "measurements.csv"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with measurements and a run that fits 30 of their 40 poses."""
    folder = tmp_path_factory.mktemp("sampling")
    data = folder / "measurements.csv"
    shutil.copy(EXAMPLE, data)
    words = ["calibrate", "hexapod-42", str(data), "-o", str(folder / "run")]
    words += ["--hold-out", "0.25", "--drop", "1", "--method", "map"]
    assert main(words) == 0
    return folder


def read_draws(path: Path) -> tuple[list[str], np.ndarray]:
    """Return the header and the numbers of a file of draws."""
    with path.open(newline="") as stream:
        rows = list(csv.reader(stream))
    return rows[0], np.array(rows[1:], dtype=float)


def test_bootstrap_repeats_the_fit_of_a_run_and_writes_its_draws(loopcal, folder) -> None:
    run, draws = str(folder / "run"), folder / "bootstrap.csv"
    document = loopcal(f"bootstrap {run} --count 60 --seed 3 -o {draws} --json").json
    assert (document["scheme"], document["seed"], document["resamples"]) == ("wild", 3, 60)
    poses = 40 - 10 - 1
    assert document["blocks"] in (poses, poses + 1)  # the excluded pose may be held out
    parameters = document["intervals"]["parameters"]
    arrays = lc.load_run(run).arrays
    sd = np.array([entry["sd"] for entry in parameters])
    assert np.median(sd / arrays["sd"]) == pytest.approx(1.0, abs=0.3)
    header, numbers = read_draws(draws)
    assert header[0] == "leg1.base.x [mm]"
    assert numbers.shape == (60, 42)
    assert 1e-3 * numbers.std(axis=0, ddof=1) == pytest.approx(sd)
    loopcal(f"bootstrap {run} --count 10 -o {draws}", "--force", code=1)
    loopcal(
        f"bootstrap {run} --count 10 -o {draws} --force", "10 resamples of", f"Written to {draws}"
    )


def test_a_run_of_python_is_repeated_with_the_constant_of_its_loss(loopcal, folder) -> None:
    robot, data = lc.load_robot("five-bar"), folder / "five-bar.csv"
    words = ["simulate", "five-bar", "--kind", "position", "--draw", "25", "--draw-errors"]
    loopcal([*words, "-o", str(data)])
    for name, loss in (("narrow", lc.Huber(0.5)), ("wide", lc.Huber(2.0))):
        options = lc.CalibrationOptions(fit=lc.FitOptions(lc.LeastSquares(), loss))
        report = lc.calibrate(robot, lc.load_measurements(data, robot), options)
        run = lc.save_run(report, folder / name, {"data": data})
        document = loopcal(f"bootstrap {run} --count 10 --json").json
        assert document["resamples"] == 10
    # with the loss of the other run, the estimate is another one
    result = json.loads((folder / "wide" / "result.json").read_text())
    assert result["options"]["fit"]["loss"] == {"name": "huber", "k": 2.0}
    result["options"]["fit"]["loss"] = {"name": "huber", "k": 0.5}
    (folder / "wide" / "result.json").write_text(json.dumps(result))
    loopcal(["bootstrap", str(folder / "wide"), "--count", "10"], "gives another estimate", code=1)


def test_sample_prints_the_size_of_the_sample_and_weights_its_draws(loopcal, folder) -> None:
    run, draws = str(folder / "run"), folder / "posterior.csv"
    loopcal(
        f"sample {run} --count 600 -o {draws}",
        "600 weighted draws worth 5",
        "All linear intervals agree with the exact posterior within 10 %",
    )
    header, numbers = read_draws(draws)
    assert header[0] == "weight"
    assert numbers[:, 0].sum() == pytest.approx(1.0)
    arrays = lc.load_run(run).arrays
    mean = 1e-3 * (numbers[:, 0] @ numbers[:, 1:])
    assert (np.abs(mean - arrays["estimate"]) < 0.25 * arrays["sd"]).all()


def test_each_column_of_draws_has_the_unit_of_its_own_parameter() -> None:
    draws = np.array([[0.2, np.pi], [0.3, np.pi / 2.0]])
    text = format_draws(("length", "offset"), ("mm", "deg"), np.array([1e-3, np.pi / 180.0]), draws)
    assert text == "length [mm],offset [deg]\n200,180\n300,90\n"


def test_files_give_the_same_fit_as_a_run(loopcal, folder) -> None:
    data = str(folder / "measurements.csv")
    options = "--method ls --noise estimated --count 100"
    document = loopcal(f"sample hexapod-42 {data} {options} --json").json
    robot = lc.load_robot("hexapod-42")
    options = lc.FitOptions(method=lc.LeastSquares(), noise="estimated")
    fit = lc.identify(robot, lc.load_measurements(data, robot), options=options)
    half = fit.interval()
    for i, entry in enumerate(document["intervals"]["parameters"]):
        assert entry["linear_upper"] - entry["linear_lower"] == pytest.approx(2 * half[i], rel=0.01)


def test_region_shows_intervals_for_all_at_once_and_the_joint_region(loopcal, folder) -> None:
    run = str(folder / "run")
    words = ["sample", run, "--region", "-p", "leg1.base.x", "-p", "leg1.base.y", "--level", "0.9"]
    document = loopcal([*words, "--json"]).json
    run_arrays = lc.load_run(run).arrays
    region = document["region"]
    assert region["names"] == ["leg1.base.x", "leg1.base.y"]
    assert np.array(region["covariance"]) == pytest.approx(run_arrays["covariance"][:2, :2])
    assert np.array(document["intervals"]["factor"]).min() > 1.645
    loopcal(words, "+/- all at once", "Joint 90 % region", "degrees of freedom)")
    loopcal(f"sample {run} --region -p leg1.base.x", "95 % intervals that hold for 1 parameter\n")
    loopcal(f"sample {run} --region --rule scheffe", "all 42 parameters at once")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["bootstrap", "RUN", "--method", "ls"], "has no effect with a run folder"),
        (["bootstrap", "RUN", "--unit", "day"], "at least 5 units 'day'"),
        (["bootstrap", "RUN", "--unit", "month"], "must be one of pose, block, session, day"),
        (["sample", "RUN", "--count", "5"], "100"),
        (["sample", "hexapod-42", "DATA", "--method", "ridge"], "penalty without a probability"),
        (
            ["sample", "RUN", "--region", "-p", "leg9.base.x"],
            "no free parameter has the name 'leg9.base.x'",
        ),
        (["sample", "RUN", "--region", "--level", "1.5"], "1.5"),
        (["sample", "RUN", "--region", "--seed", "1"], "--seed has no effect with --region"),
        (["sample", "RUN", "-p", "leg1.base.x"], "has no effect without --region"),
        (["bootstrap", "hexapod-42"], "run folder"),
        (["sample", "DATA"], "Give a run folder, or a robot file and then files"),
    ],
)
def test_wrong_use_is_refused_in_one_sentence(loopcal, folder, words, text) -> None:
    names = {"RUN": str(folder / "run"), "DATA": str(folder / "measurements.csv")}
    loopcal([names.get(word, word) for word in words], text, code=1)


def test_a_run_with_another_estimate_than_its_data_have_is_not_examined(
    loopcal, folder, tmp_path
) -> None:
    result, arrays = read_run_folder(folder / "run")
    arrays["estimate"] = arrays["estimate"] + arrays["sd"]
    for row, value in zip(result["fit"]["parameters"], arrays["estimate"].tolist(), strict=True):
        row["estimate"] = value / find_unit(row["unit"]).factor_to_si
    robot_text = (folder / "run" / "robot.yaml").read_text()
    write_run_folder(tmp_path / "run", result, arrays, robot_text)
    loopcal(["bootstrap", str(tmp_path / "run"), "--count", "10"], "gives another estimate", code=1)
