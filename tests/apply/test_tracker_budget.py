# SPDX-License-Identifier: Apache-2.0
"""The budget of a tracker's range, angle, centering, scale and temperature, against simulation.

The simulation shares nothing with the budget: it draws range and angles of each measured point,
turns them into coordinates, and repeats the calibration with one source of errors at a time.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.error_budget import compute_error_budget
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.calibration_view import build_gum_tables
from loopcal.results.serialization import json_fields

STATION = np.array([1.4, -0.9, 0.6])
POSES = 20
# Simulated calibrations, and what their root mean square scatters by: noise of 60 numbers in each
# of 25, one number of two exact sizes (the fit is linear), and 9 parameters of 60 machines.
TRIALS = {"position": (25, 0.15), "tracker": (2, 0.03), "tolerances": (60, 0.2)}
SETTINGS = """\
# kind: position
# frame: tracker
# T_base_frame: {x: 1400 mm, y: -900 mm, z: 600 mm}
# noise: {range: {U: 16 um, k: 2}, angle: 8 urad, centering: {limit: 6 um}}
# scale: {limit: 20 ppm}
# temperature: {value: 23 degC, sd: 0.5 K, expansion: 20 ppm/K, expansion_sd: 2 ppm/K}
"""
# Standard uncertainties of the sources in the settings, by the names of their lines.
SIZES = {
    "position, range": 8e-6,
    "position, angle": 8e-6,
    "position, centering": 6e-6 / 3**0.5,
    "tracker.scale": 20e-6 / 3**0.5,
    "tracker.temperature": 0.5,
    "tracker.expansion": 2e-6,
}
ROBOT = lc.load_robot("linear-delta")


def place_tool(robot: lc.Mechanism, readings: np.ndarray) -> np.ndarray:
    """Return the tool (n, 3) at readings."""
    solved = lc.forward(robot, readings)
    assert solved.converged.all()
    return (solved.T @ robot.tool)[:, :3, 3]


def write_data(path: Path, readings: np.ndarray, measured: np.ndarray, settings=SETTINGS) -> Path:
    names = [actuator.name for actuator in ROBOT.actuators]
    header = ",".join(["pose", *(f"{n} [m]" for n in names), "x [m]", "y [m]", "z [m]"])
    rows = np.concatenate([readings, measured], axis=1)
    lines = (",".join([str(i), *map(repr, row)]) for i, row in enumerate(rows.tolist()))
    path.write_text("\n".join([f"{settings}{header}", *lines, ""]))
    return path


def draw(source: str, points: np.ndarray, g: np.random.Generator, sign: int = 0) -> np.ndarray:
    """Return points (n, 3) of the tracker with errors of one source, as it makes them: by range
    and two angles, with the warm machine's lengths.
    """
    sd = SIZES.get(source, 0.0)
    length = np.linalg.norm(points, axis=1)
    flat = np.hypot(points[:, 0], points[:, 1])
    azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], flat)
    n = len(points)
    if source == "position, range":
        length = length + sd * g.standard_normal(n)
    if source == "position, angle":  # at this height, azimuths turn about the vertical
        azimuth = azimuth + sd * g.standard_normal(n) / np.cos(elevation)
        elevation = elevation + sd * g.standard_normal(n)
    seen = np.stack(
        [
            length * np.cos(elevation) * np.cos(azimuth),
            length * np.cos(elevation) * np.sin(azimuth),
            length * np.sin(elevation),
        ],
        axis=1,
    )
    if source == "position, centering":
        seen += g.uniform(-(3**0.5) * sd, 3**0.5 * sd, seen.shape)
    rise = 3.0 + (sign * sd if source == "tracker.temperature" else 0.0)
    slope = 20e-6 + (sign * sd if source == "tracker.expansion" else 0.0)
    scale = sign * sd if source == "tracker.scale" else 0.0
    return seen * (1.0 + scale) * (1.0 + rise * slope)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Return data without errors, the points of the tool in the tracker, and its budget."""
    readings = sample_workspace(ROBOT, POSES, 7).solution.q
    points = place_tool(ROBOT, readings) - STATION
    folder = tmp_path_factory.mktemp("tracker")
    path = write_data(folder / "data.csv", readings, draw("", points, np.random.default_rng(0)))
    data = lc.load_measurements(path, ROBOT)
    fit = identify(ROBOT, data, options=FitOptions(method=MAP(), sigma_uncertainty=0.0))
    budget = compute_error_budget(fit, data, "base")
    assert budget is not None
    return data, points, fit, budget


@pytest.mark.parametrize("source", [*SIZES, "tolerances"])
def test_contribution_of_each_source_is_that_of_simulated_calibrations(case, source):
    data, points, _, budget = case
    g = np.random.default_rng(20)
    used = sample_workspace(ROBOT, 40, 3).solution.q
    trials, scatter = TRIALS[source.split(",")[0].split(".")[0]]
    squares = []
    for trial in range(trials):
        truth = ROBOT
        if source == "tolerances":
            truth = ROBOT.with_values(sample_truth(ROBOT, 1, trial)[0])
            points = place_tool(truth, data.readings) - STATION
        (rows,) = data.observations
        measured = replace(rows, measured=draw(source, points, g, (-1) ** trial))
        changed = replace(data, observations=(measured,))
        fit = identify(ROBOT, changed, options=FitOptions(method=MAP()))
        error = place_tool(fit.robot, used) - place_tool(truth, used)
        squares.append(np.mean(np.sum(error**2, axis=1)))
    (line,) = [x for x in budget.lines if source in (x.source.name, x.source.kind)]
    # the poses of the budget are others, of the same workspace
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.sqrt(line.position), rel=0.05 + scatter)


