# SPDX-License-Identifier: Apache-2.0
"""Machines that outsiders described from the documentation, against equations written here."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.apply.inspection import inspect_robot
from loopcal.errors import FileError, MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.actuation import differentiate_at_pose, solve_at_pose
from loopcal.mechanism.chains import select_entries
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.over_constraint import find_over_constraint
from loopcal.mechanism.singularities import analyze_singularity
from loopcal.mechanism.solutions import forward, inverse, jacobian
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.robot_view import view_robot
from loopcal.results.tables import Table

ATOL = 1e-9  # [m, rad]: Newton stops below 1e-13 of the size; the rest is the condition
POSES = 100

# Peaucellier 1864: the platform is a point, and the three cranks turn.
PEAUCELLIER = """
format: 1
family: limbs
name: peaucellier
units: {length: mm, angle: deg}
freedoms: [x, y]
controlled: [y]
drives:
  crank: {reads: angle, stroke: [-60, 60], unknown: [offset], angle: {sd: 0.1}}
bodies: [{name: upper}, {name: lower}, {name: arm}]
limbs:
  - {name: a, to: upper, ending: rigid, chain: [{joint: R, name: pin, start: 25}]}
  - {name: b, to: lower, ending: rigid, chain: [{joint: R, name: pin, start: -25}]}
  - {name: c, to: arm, ending: rigid, chain: [{joint: R, name: pin, at: [80, 0, 0],
     actuated: crank}]}
  - {name: ac, on: upper, to: arm, tip: [250, 0, 0], attach: [80, 0, 0], ending: distance,
     length: 120}
  - {name: bc, on: lower, to: arm, tip: [250, 0, 0], attach: [80, 0, 0], ending: distance,
     length: 120}
  - {name: ap, on: upper, tip: [250, 0, 0], ending: distance, length: 120}
  - {name: bp, on: lower, tip: [250, 0, 0], ending: distance, length: 120}
home: {x: 300}
workspace: {y: [-100, 100]}
"""

# A level-luffing crane: the hook does not turn, boom and jib do. The winch pays out the rope from
# the mast to the jib's head and on to the hook.
CRANE = """
format: 1
family: stages
name: crane
units: {length: m, angle: deg}
controlled: [x, y, z]
stages:
  - name: slew
    joint: {kind: R, stroke: [-180, 180], start: 20, errors: [offset]}
  - name: luff
    family: limbs
    freedoms: [x, z]
    controlled: [x, z]
    home: {x: 22, z: 10.3}
    bodies: [{name: boom}, {name: jib}]
    drives:
      rod: {reads: length, sum: {rod: 1}, stroke: [4, 12]}
      winch: {reads: angle, radius: 0.4, sum: {stay: 1, rope: 1}, stroke: [0, 30000]}
    limbs:
      - {name: pivot, to: boom, ending: rigid, chain: [{joint: R, name: pin, at: [2, 0, 8],
         axis: y, start: -60}]}
      - {name: apex, on: boom, to: jib, ending: rigid, chain: [{joint: R, name: pin, at: [20, 0,
         0], axis: y, start: 60}]}
      - {name: tie, tip: [-1, 0, 14], to: jib, attach: [-5, 0, 1], ending: distance, length: 14.7}
      - {name: rod, tip: [-1, 0, 10], to: boom, attach: [8, 0, 1], ending: distance, actuated: rod}
      - {name: stay, tip: [-1.2, 0, 14.5], to: jib, attach: [-4.8, 0, 1.5], ending: distance,
         actuated: stay}
      - name: hook
        on: jib
        ending: rigid
        chain:
          - {joint: R, name: sheave, at: [10, 0, 0], axis: y}
          - {joint: P, name: rope, axis: -z, actuated: rope, start: 15}
