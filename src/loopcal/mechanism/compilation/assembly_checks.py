# SPDX-License-Identifier: Apache-2.0
"""Checks of an assembly: names, limbs, freedoms and ranges that fit together."""

from __future__ import annotations

from loopcal.engine import ENDINGS
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import (
    AXES,
    MOST_ACTUATORS,
    MOST_JOINTS,
    MOST_LIMBS,
    MOST_PARAMETERS,
    Assembly,
    Limb,
    is_serial,
    refuse_more,
    select_rows,
)
from loopcal.mechanism.platform_coordinates import COORDINATES, check_coordinates
from loopcal.units import SI_SYMBOLS


def check_assembly(assembly: Assembly, *, is_stage: bool = False) -> None:
    """Refuse inconsistent names, limbs, freedoms and ranges; raises MechanismError.

    A stage that is a serial joint needs no controlled coordinates, because its joint is commanded.
    """
    _check_size(assembly)
    _check_names(assembly)
    for limb in assembly.limbs:
        _check_limb(limb)
    _check_freedoms(assembly, is_stage)
    _check_ranges(assembly)


def _check_size(assembly: Assembly) -> None:
    """Refuse more limbs, joints, actuators or parameters than a mechanism may have."""
    refuse_more(MOST_LIMBS, len(assembly.limbs), f"{assembly.name} has", "limbs")
    for limb in assembly.limbs:
        refuse_more(MOST_JOINTS, len(limb.joints), f"limb {limb.name!r} has", "joints")
    refuse_more(MOST_ACTUATORS, len(assembly.actuators), f"{assembly.name} has", "actuators")
    refuse_more(MOST_PARAMETERS, len(assembly.parameters), f"{assembly.name} has", "parameters")


def _check_names(assembly: Assembly) -> None:
    """Refuse duplicate names, and drives or actuators without their counterpart."""
    limbs, actuators = [limb.name for limb in assembly.limbs], [a.name for a in assembly.actuators]
    for kind, names in (("limb", limbs), ("actuator", actuators)):
        for name in names:
            if names.count(name) > 1:
                raise MechanismError(f"two {kind}s are called {name!r}; give each its own name")
    driven = [name for limb in assembly.limbs for name in limb.drives]
    read = assembly.driven_joints
    for name in read:
        if name not in driven:
            raise MechanismError(
                f"actuator {name!r} drives 0 joints; let it drive one joint, or one in each of "
                "several limbs"
            )
    unknown = sorted(set(driven) - set(read))
    if unknown:
        raise MechanismError(
            f"a joint is driven by {unknown[0]!r}, which is not among the actuators; add it or "
            "correct the name"
        )


def _check_limb(limb: Limb) -> None:
    """Refuse duplicate names, two joints on a drive, an unknown ending or missing links."""
    joints = [joint.name for joint in limb.joints]
    if len(set(joints)) < len(joints):
        raise MechanismError(
            f"two joints of limb {limb.name!r} have the same name ({', '.join(joints)}); give each "
            "its own name"
        )
    if len(set(limb.drives)) < len(limb.drives):
        raise MechanismError(
            f"actuator {limb.drives[0]!r} drives two joints of limb {limb.name!r}; an actuator "
            "may drive one joint of a limb"
        )
    if limb.ending not in ENDINGS:
        raise MechanismError(
            f"limb {limb.name!r} ends in {limb.ending!r}; allowed endings are {', '.join(ENDINGS)}"
        )
    if len(limb.links) != len(limb.joints) + 1:
        raise MechanismError(
            f"limb {limb.name!r} has {len(limb.joints)} joints and {len(limb.links)} links; give "
            "one link more than joints"
        )


def _check_freedoms(assembly: Assembly, is_stage: bool) -> None:
    """Refuse missing, unknown or duplicate freedoms and controlled coordinates."""
    freedoms = assembly.freedoms
    unknown = [f for f in freedoms if f not in AXES]
    if unknown:
        raise MechanismError(
            f"{unknown[0]!r} is not a freedom of a platform; allowed are {', '.join(AXES)}"
        )
    if not freedoms:
        raise MechanismError(
            f"{assembly.name} has no freedoms; state those of its platform, of {', '.join(AXES)}"
        )
    duplicates = [f for f in freedoms if freedoms.count(f) > 1]
    if duplicates:
        raise MechanismError(
            f"duplicate freedom {duplicates[0]!r} in {', '.join(freedoms)}; name each once"
        )
    balls = [limb.name for limb in assembly.limbs if not select_rows(limb.ending, freedoms)]
    if balls:
        raise MechanismError(
            f"limb {balls[0]!r} ends in a ball, whose closure equations are shifts, but the "
            f"freedoms of the platform are {', '.join(freedoms)}; state the shifts of its origin, "
            "too, or leave out `freedoms:`"
        )
    rotations = [f for f in freedoms if f.startswith("r")]
    if len(rotations) == 2:
        raise MechanismError(
            f"{assembly.name} has the freedoms {' and '.join(rotations)}, which define no pose: "
            "the same two rotations in another order lead to another one. Let the platform have "
            "all freedoms, and add a limb with the joint that holds it, such as {joint: U, axes: "
            "[x, y]} with the ending rigid"
        )
    if is_stage and is_serial(assembly):
        return
    if not assembly.controlled:
        raise MechanismError(
            f"{assembly.name} names no controlled coordinate; state one for each freedom, of "
            f"{', '.join(COORDINATES)}"
        )
    check_coordinates(assembly.controlled)


def _check_ranges(assembly: Assembly) -> None:
    """Refuse strokes and limits whose low end is not below the high one."""
    ranges = [(f"stroke of {a.name} runs", a.stroke, a.dimension) for a in assembly.actuators]
    ranges += [
        (f"limits of {limb.name}.{joint.name} run", joint.limits, joint.dimension)
        for limb in assembly.limbs
        for joint in limb.joints
    ]
    for what, bounds, dimension in ranges:
        if bounds and not bounds[0] < bounds[1]:
            raise MechanismError(
                f"the {what} from {bounds[0]:g} to {bounds[1]:g} {SI_SYMBOLS[dimension]}; the "
                "first value must be smaller"
            )
