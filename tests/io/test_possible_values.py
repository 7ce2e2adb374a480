# SPDX-License-Identifier: Apache-2.0
"""Numbers that no machine has are refused where files are read, by one rule for every family."""

from pathlib import Path

import numpy as np
import pytest

from loopcal import load_measurements, save_robot
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError, LoopcalError
from loopcal.findings import Severity
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian
from loopcal.mechanism.compilation import find_impossible_values
from loopcal.mechanism.solutions import forward
from loopcal.units import SI_SYMBOLS
from tests.zoo import FEW_ROBOTS

WITHOUT_RODS = ("3-rps", "agile-eye", "belt-4", "cable-camera", "pentapod", "pulley-3")


def write_table(tmp_path: Path, robot: str, rows: str) -> Path:
    """Write a shipped robot with rows of an identified table."""
    path = tmp_path / "robot.yaml"
    path.write_text(list_shipped_robots()[robot].read_text("utf-8") + f"\nidentified:\n{rows}\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
def test_impossible_identified_values_are_refused_at_their_line(name: str, tmp_path: Path) -> None:
    robot = load_robot(name)
    positive = [p for p in robot.parameters.entries if p.positive]
    # each rod has a length that cannot be zero, and each family has one
    assert positive or robot.stages or name in WITHOUT_RODS
    wrong = [(p, value) for p in positive[:1] for value in ("0", f"{-p.nominal!r}")]
    wrong += [(robot.parameters.entries[0], value) for value in ("1e300", "-1e160")]
    for parameter, value in wrong:
        unit = SI_SYMBOLS[parameter.dimension]
        row = f"  - {{name: {parameter.name}, value: {value}, unit: '{unit}'}}"
        path = write_table(tmp_path, name, row)
        with pytest.raises(FileError, match=parameter.name) as caught:
            load_robot(path)
        assert caught.value.line == len(path.read_text().splitlines())


NAMED = """
parameters:
  - {name: rod, length: 300, tolerance: {sd: 0.1}, maps: [
      {limb: west, element: rod, axis: length}, {limb: east, element: rod, axis: length}]}
  - {name: base, length: 75, positive: true, maps: [{limb: west, element: motor, axis: x}]}
  - {name: shift, length: 0.02, maps: [{limb: east, element: motor, axis: y}]}
"""


@pytest.mark.parametrize("value", ["0", "-300", "-1.0e-9", "1.0e300", "-1.0e160"])
@pytest.mark.parametrize("name", ["rod", "base"])
def test_a_named_length_has_no_value_that_no_machine_has(tmp_path: Path, name, value) -> None:
    row = f"  - {{name: {name}, value: {value}, unit: mm}}"
    path = write_table(tmp_path, "five-bar", row)
    path.write_text(path.read_text().replace("\nidentified:", f"{NAMED}identified:"))
    with pytest.raises(
        FileError, match=rf"{name} is .*must be greater|'{name}': .* exceeds"
    ) as caught:
        load_robot(path)
    assert caught.value.line == len(path.read_text().splitlines())


def test_a_named_length_that_is_not_declared_positive_may_change_its_sign(tmp_path: Path) -> None:
    path = write_table(tmp_path, "five-bar", "  - {name: shift, value: -0.05, unit: mm}")
    path.write_text(path.read_text().replace("\nidentified:", f"{NAMED}identified:"))
    assert load_robot(path).values[-1] == pytest.approx(-5e-5)


@pytest.mark.parametrize("nominal", ["0", "-75"])
def test_a_length_that_is_declared_positive_needs_such_a_value(tmp_path: Path, nominal) -> None:
    path = write_table(tmp_path, "five-bar", "  []")
    text = NAMED.replace("length: 75", f"length: {nominal}")
    path.write_text(path.read_text().replace("\nidentified:", f"{text}identified:"))
    with pytest.raises(LoopcalError, match="parameter 'base' must be positive"):
        load_robot(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
def test_values_of_tolerated_machines_are_accepted(name: str, tmp_path: Path) -> None:
    robot = load_robot(name)
    sd = np.nan_to_num(robot.parameters.tolerance, nan=1e-4)
    values = robot.values + 5.0 * sd * np.random.default_rng(3).standard_normal(len(sd))
    save_robot(robot.with_values(values), tmp_path / "robot.yaml")
    assert find_impossible_values(robot, values) == ()
    assert np.isfinite(load_robot(tmp_path / "robot.yaml").values).all()


def test_values_whose_loops_do_not_close_are_refused_together(tmp_path: Path) -> None:
    rows = "  - {name: arm1.length, value: 900, unit: mm}\n  - {name: radius, value: 5, unit: m}"
    with pytest.raises(FileError, match=r"do not close at the readings of home.* radius = 5"):
        load_robot(write_table(tmp_path, "linear-delta", rows))


def test_a_gap_that_could_not_be_computed_is_not_named(tmp_path: Path) -> None:
    """With this radius the first step of the forward solution is not finite."""
    with pytest.raises(FileError, match=r"readings of home. The value farthest") as caught:
        load_robot(
            write_table(tmp_path, "linear-delta", "  - {name: radius, value: 500, unit: mm}")
        )
    assert "unknown" not in str(caught.value)


def test_file_of_a_failed_calibration_keeps_its_values(tmp_path: Path) -> None:
    path = write_table(tmp_path, "linear-delta", "  - {name: radius, value: -1, unit: mm}")
    path.write_text("# NOT CALIBRATED: see result.json\n" + path.read_text())
    assert load_robot(path).values[0] == -1e-3


NONSENSE = {
    "hexapod-42": [
        ("lengths: ", "lengths: -233.2 #"),
        ("home: ", "home: {z: 1e160} #"),
        ("stroke: ", "stroke: [75, -75] #"),
        ("stroke: ", "stroke: [-1e300, 75] #"),
        ("name: ", "tool: {x: 1e160}\nname: "),
        ("name: ", "tool: {roll: 1e160}\nname: "),
        ("name: ", f"tool: {{x: {'9' * 400}}}\nname: "),
        ("name: ", "tool: {x: .inf}\nname: "),
        ("tolerances:", "tolerances: {length: {sd: 1e-300}} #"),
        ("tolerances:", "tolerances: {length: {sd: 1e300}} #"),
        ("tolerances:", "tolerances: {length: {limits: -1}} #"),
    ],
    "linear-delta": [("radius: ", "radius: 1e-320 #"), ("radius: ", "radius: -130 #")],
}


@pytest.mark.parametrize(
    ("name", "old", "new"), [(name, *pair) for name, pairs in NONSENSE.items() for pair in pairs]
)
def test_nominal_numbers_that_no_machine_has_are_refused(name, old, new, tmp_path, capsys) -> None:
    path = tmp_path / "robot.yaml"
    lines = list_shipped_robots()[name].read_text("utf-8").splitlines()
    kept, done = [], False
    for line in lines:
        is_first = line.startswith(old) and not done
        kept.append(line.replace(old, new, 1) if is_first else line)
        done = done or is_first
    if old == "tolerances:":
        start = next(i for i, line in enumerate(kept) if line.startswith("tolerances:"))
        kept[start + 1 :] = [line for line in kept[start + 1 :] if not line.startswith(" ")]
    assert done
    path.write_text("\n".join(kept))
    with pytest.raises(LoopcalError):
        load_robot(path)
    assert main(["check", str(path)]) == 1
    assert "nan" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "cell"),
    [
        ("# noise: {z: 1e-300 um}", "0.1"),
        ("# noise: {z: 1e300 um}", "0.1"),
        ("# noise: {z: 20 um}", "1e300"),
        ("# noise: {z: 20 um}", "-1e160"),
        ("# reading_noise: 1e-300 um\n# noise: {z: 20 um}", "0.1"),
        ("# reading_noise: 1e300 um\n# noise: {z: 20 um}", "0.1"),
        ("# noise: {z: 20 um}\n# session_bias: {z: 1e-300 um}", "0.1"),
    ],
)
def test_measurements_that_no_instrument_gives_are_refused(line, cell, tmp_path) -> None:
    path = tmp_path / "data.csv"
    rows = "\n".join(f"p{i},{10 + i},{20 + i},{30 - i},{cell}" for i in range(12))
    header = "pose,q1 [mm],q2 [mm],q3 [mm],z [mm]"
    path.write_text(f"# kind: component\n# components: [z]\n{line}\n{header}\n{rows}\n")
    with pytest.raises(LoopcalError, match=r"exceeds|outside|standard dev|1e-15|larger than any"):
        load_measurements(path, load_robot("linear-delta"))


@pytest.mark.parametrize("sd", [0.0, -1.0, 1e-300, 1e300, np.nan, np.inf])
def test_noise_is_a_possible_standard_deviation(sd: float) -> None:
    with pytest.raises(DataError, match="sigma of the noise"):
        Gaussian(np.array([sd]))


def test_findings_of_a_fit_are_failures() -> None:
    robot = load_robot("linear-delta")
    values = robot.values.copy()
    values[robot.parameters.index("arm2.length")] = 0.0
    ((name, finding),) = find_impossible_values(robot, values)
    assert name == "arm2.length"
    assert finding.severity is Severity.FAILURE
    assert not forward(robot.with_values(values), np.full((1, 3), 0.1)).converged.any()