workspace: {x: [12, 24], y: [-12, 12], z: [2, 12]}
"""


def load(text: str, folder: Path) -> Mechanism:
    file = folder / "machine.yaml"
    file.write_text(text)
    return load_robot(file)


def test_cranks_of_a_point_turn_and_draw_a_straight_line(tmp_path: Path) -> None:
    robot = load(PEAUCELLIER, tmp_path)
    q = np.linspace(-1.0, 1.0, POSES)[:, None]
    joint = 0.08 * np.stack([1 + np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    square = np.sum(joint**2, axis=1, keepdims=True)
    point = joint * (0.25**2 - 0.12**2) / square  # the inverse of a circle through the center
    solution = forward(robot, q)
    assert_allclose(solution.T[:, :2, 3], point, rtol=0, atol=ATOL)
    assert_allclose(point[:, 0], (0.25**2 - 0.12**2) / 0.16, rtol=0, atol=1e-15)
    assert_allclose(inverse(robot, point[:, 1:]).q, q, rtol=0, atol=ATOL)
    speed = 0.5 * point[0, 0] / np.cos(q[:, 0] / 2) ** 2  # y = x tan(q / 2)
    assert_allclose(jacobian(robot, q).readings[:, 4, 0], speed, rtol=0, atol=ATOL)


def test_hook_of_a_crane_hangs_where_boom_jib_and_rope_put_it(tmp_path: Path) -> None:
    robot = load(CRANE, tmp_path)
    q = sample_workspace(robot, POSES, 3).solution.q
    solution = forward(robot, q)
    hook = solution.T[:, :3, 3]
    assert_allclose(hook[:, 1], hook[:, 0] * np.tan(q[:, 0]), rtol=0, atol=1e-8)  # [m], at 24 m
    angles = solution.passive[:, [solution.passive_names.index(n) for n in PINS]]
    boom, jib = angles[:, 0], angles.sum(axis=1)

    def turn(a: np.ndarray, x: float, z: float) -> np.ndarray:
        return np.stack([x * np.cos(a) + z * np.sin(a), z * np.cos(a) - x * np.sin(a)], axis=1)

    def measure(points: np.ndarray, x: float, z: float) -> np.ndarray:
        return np.linalg.norm(points - [x, z], axis=1)

    pivot = np.array([2.0, 8.0])
    apex = pivot + turn(boom, 20.0, 0.0)
    head = apex + turn(jib, 10.0, 0.0)
    tie, stay = apex + turn(jib, -5.0, 1.0), apex + turn(jib, -4.8, 1.5)
    assert_allclose(measure(tie, -1.0, 14.0), 14.7, rtol=0, atol=1e-8)
    assert_allclose(measure(pivot + turn(boom, 8.0, 1.0), -1.0, 10.0), q[:, 1], rtol=0, atol=1e-8)
    radius = np.hypot(hook[:, 0], hook[:, 1])
    assert_allclose(head[:, 0], radius, rtol=0, atol=1e-8)
    rope = head[:, 1] - hook[:, 2] + measure(stay, -1.2, 14.5)
    assert_allclose(rope, 0.4 * q[:, 2], rtol=0, atol=1e-8)


PINS = ("luff.pivot.pin", "luff.apex.pin")


def test_a_spool_moves_its_cable_as_much_as_a_drive_that_reads_the_length(tmp_path: Path) -> None:
    spool = load(CRANE, tmp_path)
    length = load(CRANE.replace("reads: angle, radius: 0.4", "reads: length"), tmp_path)
    margins = [
        analyze_singularity(robot, inverse(robot, robot.home[None])).drive_margin
        for robot in (spool, length)
    ]
    assert_allclose(margins[0], margins[1], rtol=1e-9)
    assert margins[0][0] > 0.1  # [m/m] of the winch alone: 1


# Three cables move a point of the plane, each over a pulley from its winch.
PULLEYS = """
format: 1
family: limbs
name: pulleys
units: {length: mm, angle: deg}
freedoms: [x, y]
controlled: [x, y]
drives:
  w: {reads: length, sum: {c: 1}, radius: {b: 40}, sigma: 0.2, unknown: [offset], length: {sd: 2}}
limbs:
  - name: cable
    copies: {count: 3}
    chain:
      - {joint: R, name: pulley, at: [900, 0, 0], axis: -z, actuated: b, start: 180}
      - {joint: P, name: wire, at: [0, 40, 0], axis: x, actuated: c, start: 850}
    ending: ball
    errors: [{of: pulley, shift: [x, y], tolerance: {sd: 1}}]
workspace: {x: [-250, 250], y: [-250, 250]}
"""


# The same machine, with winches as bodies that a coupling ties to tangent and arc.
WINCHES = (
    PULLEYS.replace(" sum: {c: 1}, radius: {b: 40},", "")
    .replace(", actuated: b", "")
    .replace(", actuated: c", "")
    .replace(
        "limbs:",
        """couplings:
  pay: {of: length, sum: {w: 1, cable.wire: -1}, radius: {cable.pulley: -40}}
