# SPDX-License-Identifier: Apache-2.0
"""The largest position error in a volume: what it covers, its grids, limits, and mistakes."""

from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest

from loopcal import geometry, load_robot
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.apply.volume_accuracy import Volume, bound_errors, join_volume, parse_volume_part
from loopcal.errors import EstimationError, LoopcalError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.results.serialization import to_json

BOX = {"x": (-0.04, 0.04), "y": (-0.04, 0.04), "z": (0.03, 0.09)}


@cache
def calibrate_machine(name: str, sensor: Sensor, poses: int, seed: int):
    """Return a fit of a drawn machine, and the true machine."""
    robot = load_robot(name)
    truth = robot.with_values(sample_truth(robot, 1, seed)[0])
    data = simulate(
        truth, sample_workspace(robot, poses, seed).coordinates, Instrument((sensor,)), seed
    )
    return identify(robot, data, LeastSquares() if name == "linear-delta" else MAP()), truth


TRACKER = Sensor(Position(), Gaussian(np.full(3, 20e-6)))
CMM = Sensor(Pose(), Gaussian(np.array([25e-6] * 3 + [5e-6] * 3)))
PLANAR = Sensor(Component(("x", "y")), Gaussian(np.full(2, 5e-6)))


def calibrate_delta(seed: int):
    return calibrate_machine("linear-delta", TRACKER, 20, seed)


def compute_errors(fit, truth, points) -> np.ndarray:
    """Return the true position errors of a fit at points."""
    q = inverse(fit.robot, points).q
    error = geometry.pose_difference(forward(truth, q).T, forward(fit.robot, q).T)
    return np.linalg.norm(error[:, 3:], axis=1)


VOLUMES = {
    "box": Volume(BOX),
    "cylinder": Volume({"z": (0.03, 0.09)}, {"x": [0.01]}, radius=0.04),
    "list": Volume(
        points=np.random.default_rng(3).uniform((-0.04, -0.04, 0.02), (0.04, 0.04, 0.1), (9, 3))
    ),
}


@pytest.mark.parametrize(
    "name", ["cylinder", "list", pytest.param("box", marks=pytest.mark.evidence)]
)
def test_the_largest_true_error_in_a_volume_is_below_the_statement(name: str) -> None:
    """In 95 % of machines; 15 of them have at least 12 with a probability of 99.5 %."""
    volume, below = VOLUMES[name], 0
    for seed in range(15):
        fit, truth = calibrate_delta(seed)
        stated = bound_errors(fit, volume, "base")
        assert stated.simultaneous >= stated.pointwise
        points = volume.list_points(fit.robot, 7)
        below += compute_errors(fit, truth, points).max() <= stated.simultaneous
    assert below >= 12


@pytest.mark.parametrize("frame", ["base", "relative"])
def test_tilts_of_a_hexapod_are_all_bounded(frame: str) -> None:
    """The largest error among tilted poses is that of a list of the same poses."""
    fit, _ = calibrate_machine("hexapod-42", CMM, 30, 1)
    disc = Volume({"z": (0.19, 0.21)}, {"roll": [0.0, 0.1], "pitch": [0.0, -0.1]}, radius=0.02)
    stated = bound_errors(fit, disc, frame)
    count = 1 + round(0.02 / stated.spacing["z"])
    points = disc.list_points(fit.robot, count)
    assert len(points) == stated.points == 4 * count**3
    assert set(map(tuple, points[:, 3:5])) == {(0, 0), (0, -0.1), (0.1, 0), (0.1, -0.1)}
    assert np.hypot(*points[:, :2].T).max() == pytest.approx(0.02)
    listed = bound_errors(fit, points, frame)
    assert listed.simultaneous == pytest.approx(stated.simultaneous, rel=1e-12)
    assert np.isnan(listed.refinement)


def test_a_disc_lies_in_the_coordinates_without_a_range() -> None:
    robot = load_robot("linear-delta")
    points = Volume({"y": (0.0, 0.01)}, {"z": [0.1]}, radius=0.03).list_points(robot, 5)
    distance = np.hypot(points[:, 0], points[:, 2] - 0.1)
    assert distance.max() == pytest.approx(0.03)
    # rings of the square at half and whole radius, and the center, for each of five y
    np.testing.assert_array_equal(np.unique(distance.round(9), return_counts=True)[1], [5, 40, 80])


def test_a_planar_machine_states_a_box_and_a_disc() -> None:
    fit, _ = calibrate_machine("five-bar", PLANAR, 30, 1)
    home = np.mean(sample_workspace(fit.robot, 50, 0).coordinates, axis=0)
    (x, y), r = home, 0.005
    box = bound_errors(fit, {"x": (x - r, x + r), "y": (y - r, y + r)}, "base")
    disc = bound_errors(fit, Volume(values={"x": [x], "y": [y]}, radius=r), "base")
    assert disc.simultaneous < box.simultaneous < 1.5 * disc.simultaneous
    assert "cylinder of radius" in str(disc)


def test_a_volume_says_what_the_robot_does_not_reach_and_what_it_extrapolates() -> None:
    fit, _ = calibrate_delta(1)
    part = bound_errors(fit, {"x": (-0.2, 0.0)})
    assert 0.0 < part.reachable < 1.0
    assert any(f"reaches {100 * part.reachable:.3g} %" in str(f) for f in part.findings)
    assert part.extrapolated > 0.0
    assert "less certain than every measured pose" in str(part)
    with pytest.raises(EstimationError, match="reaches no point"):
        bound_errors(fit, {"z": (8.0, 9.0)})
    one = bound_errors(fit, [[0.0, 0.0, 0.05]], "base")
    assert one.simultaneous == pytest.approx(one.pointwise, rel=1e-9)
    expected = pose_uncertainty(fit, [[0.0, 0.0, 0.05]], frame="base").expanded_position[0]
    assert one.simultaneous == pytest.approx(expected, rel=0.1)  # 4,000 draws, Satterthwaite
    wide = bound_errors(fit, {"x": (-0.04, 0.04)}, "base")
    assert wide.simultaneous > one.simultaneous
    assert "simultaneously" in str(wide)
    assert "pointwise" in str(wide)


