# SPDX-License-Identifier: Apache-2.0
"""Which joints of an over-constrained machine can have more freedom, so that no equation repeats.

With the combinations w of repeated equations, limb k exerts the wrench F = A_k'w_k on the platform.
A joint more, with the twist x at the platform, frees the direction in which this wrench does work:
x'F. Joints whose works are independent for all w, as many as equations that repeat others, leave
none, and do not let the machine move in any other way. The freedoms that people build are tried: R
to U, S or C, U to S, and a rotation at C or P. The machine with these joints is then built, and
must close with drawn errors of all parameters. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import over_constraint
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.limbs import (
    Axis,
    JointRecord,
    LimbRecord,
    Limbs,
    Prismatic,
    Revolute,
    Spherical,
    Universal,
    axis_vector,
)
from loopcal.mechanism.families.placement import frame_from_axis
from loopcal.mechanism.kinematics import compute_limb_frames, compute_readings, forward_trials
from loopcal.mechanism.limb_rows import move_joint
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import Status, list_bodies
from loopcal.typing import FloatArray
from loopcal.units import Dimension

# Smallest singular value of the works, relative to the largest, of independent joints.
INDEPENDENT = 1e-6
SHOWN = 3  # most sets of joints that are proposed
TRIED = 12  # most sets of joints that are built and verified
# Standard deviation of an error without tolerance: of a length, relative to the robot's size; of an
# angle [rad]; of a ratio [1].
DEFAULT_ERROR = 1e-3


@dataclass(frozen=True, eq=False)
class AddedJoint:
    """A joint that can be added behind another one.

    limb, joint : names in the file. place : of the joint in its chain. record : the joint added.
    works : (r, copies) of the twists of all copies of the limb with the r self-stresses.
    """

    limb: str
    joint: str
    place: int
    record: Revolute | Prismatic
    works: FloatArray

    @property
    def line(self) -> str:
        """The line of the robot file."""
        record = self.record
        return f"- {{joint: {record.joint}, name: {record.name}, axis: {record.axis}}}"


def propose_added_joints(robot: Mechanism) -> Finding | None:
    """Return the finding of joints that make an over-constrained machine one of exact constraint,
    or that none was found; None for other machines, and those that no `limbs` file describes.
    """
    record = getattr(robot.record, "record", robot.record)
    is_exact = over_constraint.is_over_constrained(robot) and not robot.program.may_stay_open
    if not (isinstance(record, Limbs) and is_exact and len(robot.program.freedoms) == 6):
        return None
    proposals = []
    for chosen in _choose_sets(list(_list_candidates(robot, record)))[:TRIED]:
        if _is_verified(robot, record, chosen):
            proposals.append(
                tuple({"limb": a.limb, "joint": a.joint, "line": a.line} for a in chosen)
            )
        if len(proposals) == SHOWN:
            break
    if not proposals:
        return report_finding("mechanism.no-joint-to-free", name=robot.name)
    return report_finding("mechanism.joints-to-free", proposals=tuple(proposals))


def _list_candidates(robot: Mechanism, record: Limbs) -> Iterator[AddedJoint]:
    """Yield the joints that can be added, joint by joint, rotations before slides."""
    stress = over_constraint.find_self_stress(robot)  # (r, limbs, 6)
    frames = compute_limb_frames(robot, robot.values[None], robot.home_state)
    pairs = zip(robot.program.groups, robot.home_state.joints, strict=True)
    values = {i: own[0, 0, k] for group, own in pairs for k, i in enumerate(group.limbs)}
    numbers = {limb.name: i for i, limb in enumerate(robot.assembly.limbs)}
    bodies, scale = list_bodies(robot.home_state), 1 / robot.twist_scale
    # the wrenches of a limb are those on the body where it ends
    centers = [
        bodies[robot.assembly.numbers[limb.to]][..., :3, 3].reshape(3)
        for limb in robot.assembly.limbs
    ]
    for limb in record.limbs:
        count = 0 if limb.copies is None else limb.copies.count
        members = [numbers[limb.name + str(i + 1)] for i in range(count)] or [numbers[limb.name]]
        names = [joint.name for joint in robot.assembly.limbs[members[0]].joints]
        element = -1
        for place, joint in enumerate(limb.chain):
            element += {"U": 2, "C": 2, "S": 3}.get(joint.joint, 1)
            name = joint.name or names[element]
            last: Axis = "x"  # of a ball
            if not isinstance(joint, Spherical):
                last = joint.axes[1] if isinstance(joint, Universal) else joint.axis
            carried = frame_from_axis(axis_vector(last), f"joint {name!r}").T
            for added in _list_additions(joint, name):
                works = []
                for i in members:
                    own = robot.assembly.limbs[i].joints[element]
                    T = frames[i][0, 0, element] @ move_joint(own, values[i][element])
                    u = T[:3, :3] @ carried @ axis_vector(added.axis)
                    twist = np.concatenate([np.zeros(3), u])
                    if added.joint == "R":
                        twist = np.concatenate([u, np.cross(u, centers[i] - T[:3, 3])])
                    # wrenches are those by freedoms over `scale`
                    works.append(stress[:, i] @ (twist / scale))
                yield AddedJoint(limb.name, name, place, added, np.array(works).T)


def _list_additions(joint: JointRecord, name: str) -> Iterator[Revolute | Prismatic]:
    """Yield joints to add behind one: R to U, S or C, U to S, and a rotation at C or P."""
    if isinstance(joint, Spherical) or getattr(joint, "actuated", None):
        return
    own = {joint.axis} if not isinstance(joint, Universal) else set(joint.axes)
    used = set() if isinstance(joint, Prismatic) else own
    for axis in ("x", "y", "z"):
        if axis not in used and f"-{axis}" not in used:
            yield Revolute("R", f"{name}-{axis}", axis=axis)
    if isinstance(joint, Revolute) and joint.axis in ("x", "y", "z"):
        yield Prismatic("P", f"{name}-slide", axis=joint.axis)


def _choose_sets(candidates: list[AddedJoint]) -> list[list[AddedJoint]]:
    """Return sets of joints of independent works that leave no self-stress, few joints first."""
    ordered = sorted(candidates, key=lambda c: c.record.joint == "P")
    sets: dict[frozenset[int], list[AddedJoint]] = {}
    for first in candidates:
        own = [c for c in candidates if (c.limb, c.joint) == (first.limb, first.joint)]
        chosen, works = [], np.zeros((len(first.works), 0))
        for candidate in [first, *own, *ordered]:
            extended = np.concatenate([works, candidate.works], axis=1)
            s = np.linalg.svd(extended, compute_uv=False)
            is_possible = extended.shape[1] <= len(extended)
            if is_possible and s[-1] > INDEPENDENT * max(s[0], INDEPENDENT):
                chosen, works = [*chosen, candidate], extended
        if works.shape[1] == len(works):
            sets.setdefault(frozenset(map(id, chosen)), chosen)

    def count(chosen: list[AddedJoint]) -> tuple[int, int, int]:
        slides = sum(c.record.joint == "P" for c in chosen)
        return len({(c.limb, c.joint) for c in chosen}), len(chosen), slides

    return sorted(sets.values(), key=count)


def _is_verified(robot: Mechanism, record: Limbs, chosen: list[AddedJoint]) -> bool:
    """Return whether the machine with these joints moves as before, no equation repeats another,
    and its loops close at home and near it with drawn errors of all parameters.
    """
    limbs = tuple(_add_joints(limb, chosen) for limb in record.limbs)
    try:
        freer = build(replace(record, limbs=limbs).assembly())
    except MechanismError:
        return False
    if [f.code for f in freer.findings] != [
        f.code for f in robot.findings if f.code != "mechanism.repeated-equations"
    ]:
        return False
    table, rng = freer.parameters, np.random.default_rng(0)
    is_length = np.array([p.dimension is Dimension.LENGTH for p in table.entries])
    assumed = DEFAULT_ERROR * np.where(is_length, freer.size, 1.0)
    sd = np.where(np.isnan(table.tolerance), assumed, table.tolerance)
    values = table.nominal + sd * rng.standard_normal((2, len(table)))
    q = compute_readings(
        robot, robot.parameters.nominal[None], over_constraint.find_nearby_states(robot)
    )
    state = forward_trials(freer, values, q, follow=False)
    return bool((state.status == Status.CONVERGED.value).all())


def _add_joints(limb: LimbRecord, chosen: list[AddedJoint]) -> LimbRecord:
    """Return a limb with joints added behind its own."""
    chain: list[JointRecord] = []
    for place, joint in enumerate(limb.chain):
        chain.append(joint)
        chain += [c.record for c in chosen if (c.limb, c.place) == (limb.name, place)]
    return replace(limb, chain=tuple(chain))
