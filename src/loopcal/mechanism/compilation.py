# SPDX-License-Identifier: Apache-2.0
"""Compile an assembly: group its limbs, lay out displacements and joint values, find home, check
mobility.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal import engine
from loopcal.engine import Group, Program, Slot, State
from loopcal.errors import MechanismError
from loopcal.mechanism import mobility
from loopcal.mechanism.assembly import AXES, Address, Assembly, Limb
from loopcal.mechanism.batch_kinematics import compute_closure_sign, inverse_trials
from loopcal.mechanism.coordinates import COORDINATES, check_coordinates, read_coordinates
from loopcal.mechanism.model import Mechanism, SlotMap
from loopcal.mechanism.redundant_actuation import count_shared_drives
from loopcal.mechanism.transmission import TERMS, harmonic_frequencies, nominal_terms
from loopcal.parameters import ParameterTable
from loopcal.units import Dimension

DEFAULT_SIZE = 1.0
"""Characteristic length [m] of a mechanism all of whose lengths are zero (a spherical one with
every frame in its centre).
"""
POINT = 1e-9
"""Size over the longest link below which limbs leave and end in one point."""
DEFAULT_UNITS = {Dimension.LENGTH: "mm", Dimension.ANGLE: "deg", Dimension.RATIO: "1"}
ROWS = {"rigid": 6, "ball": 3, "distance": 1}


def build(
    assembly: Assembly, units: Mapping[Dimension, str] | None = None, record: Any = None
) -> Mechanism:
    """Compile a mechanism for the engine and find its home position.

    Parameters
    ----------
    assembly : what a family's `expand` returned.
    units : display units of its file. record : the family record, kept for writing the file back.

    Returns
    -------
    Mechanism at its nominal values.

    Raises
    ------
    MechanismError
        A name that is used twice or not known, a mechanism that cannot close at home, wrong
        mobility (with the freedoms that are too many or too few), a coordinate nobody controls.
    """
    _check_names(assembly)
    _check_freedoms(assembly)
    _check_ranges(assembly)
    table = ParameterTable(assembly.parameters)
    wanted = {m.address for m in assembly.maps} | {a for s in assembly.shared for a in s.outputs}
    _check_addresses(assembly, wanted)
    freedoms = tuple(AXES.index(f) for f in AXES if f in assembly.freedoms)
    size = characteristic_length(assembly)
    loose, _, count = _groups(assembly, wanted, {})
    held = mobility.find_idle_joints(
        Program(loose, freedoms, size, count, len(assembly.actuators)), _guess(assembly, loose)
    )
    _check_drives(assembly, held)
    groups, places, count = _groups(assembly, wanted, held)
    program = Program(
        groups, freedoms, size, count, len(assembly.actuators), _weights(assembly, groups, freedoms)
    )
    guess = _guess(assembly, groups)
    notes = tuple(
        _spin_note(assembly, limb, joint) for limb in sorted(held) for joint in held[limb]
    )
    slots = _slot_map(assembly, table, places, count)
    units = {**DEFAULT_UNITS, **(units or {})}
    robot = Mechanism(
        assembly, table, table.nominal, program, slots, size, guess, units, notes, record
    )
    return mobility.check_mobility(replace(robot, home_state=_home(robot)))


def characteristic_length(assembly: Assembly) -> float:
    """Root mean square distance [m] between the points where limbs leave the base and those where
    they meet the platform.

    Where these all lie in one point, the root mean square of links and rods; DEFAULT_SIZE where
    every length is zero.
    """
    home = assembly.home
    gaps = [
        (home @ limb.attachment.transform)[:3, 3] - limb.links[0].transform[:3, 3]
        for limb in assembly.limbs
    ]
    reach = [limb.attachment.transform[:3, 3] for limb in assembly.limbs]
    feet = [limb.links[0].transform[:3, 3] for limb in assembly.limbs]
    spread = np.concatenate([gaps, reach, np.subtract(feet, np.mean(feet, axis=0))])
    size = float(np.sqrt((spread**2).sum() / len(gaps)))
    links = [
        float(np.linalg.norm(link.transform[:3, 3]))
        for limb in assembly.limbs
        for link in (*limb.links, limb.attachment)
    ]
    links += [limb.length for limb in assembly.limbs]
    if size > POINT * max(links):  # else the points coincide but for rounding
        return size
    return float(np.sqrt(np.mean(np.square(links)))) or DEFAULT_SIZE


def _check_names(assembly: Assembly) -> None:
    names = [limb.name for limb in assembly.limbs]
    for kind, found in (("limb", names), ("actuator", [a.name for a in assembly.actuators])):
        for name in found:
            if found.count(name) > 1:
                raise MechanismError(
                    f"two {kind}s are called {name!r}; every {kind} needs its own name"
                )
    driven = [
        name
        for limb in assembly.limbs
        for name in (*(j.actuator for j in limb.joints), limb.actuator)
        if name
    ]
    for actuator in assembly.actuators:
        if actuator.name not in driven:
            raise MechanismError(
                f"actuator {actuator.name!r} drives 0 joints; it must drive one, or one in each of "
                "several limbs"
            )
    unknown = sorted(set(driven) - {a.name for a in assembly.actuators})
    if unknown:
        raise MechanismError(
            f"a joint is driven by {unknown[0]!r}, which is not among the actuators; add it or "
            "mend the name"
        )
    for limb in assembly.limbs:
        own = [name for name in (*(j.actuator for j in limb.joints), limb.actuator) if name]
        if len(set(own)) < len(own):
            raise MechanismError(
                f"limb {limb.name!r} is driven twice by {own[0]!r}; a drive may move one joint of "
                "a limb"
            )
        if limb.ending not in ROWS:
            raise MechanismError(
                f"limb {limb.name!r} ends in {limb.ending!r}; allowed endings are {', '.join(ROWS)}"
            )
        if len(limb.links) != len(limb.joints) + 1:
            raise MechanismError(
                f"limb {limb.name!r} has {len(limb.joints)} joints and {len(limb.links)} links; "
                "links are one more than joints"
            )


def _check_freedoms(assembly: Assembly) -> None:
    """Freedoms and controlled coordinates: there are some, all known, each named once."""
    found = assembly.freedoms
    wrong = [f for f in found if f not in AXES]
    if wrong:
        raise MechanismError(
            f"{wrong[0]!r} is not a freedom of a platform; allowed are {', '.join(AXES)}"
        )
    if not found:
        raise MechanismError(
            f"{assembly.name} has no freedoms; state those its platform has, of {', '.join(AXES)}"
        )
    twice = [f for f in found if found.count(f) > 1]
    if twice:
        raise MechanismError(
            f"the freedom {twice[0]!r} is named twice in {', '.join(found)}; name each once"
        )
    if not assembly.controlled:
        raise MechanismError(
            f"{assembly.name} names no controlled coordinate; state one for each freedom, of "
            f"{', '.join(COORDINATES)}"
        )
    check_coordinates(assembly.controlled)


def _check_ranges(assembly: Assembly) -> None:
    """Strokes and limits run upwards."""
    units = {Dimension.LENGTH: "m", Dimension.ANGLE: "rad"}
    ranges = [
        (f"stroke of {a.name} runs", a.stroke, units.get(a.dimension, ""))
        for a in assembly.actuators
    ]
    for limb in assembly.limbs:
        ranges += [
            (f"limits of {limb.name}.{j.name} run", j.limits, "rad" if j.kind == "R" else "m")
            for j in limb.joints
        ]
    for what, found, symbol in ranges:
        if found and not found[0] < found[1]:
            raise MechanismError(
                f"the {what} from {found[0]:g} to {found[1]:g} {symbol}; the first must be smaller"
            )


def _check_addresses(assembly: Assembly, wanted: set[Address]) -> None:
    limbs = {limb.name: limb for limb in assembly.limbs}
    actuators = {a.name for a in assembly.actuators}
    for address in sorted(wanted, key=str):
        if (
            address.owner in actuators
            and address.element == "transmission"
            and address.axis in TERMS
        ):
            continue
        if address.owner in limbs and _slot(limbs[address.owner], address) is not None:
            continue
        raise MechanismError(
            f"a parameter is mapped onto {address}, which this mechanism does not have; mend the "
            "map"
        )


def _slot(limb: Limb, address: Address) -> Slot | None:
    """The slot of an address in a limb, None where there is none."""
    joints = [j.name for j in limb.joints]
    if address.axis == "length":
        return (
            Slot(len(joints), engine.LENGTH)
            if limb.ending == "distance" and address.element == "rod"
            else None
        )
    if address.axis == "pitch":
        turning = (
            address.element in joints and limb.joints[joints.index(address.element)].kind == "R"
        )
        return Slot(joints.index(address.element), engine.PITCH) if turning else None
    links = [*(link.name for link in limb.links), limb.attachment.name]
    if address.element not in links or address.axis not in AXES:
        return None
    return Slot(links.index(address.element), AXES.index(address.axis))


def _check_drives(assembly: Assembly, held: Mapping[int, tuple[int, ...]]) -> None:
    """Refuse a limb whose drive moves nothing but the limb itself."""
    for i, limb in enumerate(assembly.limbs):
        driven = sum(bool(j.actuator) for j in limb.joints) + bool(limb.actuator)
        free, rows = (
            len(limb.joints) + bool(limb.actuator) - len(held.get(i, ())),
            len(_rows(limb.ending, assembly.freedoms)),
        )
        if driven and free > rows:
            raise MechanismError(
                f"limb {limb.name!r} has {free} joints, but {rows} closure equations: its drive "
                "moves the limb and not the "
                f"platform; leave out {_joints(free - rows)}, or make their axes such that they "
                "only spin the limb"
            )


def _joints(count: int) -> str:
    return f"{count} joint{'s' if count > 1 else ''}"


def _groups(
    assembly: Assembly, wanted: set[Address], held: Mapping[int, tuple[int, ...]]
) -> tuple[tuple[Group, ...], dict[Address, int], int]:
    """Group limbs of one structure, by what is held in them too; give every displacement its place
    in e.
    """
    column = {a.name: i for i, a in enumerate(assembly.actuators)}
    alike: dict[tuple, list[int]] = {}
    for i, limb in enumerate(assembly.limbs):
        drive = tuple(bool(j.actuator) for j in limb.joints), bool(limb.actuator)
        alike.setdefault(
            (limb.ending, tuple(j.kind for j in limb.joints), drive, held.get(i, ())), []
        ).append(i)
    groups, places, count = [], {}, 0
    for (ending, kinds, _, still), members in alike.items():
        limbs = [assembly.limbs[i] for i in members]
        own = [{a: _slot(limb, a) for a in wanted if a.owner == limb.name} for limb in limbs]
        slots = tuple(
            sorted(
                {s for found in own for s in found.values() if s}, key=lambda s: (s.element, s.axis)
            )
        )
        for found in own:
            places |= {a: count + slots.index(s) for a, s in found.items() if s}
            count += len(slots)
        drives = [
            [
                *(column[j.actuator] if j.actuator else -1 for j in limb.joints),
                column.get(limb.actuator or "", -1),
            ]
            for limb in limbs
        ]
        groups.append(
            Group(
                tuple(members),
                "".join(kinds),
                np.array(drives, dtype=np.int64).T.reshape(len(kinds) + 1, len(limbs)),
                tuple(j in still for j in range(len(kinds))),
                ending,
                _rows(ending, assembly.freedoms),
                np.array(
                    [[link.transform for link in (*limb.links, limb.attachment)] for limb in limbs]
                ),
                np.array([[j.pitch for j in limb.joints] for limb in limbs]).reshape(
                    len(limbs), len(kinds)
                ),
                np.array([limb.length for limb in limbs]),
                slots,
                slice(count - len(slots) * len(limbs), count),
            )
        )
    return tuple(groups), places, count


def _rows(ending: str, freedoms: tuple[str, ...]) -> tuple[int, ...]:
    """Rows of an ending that lie in the platform's freedoms: closure of a planar machine is asked
    for in its plane.
    """
    if ending == "distance":
        return (0,)
    axes = AXES if ending == "rigid" else AXES[3:]
    return tuple(i for i, axis in enumerate(axes) if axis in freedoms)


def _weights(
    assembly: Assembly, groups: tuple[Group, ...], freedoms: tuple[int, ...]
) -> tuple[float, ...] | None:
    """Relative standard deviations of redundant actuators, the largest one 1; None where no
    actuator is redundant.
    """
    if len(assembly.actuators) <= len(freedoms):
        return None
    for group in groups:
        rows = len(group.rows) - len(group.unknown_joints(False))
        driven = int((group.actuator[:, 0] >= 0).sum())
        if rows != driven or driven != 1:
            limb = assembly.limbs[group.limbs[0]].name
            raise MechanismError(
                f"{assembly.name} has {len(assembly.actuators)} actuators for {len(freedoms)} "
                f"freedoms, and limb {limb!r} has "
                f"{driven} of them and {rows} closure equations; redundant actuation needs limbs "
                "with one of each"
            )
    sigma = [a.sigma if a.sigma is not None else 1.0 for a in assembly.actuators]
    if len({a.sigma is None for a in assembly.actuators}) > 1 or min(sigma) <= 0:
        raise MechanismError(
            f"{assembly.name} has more actuators than freedoms; state a positive sigma for each of "
            "them, or for none"
        )
    return tuple(s / max(sigma) for s in sigma)


def _spin_note(assembly: Assembly, limb: int, joint: int) -> str:
    """What is said of a joint that moves only its limb."""
    owner = assembly.limbs[limb]
    held = owner.joints[joint]
    what, unit = ("spin about itself", "rad") if held.kind == "R" else ("slide along itself", "m")
    return (
        f"limb {owner.name} can {what} without moving the platform; "
        f"its joint {held.name} is held at {held.start:g} {unit}, which changes no pose"
    )


def _slot_map(
    assembly: Assembly, table: ParameterTable, places: dict[Address, int], count: int
) -> SlotMap:
    """The maps as one matrix and the shared functions with their places."""
    actuators = {a.name: i for i, a in enumerate(assembly.actuators)}

    def place(address: Address) -> int:
        if address in places:
            return places[address]
        return count + len(TERMS) * actuators[address.owner] + TERMS.index(address.axis)

    matrix = np.zeros((count + len(TERMS) * len(actuators), len(table)))
    for entry in assembly.maps:
        matrix[place(entry.address), table.index(entry.parameter)] += entry.coefficient
    shared = tuple(
        (s, tuple(table.index(name) for name in s.inputs), tuple(place(a) for a in s.outputs))
        for s in assembly.shared
    )
    terms, w = nominal_terms(assembly.actuators), harmonic_frequencies(assembly.actuators)
    return SlotMap(matrix, shared, table.nominal, count, terms, w)


def _guess(assembly: Assembly, groups: tuple[Group, ...]) -> State:
    """The start of the search for home: the home pose with every joint at its `start`."""
    joints = []
    for group in groups:
        limbs = [assembly.limbs[i] for i in group.limbs]
        joints.append(
            np.array([[*(j.start for j in limb.joints), 0.0] for limb in limbs])[None, None]
        )
    zero = np.zeros((1, 1))
    return State(
        assembly.home[None, None],
        tuple(joints),
        zero.astype(np.int8),
        zero,
        zero.astype(np.int64),
        zero.astype(np.int8),
    )


def _home(robot: Mechanism) -> State:
    """The closed state at the home pose's controlled coordinates; raises MechanismError where the
    loops cannot close.
    """
    values = robot.values[None]
    target = read_coordinates(robot.assembly.home[None, None], robot.controlled)
    program = robot.program
    movable = len(program.freedoms) - sum(
        len(g.limbs) * (len(g.rows) - len(g.unknown_joints(True))) for g in program.groups
    )
    movable -= count_shared_drives(program)
    if len(robot.controlled) < movable:
        raise MechanismError(
            f"{robot.name} can be moved in {movable} freedoms or more, but {len(robot.controlled)} "
            "controlled coordinates are "
            f"named ({', '.join(robot.controlled)}); name one for every freedom, or state fewer "
            "`freedoms:`"
        )
    state = inverse_trials(robot, values, target)
    if state.status[0, 0] != engine.CONVERGED:
        if not count_shared_drives(program):
            mobility.refuse_uncontrolled(robot, robot.home_state)
        raise MechanismError(
            f"{robot.name} cannot close at its home pose: the loops stay "
            f"{state.residual[0, 0] * 1e3:.3g} mm open; "
            "check the joint centres, lengths and home"
        )
    return replace(state, closure_sign=compute_closure_sign(robot, values, state))
