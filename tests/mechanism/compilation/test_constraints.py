# SPDX-License-Identifier: Apache-2.0
"""Limbs and mobility: mechanisms that cannot work are refused when they are built, with the
correction to make; redundant closure equations; limbs that constrain nothing.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.geometry import invert_pose
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.assembly import Address, Joint, Limb, LinearMap, Link
from loopcal.mechanism.compilation import build
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.modes import find_assembly_modes
from loopcal.mechanism.solutions import forward, inverse
from loopcal.parameters import Parameter
from loopcal.units import Dimension
from tests import zoo
from tests.robot_texts import load_text

HOME = zoo.place((0.01, -0.02, 0.25), (0.05, -0.08, 0.1))

RIGID = ("rigid",) * 3


def make_rigid_limb(name, frames, joints, corner):
    """Return a rigid limb with joints in these frames [base] at home, at joint values of zero."""
    attachment = zoo.place(corner)
    ends = [np.eye(4), *frames, HOME @ attachment]
    links = tuple(Link(f"link{i}", invert_pose(a) @ b) for i, (a, b) in enumerate(pairwise(ends)))
    return Limb(name, links, joints, "rigid", Link("attachment", attachment))


def leg_frame(i):
    """Return the frame at a leg's foot, with z along the leg, and the leg's length."""
    foot, end = zoo.HEXAPOD_BASE[i] * zoo.MM, HOME @ zoo.place(zoo.HEXAPOD_PLATFORM[i] * zoo.MM)
    z = (end[:3, 3] - foot) / np.linalg.norm(end[:3, 3] - foot)
    x = np.cross((0.3, 1.0, 0.2), z)
    frame = np.eye(4)
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1], frame[:3, 2], frame[:3, 3] = np.cross(z, frame[:3, 0]), z, foot
    return frame, float(np.linalg.norm(end[:3, 3] - foot))


ABOUT_X, ABOUT_Y = zoo.place((0, 0, 0), (0, np.pi / 2, 0)), zoo.place((0, 0, 0), (-np.pi / 2, 0, 0))


def make_sps_leg(i, apart=0.0):
    """Return a leg RRR-P-RRR; its base axes intersect unless `apart` [m]."""
    F, length = leg_frame(i)
    top = F @ zoo.place((0, 0, length))
    askew = zoo.place((0, 0, 0), (0.3, 0.2, 0))
    frames = [
        F @ ABOUT_X @ zoo.place((0, apart, 0)),
        F @ ABOUT_Y,
        F @ askew @ zoo.place((apart, 0, 0)),
        F,
    ]
    frames += [top @ ABOUT_X, top @ ABOUT_Y, top @ askew]
    joints = tuple(
        Joint(f"j{n}", k, f"q{i + 1}" if k == "P" else None)
        for n, k in enumerate("RRRPRRR", start=1)
    )
    return make_rigid_limb(f"leg{i + 1}", frames, joints, zoo.HEXAPOD_PLATFORM[i] * zoo.MM)


def make_rrrprr_leg(i, loose):
    """Return a leg RRRPRR with its third axis along the slide.

    With `loose` the axis after the slide is parallel to it, else skew.
    """
    F, length = leg_frame(i)
    middle = F @ zoo.place((0, 0, length / 2))
    if not loose:
        middle = middle @ zoo.place((0.02, 0.01, 0), (0.4, -0.5, 0))
    askew = F @ zoo.place((0.01, -0.02, length), (0.9, 0.3, 0.2))
    frames = [F @ ABOUT_X, F @ ABOUT_Y, F, F, middle, askew]
    joints = tuple(
        Joint(f"j{n}", k, f"q{i + 1}" if k == "P" else None)
        for n, k in enumerate("RRRPRR", start=1)
    )
    return make_rigid_limb(f"leg{i + 1}", frames, joints, zoo.HEXAPOD_PLATFORM[i] * zoo.MM)


def make_assembly(limbs, controlled=("x", "y", "z", "roll", "pitch", "yaw")):
    return zoo.assemble("machine", tuple(limbs), zoo.AXES, controlled, HOME)


@pytest.mark.parametrize("odd", [0, 3])
def test_underdetermined_limb_is_named_in_any_order_of_limbs(odd):
    limbs = [make_sps_leg(i, 0.02 if i == odd else 0.0) for i in range(6)]
    messages = set()
    for shift in range(6):
        with pytest.raises(
            MechanismError, match=f"limb 'leg{odd + 1}' has 7 joints, but 6 closure equations"
        ) as error:
            build(make_assembly(np.roll(np.array(limbs, dtype=object), shift)))
        messages.add(str(error.value))
    assert len(messages) == 1


def test_limb_order_does_not_change_poses_or_the_locked_joint():
    limbs = [make_rrrprr_leg(i, loose=i == 2) for i in range(5)]
    orders = [(0, 1, 2, 3, 4), (2, 0, 1, 3, 4), (4, 3, 1, 0, 2)]
    robots = [
        build(make_assembly([limbs[i] for i in order], ("x", "y", "z", "roll", "pitch")))
        for order in orders
    ]
    target = np.array([[0.012, -0.018, 0.252, 0.06, -0.07]])
    poses = [inverse(robot, target) for robot in robots]
    for robot, result in zip(robots, poses, strict=True):
        assert result.converged.all()
        assert_allclose(result.T, poses[0].T, atol=1e-12)
        assert_allclose(forward(robot, result.q).T, result.T, atol=1e-11)
        held = [
            (limb, j)
            for g in robot.program.groups
            for limb in g.limbs
            for j, h in enumerate(g.locked)
            if h
        ]
        (limb, joint), (finding,) = held[0], robot.findings
        assert len(held) == 1
        assert finding.code == "mechanism.locked-joint"
        assert finding.data == {
            "limb": "leg3",
            "joint": robot.assembly.limbs[limb].joints[joint].name,
            "turns": True,
            "value": (0.0, "rad"),
        }


def test_locked_joint_keeps_its_reported_start_value():
    limbs = [make_rrrprr_leg(i, loose=i == 2) for i in range(5)]
    robot = build(make_assembly(limbs, ("x", "y", "z", "roll", "pitch")))
    joint = robot.findings[0].data["joint"]
    turned = replace(
        limbs[2],
        joints=tuple(replace(j, start=0.4) if j.name == joint else j for j in limbs[2].joints),
    )
    other = build(make_assembly([*limbs[:2], turned, *limbs[3:]], ("x", "y", "z", "roll", "pitch")))
    assert other.findings[0].data["joint"] == joint
    assert other.findings[0].data["value"] == (0.4, "rad")
    q = inverse(robot, np.array([[0.012, -0.018, 0.252, 0.06, -0.07]])).q
    assert_allclose(forward(other, q).T, forward(robot, q).T, atol=1e-11)


def test_planar_robot_with_six_freedoms_is_solved_and_reported_as_redundant():
    whole, flat = zoo.planar_arms(RIGID, zoo.AXES), zoo.planar_arms(RIGID)
    assert flat.findings == ()
    (finding,) = whole.findings
    assert finding.code == "mechanism.repeated-equations"
    assert (finding.data["count"], finding.data["freedoms"]) == (6, ("rz", "x", "y"))
    asked = np.random.default_rng(0).uniform((-0.06, -0.06, -0.45), (0.06, 0.06, 0.45), (300, 3))
    result = inverse(flat, asked)
    result = result.take(result.converged)
    assert len(result.q) > 200
    again = forward(whole, result.q)
    # the closure matrix is not square, so its determinant must not select a mode by its sign
    assert again.converged.all()
    assert_allclose(again.T, result.T, atol=1e-11)
    assert (again.state.closure_sign == 0).all()
    assert (whole.home_state.closure_sign == 0).all()
    modes = [find_assembly_modes(robot, result.q[0], patience=2048) for robot in (whole, flat)]
    assert_allclose(modes[0].solution.T, modes[1].solution.T, atol=1e-9)
    assert (modes[0].solution.state.closure_sign == 0).all()


def test_redundant_equations_are_reported_when_no_freedoms_avoid_them():
    turned = zoo.place((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    whole = zoo.planar_arms(RIGID, zoo.AXES)
    assembly = zoo.move_base(whole.assembly, turned)
    robot = build(replace(assembly, parameters=(), maps=(), controlled=("x", "y", "yaw")))
    (finding,) = robot.findings
    assert finding.code == "mechanism.repeated-equations"
    assert (finding.data["count"], finding.data["freedoms"]) == (6, ())


def build_spherical_3rrr():
    """Build a spherical 3-RRR with every frame at the origin and axes 60 degrees apart."""
    limbs = []
    for i in range(3):
        turn = zoo.place((0, 0, 0), (0, 0, 2 * np.pi * i / 3))
        bend = zoo.place((0, 0, 0), (np.pi / 3, 0, 0))
        links = (
            Link("base", turn @ zoo.place((0, 0, 0), (np.pi / 4, 0, 0))),
            Link("crank", bend),
            Link("rod", bend),
        )
        joints = (
            Joint("motor", "R", f"q{i + 1}", start=0.6),
            Joint("elbow", "R", start=1.4),
            Joint("wrist", "R", start=0.5),
        )
        tip = turn @ zoo.place((0, 0, 0), (np.pi / 4, 0, 0))
        for joint, link in zip(joints, (bend, bend, np.eye(4)), strict=True):
            tip = tip @ zoo.place((0, 0, 0), (0, 0, joint.start)) @ link
        limbs.append(
            Limb(f"arm{i + 1}", (*links, Link("hand", np.eye(4))), joints, "rigid", Link("on", tip))
        )
    freedoms, wanted = ("rx", "ry", "rz"), ("roll", "pitch", "yaw")
    return build(zoo.assemble("wrist", tuple(limbs), freedoms, wanted, np.eye(4)))


def test_spherical_robot_without_lengths_has_a_size_of_one_meter():
    robot = build_spherical_3rrr()
    assert robot.size == 1.0
    asked = np.random.default_rng(1).uniform(-0.2, 0.2, (50, 3))
    result = inverse(robot, asked)
    assert result.converged.all()
    assert_allclose(forward(robot, result.q).T, result.T, atol=1e-10)


Array = NDArray[np.float64]

BASE = [
    [500, -40, 0],
    [500, 40, 0],
    [-215, 453, 0],
    [-285, 413, 0],
    [-285, -413, 0],
    [-215, -453, 0],
]

PLATFORM = [
    [185, -240, 0],
    [185, 240, 0],
    [115, 280, 0],
    [-300, 40, 0],
    [-300, -40, 0],
    [115, -280, 0],
]

PROBE = """  - name: probe
    ending: rigid
    chain:
      - {joint: U, name: lower, axes: [x, y]}
      - {joint: P, name: slide, axis: z, start: 600}
      - {joint: R, name: first, axis: z}
      - {joint: R, name: middle, axis: y, start: 5}
      - {joint: R, name: last, axis: z}
    attach: {pitch: 5}
