# SPDX-License-Identifier: Apache-2.0
"""Triangle drives: lengths between anchors, angles, derivatives, files and their mistakes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.errors import FileError, MechanismError
from loopcal.io.robot.robot_file import SHIPPED_ROBOTS
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.kinematics import forward_trials, locate_anchors
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_passive_joints, differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.transmission import (
    compute_angle,
    compute_length,
    compute_range,
    differentiate_length,
)
from loopcal.mechanism.workspace import sample_workspace
from tests.jacobians import check_jacobian
from tests.robot_texts import load_text
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]

ALL = "[offset, gain, foot, head, skew]"
TRIANGLE = "triangle: {foot: [0.6, 0.1, -0.4], head: [2.3, -0.2, 0.35], skew: {rx: 2, rz: -3}}"
LINK = f"""format: 1
family: stages
name: link
units: {{length: m, angle: deg}}
controlled: [pitch]
stages:
  - name: boom
    joint:
      kind: R
      axis: y
      start: -45
      drive:
        name: ram
        {TRIANGLE}
        gain: 0.98
        offset: 0.02
        stroke: [1.8, 2.8]
        unknown: {ALL}
"""


def measure_distance(angle: float, foot: Array, head: Array, skew: Array) -> float:
    """Return the distance of the anchors when the tilted y axis has turned by an angle [rad]."""
    tilt = Rotation.from_rotvec(skew)
    turn = tilt * Rotation.from_rotvec([0.0, angle, 0.0]) * tilt.inv()
    return float(np.linalg.norm(foot - turn.apply(head)))


def measure(robot: Mechanism, coordinates: Array) -> Measurements:
    """Return full poses at controlled coordinates (n, c), measured without error."""
    instrument = Instrument((Sensor(Pose("rotation-vector"), Gaussian(np.full(6, 1e-5))),))
    return simulate(robot, coordinates, instrument, 1, nuisance_values={})


# --- kinematics


def test_angle_of_a_skew_triangle_is_the_root_of_its_distance(tmp_path: Path) -> None:
    robot = load_text(tmp_path, LINK)
    for row in np.random.default_rng(1).normal(size=(20, 10)):
        names = [n.removeprefix("boom.ram.") for n in robot.parameters.names]
        change = dict(zip(names, 0.02 * row, strict=True))
        values = robot.values + 0.02 * row
        moved = {n: np.array([change[f"{n}.{axis}"] for axis in "xyz"]) for n in ("foot", "head")}
        foot = np.array([0.6, 0.1, -0.4]) + moved["foot"]
        head = np.array([2.3, -0.2, 0.35]) + moved["head"]
        tilted = np.array([change["skew.rx"], 0.0, change["skew.rz"]])
        skew = np.deg2rad([2.0, 0.0, -3.0]) + tilted
        reading = 2.3
        length = 0.02 + change["offset"] + (0.98 + change["gain"]) * reading
        angle = brentq(
            lambda a: measure_distance(a, foot, head, skew) - length,  # noqa: B023
            np.deg2rad(-130),
            np.deg2rad(35),
            xtol=1e-14,
        )
        T = forward(robot.with_values(values), [[reading]]).T[0]
        assert_allclose(T[:3, :3], Rotation.from_euler("y", angle).as_matrix(), atol=1e-12)


def test_solar_tracker_agrees_with_the_law_of_cosines() -> None:
    robot = load_cached_robot("solar-tracker")
    q = sample_workspace(robot, 200, seed=1).solution.q

    def open_triangle(a: Array, b: Array, c: Array, height: float) -> Array:
        return np.arccos((a**2 + b**2 + height**2 - c**2) / (2 * a * b))

    # azimuth: at zero the foot is a quarter turn before the head
    yaw = open_triangle(np.array(0.8), np.array(0.35), q[:, 0], 0.04) - np.pi / 2
    # elevation: angles of foot and head about y, from z to x
    foot, head = np.arctan2(-0.15, -1.0), np.arctan2(-0.9, -0.1)
    opening = open_triangle(np.hypot(0.15, 1.0), np.hypot(0.9, 0.1), q[:, 1], 0.0)
    pitch = foot - head + opening
    turns = Rotation.from_euler("ZY", np.column_stack([yaw, pitch]))
    T = forward(robot, q).T
    assert_allclose(T[:, :3, :3], turns.as_matrix(), rtol=0, atol=1e-12)
    center = np.array([0, 0, 2.3]) + turns.apply([0, 0, 0.15])
    assert_allclose(T[:, :3, 3], center, rtol=0, atol=1e-9 * robot.size)


def test_length_and_angle_are_inverse_on_both_sides_of_the_dead_points() -> None:
    rng = np.random.default_rng(2)
    for side in (1.0, -1.0):
        points = rng.normal(size=(50, 8)) * ([1.0] * 6 + [0.2] * 2)
        triangle = np.column_stack([points, np.full(50, side), np.zeros(50)])
        low, high = compute_range(triangle)
        length = low + (high - low) * rng.uniform(0.01, 0.99, 50)
        angle = compute_angle(length, triangle)
        assert_allclose(compute_length(angle, triangle), length, rtol=1e-13)
        # the arm of the force has the sign of the side: the length grows with the angle, or falls
        arm, _ = differentiate_length(angle, triangle)
        assert (np.sign(arm) == side).all()


def test_lengths_that_no_angle_reaches_are_unreachable() -> None:
    robot = load_cached_robot("solar-tracker")
    solution = forward(robot, [[0.8, 1.5], [1.25, 1.5], [0.8, 0.05], [np.nan, 1.5]])
    assert solution.status.tolist() == [
        Status.CONVERGED,
        Status.UNREACHABLE,
        Status.UNREACHABLE,
        Status.NOT_FINITE,
    ]
    # the residual is the length that is missing
    assert solution.residual[1] == pytest.approx(1.25 - np.sqrt(0.8**2 + 0.35**2 + 0.04**2 + 0.56))


# --- derivatives


def test_a_length_of_the_wrong_sign_is_unreachable() -> None:
    robot = load_cached_robot("solar-tracker")
    solution = forward(robot, [[0.8, 1.5], [-0.8, 1.5]])
    # the second was CONVERGED at the pose of the first, because only its square was used
    assert solution.status.tolist() == [Status.CONVERGED, Status.UNREACHABLE]
    assert solution.residual[1] > 0.8  # [m] at least the length itself is missing


def test_derivatives_of_the_angle_agree_with_differences_and_jax() -> None:
    terms = np.array([0.6, -0.4, 0.1, 2.3, 0.35, -0.2, 0.05, -0.08])
    constants = np.array([1.0, 1.0])
    length = 2.2

    def find_angle(x: Array) -> Array:
        return compute_angle(x[0] + 0 * x[:1], np.concatenate([x[1:], constants])[None])

    def find_angle_by_jax(x: Any) -> object:
        from jax import numpy

        triangle: Any = numpy.concatenate([x[1:], constants])[None]
        return compute_angle(x[0] + 0 * x[:1], triangle)

    point = np.array([length, *terms])
    arm, by_term = differentiate_length(find_angle(point), np.concatenate([terms, constants]))
    known = np.concatenate([1.0 / arm[:, None], -by_term / arm[:, None]], axis=1)
    check_jacobian(find_angle, known, point, scale=0.2, automatic=find_angle_by_jax)


def test_poses_and_pins_are_differentiated_by_every_dimension_of_a_triangle(tmp_path: Path) -> None:
    robot = load_text(tmp_path, LINK)
    values, q = robot.values, np.array([[[2.0], [2.6]]])
    state = forward_trials(robot, values[None], q)
    known = differentiate_pose(robot, values[None], q, state)
    pins = differentiate_passive_joints(robot, values[None], q, state)
    assert pins.names == ("boom.serial.joint",)

    def read_pin(x: Array) -> Array:
        return forward_trials(robot, x, q).joints[0][:, :, 0, 0]

    check_jacobian(
        read_pin, pins.parameters[0, :, 0], values, scale=0.05, is_batched=True, atol=1e-11,
        atol_reason="[rad] rounding",
    )  # fmt: skip
    # the platform turns about y as the pin does
    assert_allclose(known.parameters[0, :, 1], pins.parameters[0, :, 0], atol=1e-12)
    assert_allclose(known.readings[0, :, 1], pins.readings[0, :, 0], atol=1e-12)


# --- what can be determined


@pytest.mark.parametrize(("name", "triangles"), [("solar-tracker", 2), ("excavator", 3)])
def test_all_parameters_of_shipped_triangles_are_identified(name: str, triangles: int) -> None:
    robot = load_cached_robot(name)
    result = identifiability(robot, measure(robot, sample_workspace(robot, 30, seed=1).coordinates))
    assert result.rank == len(robot.parameters)
    assert sum("foot" in n or "head" in n for n in robot.parameters.names) == 3 * triangles


def test_a_triangle_has_four_numbers_and_the_others_are_named(tmp_path: Path) -> None:
    """The length is l^2 = a - b cos(theta - gamma): gamma, and with the gain s of the reading
    a / s^2, b / s^2 and offset / s.
    """
    robot = load_text(tmp_path, LINK)
    pitch = np.linspace(-1.6, -0.1, 40)[:, None]
    result = identifiability(robot, measure(robot, pitch))
    assert len(robot.parameters) == 10
    assert result.rank == 4
    assert len(result.unidentifiable) == 6


# --- other places of triangles

PLANAR = """format: 1
family: limbs
name: planar
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators:
  ram:
    triangle: {foot: [-250, 60, 0], head: [-40, 110, 0]}
    stroke: [150, 300]
    unknown: [offset, foot.x, foot.y, head.x]
    length: {sd: 0.2}