bodies: [{name: winch, copies: {count: 3}}]
limbs:
  - name: drum
    to: winch
    ending: rigid
    copies: {count: 3}
    chain: [{joint: P, name: slide, axis: x, actuated: w, start: 1000}]""",
    )
)


def measure_cables(points: np.ndarray) -> np.ndarray:
    """Return tangents plus arcs (n, 3) [m] of points (n, 2) [m]."""
    lengths = []
    for i in range(3):
        a = 2 * np.pi / 3 * i
        c, s = np.cos(a), np.sin(a)
        x, y = c * points[:, 0] + s * points[:, 1] - 0.9, c * points[:, 1] - s * points[:, 0]
        tangent = np.sqrt(x**2 + y**2 - 0.04**2)
        turned = np.arctan2(0.04, tangent) - np.arctan2(y, x)
        lengths.append(tangent + 0.04 * (turned % (2 * np.pi)))
    return np.stack(lengths, axis=1)


BOTH = pytest.mark.parametrize("text", [PULLEYS, WINCHES], ids=["sums", "couplings"])


@BOTH
def test_cables_over_pulleys_are_tangents_and_arcs(text: str, tmp_path: Path) -> None:
    robot = load(text, tmp_path)
    points = sample_workspace(robot, POSES, 3).coordinates
    q = measure_cables(points)
    assert_allclose(inverse(robot, points).q, q, rtol=0, atol=ATOL)
    assert_allclose(forward(robot, q).T[:, :2, 3], points, rtol=0, atol=ATOL)


@BOTH
def test_readings_over_pulleys_follow_the_pose_with_exact_derivatives(
    text: str, tmp_path: Path
) -> None:
    robot = load(text, tmp_path)
    solution = sample_workspace(robot, 5, 3).solution
    values, T, step = robot.values[None], solution.state.T, 1e-6  # [m, rad]
    moved = differentiate_at_pose(robot, values, solution.q[None], solution.state)

    bodies = len(moved.names) - 12 * len(robot.assembly.bodies)  # behind the passive joints
    slopes = [
        np.concatenate([of_readings, of_passive[:, :, bodies:]], axis=2)
        for of_readings, of_passive in zip(moved.readings, moved.passive, strict=True)
    ]

    def read(change: np.ndarray, shift: np.ndarray) -> np.ndarray:
        at = T.copy()
        at[..., :2, 3] += shift
        state, q = solve_at_pose(robot, values + change, at, solution.state)
        return np.dstack([q, *select_entries(robot, state).values()])

    p, still = len(robot.parameters), np.zeros(2)
    for i, change in enumerate(step * np.eye(p)):
        difference = (read(change, still) - read(-change, still)) / (2 * step)
        assert_allclose(slopes[0][..., i], difference, rtol=0, atol=1e-8)
    for i, shift in enumerate(step * np.eye(2)):
        difference = (read(np.zeros(p), shift) - read(np.zeros(p), -shift)) / (2 * step)
        assert_allclose(slopes[1][..., i], difference, rtol=0, atol=1e-8)


@pytest.mark.slow
@BOTH
def test_cables_over_pulleys_calibrate_themselves(text: str, tmp_path: Path) -> None:
    robot = load(text, tmp_path)
    points = sample_workspace(robot, 40, 3).coordinates
    place = Sensor(Position(), Gaussian(np.full(3, 1e-4)), rows=np.arange(6))
    instrument = Instrument((place, Sensor(Closure(), Gaussian(np.zeros(0)))))
    options = FitOptions(method=MAP(), sigma_uncertainty=0.0)
    z = []
    for i, truth in enumerate(sample_truth(robot, 20, seed=11)):
        data = simulate(robot.with_values(truth), points, instrument, 100 + i)
        fit = identify(robot, data, options=options)
        z.append((fit.estimate - truth) / fit.standard_deviations)
    # 20 machines of 9 parameters: three standard deviations of their rms, 0.053
    assert_allclose(np.sqrt(np.mean(np.square(z))), 1.0, rtol=0, atol=0.16)


# A planar robot with a redundant fourth leg.
FOUR_LEGS = """
format: 1
family: limbs
name: four-legs
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
drives:
  q: {reads: angle, sigma: 0.005, unknown: [offset], angle: {sd: 0.3}}
limbs:
  - name: leg
    copies: {count: 4}
    chain: [{joint: R, name: motor, at: {x: 320, yaw: 130}, actuated: q}]
    tip: [200, 0, 0]
    ending: distance
    length: 190
    attach: [70, 10, 0]