"""


def load_hexapod(folder: Path, limbs: str = "") -> Mechanism:
    """Return the hexapod with further limbs."""
    lines = ["format: 1", "family: limbs", "name: hexapod", "units: {length: mm, angle: deg}"]
    lines += ["controlled: [x, y, z, roll, pitch, yaw]", "actuators:"]
    lines += [f"  q{i}: {{reads: length}}" for i in range(1, 7)] + ["limbs:"]
    for i, (tip, attach) in enumerate(zip(BASE, PLATFORM, strict=True), 1):
        lines += [f"  - name: leg{i}", "    ending: distance", f"    tip: {tip}"]
        lines += [f"    attach: {attach}", f"    actuated: q{i}"]
        lines += ["    errors: [{of: base, shift: [x, y, z], tolerance: {sd: 0.1}}]"]
    path = folder / f"hexapod{len(limbs)}.yaml"
    path.write_text("\n".join(lines) + "\n" + limbs + "home: {z: 600}\n", "utf-8")
    return load_robot(path)


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> tuple[Mechanism, Mechanism]:
    folder = tmp_path_factory.mktemp("robots")
    return load_hexapod(folder), load_hexapod(folder, PROBE)


def draw_poses(n: int) -> Array:
    """Draw coordinates (n, 6), shifts up to 0.6 m and turns up to 1.5 rad."""
    wide, middle = np.repeat([0.6, 1.5], 3), np.array([0, 0, 0.6, 0, 0, 0])
    return middle + np.random.default_rng(2).uniform(-wide, wide, (n, 6))


def test_the_wrist_of_a_probe_passes_its_singularity(machines: tuple[Mechanism, Mechanism]) -> None:
    plain, probed = machines
    target = np.zeros((9, 6))
    target[:, 2], target[:, 4] = 0.6, np.linspace(-0.3, 0.3, 9)
    solution = inverse(probed, target)
    assert solution.converged.all()  # those below -5 degrees were in another mode
    assert_allclose(solution.q, inverse(plain, target).q, atol=1e-12)  # [m] rounding
    back = forward(probed, solution.q)
    assert back.converged.all()
    assert np.abs(geometry.pose_difference(back.T, solution.T)).max() < 1e-9
    middle = solution.passive[:, list(solution.passive_names).index("probe.middle")]
    assert middle.min() < -0.1 < 0.1 < middle.max()


def test_modes_of_the_actuated_loops_are_those_without_the_probe(machines):
    plain, probed = machines
    target = draw_poses(40)
    expected, solution = inverse(plain, target), inverse(probed, target)
    both = expected.closed & solution.closed
    assert both.sum() > 30
    assert 2 < expected.converged.sum() < 38
    # the probe needs more steps of a path, so that a row may be refused, but no other is taken
    assert not (solution.converged & ~expected.converged).any()
    assert (solution.converged & expected.converged).sum() > 0.9 * expected.converged.sum()


def strip_parameters(assembly, **changes):
    """Return the assembly without parameters and with these changes."""
    return replace(assembly, parameters=(), maps=(), shared=(), **changes)


HEXAPOD = strip_parameters(zoo.hexapod().assembly)

PRS = strip_parameters(zoo.three_prs().assembly)


def change_limb(assembly, i, **changes):
    limbs = list(assembly.limbs)
    limbs[i] = replace(limbs[i], **changes)
    return replace(assembly, limbs=tuple(limbs))


def make_five_legs():
    return replace(HEXAPOD, limbs=HEXAPOD.limbs[:5], actuators=HEXAPOD.actuators[:5])


def add_fixed_rod():
    """Return a hexapod with a seventh rod of fixed length."""
    rod = replace(
        HEXAPOD.limbs[0], name="rod", actuator=None, attachment=HEXAPOD.limbs[3].attachment
    )
    gap = HEXAPOD.home @ rod.attachment.transform[:, 3] - rod.links[0].transform[:, 3]
    return replace(HEXAPOD, limbs=(*HEXAPOD.limbs, replace(rod, length=float(np.linalg.norm(gap)))))


def make_singular_hexapod():
    """Return a hexapod whose platform is similar and parallel to the base: it is singular."""
    base = zoo.HEXAPOD_BASE * zoo.MM
    limbs = tuple(
        replace(
            limb,
            links=(Link("base", zoo.place(b)),),
            attachment=Link("platform", zoo.place(0.6 * b)),
        )
        for limb, b in zip(HEXAPOD.limbs, base, strict=True)
    )
    return replace(HEXAPOD, limbs=limbs)


INVALID_ASSEMBLIES = {
    "five legs": (
        make_five_legs,
        (
            r"hexapod: at home the platform can move with every actuator locked "
            r"\((rotation|translation) .*5 of 6 freedoms"
        ),
    ),
    "similar base and platform": (make_singular_hexapod, r"at home the platform can move"),
    "a rod too many": (
        add_fixed_rod,
        r"hexapod has 6 actuators, .* only 5 of 6 freedoms .* drive only 5 joints",
    ),
    "a coordinate too few": (
        lambda: replace(PRS, controlled=("z",)),
        r"3-PRS moves in 3 freedoms or more, but names only 1 controlled coordinates",
    ),
    "a coordinate that cannot be controlled": (
        lambda: replace(PRS, controlled=("z", "x", "psi")),
        r"cannot set the coordinates .* independently at home",
    ),
    "an unknown coordinate": (
        lambda: replace(PRS, controlled=("z", "tilt", "x")),
        r"'tilt' is not a platform coordinate. Allowed: x, y, z",
    ),
    "two rotations": (
        lambda: replace(PRS, freedoms=("rx", "ry", "z")),
        r"3-PRS has the freedoms rx and ry, which define no pose: .* add a limb with the joint",
    ),
    "two limbs of one name": (
        lambda: change_limb(PRS, 1, name="limb1"),
        r"two limbs have the name 'limb1'. Give each its own name",
    ),
    "an actuator twice": (
        lambda: replace(HEXAPOD, actuators=HEXAPOD.actuators[:1] * 2),
        r"two actuators have the name 'q1'",
    ),
    "legs that are too short": (
        lambda: replace(
            change_limb(HEXAPOD, 0, actuator=None, length=0.01),
            actuators=HEXAPOD.actuators[1:],
            controlled=("x", "y", "z", "phi", "theta"),
        ),
        r"the loops of hexapod do not close at its home pose: .* mm stay open",
    ),
}


def test_singular_home_is_called_singular_and_its_actuators_are_named(root, tmp_path) -> None:
    """Arm and rod of every limb are in one line: 300 mm - 75 mm = 112.5 mm + 112.5 mm."""
    text = (root / "src" / "loopcal" / "robots" / "3-rrr.yaml").read_text("utf-8")
    stretched = text.replace("tip: [180, 0, 0]", "tip: [112.5, 0, 0]")
    stretched = stretched.replace("length: 180", "length: 112.5").replace(
        "start: 129", "start: 180"
    )
    (tmp_path / "robot.yaml").write_text(stretched, "utf-8")
    sentence = "a stretched or folded limb prevents q1, q2 and q3 from moving the platform"
    with pytest.raises(MechanismError, match=sentence) as error:
        load_robot(tmp_path / "robot.yaml")
    assert "stay open" not in str(error.value)


@pytest.mark.parametrize("case", INVALID_ASSEMBLIES)
def test_invalid_mechanism_is_refused_in_one_sentence(case):
    make, sentence = INVALID_ASSEMBLIES[case]
    with pytest.raises(MechanismError, match=sentence) as error:
        build(make())
    assert "\n" not in str(error.value)


def test_parameter_with_an_unknown_address_is_refused():
    parameter = Parameter("a", Dimension.LENGTH, 0.0)
    for address in (
        Address("leg1", "knee", "x"),
        Address("leg1", "rod", "pitch"),
        Address("q1", "transmission", "tooth"),
        Address("leg9", "base", "x"),
    ):
        wrong = replace(HEXAPOD, parameters=(parameter,), maps=(LinearMap("a", address),))
        with pytest.raises(
            MechanismError, match=f"maps onto {address}, which this mechanism does not have"
        ):
            build(wrong)


def test_serial_arm_is_a_valid_mechanism():
    limb = Limb(
        "arm", (Link("base", np.eye(4)), Link("upper", zoo.place((0.3, 0, 0))), Link("lower", zoo.place((0.2, 0, 0)))),  # noqa: E501
        (Joint("a", "R", "q1", start=0.3), Joint("b", "R", "q2", start=0.8)), "ball", Link("hand", np.eye(4)),  # noqa: E501
    )  # fmt: skip
    robot = build(
        zoo.assemble("arm", (limb,), ("x", "y"), ("x", "y"), zoo.place((0.35, 0.25, 0.0)))
    )
    assert robot.home_state.status[0, 0] == 0


UPU = """
format: 1
family: limbs
name: upu
units: {length: mm, angle: deg}
controlled: [x, y, z]
limbs:
  - name: leg
    ending: rigid
    chain:
      - {joint: U, name: low, at: [300, 0, 0], axes: [y, x]}
      - {joint: P, name: slide, axis: z, actuated: q, start: 500}
      - {joint: U, name: up, axes: [x, y]}
    attach: [150, 0, 0]
    copies: {count: 3}
