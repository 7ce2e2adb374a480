# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# matplotlib's types do not say that lines and images contain arrays.
"""Repeatability, uncertainty budgets, setup parameters and compared runs as figures and tables."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.units import find_unit
from tests.report.test_figures import check

FIVE_BAR = Path(lc.__file__).parent / "robots" / "five-bar.yaml"


@pytest.fixture(scope="module")
def repeatability() -> lc.Repeatability:
    robot = lc.load_robot("hexapod-octahedral")
    commanded = np.repeat(lc.sample_workspace(robot, 3, seed=1).coordinates, 6, axis=0)
    noise = lc.Gaussian(np.array([2e-5] * 3 + [1e-5] * 3))
    instrument = lc.Instrument((lc.Sensor(lc.Pose(), noise),))
    data = lc.simulate(robot, commanded, instrument, seed=1)
    return lc.assess_repeatability(robot, data)


def test_figure_of_repeatability_has_both_numbers_of_every_pose(repeatability) -> None:
    figure = repeatability.plot()
    check(figure)
    accuracy, scatter, _, rotations = figure.axes
    whole = [pose.accuracy.value for pose in repeatability.poses["position"]]
    drawn = [float(line.get_ydata()[0]) for line in accuracy.lines]
    assert_allclose(drawn, 1e3 * np.array(whole))
    assert scatter.get_ylabel() == "position [mm]"
    assert rotations.get_ylabel() == "orientation [deg]"
    assert len(rotations.lines) == 3 * len(whole)
    assert "6 visits" in figure.get_suptitle()


def test_figure_of_repeatability_names_the_axes_of_several_gauges() -> None:
    robot = lc.load_robot("hexapod-42")
    poses = np.repeat(lc.sample_workspace(robot, 2, seed=1).coordinates, 4, axis=0)
    gauges = (lc.Component(("x",)), lc.Component(("y", "z")))
    sensors = (lc.Sensor(g, lc.Gaussian(np.full(len(g.columns), 1e-5))) for g in gauges)
    data = lc.simulate(robot, poses, lc.Instrument(tuple(sensors)), seed=2)
    axes = lc.assess_repeatability(robot, data).plot().axes[0]
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == ["1 x", "5 x", "1 y z", "5 y z"]


def test_table_of_repeatability_has_whole_positions_and_components(repeatability) -> None:
    table = repeatability.to_frame()
    assert len(table) == 3 * 4 + 3 * 3
    assert list(table.component[:4]) == ["all", "x", "y", "z"]
    assert (table.RP_low < table.RP).all()
    assert (table.RP_high > table.RP).all()
    first = repeatability.poses["position"][0]
    assert table.AP[0] == first.accuracy.value
    assert "RP" in str(repeatability)


def test_budget_shows_and_lists_the_part_of_every_source(linear_delta) -> None:
    budget = lc.calibrate(linear_delta.robot, linear_delta.fitted).budget
    assert budget is not None
    figure = budget.plot()
    check(figure)
    axes = figure.axes[0]
    parts = [bar.get_width() for bar in axes.patches]
    table = budget.to_frame()
    unit = find_unit(axes.get_xlabel().partition("[")[2][:-1])
    assert_allclose(np.multiply(parts, unit.factor_to_si), table["position [m]"])
    assert np.sqrt((table["position [m]"] ** 2).sum()) == pytest.approx(budget.position.rms)
    assert [label.get_text() for label in axes.get_yticklabels()] == list(table.source)
    variances = budget.to_dataset().parameter_variance.sum("source")
    assert_allclose(variances, budget.sd**2)


def test_setup_parameters_are_listed_with_their_uncertainty(linear_delta) -> None:
    nuisance = linear_delta.fit.nuisance
    table = nuisance.to_frame()
    assert list(table.parameter) == list(nuisance.names)
    assert set(table.unit) == {"deg", "mm"}
    assert_allclose(table.sd[3:], 1e3 * nuisance.sd[3:])
    lines = str(nuisance).splitlines()
    assert len(lines) == 8
    assert {len(line.split()) for line in lines[2:]} == {4}
    assert len(repr(nuisance)) < 300
    assert nuisance._repr_html_()


@pytest.fixture(scope="module")
def runs(five_bar, tmp_path_factory) -> lc.RunComparison:
    folder, robot = tmp_path_factory.mktemp("runs"), five_bar.robot
    truth = lc.sample_truth(robot, 1, 1)[0]
    truth[robot.parameters.names.index("east.length")] += 1e-3
    poses = lc.sample_workspace(robot, 20, seed=2).coordinates
    instrument = lc.Instrument((lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 2e-5))),))
    moved = lc.simulate(robot.with_values(truth), poses, instrument, 2)
    for name, data in {"may": five_bar.fitted, "june": moved}.items():
        lc.save_run(lc.calibrate(robot, data), folder / name)
    return lc.compare_runs([lc.load_run(folder / name) for name in ("may", "june")])


def test_compared_runs_show_and_list_the_shifts_in_standard_deviations(runs) -> None:
    figure = runs.plot()
    check(figure)
    title = "june: has changed; a change of east.length alone explains it"
    assert figure.get_suptitle() == title
    (axes,) = figure.axes
    table = runs.to_frame()
    sizes = table["june shift"] / table["june shift_sd"]
    drawn = np.concatenate([line.get_xdata() for line in axes.lines[:2]])
    assert_allclose(np.sort(drawn), np.sort(sizes.to_numpy()))
    assert len(axes.lines[0].get_xdata()) == table["june significant"].sum()
    assert list(table.parameter) == list(runs.parameters)


def test_regularization_curves_draw_themselves(five_bar) -> None:
    check(lc.compute_regularization_curves(five_bar.robot, five_bar.fitted, folds=3).plot())


def test_validation_by_readings_alone_has_narrow_bars_with_their_numbers() -> None:
    robot = lc.load_robot("cable-4")
    machine = robot.with_values(lc.sample_truth(robot, 1, seed=3)[0])
    poses = lc.sample_workspace(robot, 24, seed=1).coordinates
    tape = lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-3)), rows=np.arange(3))
    data = lc.simulate(machine, poses, lc.Instrument((tape,)), seed=2)
    readings = lc.Measurements(robot.name, data.readings, (), reading_sigma=data.reading_sigma)
    fitted, held_out = readings.split(hold_out=0.25, seed=1)
    validation = lc.validate(lc.identify(robot, fitted), held_out)
    assert str(validation).startswith("Errors at 6 measured poses, divided by sigma\nkind ")
    figure = validation.plot()
    check(figure)
    (axes,) = figure.axes
    before, after = axes.patches
    assert after.get_width() < 0.1 * np.ptp(axes.get_xlim())
    numbers = [float(text.get_text()) for text in axes.texts]
    assert_allclose(numbers, [before.get_height(), after.get_height()], rtol=0.01)


def test_a_ratio_stands_without_the_unit_1(tmp_path) -> None:
    """The gain of a drive is a number, not a number of ones."""
    text = FIVE_BAR.read_text().replace("unknown: [offset]", "unknown: [offset, gain]")
    path = tmp_path / "ratios.yaml"
    path.write_text(text.replace("angle: {sd: 0.1}}", "angle: {sd: 0.1}, ratio: {sd: 0.001}}"))
    robot = lc.load_robot(path)
    poses = lc.sample_workspace(robot, 20, seed=1).coordinates
    camera = lc.Instrument((lc.Sensor(lc.Component(("x", "y")), lc.Gaussian(np.full(2, 2e-5))),))
    figure = lc.identify(robot, lc.simulate(robot, poses, camera, 1)).plot.parameters()
    labels = [label.get_text() for label in figure.axes[1].get_yticklabels()]
    gains = [label for label in labels if label.startswith(("0.99", "1.00"))]
    assert len(gains) == 2
    assert not [label for label in gains if label.endswith(" 1")]