"""


def test_gaps_of_redundant_motors_are_lengths(tmp_path: Path) -> None:
    offsets = np.deg2rad([[0.24, -0.24, 0.24, -0.24]])  # contradict each other
    small, large = (load(FOUR_LEGS.replace("mm", unit), tmp_path) for unit in ("mm", "in"))
    homes = [inverse(robot, robot.home[None]).q for robot in (small, large)]
    assert_allclose(homes[0], homes[1], rtol=0, atol=ATOL)
    ends = [forward(robot, homes[0] + offsets) for robot in (small, large)]
    assert all(end.converged.all() for end in ends)
    assert_allclose(ends[1].residual, 25.4 * ends[0].residual, rtol=1e-9)
    assert ends[0].residual[0] < 4 * 0.2 * np.deg2rad(0.24) * 3  # [m], cranks of 0.2 m


# A delta whose arms are bodies: the platform does not turn, the arms do.
ARMS = """
format: 1
family: limbs
name: arms
units: {length: mm, angle: deg}
freedoms: [x, y, z]
controlled: [x, y, z]
bodies: [{name: arm, copies: {count: 3}}]
limbs:
  - name: shoulder
    to: arm
    ending: rigid
    copies: {count: 3}
    chain: [{joint: R, name: motor, at: [200, 0, 0], axis: y, actuated: q, start: 20}]
  - name: rod
    on: arm
    tip: [300, 0, 0]
    attach: [60, 0, 0]
    ending: distance
    length: 800
    copies: {count: 3}
drives: {q: {reads: angle, stroke: [-60, 90], unknown: [offset], angle: {sd: 0.1}}}
home: {z: -750}
workspace: {x: [-150, 150], y: [-150, 150], z: [-800, -700]}
"""


def test_arms_of_a_delta_turn_although_its_platform_does_not(tmp_path: Path) -> None:
    robot = load(ARMS, tmp_path)
    q = sample_workspace(robot, POSES, 3).solution.q
    T = forward(robot, q).T
    assert_allclose(T[:, :3, :3], np.tile(np.eye(3), (POSES, 1, 1)), rtol=0, atol=1e-15)
    for i, angle in enumerate(2 * np.pi / 3 * np.arange(3)):
        radius = 0.2 + 0.3 * np.cos(q[:, i]) - 0.06
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        elbow = radius[:, None] * axis - np.stack([0 * q[:, i]] * 2 + [0.3 * np.sin(q[:, i])], 1)
        rods = np.linalg.norm(T[:, :3, 3] - elbow, axis=1)
        assert_allclose(rods, 0.8, rtol=0, atol=ATOL)


# A table on a trunnion that its motor turns over gears; three of its legs grow.
TRUNNION = """
format: 1
family: stages
name: trunnion
units: {length: mm, angle: deg}
controlled: [x, y, z, roll, pitch, yaw]
conditions: {temperature.legs: {reference: 20, range: [15, 35]}}
couplings:
  grow: {of: length, sum: {table.a.stretch: 1}, condition: temperature.legs, slope: 0.004,
    unknown: [slope], slopes: {sd: 0.0008}}
  still: {of: length, sum: {table.b.stretch: 1}}
  gear: {sum: {motor: 1, trunnion.serial.joint: -50}, unknown: [offset], angle: {sd: 3}}
stages:
  - {name: motor, joint: {kind: R, axis: y, stroke: [-1500, 1500], at: [0, 400, 0]}}
  - {name: trunnion, on: base, joint: {kind: R, axis: x, drive: none, errors: [y, z]}}
  - name: table
    mount: {z: 50}
    family: limbs
    controlled: [x, y, z, roll, pitch, yaw]
    home: {z: 260}
    drives: {q: {reads: length, stroke: [-60, 60], unknown: [offset], length: {sd: 0.1}}}
    limbs:
      - name: a
        copies: &copies {count: 3}
        chain:
          - &slide {joint: P, name: slide, at: [200, 40, 0], axis: z, actuated: q1}
          - {joint: U, name: low}
          - &stretch {joint: P, name: stretch, axis: z}
        tip: &tip [0, 0, 300]
        ending: ball
        attach: [60, 90, 0]
      - name: b
        copies: *copies
        chain: [{<<: *slide, at: [200, -40, 0], actuated: q2}, {joint: U, name: low}, *stretch]
        tip: *tip
        ending: ball
        attach: [60, -90, 0]
