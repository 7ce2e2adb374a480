# SPDX-License-Identifier: Apache-2.0
"""Every kind refuses invalid settings and rows in one sentence."""

from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal import geometry
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.errors import DataError, LoopcalError
from loopcal.measure.data_checks import check_duplicates, check_targets_move
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.directions import Autocollimation, Direction, Inclination
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.kinds.surfaces import Line, Plane, Sphere
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from tests import zoo
from tests.findings.expectations import expect_refusal

POINT = np.zeros((1, 3))
POSE = Pose(T_platform_tool=np.eye(4))
BAR = Separation(places=POINT)
EXAMPLES = [
    pytest.param(kind, id=f"{name}-{i}")
    for name, cls in KINDS.items()
    for i, kind in enumerate(cls.examples())
    if kind.columns
]


POINTS = Component(("x", "y", "z"), T_platform_tool=np.eye(4))
HEIGHT = Component(("z",), T_platform_tool=np.eye(4))
POSES = zoo.make_poses(np.zeros((1, 6)))


def observe(*rows: Any, kind: Any = POINTS, poses: Any = None, sigma: Any = 1e-4) -> Observations:
    """Return observations of the first poses."""
    poses = range(len(rows)) if poses is None else poses
    return Observations.from_sigma(kind, poses, rows, sigma)


def observe_points(**change):
    right = {"kind": POINTS, "rows": [0, 1], "measured": np.zeros((2, 3)), "covariance": np.eye(3)}
    return Observations(**(right | change))


def record(**change):
    rows = observe([0.0], [0.0], kind=HEIGHT)
    right = {"robot_name": "toy", "readings": np.zeros((2, 2)), "observations": (rows,)}
    return Measurements(**(right | change))


def record_readings(sigma, first=(1.0, 1.0)):
    readings = [first, (1.0, 1.0), (1.0, 1.0)]
    return record(readings=readings, observations=(), reading_sigma=sigma)


def observe_correlated(a, b=None):
    """Return points whose x and y have a correlation, which may be asymmetric."""
    covariance = np.eye(3)
    covariance[0, 1], covariance[1, 0] = a, a if b is None else b
    return observe_points(covariance=covariance)


