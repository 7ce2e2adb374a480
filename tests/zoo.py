# SPDX-License-Identifier: Apache-2.0
"""Small robots and true parameter values that the tests share. Lengths in meters, angles in
radians.

A robot is a cached function without arguments: a test names the robot and builds it once.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism.assembly import (
    AXES,
    Actuator,
    Address,
    Assembly,
    Joint,
    Limb,
    LinearMap,
    Link,
)
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.families.records import Workspace
from loopcal.mechanism.model import Mechanism
from loopcal.parameters import Parameter
from loopcal.units import Dimension

Array = NDArray[np.float64]
MM = 1e-3

RELATIVES = {
    "3-rps", "6-pus", "cable-4", "cable-camera", "hexapod-elastic", "hexapod-nategh-agheli",
    "hexapod-octahedral", "klann-leg", "linear-delta-6", "orthoglide", "palletizer", "par4",
    "pulley-3", "rotary-delta", "solar-tracker", "telescopic-delta", "tricept", "warm-delta",
}  # fmt: skip
"""Shipped robots whose closure another shipped robot has, too; here the evidence tests them."""

ROBOTS = [
    pytest.param(name, marks=pytest.mark.evidence if name in RELATIVES else ())
    for name in list_shipped_robots()
]
"""The names of all shipped robots, as parameters of a test."""

FEW = {"3-prs", "arm-6r", "core-xy", "five-bar", "h4", "hexapod-42", "linear-delta", "ru-pus-prs"}
"""One robot of each family and way to solve a closure: limbs in a plane and in space, shared
drives, bodies in loops, stages."""

FEW_ROBOTS = [
    pytest.param(name, marks=() if name in FEW else pytest.mark.evidence)
    for name in list_shipped_robots()
]
"""All shipped robots for statements that other tests prove of their parts; most run as evidence."""

# --- hexapods with 42 parameters
# ------------------------------------------------------------------------------------- "Numerical
# simulation of the calibration algorithm for a 6-DOF parallel mechanism": Table 2 (nominal: base,
# length, platform, leg by leg) and Table 3 (errors, in the same order) [mm].
HEXAPOD_BASE = np.array(
    [
        (120, -140, 0),
        (120, 140, 0),
        (61.243557, 173.92305, 0),
        (-181.24356, 33.92305, 0),
        (-181.24356, -33.92305, 0),
        (61.243557, -173.92305, 0),
    ]
)
HEXAPOD_PLATFORM = np.array(
    [
        (120, -20, 0),
        (120, 20, 0),
        (-42.679489, 113.92304, 0),
        (-77.320511, 93.923042, 0),
        (-77.320511, -93.923042, 0),
        (-42.679489, -113.92304, 0),
    ]
)
HEXAPOD_LENGTH = 233.238076  # sqrt(120^2 + 200^2); the paper prints 233.23808
HEXAPOD_ERRORS = np.array(
    [
        (0.02, 0.03, -0.05, -0.02, 0.04, 0.03, -0.01),
        (-0.03, 0.02, 0.04, 0.02, 0.05, -0.02, -0.03),
        (0.01, -0.05, 0.04, -0.01, -0.02, 0.01, 0.04),
        (-0.05, -0.02, 0.02, 0.04, -0.04, -0.04, 0.01),
        (-0.02, 0.05, -0.01, -0.05, 0.04, 0.02, -0.05),
        (0.05, -0.04, -0.02, 0.04, 0.02, 0.03, 0.04),
    ]
)

# Nategh & Agheli (2009), Table 2, as in the public repository
# tabathaviso/hexapod-parallel-manipulator (calibration.m) [mm]: rows x, y, z; columns legs 1 to 6.
NATEGH_TRUE_BASE = np.array(
    [
        (305.2599, -55.2814, -244.7954, -252.5755, -53.9678, 302.4266),
        (115.0695, 322.9819, 208.0087, -211.8783, -320.6115, -109.4351),
        (2.6210, 4.2181, 3.9365, -3.0128, 4.3181, 3.3812),
    ]
).T
NATEGH_TRUE_PLATFORM = np.array(
    [
        (96.6610, 22.2476, -122.4519, -120.6859, 24.7769, 91.3462),
        (81.7602, 125.2511, 36.6453, -34.4565, -125.0489, -80.9866),
        (1.0684, -0.5530, 4.3547, -4.9014, -4.8473, 0.2515),
    ]
).T
NATEGH_TRUE_LENGTHS = np.array((604.4299, 607.2473, 600.4441, 605.9031, 604.5251, 600.0616))


@cache
def load_cached_robot(name: str) -> Mechanism:
    """Return a shipped robot, read once."""
    return load_robot(name)


@cache
def hexapod() -> Mechanism:
    """The 42-parameter hexapod at its nominal values."""
    return gough(
        "hexapod",
        HEXAPOD_BASE * MM,
        HEXAPOD_PLATFORM * MM,
        HEXAPOD_LENGTH * MM,
        0.2,
        (-0.075, 0.075),
    )


def hexapod_truth() -> Array:
    """Return the true values of `hexapod` (42,): Table 2 plus Table 3."""
    return hexapod().values + gough_values(
        HEXAPOD_ERRORS[:, :3] * MM, HEXAPOD_ERRORS[:, 4:] * MM, HEXAPOD_ERRORS[:, 3] * MM
    )


def nategh_truth() -> Array:
    """Return the true values of `nategh` (42,), with errors up to 5 mm."""
    return gough_values(NATEGH_TRUE_BASE * MM, NATEGH_TRUE_PLATFORM * MM, NATEGH_TRUE_LENGTHS * MM)


def nategh_poses(rng: np.random.Generator, n: int = 18) -> Array:
    """Random poses (n, 4, 4): +-100 mm, z 650 to 950 mm, +-0.2 rad in roll, pitch and yaw."""
    low, high = (
        np.array([-0.1, -0.1, 0.65, -0.2, -0.2, -0.2]),
        np.array([0.1, 0.1, 0.95, 0.2, 0.2, 0.2]),
    )
    return make_poses(rng.uniform(low, high, (n, 6)))


def gough(
    name: str,
    base: Array,
    platform: Array,
    lengths: float | Array,
    z: float,
    stroke: tuple[float, float] | None = None,
) -> Mechanism:
    """A hexapod with rod legs from its centers (6, 3) [m] and leg lengths at reading zero."""
    record = Gough(
        name=name,
        base=tuple(tuple(p) for p in base.tolist()),
        platform=tuple(tuple(p) for p in platform.tolist()),
        lengths=tuple(np.broadcast_to(lengths, 6).tolist()),
        stroke=stroke,
        home=PoseRecord(z=z),
    )
    return build(record.expand(), record=record)


def gough_values(base: Array, platform: Array, lengths: Array) -> Array:
    """Return values (42,) in the order of parameters: base, platform and length, leg by leg."""
    return np.column_stack([base, platform, lengths]).ravel()


def make_poses(coordinates: Array) -> Array:
    """Poses (n, 4, 4) of x, y, z, roll, pitch, yaw (n, 6) [m, rad]."""
    return geometry.make_pose(
        geometry.euler_to_matrix(coordinates[:, 3:], "xyz"), coordinates[:, :3]
    )


# --- deltas and planar machines: platforms with fewer than six freedoms
# ----------------------------------------------


@cache
def delta(readings: str = "drop") -> Mechanism:
    """A linear delta of a printer's size, with arms and stops that differ."""
    record = LinearDelta(
        name="delta",
        radius=0.12,
        angles=(np.deg2rad(210.5), np.deg2rad(329.0), np.deg2rad(90.0)),
        arms=(0.27, 0.268, 0.271),
        stops=(0.3, 0.301, 0.2985),
        readings="drop" if readings == "drop" else "height",
        stroke=(-0.1, 0.4),
        home=PoseRecord(z=0.1),
        workspace=Workspace(x=(-0.08, 0.08), y=(-0.08, 0.08), z=(0.0, 0.2)),
    )
    return build(record.expand(), record=record)