def test_scatter_of_the_readings_counts_for_one_approach_to_any_point_or_to_each_of_a_list() -> (
    None
):
    """As in the uncertainty of a pose; of a list with more points, more of it."""
    robot = load_robot("linear-delta")
    fit, _ = calibrate_delta(2)
    posterior = fit.posterior
    shaken = replace(posterior, reading_sigma=np.full(len(robot.actuators), 50e-6))
    point = [[0.0, 0.0, 0.05]]
    one = bound_errors(shaken, point, "base")
    expected = pose_uncertainty(shaken, point, frame="base").expanded_position[0]
    assert one.pointwise == pytest.approx(expected, rel=0.1)
    many = bound_errors(shaken, [*point] * 9, "base")
    assert many.pointwise == pytest.approx(one.pointwise, rel=0.05)
    assert many.simultaneous > 1.2 * one.simultaneous
    assert "one approach to each point" in str(many)
    fine, coarse = (
        bound_errors(
            shaken, Volume({"z": (0.05, 0.0501)}, {"x": [1e-6 * i for i in range(n)]}), "base"
        )
        for n in (40, 1)
    )  # one approach, however many points are compared
    assert fine.simultaneous == pytest.approx(coarse.simultaneous, rel=0.01)
    assert fine.simultaneous == pytest.approx(one.simultaneous, rel=0.05)
    assert "one approach to any point" in str(fine)


def test_a_limit_is_judged_by_the_drawn_errors() -> None:
    fit, _ = calibrate_delta(3)
    bound = bound_errors(fit, BOX, "base").simultaneous
    for limit, decision in ((1.01 * bound, "conforms"), (0.99 * bound, "neither"), (1e-7, "not")):
        judged = bound_errors(fit, BOX, "base", limit=limit)
        assert judged.conformity is not None
        assert decision in judged.conformity.decision.value
        assert bool(judged.failures) == (decision == "not")
        assert judged.conformity.bound == pytest.approx(bound)
        assert "in the volume" in str(judged.findings[-1])
        assert to_json(judged)["conformity"]["decision"] == judged.conformity.decision.value


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (Volume, "contains nothing"),
        (lambda: Volume(BOX, points=[[0.0, 0.0, 0.1]]), "with other parts"),
        (lambda: Volume({"x": (0.1, 0.1)}), "lower end first"),
        (lambda: Volume({"x": (0.0, np.nan)}), "lower end first"),
        (lambda: Volume({"x": (0.0, 0.1)}, {"x": [0.0]}), "one range"),
        (lambda: Volume(values={"x": []}), "no value of x"),
        (lambda: Volume(values={"x": [np.nan]}), "values of x"),
        (lambda: Volume(values={"x": cast("Any", 0.01)}), "values of x"),
        (lambda: Volume(radius=-1.0), "above 0"),
        (lambda: Volume(radius=np.inf), "above 0"),
        (lambda: Volume({"theta": (0.0, 0.1)}), "'x', 'y', 'z'"),
        (lambda: Volume(BOX, radius=0.01), "two controlled coordinates"),
        (lambda: Volume(values={"x": [0.0, 0.01]}, radius=0.01), "one value as center"),
        (lambda: Volume(values={"x": np.linspace(0, 0.01, 5000).tolist()}), "more than 4,096"),
        (lambda: [[0.0, 0.0]], "x, y, z"),
        (lambda: [[0.0, 0.0, np.nan]], "points of the volume"),
        (list, "points of the volume"),
        (lambda: parse_volume_part("x"), "nor a part of a volume"),
        (lambda: parse_volume_part("x=1mm..2mm..3mm"), "not a range"),
        (lambda: parse_volume_part("theta=1mm"), "angle"),
        (lambda: join_volume([("x", [0.0]), ("x", (0.0, 1.0))]), "twice"),
    ],
)
def test_a_wrong_volume_is_refused_in_one_sentence(wrong, words: str) -> None:
    fit, _ = calibrate_delta(1)
    with pytest.raises(LoopcalError, match=words) as refusal:
        bound_errors(fit, wrong())
    assert "\n" not in str(refusal.value)


def test_texts_state_the_same_volume_as_python() -> None:
    parts = map(parse_volume_part, ("z=0mm..60mm", "radius=80mm", "theta=0deg,5deg"))
    volume = join_volume(parts)
    assert volume.ranges == {"z": (0.0, 0.06)}
    assert volume.radius == pytest.approx(0.08)
    np.testing.assert_allclose(volume.values["theta"], np.deg2rad([0.0, 5.0]))


def test_errors_that_the_data_do_not_determine_are_refused() -> None:
    """Heights alone leave x and y of a hexapod open."""
    heights = Sensor(Component(("z",)), Gaussian(np.full(1, 1e-5)))
    robot = load_robot("hexapod-42")
    data = simulate(robot, sample_workspace(robot, 60, 1).coordinates, Instrument((heights,)), 1)
    fit = identify(robot, data, LeastSquares())
    with pytest.raises(EstimationError, match="do not determine"):
        bound_errors(fit, {"z": (0.19, 0.21)}, "base")