home: {z: 500}
"""


def test_a_singular_start_is_refused_with_the_start_values_of_home(tmp_path: Path) -> None:
    """Legs of a 3-UPU that begin upright lean by arctan(150 / 500) at home."""
    with pytest.raises(MechanismError) as refusal:
        load_text(tmp_path, UPU)
    # the values of one of three equal legs, all of them
    values = "leg1.low.1 -16.7 deg, leg1.slide 522 mm and leg1.up.2 16.7 deg"
    assert str(refusal.value).endswith(f"Enter values near home: {values}.")
    leaning = UPU.replace("axes: [y, x]", "axes: [y, x], start: [-16.7, 0]").replace(
        "axes: [x, y]", "axes: [x, y], start: [0, 16.7]"
    )
    assert load_text(tmp_path, leaning).controlled == ("x", "y", "z")
    parallel = UPU.replace("attach: [150", "attach: [300")  # singular at home itself
    with pytest.raises(MechanismError, match=r"cannot set the coordinates .* independently"):
        load_text(tmp_path, parallel)


SCOTT_RUSSELL = """
format: 1
family: limbs
name: russell
units: {length: mm, angle: deg}
freedoms: [x, z, ry]
controlled: [x]
bodies: [{name: crank}]
limbs:
  - {name: crank, to: crank, ending: rigid, chain: [{joint: R, name: pin, axis: -y, start: 45}]}
  - name: bar
    ending: rigid
    chain:
      - {joint: P, name: rail, axis: z, actuated: s, start: 150}
      - {joint: R, name: pin, axis: y, start: 40}
    attach: [-200, 0, 0]
  - {name: mid, on: crank, tip: [100, 0, 0], attach: [-100, 0, 0], ending: ball}
home: {x: 132}
"""


def test_a_home_without_its_rotation_is_refused_with_this_rotation(tmp_path: Path) -> None:
    """A bar of 200 mm, with one end at x = 132 mm and level, is in a singular position."""
    with pytest.raises(MechanismError, match=r"and `home:` pitch 48.7 deg.$"):  # acos(132 / 200)
        load_text(tmp_path, SCOTT_RUSSELL)
    robot = load_text(tmp_path, SCOTT_RUSSELL.replace("x: 132", "x: 132, pitch: 48.7"))
    np.testing.assert_allclose(robot.home[0, 0], 0.66, rtol=0, atol=1e-12)