limbs:
  - name: arm
    ending: rigid
    chain:
      - {joint: R, name: motor, at: [300, 0, 0], axis: z, actuated: ram, start: 60}
      - {joint: R, name: elbow, at: [200, 0, 0], axis: z, start: 90}
      - {joint: R, name: wrist, at: [200, 0, 0], axis: z}
    attach: [80, 0, 0]
    copies: {count: 3}
    errors: [{of: motor, shift: [x, y], tolerance: {sd: 0.2}}]
home: {yaw: 10}
"""


def use_angle_drives(text: str) -> str:
    """Return a file with drives that read the angles of the joints."""
    return text.replace(
        "    triangle: {foot: [-250, 60, 0], head: [-40, 110, 0]}\n    stroke: [150, 300]\n"
        "    unknown: [offset, foot.x, foot.y, head.x]\n    length: {sd: 0.2}\n",
        "    reads: angle\n",
    )


def test_triangles_drive_the_first_joints_of_a_planar_machine(tmp_path: Path) -> None:
    robot = load_text(tmp_path, PLANAR)
    motors = load_text(tmp_path, use_angle_drives(PLANAR))
    poses = np.random.default_rng(3).uniform(-1, 1, (20, 3)) * [0.03, 0.03, 0.1]
    turned, pushed = inverse(motors, poses), inverse(robot, poses)
    assert pushed.converged.all()
    head = Rotation.from_rotvec([[0, 0, a] for a in turned.q.ravel()]).apply([-0.04, 0.11, 0])
    lengths = np.linalg.norm(head - [-0.25, 0.06, 0], axis=1).reshape(-1, 3)
    assert_allclose(pushed.q, lengths, rtol=0, atol=1e-12)
    back = forward(robot, pushed.q)
    assert_allclose(back.T, pushed.T, rtol=0, atol=1e-9 * robot.size)
    assert "ram2.foot.x" in robot.parameters.names
    result = identifiability(robot, measure(robot, poses))
    assert result.rank == len(robot.parameters)


def test_a_complete_model_contains_three_dimensions_of_each_triangle(tmp_path: Path) -> None:
    complete = PLANAR.replace("family: limbs\n", "family: limbs\nerror_model: complete\n") + (
        "tolerances: {lengths: {sd: 0.2}, angles: {sd: 0.05}}\n"
    )
    unnamed = complete.replace("    unknown: [offset, foot.x, foot.y, head.x]\n", "")
    unnamed = unnamed.replace("    length: {sd: 0.2}\n", "")
    named, found = load_text(tmp_path, complete), load_text(tmp_path, unnamed)
    motors = load_text(tmp_path, use_angle_drives(complete))
    # the head is 40 mm and 110 mm from the pin in x and y
    assert set(found.parameters.names) - set(motors.parameters.names) == {
        f"ram{i}.{name}" for i in (1, 2, 3) for name in ("foot.x", "foot.y", "head.y")
    }
    assert len(named.parameters) == len(found.parameters) + 3  # and head.x, which the file names
    poses = np.random.default_rng(3).uniform(-1, 1, (60, 3)) * [0.06, 0.06, 0.2]
    ranks = [identifiability(robot, measure(robot, poses)).rank for robot in (motors, found, named)]
    assert ranks == [ranks[0], ranks[0] + 9, ranks[0] + 9]


def test_anchors_in_pictures_are_as_far_apart_as_the_readings_say(tmp_path: Path) -> None:
    for robot in (load_cached_robot("excavator"), load_text(tmp_path, LINK)):
        q = inverse(robot, sample_or_home(robot)).q
        located = locate_anchors(robot, forward(robot, q).state)
        gains = [a.terms["gain"] for a in robot.actuators if a.is_triangle]
        offsets = [a.terms["offset"] for a in robot.actuators if a.is_triangle]
        for i, anchors in enumerate(located):
            distance = np.linalg.norm(np.diff(anchors.points[:, :, :], axis=1)[:, 0], axis=1)
            own = q[:, [a.name for a in robot.actuators].index(anchors.actuator)]
            assert_allclose(distance, offsets[i] + gains[i] * own, atol=1e-12)


def sample_or_home(robot: Mechanism) -> Array:
    """Return poses (n, 4, 4): of the workspace, or home."""
    if robot.assembly.workspace:
        return sample_workspace(robot, 3, seed=4).solution.T
    return robot.home[None]


# --- mistakes


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("foot: [0.6, 0.1, -0.4]", "foot: [0, 0.1, 0]", "triangle: an anchor is on the axis"),
        ("stroke: [1.8, 2.8]", "stroke: [1.8, 4]", "no angle of its joint reaches"),
        ("foot: [0.6", "feet: [0.6", "unknown key 'feet'"),
        ("[offset, gain", "[offset, fot.x, gain", "no term 'fot.x'"),
        ("[offset, gain", "[offset, foot.w, gain", "no term 'foot.w'"),
        ("[offset, gain", "[offset, skew.ry, gain", "about the joint's own axis"),
        ("start: -45", "start: -45\n      stroke: [0, 1]", "has 'stroke' besides the triangle"),
        ("start: -45", "start: -45\n      errors: [offset]", "errors: \\[offset\\]' beside"),
        ("kind: R", "kind: P", "'kind' is 'P'|kind' is 'P'"),
        ("gain: 0.98", "gain: 0.98\n        reads: angle", "reads"),
    ],
)
def test_impossible_triangles_are_refused_in_one_sentence(tmp_path, old, new, sentence):
    text = LINK.replace("skew: {rx: 2, rz: -3}", "skew: {}") if "foot: [0," in new else LINK
    assert old in text
    with pytest.raises((FileError, MechanismError), match=sentence) as error:
        load_text(tmp_path, text.replace(old, new, 1))
    assert "\n" not in str(error.value)


DEAD_POINT = LINK.replace(TRIANGLE, "triangle: {foot: [1, 0, 0], head: [1.2, 0, 0]}").replace(
    "start: -45", "start: 180"
)
SLIDE = PLANAR.replace("joint: R, name: motor", "joint: P, name: motor").replace(
    "axis: z, actuated: ram", "axis: y, actuated: ram"
)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [(DEAD_POINT, "180 deg, a dead point"), (SLIDE, "drives a joint that slides")],
)
def test_triangles_at_dead_points_and_of_slides_are_refused(tmp_path, text, sentence) -> None:
    with pytest.raises((FileError, MechanismError), match=sentence):
        load_text(tmp_path, text)


def test_all_strokes_that_no_angle_reaches_are_reported_at_once(tmp_path: Path) -> None:
    """Of three cylinders in stages two have strokes beyond their triangles."""
    text = (SHIPPED_ROBOTS / "excavator.yaml").read_text()
    text = text.replace("[2200, 3600]", "[22, 3600]").replace("[1800, 2750]", "[1800, 9999]")
    with pytest.raises((FileError, MechanismError)) as refusal:
        load_text(tmp_path, text)
    assert "stick-cylinder' contains the length 22 mm" in str(refusal.value)
    assert "bucket-cylinder' contains the length 9999 mm" in str(refusal.value)
