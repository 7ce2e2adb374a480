# SPDX-License-Identifier: Apache-2.0
"""Errors of several measurement kinds are compared in units of sigma, with the number of rows."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.validation import validate
from loopcal.diagnose.row_errors import sum_kinds, summarize_kinds
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import UM, hexapod, hexapod_data, noise

MM = 1e-3


def make_rows(kind, count: int, sigma: float) -> Observations:
    columns = len(kind.columns)
    return Observations.from_sigma(
        kind.with_tool(np.eye(4)), np.arange(count), np.zeros((count, columns)), sigma
    )


def test_kind_errors_are_in_units_of_sigma_for_each_kind_and_for_all():
    heights, positions = (
        make_rows(Component(("z",)), 4, 20 * UM),
        make_rows(Position(), 2, 300 * UM),
    )
    measured = positions.measured.copy()
    measured[1, 2] = np.nan
    positions = replace(positions, measured=measured)
    before = [np.full((4, 1), 80 * UM), np.full((2, 3), 300 * UM)]
    after = [np.full((4, 1), 20 * UM), np.full((2, 3), 600 * UM)]
    one, two, every = summarize_kinds(sum_kinds([heights, positions], before, after))
    assert [(k.kind, k.count) for k in (one, two, every)] == [
        ("component", 4),
        ("position", 5),
        ("all", 9),
    ]
    np.testing.assert_allclose(
        [one.before, one.after, two.before, two.after], [4.0, 1.0, 1.0, 2.0], rtol=1e-12
    )
    assert every.before == pytest.approx(np.sqrt((4 * 16 + 5 * 1) / 9), rel=1e-12)
    assert every.after == pytest.approx(np.sqrt((4 * 1 + 5 * 4) / 9), rel=1e-12)


def test_improvement_weights_each_instrument_by_its_sigma():
    """Ten heights (sigma 20 um) fit the new stops; thirty positions (1 mm) fit the old ones,
    0.1 mm away: a tenth of their sigma.
    """
    new = load_robot("linear-delta")
    stops = np.array([name.endswith("stop") for name in new.parameters.names])
    old = new.with_values(new.values + 0.1 * MM * stops)
    heights = Instrument((Sensor(Component(("z",)), noise(20 * UM)),))
    readings = simulate(new, sample_workspace(new, 40, 3).coordinates, heights, 3).readings
    z, xyz = forward(new, readings[:10]).T[:, 2, 3:], forward(old, readings[10:]).T[:, :3, 3]
    heights = Observations.from_sigma(
        Component(("z",)).with_tool(new.tool), np.arange(10), z, 20 * UM
    )
    positions = Observations.from_sigma(Position().with_tool(new.tool), np.arange(10, 40), xyz, MM)
    result = validate(new, Measurements(new.name, readings, (heights, positions)), before=old)
    before, after = (errors.statistics("position").rms for errors in (result.before, result.after))
    assert before / after == pytest.approx(1 / np.sqrt(3.0), rel=1e-6)  # as millimetres they grew
    ((name, change),) = result.changes().items()
    assert name == "weighted"
    assert change.times == pytest.approx(np.sqrt(10 * 5.0**2 / (30 * 0.1**2)), rel=1e-6)
    assert [k.kind for k in result.to_dict()["kinds"]] == ["component", "position", "all"]


def test_validation_counts_rows_of_each_quantity_and_reports_too_few():
    data = hexapod_data(12)
    pose = data.observations[0]
    measured = pose.measured.copy()
    lengths = np.array([name in "xyz" for name in (column.name for column in pose.kind.columns)])
    measured[np.ix_(np.arange(3, 12), lengths)] = (
        np.nan
    )  # position of three rows, orientation of eleven, and one empty row
    measured[11] = np.nan
    result = validate(hexapod(), replace(data, observations=(replace(pose, measured=measured),)))
    assert len(result.poses) == 11
    assert result.after.statistics("position").count == 3
    assert result.after.statistics("orientation").count == 11
    (few,) = [f for f in result.findings if f.code == "validation.few-rows"]
    assert few.data == {"quantity": "position", "count": 3}
    assert not validate(hexapod(), data).findings