def test_lines_state_the_values_of_the_certificates(case):
    *_, budget = case
    stated = {x.source.name: x.source.size for x in budget.lines if x.source.name in SIZES}
    assert {name: (s.value, s.unit, s.distribution) for name, s in stated.items()} == {
        "position, range": (16.0, "um", "normal"),
        "position, angle": (8.0, "urad", "normal"),
        "position, centering": (6.0, "um", "uniform"),
        "tracker.scale": (20.0, "ppm", "uniform"),
        "tracker.temperature": (0.5, "K", "normal"),
        "tracker.expansion": (2.0, "ppm/K", "normal"),
    }
    assert stated["position, range"].divisor == 2.0
    assert stated["position, centering"].divisor == pytest.approx(3**0.5)


def test_each_line_has_its_value_or_says_where_its_size_is_from(case, tmp_path):
    """Of standard deviations that a file states for each point, the root mean square."""
    data, *_ = case
    sizes = np.tile([8.0, 24.0], len(data.readings))[: len(data.readings)]
    path = write_data(tmp_path / "each.csv", data.readings, data.observations[0].measured)
    *settings, head = path.read_text().splitlines()[:7]
    rows = path.read_text().splitlines()[7:]
    lines = [*settings[:3], f"{head},sigma.x [um],sigma.y [um],sigma.z [um]"]
    lines += [f"{row},{s:g},{s:g},{s:g}" for row, s in zip(rows, sizes, strict=True)]
    path.write_text("\n".join(lines))
    own = lc.load_measurements(path, ROBOT)
    for fitted in (data, own):
        fit = identify(ROBOT, fitted, options=FitOptions(method=MAP(), sigma_uncertainty=0.0))
        budget = json_fields(compute_error_budget(fit, fitted, "base"))
        for table in build_gum_tables(budget, ROBOT):
            *lines, _ = table.rows
            assert all(len(value) > 1 for _, _, value, *_ in lines)
    instrument, tolerances, *_ = lines
    rms = np.sqrt((sizes**2).mean())
    assert instrument[2:5] == (f"{rms:.3g} um", "normal, rms", "1")
    assert tolerances[2] == "by parameter"


def test_halving_the_range_is_a_new_budget_with_half_the_range(case, tmp_path):
    data, _points, _, budget = case
    half = SETTINGS.replace("U: 16 um", "U: 8 um")
    path = write_data(tmp_path / "half.csv", data.readings, data.observations[0].measured, half)
    other = lc.load_measurements(path, ROBOT)
    fit = identify(ROBOT, other, options=FitOptions(method=MAP(), sigma_uncertainty=0.0))
    again = compute_error_budget(fit, other, "base")
    assert again is not None
    (line,) = [x for x in budget.lines if x.source.name == "position, range"]
    assert line.halved.position == pytest.approx(again.position.rms, rel=1e-6)


def test_degrees_of_freedom_of_the_sum_are_those_of_the_guide(case):
    """With a sigma that is known to 25 %, noise has 8 degrees of freedom (JCGM 100, G.3)."""
    data, *_ = case
    fit = identify(ROBOT, data, options=FitOptions(method=MAP(), noise="estimated"))
    budget = compute_error_budget(fit, data, "base")
    assert budget is not None
    noise = sum(x.position for x in budget.lines if x.source.kind == "instrument")
    (nu,) = {x.source.degrees for x in budget.lines if x.source.kind == "instrument"}
    expected = nu * (budget.position.rms**2 / noise) ** 2
    assert budget.to_dict()["position"]["degrees"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("{U: 16 um, k: 2}", "{U: 16 um, sd: 8 um}", "has one form"),
        ("{U: 16 um, k: 2}", "{U: 16 um, k: 0}", "coverage factor"),
        ("{U: 16 um, k: 2}", "{U: 16 um, nu: 9}", "nu"),
        ("{limit: 20 ppm}", "{mean: 3 ppm}", "has one form"),
        ("angle: 8 urad", "angle: 8 um", "angle"),
        ("# T_base_frame: {x: 1400 mm, y: -900 mm, z: 600 mm}\n", "", "station"),
    ],
)
def test_statements_that_say_nothing_are_refused(case, tmp_path, old, new, words):
    data, points, *_ = case
    assert old in SETTINGS
    settings = SETTINGS.replace(old, new)
    path = write_data(tmp_path / "x.csv", data.readings, points, settings)
    with pytest.raises(lc.LoopcalError, match=words):
        lc.load_measurements(path, ROBOT)


def test_station_is_where_lines_of_sight_begin(case, tmp_path):
    data, _points, *_ = case
    moved = SETTINGS.replace("{x: 1400 mm, y: -900 mm, z: 600 mm}", "{}")
    moved = moved.replace("# noise", "# station: [1400 mm, -900 mm, 600 mm]\n# noise")
    measured = data.observations[0].measured
    path = write_data(tmp_path / "x.csv", data.readings, measured + STATION, moved)
    (rows,) = lc.load_measurements(path, ROBOT).observations
    assert rows.covariance == pytest.approx(data.observations[0].covariance, rel=1e-9)