REFUSED = {
    # settings of kinds
    "the targets are empty. Name at least one": lambda: Position(targets=()),
    "the targets are a, a. Name at least one, and each once": lambda: Position(targets=("a", "a")),
    r"number of places is 1, but there are 2 targets \(a, b\). Give one place": lambda: Position(
        targets=("a", "b"), places=POINT
    ),
    "'tracker' cannot be unknown in the kind 'position'. Allowed: frame, targets": (
        lambda: Position(unknown=("tracker",))
    ),
    "T_base_frame is not a pose": lambda: Position(T_base_frame=2.0 * np.eye(4)),
    "rotation part deviates by 0 from a right-handed": (
        lambda: Pose(T_base_frame=np.diag([1.0, 1.0, -1.0, 1.0]))
    ),
    r"T_platform_tool has shape \(3, 3\)": lambda: Pose(T_platform_tool=np.eye(3)),
    "in the kind 'pose'. Allowed: frame, tool, bias, drift": lambda: Pose(unknown=("offset",)),
    "the component 'w' does not exist. Use x, y, z; for angles": (lambda: Component(("w",))),
    "for angles, declare orientation: tilt-torsion": lambda: Component(("phi", "theta")),
    "Use phi, theta, psi, x, y, z": lambda: Component(("a",), "tilt-torsion"),
    "the components are z, z. Name .* each once": lambda: Component(("z", "z")),
    "the components are empty. Name at least one": lambda: Component(()),
    "phi needs theta": lambda: Component(("phi",), "tilt-torsion"),
    "a rotation-vector has no single components": lambda: Component(("x",), "rotation-vector"),
    "is not one of the 24": lambda: Component(("a",), "euler-xxy"),
    "orientation form 'rpy'. Use rotation-vector, quaternion, tilt-torsion, or euler-": (
        lambda: Component(("a",), "rpy")
    ),
    "the form of a bearing is 'telescope'. Use theodolite or camera": (
        lambda: Bearing(form="telescope")
    ),
    "the anchor: row 2 is nan. Give a finite number": lambda: Distance(
        anchor=np.array([0.0, np.nan, 0.0])
    ),
    "the direction of the surface is 0, 0, 0": lambda: Plane(along=np.zeros(3)),
    "the radius of a sphere is 0.0 m. Give a length above 0": lambda: Sphere(radius=0.0),
    "the axis is 0, 0, 0": lambda: Direction(axis=np.zeros(3)),
    "Allowed: mounting, gravity": lambda: Inclination(unknown=("frame",)),
    "the joints are empty. Name at least one": lambda: JointSensor(joints=()),
    "the joints measure 'force'. Use length or angle": lambda: JointSensor(measures="force"),
    # values of rows
    "row 2 of kind 'distance' has a distance of 0 m. A distance is above 0": (
        lambda: observe([1.0], [0.0], kind=Distance(places=POINT))
    ),
    "has a distance of -0.1 m": lambda: observe([1.0], [-0.1], kind=BAR, poses=[[0, 1], [1, 0]]),
    "row 2 of kind 'separation' compares pose 3 with itself": lambda: observe(
        [1.0], [1.0], kind=BAR, poses=[[0, 1], [3, 3]]
    ),
    "has a direction of length 0.921954; the length must be 1 to 1e-3": (
        lambda: observe([0.0, 0.6, 0.7], kind=Direction())
    ),
    "row 2 of kind 'pose' has an incomplete orientation": (
        lambda: observe([0.0] * 6, [0.0, np.nan, 0.0, 1.0, 2.0, 3.0], kind=POSE)
    ),
    "has a quaternion of length 0; the length must be 1": (
        lambda: observe([0.0] * 7, kind=Pose("quaternion", T_platform_tool=np.eye(4)))
    ),
    "row 2 .* b = 90 deg, at which a and c of euler-xyz are one rotation": lambda: observe(
        [0.1, 0.2],
        [0.1, np.pi / 2],
        kind=Component(("a", "b"), "euler-xyz", T_platform_tool=np.eye(4)),
    ),
    "has an incomplete direction": lambda: observe([0.0, np.nan, 1.0], kind=Direction()),
    "has tilts of 51.5662 and 51.5662 deg, which are impossible": (
        lambda: observe([0.9, 0.9], kind=Inclination())
    ),
    "has tilts of 114.592 and 0 deg": lambda: observe([2.0, 0.0], kind=Inclination()),
    "has an angle of 91.6732 deg, at which the mirror faces away": (
        lambda: observe([0.0, 1.6], kind=Autocollimation())
    ),
    # shapes and numbers of observations
    r"measured values of kind 'component' \(x, y, z\) has shape \(2, 4\). Give .*\(2, 3\)": (
        lambda: observe_points(measured=np.zeros((2, 4)))
    ),
    "row 1, column 2 is inf. Give a finite number or NaN": (
        lambda: observe_points(measured=[[1.0, np.inf, 0.0], [0.0] * 3])
    ),
    "Give whole numbers of shape": lambda: observe_points(rows=[0.5, 1.0]),
    r"has shape \(2, 3\)": lambda: observe_points(rows=[0]),
    "covariance of row 1 has a variance that is not above 0": (
        lambda: observe_points(covariance=np.diag([1.0, 0.0, 1.0]))
    ),
    "covariance of row 1 is not positive definite": lambda: observe_correlated(2.0),
    "row 1 is not positive definite": lambda: observe_correlated(1.0),
    "row 1 is not symmetric": lambda: observe_correlated(0.5, 0.0),
    "covariance of row 2 is not positive definite": lambda: observe_points(
        covariance=[np.eye(3), np.eye(3) + 1.5 * np.eye(3)[[1, 0, 2]] * [1, 1, 0]]
    ),
    "weight of row 2 is -1": lambda: observe_points(weight=[1.0, -1.0]),
    "the weight: row 2 is nan": lambda: observe_points(weight=[1.0, np.nan]),
    r"covariance has shape \(2, 2\). Give \(2, 3, 3\) or \(3, 3\)": (
        lambda: observe_points(covariance=np.eye(2))
    ),
    r"the weight has shape \(3,\). Give one number for each of 2 rows": (
        lambda: observe_points(weight=[1.0, 1.0, 1.0])
    ),
    r"sigma has shape \(2,\). Give one number, or one for each of rx, ry, rz, x, y, z": (
        lambda: observe([0.0] * 6, kind=POSE, sigma=[1.0, 2.0])
    ),
    r"\(rx, ry, rz, x, y, z\) has shape \(1, 5\).* \(any, 6\)": lambda: observe(
        [0.0] * 5, kind=POSE
    ),
    # measurements and their readings
    "readings: row 1, column 2 is nan. Give a finite number": (
        lambda: record(readings=[[1.0, np.nan], [0.0, 0.0]])
    ),
    r"readings has shape \(2,\)": lambda: record(readings=[1.0, 2.0]),
    "have no pose": lambda: record(readings=np.empty((0, 2))),
    "row 2 of kind 'component' refers to pose 1, but the 1 poses are 0 to 0": (
        lambda: record(readings=[[1.0, 2.0]])
    ),
    "Give one whole number for each pose": lambda: record(block=np.array([1])),
    "1 labels for 2 poses": lambda: record(labels=("a",)),
    "sigma -1e-06 .* not a standard deviation": lambda: record_readings(-1e-6),
    "sigma nan .* not a standard deviation": lambda: record_readings(np.nan),
    "missing reading": lambda: record_readings(1e-6, (1.0, np.nan)),
    "one for each of the 2 actuators": lambda: record_readings(np.ones(3)),
    "column 2 is nan. Give a finite number, or": lambda: record_readings(None, (1.0, np.nan)),
    "column 2 is inf. Give a finite": lambda: record_readings(np.inf, (1.0, np.inf)),
    # sensors and their noise
    "the sigma of the noise contains 0": lambda: Gaussian(np.array([0.0])),
    "the sigma of the noise contains -1": lambda: Gaussian(np.array([-1.0])),
    "the sigma of the noise: row 1 is nan": lambda: Gaussian(np.array([np.nan])),
    "Give one for each of rx, ry, rz, x, y, z": lambda: Sensor(POSE, Gaussian(np.ones(1))),
    "at least one sensor": lambda: Instrument(()),
    "refers to pose 7, but the 4 poses are 0 to 3": (
        lambda: Sensor(BAR, Gaussian(np.ones(1)), rows=np.array([[0, 7]])).assign_rows(4)
    ),
    "compares two poses, but the number of poses is 1": (
        lambda: Sensor(BAR, Gaussian(np.ones(1))).assign_rows(1)
    ),
    # arguments of another type
    "readings: got the text 'data.csv'. Give an array": lambda: record(readings="data.csv"),
    "observations: got the text 'rows.csv'. Give Observations": (
        lambda: record(observations=("rows.csv",))
    ),
    "kind: got the text 'pose'. Give Kind, such as": lambda: observe_points(kind="pose"),
    r"\(x, y, z\): got the text 'data.csv'. Give an array": (
        lambda: Observations.from_sigma(POINTS, [0], "data.csv", 1.0)
    ),
    "noise: got a float. Give Noise, such as": (
        lambda: Sensor(POSE, 1e-5)  # type: ignore[arg-type]
    ),
    "robot: got the text 'hexapod-42'. Give Mechanism, as from loopcal.load_robot": (
        lambda: lc.sample_truth("hexapod-42", 1, 0)  # type: ignore[arg-type]
    ),
    "instrument: got the text 'pose'. Give Instrument": (
        lambda: lc.simulate(zoo.hexapod(), POSES, "pose", 1)  # type: ignore[arg-type]
    ),
    "got the text '1 um'. Give an array": lambda: Gaussian("1 um"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_invalid_input_is_refused_in_one_sentence(sentence):
    with pytest.raises(DataError, match=sentence):
        REFUSED[sentence]()


@pytest.mark.parametrize("kind", EXAMPLES)
def test_singular_covariance_and_duplicate_rows_are_refused(kind):
    kind = kind.with_tool(np.eye(4))
    T = geometry.apply_twist(np.eye(4), np.random.default_rng(0).uniform(-0.4, 0.4, (1, 3, 6)))
    rows = np.array([0, 1, 1]) if kind.poses_per_row == 1 else np.array([[0, 1], [1, 2], [1, 2]])
    m = len(kind.noise_columns)
    one = np.zeros((3, kind.label_count))
    measured = kind.measure(T[:, rows], np.zeros((1, 3, m)), labels=one)[0]
    with pytest.raises(DataError, match="the covariance of row 1"):
        Observations(kind, rows, measured, np.zeros((m, m)))
    twice = Observations.from_sigma(kind, rows, measured, 1e-4)
    data = Measurements("toy", np.arange(3.0)[:, None], (twice,))
    if np.ptp(measured, axis=0).any():
        with expect_refusal("data.duplicate-rows", DataError, poses=("2", "2"), kind=kind.name):
            check_duplicates(data)
    else:  # a number that never changes is equal without being copied
        check_duplicates(data)
    apart = Observations.from_sigma(kind, rows, measured, 1e-4, group=np.array(["a", "b", "c"]))
    check_duplicates(Measurements("toy", np.arange(3.0)[:, None], (apart,)))


@pytest.mark.parametrize("name", ["a,b", 'say "hello"', "Kügelchen №1", "日本"])
def test_names_of_targets_may_contain_any_text(name):
    kind = Position(targets=(name, "b"), places=np.zeros((2, 3)), unknown=("targets",))
    assert kind.columns[0].name == f"{name}.x"
    assert kind.nuisance_parameters[0].name == f"{name}.x"


SIZE = 0.3  # [m]


def collect(kind, values, sigma=1e-5):
    """Return measurements of one row for each pose."""
    n = len(values)
    rows = Observations.from_sigma(kind, np.arange(n), values, sigma)
    return Measurements("toy", np.arange(float(n))[:, None], (rows,))


def test_target_that_never_moves_is_refused_by_name():
    T = zoo.make_poses(np.random.default_rng(0).uniform(-0.1, 0.1, (8, 6)))
    kind = Position(targets=("a", "b"), places=0.1 * np.eye(3)[:2])
    noise = 1e-5 * np.random.default_rng(1).normal(size=(1, 8, 6))
    measured = kind.measure(T[None], noise)[0]
    check_targets_move(collect(kind, measured), T, SIZE)
    measured[:, 3:] = measured[0, 3:] + noise[0, :, 3:]
    data = collect(kind, measured)
    with pytest.raises(DataError) as error:
        check_targets_move(data, T, SIZE)
    assert error.value.code == "conventions.target-never-moves"
    found = error.value.args[0].data
    assert (found["target"], found["kind"]) == ("b", "position")
    assert found["moved"].value < 0.2 < found["expected"].value  # [mm]


FOLLOWING = [
    kind
    for cls in KINDS.values()
    for kind in cls.examples()[:1]
    if kind.changes_with_pose and kind.poses_per_row == 1
]


@pytest.mark.parametrize("kind", FOLLOWING, ids=lambda kind: kind.name)
def test_constant_values_are_refused_for_every_kind_that_follows_the_robot(kind):
    kind = kind.with_tool(np.eye(4))
    T = zoo.make_poses(
        np.random.default_rng(0).uniform(-0.1, 0.1, (8, 6)) + np.array([0, 0, 0, 0.1, 0.1, 0.0])
    )
    noise = 1e-6 * np.random.default_rng(1).normal(size=(1, 8, len(kind.noise_columns)))
    true, still = (
        kind.measure(poses[None], noise, labels=np.zeros((8, kind.label_count)))[0]
        for poses in (T, np.repeat(T[:1], 8, axis=0))
    )
    check_targets_move(collect(kind, true, 1e-6), T, SIZE)
    with expect_refusal("conventions.target-never-moves", DataError, kind=kind.name):
        check_targets_move(collect(kind, still, 1e-6), T, SIZE)


BALL_BAR = Distance(targets=("ball",), places=np.zeros((1, 3)), anchor=np.array([0.3, 0.0, 0.0]))
CONSTANT_BY_DESIGN = {
    "probed height": (Component(("z",)), [0.06, 0.06, 0.0]),
    "ball bar": (BALL_BAR, [0.06, 0.06, 0.0]),
    "level": (Inclination(), [0.06, 0.06, 0.06]),
}


@pytest.mark.parametrize("case", CONSTANT_BY_DESIGN)
def test_values_that_are_constant_by_design_are_accepted_and_frozen_ones_are_not(case):
    """The true machine keeps the value at these poses; by the nominal one it changes a little,
    since the machine is inaccurate.
    """
    kind, half = CONSTANT_BY_DESIGN[case]
    kind = kind.with_tool(np.eye(4))
    rng, n = np.random.default_rng(0), 12
    coordinates = np.zeros((n, 6))
    coordinates[:, :3] = rng.uniform(-1.0, 1.0, (n, 3)) * half
    if case == "ball bar":  # poses on a sphere about the anchor
        away = rng.uniform(-1.0, 1.0, (n, 3)) - [2.0, 0.0, 0.0]
        away *= 0.2 / np.linalg.norm(away, axis=1)[:, None]
        coordinates[:, :3] = BALL_BAR.anchor + away
    true = zoo.make_poses(coordinates)
    values = kind.measure(true[None], np.zeros((1, n, len(kind.noise_columns))))[0]
    assert np.ptp(values) < 1e-9
    data = collect(kind, values, 1e-6)
    error = np.zeros((n, 6))
    error[:, 3:] = 0.02 * coordinates[:, :3]  # [rad]: more than 1000 times the noise
    error[:, 2] = 0.03 * coordinates[:, 0]
    check_targets_move(data, zoo.make_poses(coordinates + error), SIZE)
    random = zoo.make_poses(rng.uniform(-0.1, 0.1, (n, 6)))
    with expect_refusal("conventions.target-never-moves", DataError):
        check_targets_move(data, random, SIZE)


@pytest.mark.parametrize(("tilt", "is_accepted"), [(0.12, True), (0.5, False)])
def test_heights_of_a_tilted_bed_are_constant_by_design(tilt, is_accepted):
    """End stops that are wrong by millimeters tilt the bed, here by more than a tenth of its size.
    A frozen display of heights, whose poses lie in no plane, is refused.
    """
    kind, n = Component(("z",)).with_tool(np.eye(4)), 12
    rng = np.random.default_rng(3)
    coordinates = np.zeros((n, 6))
    coordinates[:, :2] = 0.07 * rng.uniform(-1.0, 1.0, (n, 2))
    data = collect(kind, np.zeros((n, 1)), 2e-5)
    coordinates[:, 2] = 0.003 + tilt * coordinates[:, 0] + 0.5 * coordinates[:, 1] ** 2
    if is_accepted:
        check_targets_move(data, zoo.make_poses(coordinates), SIZE)
    else:
        with pytest.raises(DataError, match="never moves"):
            check_targets_move(data, zoo.make_poses(coordinates), SIZE)
    coordinates[:, 2] = 0.12 * rng.uniform(-0.1, 0.1, n)
    with pytest.raises(DataError, match="never moves"):
        check_targets_move(data, zoo.make_poses(coordinates), SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXAMPLES)
def test_poses_in_one_plane_give_unidentifiable_combinations_or_a_refusal(kind):
    """Poses without rotation at one height leave combinations unidentifiable in every kind.

    A kind whose frame cannot be found is refused instead.
    """
    robot = zoo.hexapod()
    flat = np.column_stack(
        [
            np.random.default_rng(0).uniform(-0.03, 0.03, (10, 2)),
            np.full(10, 0.2),
            np.zeros((10, 3)),
        ]
    )
    sensor = Sensor(kind, Gaussian(np.full(len(kind.noise_columns), 1e-5)))
    found, refused = None, ""
    try:
        found = identifiability(
            robot, simulate(robot, zoo.make_poses(flat), Instrument((sensor,)), 0)
        )
    except LoopcalError as error:
        refused = str(error)
    if found is None:
        assert any(words in refused for words in ("from points in one plane", "are one rotation"))
        return
    assert found.rank < found.n_parameters
    assert len(found.unidentifiable) == found.n_parameters - found.rank
    assert "fit.unidentifiable" in [f.code for f in found.findings]


@pytest.mark.parametrize("kind", [Plane(places=POINT), Line(places=POINT), JointSensor()])
def test_constant_values_are_accepted_for_surfaces_and_joints(kind):
    T = zoo.make_poses(np.random.default_rng(0).uniform(-0.1, 0.1, (8, 6)))
    data = collect(kind, np.zeros((8, len(kind.columns))))
    assert check_targets_move(data, T, SIZE) is None