@cache
def five_bar() -> Mechanism:
    """A planar machine with freedoms x and y: one limb ends in a rod, the other in a passive joint
    and a point.
    """
    limbs = (
        Limb(
            "left",
            (Link("pivot", place((-0.07, 0, 0))), Link("crank", place((0.1, 0, 0)))),
            (Joint("motor", "R", "q1", start=2.2),),
            "distance",
            Link("pin", np.eye(4)),
            length=0.22,
        ),
        Limb(
            "right",
            (
                Link("pivot", place((0.07, 0, 0))),
                Link("crank", place((0.15, 0, 0))),
                Link("rod", place((0.2, 0, 0))),
            ),
            (Joint("motor", "R", "q2", start=0.7), Joint("elbow", "R", start=1.2)),
            "ball",
            Link("pin", np.eye(4)),
        ),
    )
    return build(assemble("five-bar", limbs, ("x", "y"), ("x", "y"), place((0.0, 0.25, 0.0))))


@cache
def planar_arms(
    endings: tuple[str, ...], freedoms: tuple[str, ...] = ("rz", "x", "y"), first: float = 90.0
) -> Mechanism:
    """A planar platform on arms with two passive joints: a crank of 150 mm and a rod of 170 mm from
    feet on a circle of 300 mm, the first at an angle [deg], to corners on one of 60 mm.

    A `rigid` ending has a pivot in the platform.
    """
    limbs = []
    for i, ending in enumerate(endings):
        angle = np.deg2rad(first + 360.0 * i / len(endings))
        out = np.array((np.cos(angle), np.sin(angle), 0.0))
        links = [
            Link("base", place(0.3 * out, (0, 0, angle))),
            Link("crank", place((0.15, 0, 0))),
            Link("rod", place((0.17, 0, 0))),
        ]
        joints = [Joint("motor", "R", f"q{i + 1}", start=2.2), Joint("elbow", "R", start=1.7)]
        if ending == "rigid":
            joints.append(Joint("wrist", "R", start=-0.5))
            links.append(Link("hand", np.eye(4)))
        corner = Link("corner", place(0.06 * out))
        limbs.append(Limb(f"arm{i + 1}", tuple(links), tuple(joints), ending, corner))
    name, controlled = f"{len(endings)}-RRR", ("x", "y", "yaw")
    return build(assemble(name, tuple(limbs), freedoms, controlled, np.eye(4)))


