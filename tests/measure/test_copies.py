# SPDX-License-Identifier: Apache-2.0
"""Copies of rows, also with fewer digits, are no new measurements; repeats are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.measure.data_checks import check_duplicates
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from tests.estimate.problems import UM, hexapod_data
from tests.findings.expectations import get_finding, list_codes

MM = 1e-3


def append_copies(data: Measurements, poses: np.ndarray, step: float) -> Measurements:
    """Return measurements with copies of some poses, of which all numbers are rounded."""
    (rows,) = data.observations
    readings = np.concatenate([data.readings, np.round(data.readings[poses] / step) * step])
    measured = np.concatenate([rows.measured, np.round(rows.measured[poses] / step) * step])
    n = len(measured)
    copied = Observations(rows.kind, np.arange(n), measured, rows.covariance[0])
    return Measurements(data.robot_name, readings, (copied,))


def measure_heights(seed: int, points: int, times: int, step: float, sigma: float) -> Measurements:
    """Return heights of points, each probed several times and rounded to a step [m]."""
    stream = np.random.default_rng(seed)
    readings = np.repeat(stream.uniform(-0.1, 0.1, (points, 3)), times, axis=0)
    heights = np.repeat(stream.normal(0, 0.3 * MM, (points, 1)), times, axis=0)
    heights = np.round((heights + stream.normal(0, sigma, heights.shape)) / step) * step
    kind = lc.Component(("z",)).with_tool(np.eye(4))
    rows = Observations.from_sigma(kind, np.arange(len(heights)), heights, sigma)
    return Measurements("toy", readings, (rows,))


@pytest.mark.parametrize("step", [1e-12, 1e-5 * MM, 2e-5 * MM])
@pytest.mark.parametrize("count", [1, 20])
def test_copies_with_fewer_digits_are_refused_by_name(step: float, count: int) -> None:
    """Sigma is 1 um: the copies differ by up to 0.01 sigma."""
    data = append_copies(hexapod_data(20), np.arange(5, 5 + count) % 20, step)
    with pytest.raises(lc.DataError) as error:
        check_duplicates(data)
    finding = error.value.args[0]
    assert finding.code == "data.duplicate-rows"
    first, copy = finding.data["poses"]
    assert int(copy) > 20
    assert (int(first) - 1) == (int(copy) - 21 + 5) % 20
    assert finding.data["more"] == count - 1
    check_duplicates(data, allow=True)


def test_calibrate_refuses_copies_unless_they_are_allowed() -> None:
    data = append_copies(hexapod_data(30), np.arange(30), 1e-5 * MM)
    robot = lc.load_robot("hexapod-42")
    with pytest.raises(lc.DataError, match="have equal pose values up to rounding, as 29 more"):
        lc.calibrate(robot, data)
    allowed = lc.CalibrationOptions(allow_duplicates=True, check_conventions=False)
    assert lc.calibrate(robot, data, allowed).identification.converged


def test_validate_names_copies_of_fitted_rows() -> None:
    data = hexapod_data(30)
    both = append_copies(data, np.arange(3), 1e-5 * MM)
    fit = lc.identify(lc.load_robot("hexapod-42"), data.take(np.arange(20)))
    result = lc.validate(fit, both.take([20, 21, 22, 23, 24, 30, 31, 32]))
    reused = get_finding(result.findings, "validation.rows-reused")
    assert (reused.data["poses"], reused.data["total"]) == (("31", "32", "33"), 8)
    assert "validation.rows-reused" not in list_codes(
        lc.validate(fit, data.take([22, 23])).findings
    )


@pytest.mark.parametrize("step", [0.01 * MM, 0.001 * MM, 1e-6 * MM])
def test_repeated_heights_with_a_coarse_step_are_no_copies(step: float) -> None:
    """With a step of half of sigma, 14 % of the repeats are equal; 5 in 100,000 are refused."""
    for seed in range(30):
        check_duplicates(measure_heights(seed, 14, 2, step, 0.02 * MM))
        check_duplicates(measure_heights(seed, 5, 30, step, 0.02 * MM))


def test_file_of_coarse_heights_given_twice_is_refused() -> None:
    data = measure_heights(1, 14, 1, 0.01 * MM, 0.02 * MM)
    with pytest.raises(lc.DataError, match="component values up to rounding, as 13 more rows"):
        check_duplicates(append_copies(data, np.arange(14), 0.01 * MM))


@pytest.mark.parametrize("overstated", [1.0, 3.0])
def test_repeats_of_poses_are_no_copies(overstated: float) -> None:
    data = hexapod_data(40)
    for seed in range(20):
        order = np.repeat(np.arange(8), 5)
        (rows,) = data.observations
        noise = np.random.default_rng(seed).normal(0, UM, rows.measured[order].shape)
        covariance = rows.covariance * overstated**2
        again = replace(rows, measured=rows.measured[order] + noise, covariance=covariance)
        check_duplicates(Measurements("toy", data.readings[order], (again,)))


def test_many_repeats_are_no_copies_and_some_copies_are_found() -> None:
    stream = np.random.default_rng(0)
    readings = np.repeat(stream.uniform(-0.1, 0.1, (20_000, 3)), 5, axis=0)
    point = lc.Position().with_tool(np.eye(4))
    values = readings + stream.normal(0, 10 * UM, readings.shape)
    rows = Observations.from_sigma(point, np.arange(len(values)), values, 10 * UM)
    check_duplicates(Measurements("toy", readings, (rows,)))
    values[1] = values[0]
    rows = Observations.from_sigma(point, np.arange(len(values)), values, 10 * UM)
    with pytest.raises(lc.DataError, match="poses '1' and '2'"):
        check_duplicates(Measurements("toy", readings, (rows,)))
