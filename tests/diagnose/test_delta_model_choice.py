# SPDX-License-Identifier: Apache-2.0
"""The set of parameters that a controller stores among those that are compared, on real printers
and on the delta of the examples.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.cross_validation import choose_model, list_parameter_sets
from loopcal.diagnose.outliers import find_outliers
from loopcal.errors import FileError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.findings import Severity
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import sample_truth
from tests.diagnose.test_delta_identifiability import (
    GEOMETRY,
    WITH_DISTANCES,
    printers,
    with_sigmas,
)
from tests.estimate.problems import bed_points, simulate_heights, with_tolerance
from tests.findings.expectations import list_codes

assert printers  # a fixture
MM = 1e-3


def test_the_firmware_set_is_compared_and_chosen_where_only_its_parameters_err():
    """A delta whose arms are exact; heights at two bed heights determine all nine poorly."""
    robot = with_tolerance(lc.load_robot("linear-delta"), 0.3 * MM)
    truth = sample_truth(robot, 1, 4)[0]
    for k in (1, 2, 3):
        place = robot.parameters.names.index(f"arm{k}.length")
        truth[place] = robot.values[place]
    data = simulate_heights(robot.with_values(truth), bed_points(40, 3, 0.1), 3)
    choice = choose_model(robot, data)
    sets = {c.name: set(c.parameters) for c in choice.candidates}
    assert sets["controller"] == set(GEOMETRY)
    assert len(sets["complete"]) == 9
    sizes = [len(c.parameters) for c in choice.candidates]
    assert sizes == sorted(sizes)
    assert choice.chosen.name == "controller"
    assert "controller" in str(choice)


def test_rank_and_condition_of_every_set_are_those_of_its_columns(printers):
    robot, data = printers[WITH_DISTANCES]
    data = with_sigmas(data, 1 * MM, 1 * MM)
    choice = choose_model(robot, data)
    for candidate in choice.candidates[1:]:
        names = candidate.parameters
        only = replace(robot, parameters=robot.parameters.with_free(names))
        expected = lc.identifiability(only, data)
        assert candidate.rank == expected.rank == len(names)
        assert candidate.condition == pytest.approx(expected.condition, rel=1e-6)
    by_name = {c.name: c.condition for c in choice.candidates}
    assert by_name["controller"] < 0.3 * by_name["complete"]
    assert by_name["complete"] == pytest.approx(46, abs=0.5)  # docs/delta-printers.md
    document = choice.to_dict()["candidates"][-1]
    assert document.rank == 9


def test_real_printer_with_wrong_stops_gets_a_comparison_of_six_and_nine(printers):
    """The stored geometry was fitted to the same probes; its stops are moved by 1, 2 and 3 mm."""
    robot, data = printers[WITH_DISTANCES]
    moved = {f"tower{k}.stop": k * MM for k in (1, 2, 3)}
    shift = np.array([moved.get(name, 0.0) for name in robot.parameters.names])
    choice = choose_model(
        robot.with_values(robot.values + shift), with_sigmas(data, 0.05 * MM, 0.3 * MM)
    )
    by_name = {c.name: c for c in choice.candidates}
    assert set(by_name) == {"nothing", "offsets", "lengths", "controller", "complete"}
    assert all(np.isfinite(c.score) for c in choice.candidates)
    assert choice.chosen.name in ("offsets", "controller")
    assert by_name["controller"].score < 0.1 * by_name["nothing"].score


def test_sets_with_too_few_equations_are_listed_and_not_compared(printers):
    for name, (robot, data) in printers.items():
        if name == WITH_DISTANCES:
            continue
        choice = choose_model(robot, data, method=LeastSquares())
        large = [c for c in choice.candidates if len(c.parameters) > 5]
        assert {c.name for c in large} == {"controller", "lengths", "complete"}
        for candidate in large:
            assert candidate.validation is None
            assert candidate.name in choice.finding.data["not_compared"]
            assert candidate.name in str(choice.finding)
        ranks = {c.name: c.rank for c in large}
        assert ranks == {"controller": 6, "lengths": 7, "complete": 7}
        assert np.isinf(choice.candidates[-1].condition)


def test_any_robot_file_can_state_what_its_controller_stores(tmp_path: Path):
    text = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    path = tmp_path / "robot.yaml"
    path.write_text(text + "\nstored_parameters: [leg*.length, leg*.base.*]\n", "utf-8")
    sets = list_parameter_sets(lc.load_robot(path))
    assert len(sets["controller"]) == 24
    path.write_text(text + "\nstored_parameters: [leg*.lenght]\n", "utf-8")
    with pytest.raises(FileError, match="under `stored_parameters` matches no parameter"):
        lc.load_robot(path)
    assert "controller" not in list_parameter_sets(lc.load_robot("hexapod-42"))


def scale_to_chi_square(robot, data: Measurements, value: float) -> Measurements:
    """Return the measurements with a sigma for which chi-square has this value."""
    fit = identify(robot, data, LeastSquares())
    (rows,) = data.observations
    sigma = np.sqrt(np.asarray(rows.covariance)[0, 0, 0] * fit.chi_square / value)
    scaled = Observations.from_sigma(rows.kind, rows.rows, rows.measured, sigma)
    return replace(data, observations=(scaled,))


@pytest.mark.parametrize(
    ("chi_square", "code", "severity"),
    [
        (1.0, "noise.consistent", Severity.INFO),
        (10.0, "noise.doubtful", Severity.WARNING),
        (30.0, "noise.residuals-too-large", Severity.WARNING),
    ],
)
def test_seven_heights_get_one_statement_about_the_noise(printers, chi_square, code, severity):
    """One degree of freedom: chi-square 10 has the probability 0.0016."""
    for name, (robot, data) in printers.items():
        if name == WITH_DISTANCES:
            continue
        six = replace(robot, parameters=robot.parameters.with_free(GEOMETRY))
        scaled = scale_to_chi_square(six, data, chi_square)
        fit = identify(six, scaled, LeastSquares())
        assert fit.residual_test.degrees == pytest.approx(1.0)
        assert fit.chi_square == pytest.approx(chi_square, rel=1e-3)
        test = fit.residual_test.finding
        assert (test.code, test.severity) == (code, severity)
        assert list_codes(find_outliers(fit, scaled).findings) == {"outliers.not-testable"}