def planar_rrr() -> Mechanism:
    """A planar 3-RRR with freedoms x, y and yaw: two limbs end in a point, one in a pivot rigid in
    the platform.
    """
    return planar_arms(("ball", "ball", "rigid"))


# --- a tripod machine head: passive joints, three controlled coordinates of six
# -------------------------------------
PRS_A, PRS_B, PRS_L = 0.2, 0.35, 0.5


@cache
def three_prs() -> Mechanism:
    """A 3-PRS head with the 33 parameters of ideal joints: eleven a chain, in the chain's own
    frame.
    """
    limbs, parameters, maps = [], [], []
    swing = float(np.arctan2(-np.sqrt(PRS_L**2 - (PRS_B - PRS_A) ** 2), PRS_A - PRS_B))
    for i in range(3):
        turn, limb = (0.0, 0.0, 2 * np.pi * i / 3), f"limb{i + 1}"
        R = geometry.exp_so3(np.array(turn))
        links = (
            Link("guide", place(R @ (PRS_B, 0, 0), turn)),
            Link("pin", place((0, 0, 0), (-np.pi / 2, 0, 0))),
            Link("rod", place((PRS_L, 0, 0))),
        )
        joints = (Joint("carriage", "P", f"q{i + 1}", start=0.224), Joint("pin", "R", start=swing))
        limbs.append(
            Limb(limb, links, joints, "ball", Link("centre", place(R @ (PRS_A, 0, 0), turn)))
        )
        moved = [(limb, "centre", a) for a in "xyz"] + [
            (limb, "guide", a) for a in ("x", "y", "rx", "ry")
        ]
        moved += [
            (limb, "pin", "rx"),
            (limb, "pin", "ry"),
            (limb, "rod", "x"),
            (f"q{i + 1}", "transmission", "offset"),
        ]
        for owner, element, axis in moved:
            name = f"{owner}.{element}.{axis}"
            dimension = Dimension.ANGLE if axis in AXES[:3] else Dimension.LENGTH
            parameters.append(Parameter(name, dimension, 0.0))
            maps.append(LinearMap(name, Address(owner, element, axis)))
    return build(
        Assembly(
            name="3-PRS",
            limbs=tuple(limbs),
            actuators=tuple(Actuator(f"q{i + 1}", Dimension.LENGTH) for i in range(3)),
            freedoms=AXES,
            controlled=("z", "phi", "theta"),
            home=place((0, 0, 0.7)),
            parameters=tuple(parameters),
            maps=tuple(maps),
        )
    )


# --- a hexapod with a limb of every kind, and a displacement at every place
# ------------------------------------------