workspace: {x: [-20, 20], y: [-20, 20], z: [290, 320], roll: [-8, 8], pitch: [-5, 5], yaw: [-5, 5]}
tolerances: {lengths: {sd: 0.1}}
"""


def test_copied_legs_of_a_stage_grow_on_a_geared_trunnion(tmp_path: Path) -> None:
    nominal = load(TRUNNION, tmp_path)
    robot = nominal.with_values(sample_truth(nominal, 1, seed=4)[0])
    value = dict(zip(robot.parameters.names, robot.values, strict=True))
    reached = inverse(robot, sample_workspace(nominal, POSES, 3).coordinates)
    assert reached.converged.all()
    q = np.array(reached.q)
    q[:, 7] = np.linspace(15, 35, POSES)
    T = forward(robot, q).T
    angle = (q[:, 0] - value["gear.offset"]) / 50
    c, s, one = np.cos(angle), np.sin(angle), np.ones(POSES)
    turned = np.stack([one, 0 * c, 0 * c, 0 * c, c, -s, 0 * c, s, c], axis=1).reshape(-1, 3, 3)
    axis = np.array([0.0, value["trunnion.y"], value["trunnion.z"]])
    for k, side in (("a", 1), ("b", -1)):
        for i in range(3):
            a = 2 * np.pi / 3 * i
            Rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
            column = [x.name for x in robot.actuators].index(f"q{1 if side > 0 else 2}{i + 1}")
            lift = q[:, column] + value[f"table.q{1 if side > 0 else 2}{i + 1}.offset"] + 0.05
            foot = np.outer(one, Rz @ [0.2, side * 0.04, 0]) + np.outer(lift, [0, 0, 1])
            foot = axis + np.einsum("nij,nj->ni", turned, foot)
            head = T[:, :3, 3] + T[:, :3, :3] @ (Rz @ [0.06, side * 0.09, 0])
            slope = value[f"grow{i + 1}.slope"] if k == "a" else 0.0
            length = np.linalg.norm(head - foot, axis=1)
            assert_allclose(length, 0.3 + slope * (q[:, 7] - 20), rtol=0, atol=ATOL)


@pytest.mark.parametrize(
    ("text", "old", "new", "sentence"),
    [(WINCHES, "  pay:", "  w:", "coupling 'w' has the name 'w1' of another row")],
)
def test_names_that_mean_two_things_are_refused(tmp_path, text, old, new, sentence) -> None:
    text = text.replace("of: pulley,", "of: tip,")
    with pytest.raises((FileError, MechanismError), match=sentence):
        load(text.replace(old, new), tmp_path)


# Two arms with two motors each hold a plate, which needs three.
TWO_ARMS = """
format: 1
family: limbs
name: two-arms
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
drives: {a: {reads: angle, sigma: 0.01, unknown: [offset], angle: {sd: 0.2}}}
limbs:
  - name: left
    ending: rigid
    chain:
      - {joint: R, name: s, at: [-200, 0, 0], actuated: a1, start: 100}
      - {joint: R, name: e, at: [200, 0, 0], actuated: a2, start: -60}
      - {joint: R, name: p, at: [200, 0, 0], start: -40}
    attach: [-50, 0, 0]
  - name: right
    ending: rigid
    chain:
      - {joint: R, name: s, at: [200, 0, 0], actuated: a3, start: 80}
      - {joint: R, name: e, at: [200, 0, 0], actuated: a4, start: 60}
      - {joint: R, name: p, at: [200, 0, 0], start: -140}
    attach: [50, 0, 0]
home: {y: 310}
workspace: {x: [-50, 50], y: [290, 340], yaw: [-8, 8]}
"""


def test_two_motors_of_one_limb_may_be_redundant(tmp_path: Path) -> None:
    robot = load(TWO_ARMS, tmp_path)
    reached = sample_workspace(robot, POSES, 3).solution
    x, y = reached.T[:, :2, 3].T
    yaw = np.arctan2(reached.T[:, 1, 0], reached.T[:, 0, 0])
    for side, (first, second) in ((-1, reached.q[:, :2].T), (1, reached.q[:, 2:].T)):
        tip = side * 0.2 + 0.2 * np.exp(1j * first) + 0.2 * np.exp(1j * (first + second))
        assert_allclose(tip, x + 1j * y + side * 0.05 * np.exp(1j * yaw), rtol=0, atol=ATOL)
    assert_allclose(forward(robot, reached.q).T, reached.T, rtol=0, atol=ATOL)
    turned = reached.q + 1e-4 * np.eye(4)[0]  # contradicts the others, which share the error
    assert 0.0 < np.abs(forward(robot, turned).T - reached.T).max() < 3e-4


def test_gaps_of_a_spherical_machine_are_angles(tmp_path: Path) -> None:
    text = """
