# SPDX-License-Identifier: Apache-2.0
"""Each kind determines as many of a hexapod's 42 parameters as counting predicts.

Six are lost to each unknown frame, three to a point's unknown orientation or to an orientation's
unknown place, and so on. The numbers were computed beforehand for two hexapods by other code.
"""

import numpy as np
import pytest

from loopcal import geometry
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.directions import Autocollimation, Direction, Inclination
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.kinds.surfaces import Line, Plane, Sphere
from loopcal.measure.simulation import simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.sensitivity import differentiate_pose
from tests import zoo

FIVE = ("x", "y", "z", "phi", "theta")
STATION = geometry.make_pose(np.eye(3), np.array([-2.5, -1.8, 0.1]))
FAR = np.array([0.7, -0.4, 0.1])
POINT = np.array([[0.03, -0.02, 0.05]])
BOTH = ("frame", "tool")
ALL = np.arange(60)

CASES = {
    "full pose": (Pose(), 42),
    "full pose, base unknown": (Pose(unknown=("frame",)), 36),
    "full pose, tool unknown": (Pose(unknown=("tool",)), 36),
    "full pose, both unknown": (Pose(unknown=BOTH), 30),
    "positions": (Position(places=POINT), 39),
    "positions of an unknown target": (Position(places=POINT, unknown=("targets",)), 36),
    "positions in an unknown frame": (Position(places=POINT, unknown=("frame",)), 33),
    "positions in an unknown frame, target unknown": (
        Position(places=POINT, unknown=("frame", "targets")),
        30,
    ),
    "three targets": (Position(targets=("a", "b", "c"), places=0.1 * np.eye(3)), 42),
    "three targets, all unknown": (
        Position(targets=("a", "b", "c"), places=0.1 * np.eye(3), unknown=("frame", "targets")),
        30,
    ),
    "orientation": (Component(("a", "b", "c"), "euler-xyz"), 36),
    "five coordinates": (Component(FIVE, "tilt-torsion"), 41),
    "five coordinates, base unknown": (Component(FIVE, "tilt-torsion", unknown=("frame",)), 35),
    "height and two tilts": (Component(("z", "a", "b"), "euler-xyz"), 39),
    "roll and pitch": (Inclination(), 35),
    "roll and pitch, gravity unknown": (Inclination(unknown=("gravity",)), 33),
    "roll and pitch, gravity and mounting unknown": (
        Inclination(unknown=("gravity", "mounting")),
        30,
    ),
    "ball-bar": (Separation(places=POINT), 33),
    "distance to an unknown point": (Distance(places=POINT, anchor=FAR, unknown=("anchor",)), 33),
    "sphere": (Sphere(places=POINT, through=FAR, unknown=("surface",)), 33),
    "bearing": (Bearing(places=POINT, T_base_frame=STATION), 39),
    "bearing, station unknown": (
        Bearing(places=POINT, T_base_frame=STATION, unknown=("frame",)),
        33,
    ),
    "plane": (Plane(places=POINT, unknown=("surface",)), 33),
    # gaps a and b across the line are told apart, so a turn about the line is seen
    "line": (Line(places=POINT, along=np.array([0.6, 0.0, 0.8]), unknown=("surface",)), 34),
    "direction": (Direction(), 35),
    "direction in an unknown frame": (Direction(unknown=("frame",)), 32),
    "autocollimation": (Autocollimation(), 35),
    "autocollimation, all unknown": (Autocollimation(unknown=("frame", "mirror")), 30),
}


def build_instrument(kind):
    """Return a sensor of this kind that measures all poses, or many pairs of them."""
    rows = None
    if kind.poses_per_row == 2:
        rows = np.concatenate([np.stack([ALL, np.roll(ALL, -k)], axis=-1) for k in (1, 7, 19)])
    dimensions = [column.dimension.value for column in kind.noise_columns]
    sigma = np.array([1e-5 if d == "length" else 5e-5 for d in dimensions])
    return Instrument((Sensor(kind, Gaussian(sigma), rows=rows),))


def compute_singular_values(robot, poses, instrument):
    """Return singular values of the scaled machine columns; nuisance columns are projected out."""
    trials = simulate_trials(robot, robot.values, poses, instrument, seed=1, controller=robot)
    data = trials.trial(0)
    state = forward_trials(robot, robot.values[None], data.readings[None])
    D = differentiate_pose(robot, robot.values[None], data.readings[None], state).parameters
    rows = whiten_rows(
        evaluate_measurements(
            data, state.T, trials.nuisance_parameters.values()[None], trials.nuisance_parameters
        ),
        D,
    )[0]
    p = len(robot.parameters)
    machine, nuisance = rows[:, :p], rows[:, p:-1]
    if nuisance.shape[1]:
        U, s, _ = np.linalg.svd(nuisance / np.linalg.norm(nuisance, axis=0), full_matrices=False)
        U = U[:, s > 1e-10]
        machine = machine - U @ (U.T @ machine)
        machine = machine - U @ (U.T @ machine)
    return np.linalg.svd(machine / np.linalg.norm(rows[:, :p], axis=0), compute_uv=False)


def check_rank(s, rank):
    assert s[rank - 1] > 1e-8 * s[0], s[rank - 2 : rank + 2]
    assert rank == len(s) or s[rank] < 1e-11 * s[0], s[rank - 2 : rank + 2]


@pytest.fixture(scope="module")
def robot():
    return zoo.load_cached_robot("hexapod-nategh-agheli").with_values(zoo.nategh_truth())


@pytest.fixture(scope="module")
def generic():
    rng = np.random.default_rng(12)
    low, high = (
        np.array([-0.1, -0.1, 0.65, -0.3, -0.3, -0.3]),
        np.array([0.1, 0.1, 0.95, 0.3, 0.3, 0.3]),
    )
    return zoo.make_poses(rng.uniform(low, high, (len(ALL), 6)))


@pytest.mark.parametrize("name", CASES)
def test_rank_of_each_kind_is_the_predicted_one(robot, generic, name):
    kind, rank = CASES[name]
    check_rank(compute_singular_values(robot, generic, build_instrument(kind)), rank)


def test_planes_and_perpendicular_lines_have_rank_33(robot):
    rng = np.random.default_rng(4)
    turns = zoo.make_poses(rng.uniform(-0.3, 0.3, (180, 6)))[:, :3, :3]
    points, seen, first = [], [], 0
    for axis in np.eye(3):
        for touched, kind in (
            (np.eye(3) - np.outer(axis, axis), Plane),
            (np.outer(axis, axis), Line),
        ):
            points.append(np.array([0.0, 0.0, 0.8]) + rng.uniform(-0.1, 0.1, (30, 3)) @ touched)
            through = np.array([0.0, 0.0, 0.8])
            made = kind(
                places=POINT,
                through=through,
                along=axis,
                unknown=("surface",),
                surface=f"surface{first}",
            )
            noise = Gaussian(np.full(len(made.noise_columns), 1e-5))
            seen.append(Sensor(made, noise, rows=np.arange(first, first + 30)))
            first += 30
    poses = geometry.make_pose(turns, np.concatenate(points) - (turns @ POINT[0]))
    check_rank(compute_singular_values(robot, poses, Instrument(tuple(seen))), 33)


def test_ball_bar_and_tilts_together_have_rank_38(robot, generic):
    both = Instrument(
        build_instrument(Separation(places=POINT)).sensors + build_instrument(Inclination()).sensors
    )
    # the ball-bar leaves six of the base and three of the tool's orientation; level gravity gives
    # two of the base and the mounting all three of the tool
    check_rank(compute_singular_values(robot, generic, both), 38)