@cache
def mixed_hexapod() -> Mechanism:
    """A hexapod of six different limbs: rigid, ball and distance endings; R, P and screw joints,
    passive or driven.
    """
    return build(mixed_hexapod_assembly())


@cache
def mixed_hexapod_assembly(seed: int = 7) -> Assembly:
    """Draw axes and offsets about the legs of a hexapod: no entry is zero by symmetry."""
    rng = np.random.default_rng(seed)
    home = geometry.make_pose(
        geometry.exp_so3(np.array([0.05, -0.08, 0.1])), np.array([0.01, -0.02, 0.25])
    )
    kinds = [
        ("RRP", "ball", 2),
        ("RRPRRR", "rigid", 2),
        ("PRR", "ball", 0),
        ("P", "distance", 0),
        ("H", "distance", 0),
    ]
    limbs = []
    for i, (joints, ending, driven) in enumerate([*kinds, ("", "distance", -1)]):
        limbs.append(
            random_limb(
                rng,
                f"limb{i + 1}",
                joints,
                ending,
                driven,
                HEXAPOD_BASE[i] * MM,
                HEXAPOD_PLATFORM[i] * MM,
                home,
                f"q{i + 1}",
            )
        )
    return assemble(
        "mixed_hexapod", tuple(limbs), AXES, ("x", "y", "z", "roll", "pitch", "yaw"), home
    )


def random_limb(
    rng: np.random.Generator,
    name: str,
    kinds: str,
    ending: str,
    driven: int,
    foot: Array,
    corner: Array,
    home: Array,
    motor: str,
) -> Limb:
    """Draw a limb that closes at `home`: random joint frames from foot to corner (H: screw).

    `driven` is the joint that `motor` drives; -1 for the rod of a `distance` ending.
    """
    attachment = geometry.make_pose(geometry.exp_so3(rng.normal(size=3)), corner)
    end = home @ attachment
    rod = ending == "distance"
    leg, frames = end[:3, 3] - foot, []
    for j, kind in enumerate(kinds):
        along = float(j + 0.3 * rng.uniform()) / (len(kinds) + int(rod))
        point = foot + along * leg + 0.01 * rng.normal(size=3)
        frames.append(geometry.make_pose(_frame(rng, leg, kind), point))
    tip = end
    if rod and kinds == "H":  # a crank whose arm lies across the leg, far from its dead points
        arm = geometry.hat(frames[0][:3, 2]) @ leg
        tip = geometry.make_pose(geometry.exp_so3(rng.normal(size=3)), foot + leg * 0.2 + arm * 0.4)
    elif rod:
        tip = geometry.make_pose(
            geometry.exp_so3(rng.normal(size=3)), foot + leg * (0.7 if kinds else 0.0)
        )
    start = rng.uniform(0.02, 0.06, len(kinds)) * np.where([k == "P" for k in kinds], 1.0, 8.0)
    joints = tuple(
        Joint(
            f"joint{j + 1}",
            "P" if k == "P" else "R",
            motor if j == driven else None,
            0.015 if k == "H" else 0.0,
            s,
        )
        for j, (k, s) in enumerate(zip(kinds, start.tolist(), strict=True))
    )
    before, links = np.eye(4), []
    for j, frame in enumerate([*frames, tip]):
        links.append(Link(f"link{j}", geometry.invert_pose(before) @ frame))
        if j < len(kinds):
            before = frame @ _motion(joints[j])
    length = float(np.linalg.norm(end[:3, 3] - tip[:3, 3])) if rod else 0.0
    return Limb(
        name,
        tuple(links),
        joints,
        ending,
        Link("attachment", attachment),
        length,
        motor if rod and driven < 0 else None,
    )


def _frame(rng: np.random.Generator, leg: Array, kind: str) -> Array:
    """Draw a rotation with its z axis near the leg for P, across it for R and skew for H."""
    z = leg / np.linalg.norm(leg) + 0.2 * rng.normal(size=3)
    if kind != "P":
        z = np.cross(z, rng.normal(size=3)) + (0.3 * z if kind == "H" else 0.0)
    basis, _ = np.linalg.qr(np.column_stack([z, rng.normal(size=(3, 2))]))
    R = basis[:, [1, 2, 0]] * np.sign(basis[:, 0] @ z)
    return R * np.array([np.linalg.det(R), 1.0, 1.0])


def _motion(joint: Joint) -> Array:
    """Return the transform of a joint at its start value."""
    if joint.kind == "P":
        return place((0, 0, joint.start))
    return place((0, 0, joint.pitch * joint.start), (0, 0, joint.start))


