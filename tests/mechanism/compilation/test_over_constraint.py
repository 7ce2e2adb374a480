# SPDX-License-Identifier: Apache-2.0
"""Over-constrained machines: repeated equations, what opens loops, the least-squares closure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import engine, geometry
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.engine.numpy_engine import newton
from loopcal.errors import MechanismError
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.joint_release import propose_added_joints
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.over_constraint import (
    find_breaking_parameters,
    find_nearby_states,
    find_over_constraint,
    fix_breaking_parameters,
    is_over_constrained,
)
from loopcal.mechanism.platform_coordinates import compare_coordinates
from loopcal.mechanism.sensitivity import differentiate_passive_joints, differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status, driven_values
from tests.over_constrained import (
    EXECHON,
    FOUR_BAR,
    RAILS,
    THREE_RRR,
    TWO_FOUR_BARS,
    close_by_least_squares,
    put_on_wrist,
    solve_exechon,
)
from tests.robot_texts import load_text
from tests.zoo import move_base, place

BOTH = pytest.mark.parametrize("text", [EXECHON, FOUR_BAR], ids=["exechon", "four-bar"])
OPEN = pytest.mark.parametrize(
    "text", [EXECHON, FOUR_BAR, TWO_FOUR_BARS], ids=["exechon", "four-bar", "two-four-bars"]
)


def get_data(robot: Mechanism) -> dict:
    """Return the data of the finding of repeated equations."""
    finding = find_over_constraint(robot)
    assert finding is not None
    return dict(finding.data)


def name_axis(turns: bool, name: str) -> dict:
    """Return a repeated direction along an axis of the base."""
    return {"turns": turns, "name": name, "vector": ()}


def test_second_limb_of_an_exechon_head_repeats_a_translation_and_a_rotation(tmp_path):
    data = get_data(load_text(tmp_path, EXECHON))
    assert (data["count"], data["tolerance"], data["freedoms"]) == (2, 1e-9, ())
    # both limbs are in the plane y = 0 and turn about x and y only
    directions = (name_axis(False, "y"), name_axis(True, "z"))
    assert data["repeated"] == ({"limb": "right", "others": ("left",), "directions": directions},)


def test_four_bar_in_space_repeats_what_its_plane_needs_once(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FOUR_BAR)
    data = get_data(robot)
    directions = (name_axis(False, "y"), name_axis(True, "x"), name_axis(True, "z"))
    assert data["repeated"] == ({"limb": "rocker", "others": ("crank",), "directions": directions},)
    # at home it moves along x alone; on its way it also turns and moves along z
    assert data["freedoms"] == ("ry", "x", "z")
    flat = build(replace(robot.assembly, freedoms=data["freedoms"]))
    assert find_over_constraint(flat) is None
    q = np.deg2rad(np.linspace(-20, 20, 9))[:, None]
    assert_allclose(forward(flat, q).T, forward(robot, q).T, atol=1e-12)


def test_directions_of_a_machine_at_any_angle_are_vectors(tmp_path: Path) -> None:
    robot = load_text(tmp_path, EXECHON)
    turned = place((0.1, -0.2, 0.3), (0.4, 0.5, -0.6))
    moved = build(replace(move_base(robot.assembly, turned), controlled=("x", "y", "z")))
    (entry,) = get_data(moved)["repeated"]
    shift, turn = entry["directions"]
    for direction, axis in ((shift, turned[:3, 1]), (turn, turned[:3, 2])):
        assert abs(np.abs(np.dot(direction["vector"], axis)) - 1) < 1e-3  # vectors have 3 digits
    assert (shift["turns"], turn["turns"]) == (False, True)


@BOTH
def test_loops_stay_closed_with_other_values_exactly_of_parameters_that_are_not_named(
    text: str, tmp_path: Path
) -> None:
    robot = load_text(tmp_path, text)
    breaking = find_breaking_parameters(robot)
    near = find_nearby_states(robot)
    q = driven_values(robot.program, near)
    assert q.shape[1] == 5  # home and four poses near it
    table, closes = robot.parameters, []
    for i in range(len(table)):
        values = table.nominal.copy()
        values[i] += 5 * table.tolerance[i]
        state = forward_trials(robot, values[None], q, near, follow=False)
        closes.append(bool((state.status == Status.CONVERGED).all()))
    opened = tuple(name for name, ok in zip(table.names, closes, strict=True) if not ok)
    assert opened == breaking
    assert 0 < len(breaking) < len(table)
    assert find_breaking_parameters(fix_breaking_parameters(robot)) == ()


@BOTH
def test_errors_that_open_the_loops_are_neither_drawn_nor_identified(text, tmp_path):
    robot = load_text(tmp_path, text)
    with pytest.raises(MechanismError) as refusal:
        sample_truth(robot, 1, 0)
    assert refusal.value.code == "mechanism.drawn-errors-open-loops"
    instrument = Instrument((Sensor(Pose(), Gaussian(np.array([50e-6] * 3 + [1e-5] * 3))),))
    data = simulate(robot, robot.home[None], instrument, 0)
    with pytest.raises(MechanismError) as refusal:
        identifiability(robot, data)
    assert refusal.value.code == "mechanism.free-parameters-open-loops"
    assert find_breaking_parameters(robot)[0] in str(refusal.value)
    rest = fix_breaking_parameters(robot)
    assert np.isfinite(sample_truth(rest, 2, 0)).all()
    assert identifiability(rest, data).n_parameters == int(rest.parameters.free.sum())


def draw(robot: Mechanism, poses: int) -> tuple[np.ndarray, np.ndarray]:
    """Return values (2, p) of drawn errors, and readings (1, n, a) of poses in the workspace."""
    ranges = np.array(list(robot.assembly.workspace.values()))
    asked = np.random.default_rng(3).uniform(ranges[:, 0], ranges[:, 1], (poses, len(ranges)))
    return sample_truth(robot, 2, 5), inverse(robot, asked).q[None]


def test_least_squares_closure_agrees_with_an_independent_minimization(tmp_path: Path) -> None:
    robot = load_text(tmp_path, close_by_least_squares(EXECHON))
    values, q = draw(robot, 2)
    state = forward_trials(robot, values, q)
    assert (state.status == Status.CONVERGED).all()
    assert (state.residual > 1e-5).all()  # [m] the loops are open
    for t, n in ((0, 0), (1, 1)):
        own = solve_exechon(robot, values[t], q[0, n], state.T[t, n])
        assert_allclose(state.T[t, n], own, atol=1e-9 * robot.size)  # [m, rad]


@BOTH
def test_engines_agree_on_the_least_squares_closure(text: str, tmp_path: Path) -> None:
    robot = load_text(tmp_path, close_by_least_squares(text))
    values, q = draw(robot, 7)
    e, _ = robot.slots(values)
    joints = q + robot.slots(values)[1].tau[:, None, :, 0]  # the offset is the first term
    own = newton.solve(robot.program, e, joints, robot.home_state)
    other = engine.solve(robot.program, e, joints, robot.home_state)
    assert (own.status == engine.CONVERGED).all()
    assert (other.status == engine.CONVERGED).all()
    assert_allclose(other.T, own.T, atol=1e-11)
    assert_allclose(other.residual, own.residual, rtol=1e-9)


@BOTH
def test_forward_kinematics_of_open_loops_returns_commanded_coordinates(text, tmp_path):
    robot = load_text(tmp_path, close_by_least_squares(text))
    true = robot.with_values(draw(robot, 1)[0][0])
    ranges = np.array(list(robot.assembly.workspace.values()))
    asked = np.random.default_rng(4).uniform(ranges[:, 0], ranges[:, 1], (8, len(ranges)))
    solution = inverse(true, asked)
    assert solution.converged.all()
    assert_allclose(forward(true, solution.q).T, solution.T, atol=1e-11)
    again = inverse(true, solution.T)
    assert_allclose(again.q, solution.q, atol=1e-9)


@OPEN
def test_derivatives_of_open_loops_agree_with_differences(text: str, tmp_path: Path) -> None:
    robot = load_text(tmp_path, close_by_least_squares(text))
    values, q = draw(robot, 3)
    state = forward_trials(robot, values, q)
    D = differentiate_pose(robot, values, q, state)
    h = 1e-5

    def differ(shift_values: np.ndarray, shift_q: np.ndarray) -> np.ndarray:
        ends = [
            forward_trials(robot, values + s * shift_values, q + s * shift_q, state).T
            for s in (h, -h)
        ]
        return geometry.pose_difference(*ends) / (2 * h)

    for i, unit in enumerate(np.eye(values.shape[1])):
        # [m/rad, 1] a step of 1e-5 has an error of about 1e-10 times the third derivative
        assert_allclose(D.parameters[..., i], differ(unit, 0 * q[0, 0]), atol=2e-7)
    for i, unit in enumerate(np.eye(q.shape[2])):
        assert_allclose(D.readings[..., i], differ(0 * values[0], unit), atol=2e-7)


@OPEN
def test_derivatives_of_passive_joints_of_open_loops_agree_with_differences(text, tmp_path):
    robot = load_text(tmp_path, close_by_least_squares(text))
    values, q = draw(robot, 2)
    state = forward_trials(robot, values, q)
    D = differentiate_passive_joints(robot, values, q, state)
    h = 1e-5

    def read(shift_values: np.ndarray, shift_q: np.ndarray) -> np.ndarray:
        moved = forward_trials(robot, values + shift_values, q + shift_q, state)
        joints = {
            f"{robot.assembly.limbs[i].name}.{joint.name}": own[:, :, k, j]
            for group, own in zip(robot.program.groups, moved.joints, strict=True)
            for k, i in enumerate(group.limbs)
            for j, joint in enumerate(robot.assembly.limbs[i].joints)
        }
        return np.stack([joints[name] for name in D.names], axis=-1)

    for i, unit in enumerate(h * np.eye(values.shape[1])):
        differences = (read(unit, 0 * q[0, 0]) - read(-unit, 0 * q[0, 0])) / (2 * h)
        # [rad/m, 1] a step of 1e-5 has an error of about 1e-10 times the third derivative
        assert_allclose(D.parameters[..., i], differences, atol=2e-7)
    for i, unit in enumerate(h * np.eye(q.shape[2])):
        differences = (read(0 * values[0], unit) - read(0 * values[0], -unit)) / (2 * h)
        assert_allclose(D.readings[..., i], differences, atol=2e-7)


def test_readings_that_lead_nowhere_leave_the_derivatives_of_other_rows_alone(tmp_path) -> None:
    robot = load_text(tmp_path, close_by_least_squares(EXECHON))
    values, q = draw(robot, 4)
    lost = q.copy()
    lost[:, 1], lost[:, 2] = np.nan, np.inf
    D, E = (
        differentiate_passive_joints(
            robot, values, readings, forward_trials(robot, values, readings)
        )
        for readings in (q, lost)
    )
    for good, other in ((D.parameters, E.parameters), (D.readings, E.readings)):
        assert_array_equal(np.isfinite(other).all(axis=(0, 2, 3)), [True, False, False, True])
        assert_allclose(other[:, [0, 3]], good[:, [0, 3]], rtol=1e-9)  # [1] rounding of differences


def test_least_squares_closure_without_repeated_equations_changes_nothing(tmp_path: Path) -> None:
    text = FOUR_BAR.replace("controlled:", "freedoms: [ry, x, z]\ncontrolled:")
    plain = load_text(tmp_path, text)
    asked = load_text(tmp_path, close_by_least_squares(text))
    assert plain.findings == ()
    assert [f.code for f in asked.findings] == ["mechanism.closure-without-effect"]
    assert asked.program.may_stay_open is False
    q = np.deg2rad(np.linspace(-20, 20, 5))[:, None]
    assert_allclose(forward(asked, q).T, forward(plain, q).T, atol=0)


def insert_line(text: str, added: dict) -> str:
    """Return the text of a file with a line behind a joint of a limb."""
    lines = text.splitlines()
    limb = lines.index(f"  - name: {added['limb']}")
    at = next(i for i in range(limb, len(lines)) if f"name: {added['joint']}," in lines[i])
    return "\n".join([*lines[: at + 1], f"      {added['line']}", *lines[at + 1 :]]) + "\n"


@BOTH
def test_lines_that_free_joints_make_the_file_one_of_exact_constraint(text, tmp_path):
    robot = load_text(tmp_path, text)
    finding = propose_added_joints(robot)
    assert finding is not None
    assert finding.code == "mechanism.joints-to-free"
    count = get_data(robot)["count"]
    q = driven_values(robot.program, find_nearby_states(robot))
    for chosen in finding.data["proposals"]:
        assert len(chosen) == count  # one more freedom for each repeated equation
        written = text
        for added in reversed(chosen):
            written = insert_line(written, added)
        freer = load_text(tmp_path, written)
        assert freer.findings == ()
        assert find_breaking_parameters(freer) == ()
        state = forward_trials(freer, sample_truth(freer, 3, 7), q, follow=False)
        assert (state.status == Status.CONVERGED).all()
        # with exact geometry it is the same machine
        exact = forward_trials(freer, freer.values[None], q, follow=False)
        whole = forward_trials(robot, robot.values[None], q, follow=False)
        assert_allclose(exact.T, whole.T, atol=1e-11)


def test_joint_that_would_only_spin_a_limb_is_not_proposed(tmp_path: Path) -> None:
    finding = propose_added_joints(load_text(tmp_path, EXECHON))
    assert finding is not None
    # a sphere at the gimbal and one at the hinge of one limb would let it spin
    joints = [{(a["limb"], a["joint"]) for a in chosen} for chosen in finding.data["proposals"]]
    assert {("right", "hinge")} in joints
    assert {("right", "gimbal"), ("right", "hinge")} not in joints


def test_no_rotation_frees_a_table_on_two_rails(tmp_path: Path) -> None:
    robot = load_text(tmp_path, RAILS)
    assert get_data(robot)["count"] == 5
    finding = propose_added_joints(robot)
    assert finding is not None
    assert finding.code == "mechanism.no-joint-to-free"


def test_a_machine_that_is_not_over_constrained_has_no_proposal(tmp_path: Path) -> None:
    planar = FOUR_BAR.replace("controlled:", "freedoms: [ry, x, z]\ncontrolled:")
    assert propose_added_joints(load_text(tmp_path, planar)) is None
    assert propose_added_joints(load_text(tmp_path, close_by_least_squares(EXECHON))) is None


def test_a_joint_of_a_limb_with_copies_is_freed_in_each_copy(tmp_path: Path) -> None:
    robot = load_text(tmp_path, THREE_RRR)
    data = get_data(robot)
    assert (data["count"], data["freedoms"]) == (6, ("rz", "x", "y"))
    assert [entry["limb"] for entry in data["repeated"]] == ["arm2", "arm3"]
    finding = propose_added_joints(robot)
    assert finding is not None
    for chosen in finding.data["proposals"]:
        assert len(chosen) == 2  # in each of three limbs
        written = THREE_RRR
        for added in reversed(chosen):
            written = insert_line(written, added)
        assert load_text(tmp_path, written).findings == ()


def test_stage_of_a_chain_names_its_parameters_and_closes_by_least_squares(tmp_path: Path) -> None:
    alone = find_breaking_parameters(load_text(tmp_path, EXECHON))
    chain = load_text(tmp_path, put_on_wrist(EXECHON))
    assert find_breaking_parameters(chain) == tuple(f"head.{name}" for name in alone)
    with pytest.raises(MechanismError):
        sample_truth(chain, 1, 0)
    robot = load_text(tmp_path, put_on_wrist(close_by_least_squares(EXECHON)))
    true = robot.with_values(sample_truth(robot, 1, 5)[0])
    asked = np.array([[1.0, 0.3, 0.08, -0.4], [1.05, -2.0, 0.1, 0.9]])
    solution = inverse(true, asked)
    assert solution.converged.all()
    again = forward(true, solution.q)
    assert again.converged.all()
    error = compare_coordinates(again.T, asked, robot.controlled, robot.size)[0]
    assert_allclose(error, 0, atol=1e-10)  # [m]


BALL_ON_A_PIN = """format: 1
family: limbs
name: swing
units: {length: mm, angle: deg}
controlled: [pitch]
limbs:
  - {name: pin, ending: rigid, chain: [{joint: R, axis: y}]}
  - name: arm
    ending: ball
    chain:
      - {joint: R, name: m, at: [100, 0, 0], axis: y, actuated: m}
      - {joint: P, name: s, axis: z, start: 200}
    attach: [100, 0, 200]
