# SPDX-License-Identifier: Apache-2.0
"""Mechanisms: rows of kinematic solutions, limits, singularities, redundant constraints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry, Quantity, fill_template

MOTIONS = {
    "rx": "rotation about x",
    "ry": "rotation about y",
    "rz": "rotation about z",
    "x": "translation along x",
    "y": "translation along y",
    "z": "translation along z",
}


def describe_motion(freedoms: Sequence[str]) -> str:
    """Return the motion in these freedoms, the largest component first."""
    return " with ".join(MOTIONS[freedom] for freedom in freedoms)


def _word_free_platform(data: Mapping[str, Any]) -> str:
    return fill_template(
        "{name}: at home the platform can still move with every actuator locked "
        f"({describe_motion(data['motion'])}); its {{equations:count closure equation}} constrain "
        "{rank} of {freedoms} freedoms. Add a limb or an actuator, or state fewer freedoms.",
        **data,
    )


def _word_over_constrained(data: Mapping[str, Any]) -> str:
    motions = ", ".join(describe_motion(motion) for motion in data["motions"])
    return fill_template(
        "{name} is over-constrained: it has {actuators:count actuator}, but at home the limbs "
        f"leave the platform only {{movable}} of {{freedoms}} freedoms. Impossible: {motions}. "
        "Remove a constraint or make a joint passive.",
        **data,
    )


def _word_idle_joint(data: Mapping[str, Any]) -> str:
    motion = "spin about its own axis" if data["turns"] else "slide along its own axis"
    return fill_template(
        f"Limb {{limb}} can {motion} without moving the platform. Its joint {{joint}} is locked at "
        "{value}; this changes no pose.",
        **data,
    )


def _word_repeated_equations(data: Mapping[str, Any]) -> str:
    verb = "repeats another one" if data["count"] == 1 else "repeat others"
    text = (
        f"{{count:count closure equation}} {verb}: the robot is over-constrained and closes for "
        "exact geometry only."
    )
    if data["freedoms"]:
        text += f" State freedoms: [{', '.join(data['freedoms'])}] to leave them out."
    return fill_template(text, **data)


def _word_distance(data: Mapping[str, Any]) -> str:
    return fill_template(
        "the smallest singular value of the closure is {margin} m/m, {ratio} of the median; the "
        f"platform is least constrained in {describe_motion(data['motion'])}",
        **data,
    )


def _word_weak_actuator(data: Mapping[str, Any]) -> str:
    return _word_distance(data) + fill_template(
        "; {actuator} hardly moves the platform ({drive_margin} m/m, {drive_ratio} of the median)",
        **data,
    )


def _word_path_near(data: Mapping[str, Any]) -> str:
    nearest = _word_weak_actuator(data) if data["actuator"] else _word_distance(data)
    return fill_template(
        f"Steps {{first}} to {{last}} are close to a singularity, closest at step {{row}}: "
        f"{nearest}.",
        **data,
    )


_DISTANCE = {"row": 7, "margin": 0.31, "ratio": 0.08, "motion": ("rz", "x")}
"""Data of the examples."""

ENTRIES = (
    Entry(
        "kinematics.closed",
        Severity.INFO,
        "closed, residual {gap}",
        "Every loop closes in the assembly mode of the start.",
    ),
    Entry(
        "kinematics.compromise",
        Severity.INFO,
        "redundant readings contradict each other by {gap}; the pose is their best compromise",
        "The robot has more actuators than freedoms and the readings do not agree exactly.",
    ),
    Entry(
        "kinematics.unreachable",
        Severity.WARNING,
        "the loops cannot be closed: the nearest position leaves a gap of {gap}",
        "The readings or the pose are outside the reach of the machine.",
        "Check the readings, the pose and the geometry.",
    ),
    Entry(
        "kinematics.not-converged",
        Severity.WARNING,
        "no solution after {iterations:count step}: the loops still have a gap of {gap}",
        "Newton's method ran out of steps.",
        "Choose a start closer to the solution.",
    ),
    Entry(
        "kinematics.not-finite",
        Severity.WARNING,
        "not computed: the row contains NaN or infinity, or the mechanism is singular there",
        "An input is not a number, or the equations have no unique solution.",
        "Check the row for missing values; move the pose away from the singularity.",
    ),
    Entry(
        "kinematics.other-mode",
        Severity.WARNING,
        "closed, but in another assembly mode than the start",
        "The solution lies on the other side of a singularity than the start.",
        "Check the row, or choose a start in this mode.",
    ),
    Entry(
        "limits.exceeded",
        Severity.WARNING,
        "{name} is {value}, outside {low} to {high}",
        "A reading, a joint or the inclination of a rod is outside its stated range.",
        "Choose another pose, or correct the range in the robot file.",
    ),
    Entry(
        "singularity.not-reached",
        Severity.WARNING,
        "not reached: {reason}",
        "The distance from a singularity is unknown, since the loops do not close.",
        "Check the pose.",
        example={"row": 3, "reason": "The loops cannot be closed"},
    ),
    Entry(
        "singularity.distance",
        Severity.INFO,
        _word_distance,
        "The distance of a pose from a parallel singularity.",
        example=_DISTANCE | {"actuator": None},
    ),
    Entry(
        "singularity.weak-actuator",
        Severity.WARNING,
        _word_weak_actuator,
        "An actuator moves the platform by less than a tenth of the usual amount.",
        "Keep a distance from this pose: it is close to a serial singularity.",
        example=_DISTANCE | {"actuator": "q2", "drive_margin": 0.021, "drive_ratio": 0.06},
    ),
    Entry(
        "singularity.path-crosses",
        Severity.WARNING,
        "The determinant of closure changes its sign before step {row}: the path crosses a "
        "singularity or jumps to another mode.",
        "Two neighboring steps lie on different sides of a singularity.",
        "Change the path, or use smaller steps.",
    ),
    Entry(
        "singularity.path-not-reached",
        Severity.WARNING,
        "The path is not reached from step {row} on: {reason}.",
        "The loops do not close at a step of the path.",
        "Check the readings or coordinates of this step.",
    ),
    Entry(
        "singularity.path-near",
        Severity.WARNING,
        _word_path_near,
        "A margin along the path is less than a tenth of its median over the workspace.",
        "Change the path between these steps.",
        example=_DISTANCE | {"actuator": None, "first": 4, "last": 9},
    ),
    Entry(
        "mechanism.free-platform",
        Severity.REFUSAL,
        _word_free_platform,
        "Locked actuators do not hold the platform at home.",
        "Add a limb or an actuator, or state fewer freedoms.",
        example={"name": "hexapod", "motion": ("rz",), "equations": 5, "rank": 5, "freedoms": 6},
    ),
    Entry(
        "mechanism.over-constrained",
        Severity.REFUSAL,
        _word_over_constrained,
        "The limbs leave the platform fewer freedoms than there are actuators.",
        "Remove a constraint, make a joint passive or state other freedoms.",
        example={
            "name": "tripod",
            "actuators": 3,
            "movable": 2,
            "freedoms": 3,
            "motions": (("z",),),
        },
    ),
    Entry(
        "mechanism.locked-joint",
        Severity.INFO,
        _word_idle_joint,
        "A limb can move while its two ends rest, such as the rod of an S-P-S leg.",
        example={
            "limb": "leg1",
            "joint": "leg1.spin",
            "turns": True,
            "value": Quantity(0.0, "rad"),
        },
    ),
    Entry(
        "mechanism.repeated-equations",
        Severity.INFO,
        _word_repeated_equations,
        "The limbs constrain the platform more often than necessary.",
        "State the platform's freedoms in the robot file, if the redundant constraints are real.",
        example={"count": 6, "freedoms": ("x", "y", "z")},
    ),
)