format: 1
family: limbs
name: wrist
units: {length: mm, angle: deg}
freedoms: [rx, ry, rz]
controlled: [roll, pitch, yaw]
drives: {m: {reads: angle, sigma: 0.01, unknown: [offset], angle: {sd: 0.2}}}
limbs:
  - name: crank
    copies: {count: 4, about: z}
    ending: rigid
    chain:
      - {joint: R, name: motor, axis: [1, 0, -0.4], actuated: m}
      - {joint: R, name: elbow, axis: [0, 1, 0.2]}
      - {joint: R, name: pin, axis: [0.3, 0, 1]}
"""
    robot = load(text, tmp_path)
    solution = forward(robot, 1e-3 * np.array([[1.0, -1.0, 1.0, -1.0]]))  # contradict each other
    assert_allclose(solution.residual, 2e-3 * robot.size, rtol=1e-3)  # four times a mrad
    assert "mrad" in repr(solution)
    assert "mrad" in str(robot.describe_gap(solution.residual[0]))


# A delta whose parallelograms turn on pins about upper and lower cross bars (3-RRPaR).
CROSS_BARS = """
format: 1
family: limbs
name: cross-bars
units: {length: mm, angle: deg}
freedoms: [x, y, z]
controlled: [x, y, z]
bodies: [{name: upper, copies: {count: 3}}, {name: lower, copies: {count: 3}}]
drives: {q: {reads: angle, stroke: [-30, 80], unknown: [offset, gain], angle: {sd: 0.2}}}
limbs:
  - name: arm
    to: upper
    ending: rigid
    copies: {count: 3}
    chain:
      - {joint: R, name: motor, at: [150, 0, 0], axis: y, actuated: q, start: 20}
      - {joint: R, name: elbow, at: [200, 0, 0], axis: y, start: 80}
  - name: left
    on: upper
    to: lower
    ending: rigid
    copies: {count: 3}
    chain: [{joint: R, name: top, at: [0, 40, 0]}, {joint: R, name: bottom, at: [450, 0, 0]}]
    attach: [0, 40, 0]
  - {name: right, on: upper, to: lower, tip: [0, -40, 0], attach: [0, -40, 0], ending: distance,
     length: 450, copies: {count: 3}}
  - {name: foot, on: lower, ending: rigid, copies: {count: 3}, attach: [60, 0, 0],
     chain: [{joint: R, name: pin, axis: y, start: -100}]}
home: {z: -450}
workspace: {x: [-100, 100], y: [-100, 100], z: [-500, -420]}
"""


def test_bars_between_pins_are_rods_of_a_delta(tmp_path: Path) -> None:
    nominal = load(CROSS_BARS, tmp_path)
    robot = nominal.with_values(sample_truth(nominal, 1, seed=5)[0])
    value = dict(zip(robot.parameters.names, robot.values, strict=True))
    reached = inverse(robot, sample_workspace(nominal, POSES, 3).coordinates)
    T = forward(robot, reached.q).T
    for i, turn in enumerate(np.exp(2j * np.pi / 3 * np.arange(3))):
        angle = value[f"q{i + 1}.gain"] * reached.q[:, i] + value[f"q{i + 1}.offset"]
        apart = T[:, 0, 3] + 1j * T[:, 1, 3] - (0.15 + 0.2 * np.cos(angle) - 0.06) * turn
        assert_allclose(np.hypot(abs(apart), T[:, 2, 3] + 0.2 * np.sin(angle)), 0.45, atol=ATOL)
    # lower bars cannot turn about their rods or upright: platform and parallelogram prevent it
    finding = find_over_constraint(nominal)
    assert finding is not None
    repeated = finding.data["repeated"]
    for i, entry in enumerate(repeated, start=1):
        others = (f"arm{i}", f"left{i}", f"right{i}")
        assert (entry["limb"], entry["others"]) == (f"foot{i}", others)
        assert [direction["turns"] for direction in entry["directions"]] == [True, True]
    assert len(repeated) == 3


def test_weights_of_turning_joints_in_a_length_are_shown_per_radian(tmp_path: Path) -> None:
    page = view_robot(
        inspect_robot(load(WINCHES.replace("pulley: -40}", "pulley: -40.5}"), tmp_path))
    )
    sums = next(block for block in page if isinstance(block, Table) and "Sums" in block.caption)
    assert ("pay1", "w1 - cable1.wire - 40.5 mm/rad cable1.pulley") in sums.rows