"""


def test_freedoms_without_shifts_are_refused_where_a_limb_ends_in_a_ball(tmp_path) -> None:
    path = tmp_path / "swing.yaml"
    path.write_text(BALL_ON_A_PIN.replace("controlled", "freedoms: [ry]\ncontrolled"))
    with pytest.raises(MechanismError, match="'arm' ends in a ball, whose closure equations are"):
        load_robot(path)
    # `check` tried these freedoms by itself, which ended in an exception of the engine
    path.write_text(BALL_ON_A_PIN)
    assert is_over_constrained(load_robot(path))


PARALLELOGRAM = """format: 1
family: limbs
name: parallelogram
units: {length: mm, angle: deg}
controlled: [x]
home: {x: 100, y: 150}
limbs:
  - name: crank
    ending: rigid
    chain:
      - {joint: R, name: motor, axis: z, actuated: m, start: 90}
      - {joint: R, name: pin, at: [100, 0, 0], axis: z, start: -90}
    tip: [100, 50, 0]
  - name: rocker
    ending: rigid
    chain:
      - {joint: R, name: low, at: [200, 0, 0], axis: z, start: 90}
      - {joint: R, name: high, at: [100, 0, 0], axis: z, start: -90}
    tip: [-100, 50, 0]
    errors: [{of: high, shift: [x], tolerance: {sd: 0.1}}]
"""


def test_proposed_freedoms_keep_the_rotation_that_errors_cause(tmp_path) -> None:
    """The platform of a parallelogram rotates only if its sides are not equal."""
    robot = load_text(tmp_path, PARALLELOGRAM)
    finding = find_over_constraint(robot)
    assert finding is not None
    assert finding.data["freedoms"] == ("rz", "x", "y")
    flat = build(replace(robot.assembly, freedoms=finding.data["freedoms"]))
    long = forward(flat.with_values(flat.values + 1e-4), [[1.3]])
    assert long.converged.all()
    # the rocker is 0.1 mm longer at a distance of 200 mm from the crank
    assert abs(np.arctan2(long.T[0, 1, 0], long.T[0, 0, 0])) == pytest.approx(5e-4, rel=0.1)