def assemble(
    name: str,
    limbs: tuple[Limb, ...],
    freedoms: tuple[str, ...],
    controlled: tuple[str, ...],
    home: Array,
) -> Assembly:
    """Return an assembly with a parameter for every link axis, pitch, rod length, and
    transmission offset and gain.
    """
    driven = [(m, j.kind) for limb in limbs for m, j in ((j.actuator, j) for j in limb.joints) if m]
    driven += [(limb.actuator, "P") for limb in limbs if limb.actuator]
    actuators = tuple(
        Actuator(m, Dimension.ANGLE if k == "R" else Dimension.LENGTH) for m, k in sorted(driven)
    )
    addresses = [a for limb in limbs for a in list_addresses(limb)]
    addresses += [
        Address(a.name, "transmission", term) for a in actuators for term in ("offset", "gain")
    ]
    turns = {a.name for a in actuators if a.dimension is Dimension.ANGLE}
    parameters, maps = [], []
    for address in addresses:
        name_of = f"{address.owner}.{address.element}.{address.axis}"
        nominal = 1.0 if address.axis == "gain" else 0.0
        parameters.append(Parameter(name_of, _dimension(address, turns), nominal))
        maps.append(LinearMap(name_of, address))
    return Assembly(
        name, limbs, actuators, freedoms, controlled, home, tuple(parameters), tuple(maps)
    )


def list_addresses(limb: Limb) -> Iterable[Address]:
    """Yield every number of a limb that a parameter may change."""
    for link in (*limb.links, limb.attachment):
        yield from (Address(limb.name, link.name, axis) for axis in AXES)
    yield from (
        Address(limb.name, joint.name, "pitch") for joint in limb.joints if joint.kind == "R"
    )
    if limb.ending == "distance":
        yield Address(limb.name, "rod", "length")


def _dimension(address: Address, turns: set[str]) -> Dimension:
    if address.axis == "gain":
        return Dimension.RATIO
    angle = address.axis in AXES[:3] or (address.axis == "offset" and address.owner in turns)
    return Dimension.ANGLE if angle else Dimension.LENGTH


def place(point: Iterable[float], turn: Iterable[float] = (0.0, 0.0, 0.0)) -> Array:
    """Pose (4, 4) from a position [m] and a rotation vector [rad]."""
    return geometry.make_pose(
        geometry.exp_so3(np.array(list(turn), dtype=float)), np.array(list(point), dtype=float)
    )


def scale_lengths(assembly: Assembly, s: float) -> Assembly:
    """Multiply every length by s. Parameters must be zero or belong to links."""

    def grown(link: Link) -> Link:
        T = np.array(link.transform)
        T[:3, 3] *= s
        return replace(link, transform=T)

    def limb_of(limb: Limb) -> Limb:
        joints = tuple(
            replace(j, pitch=j.pitch * s, start=j.start * (s if j.kind == "P" else 1.0))
            for j in limb.joints
        )
        links = tuple(grown(link) for link in limb.links)
        return replace(
            limb,
            links=links,
            joints=joints,
            attachment=grown(limb.attachment),
            length=limb.length * s,
        )

    home = grown(Link("home", assembly.home)).transform
    return replace(assembly, limbs=tuple(limb_of(limb) for limb in assembly.limbs), home=home)


def move_base(assembly: Assembly, G: Array) -> Assembly:
    """Move the base: multiply what is on it and the homes of bodies by G (4, 4) from the left; of a
    chain the mounts of the stages on its base.
    """
    if assembly.stages:
        moved = (
            replace(stage, mount=G @ stage.mount) if stage.on == "base" else stage
            for stage in assembly.stages
        )
        return replace(assembly, stages=tuple(moved))

    def limb_of(limb: Limb) -> Limb:
        if limb.to == "base":
            end = replace(limb.attachment, transform=G @ limb.attachment.transform)
            limb = replace(limb, attachment=end)
        if limb.on != "base":
            return limb
        first = replace(limb.links[0], transform=G @ limb.links[0].transform)
        return replace(limb, links=(first, *limb.links[1:]))

    return replace(
        assembly,
        limbs=tuple(limb_of(limb) for limb in assembly.limbs),
        home=G @ assembly.home,
        bodies={name: G @ T for name, T in assembly.bodies.items()},
    )
