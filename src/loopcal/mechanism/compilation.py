# SPDX-License-Identifier: Apache-2.0
"""Compilation of an assembly: groups of limbs, places of displacements, home position, mobility."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal import engine, geometry
from loopcal.engine import Group, Program, Slot, State
from loopcal.errors import MechanismError, suggest_names
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.findings.wording import name_count
from loopcal.mechanism import kinematics
from loopcal.mechanism.actuation import list_open_sums, stack_sum_rows
from loopcal.mechanism.assembly import AXES, BASE, PLATFORM, Address, Assembly, AttachedStage, Limb
from loopcal.mechanism.chains import find_carrying_actuators, join_stage_states, locate_stage_bases
from loopcal.mechanism.inverse import close_with_free_actuators, inverse_trials
from loopcal.mechanism.limb_rows import linearize_state
from loopcal.mechanism.mobility import (
    RANK,
    STRETCHED,
    check_assembly,
    check_mobility,
    count_rank,
    find_idle_joints,
    refuse_free_bodies,
    refuse_singular_home,
    refuse_uncontrolled,
    shake_joints,
)
from loopcal.mechanism.model import Mechanism, SlotMap, Stage
from loopcal.mechanism.over_constraint import report_over_constraint
from loopcal.mechanism.platform_coordinates import (
    COORDINATES,
    differentiate_coordinates,
    read_coordinates,
)
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import is_closed, make_start
from loopcal.mechanism.transmission import LOAD, list_constants, name_terms, nominal_terms
from loopcal.numerics.decomposition import find_null_space
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, LARGEST, SI_SYMBOLS, Dimension


def find_impossible_values(
    robot: Mechanism, values: FloatArray
) -> tuple[tuple[str | None, Finding], ...]:
    """Return (parameter, finding) for values (p,) [SI] that no machine of this structure has; the
    parameter is None where single values are possible, but the loops cannot be closed.
    """
    findings = tuple(_find_single_values(robot, values))
    if findings:
        return findings
    if robot.program.sigma is not None:
        # errors of the geometry make redundant readings contradict each other
        target = read_coordinates(robot.home_state.T, robot.controlled)
        state = inverse_trials(robot, values[None], target)
    else:  # at the readings of the nominal home, where nominal values displace nothing
        q = kinematics.compute_readings(robot, robot.parameters.nominal[None], robot.home_state)
        state = kinematics.forward_trials(robot, values[None], q)
    if is_closed(state.status).all():
        return ()
    table = robot.parameters
    largest = int(np.argmax(np.abs(values - table.nominal)))
    value, nominal = (
        robot.to_quantity(float(own[largest]), table.dimensions[largest])
        for own in (values, table.nominal)
    )
    gap = float(state.residual[0, 0])
    finding = report_finding(
        "mechanism.values-open-loops",
        gap=robot.describe_gap(gap) if np.isfinite(gap) else None,
        name=table.names[largest],
        value=value,
        nominal=nominal,
    )
    return ((None, finding),)


def _find_single_values(robot: Mechanism, values: FloatArray) -> Iterator[tuple[str, Finding]]:
    """Yield parameters whose own value is impossible."""
    table = robot.parameters
    is_large = ~(np.abs(values) <= LARGEST)
    for i in np.flatnonzero(is_large | (table.positive & ~(values > 0.0))):
        p = table.entries[i]
        code, bound = "mechanism.value-not-positive", {"nominal": p.nominal}
        if is_large[i]:
            code, bound = "mechanism.value-too-large", {"limit": LARGEST}
        numbers = {"value": float(values[i]), **bound}
        shown: dict[str, Any] = {
            name: robot.to_quantity(number, p.dimension) for name, number in numbers.items()
        }
        yield p.name, report_finding(code, name=p.name, **shown)


LESS = 1e-3  # weight of rods, which have no start, among drives that are chosen to be held
STARTS = 4  # disturbed starts from which home is tried where it is not found
# Characteristic length [m] of a mechanism whose lengths are all zero (a spherical one).
DEFAULT_SIZE = 1.0
POINT = 1e-9  # ratio of size and longest link below which all limbs begin and end in one point


def build(
    assembly: Assembly,
    units: Mapping[Dimension, str] | None = None,
    record: Any = None,
    *,
    is_stage: bool = False,
) -> Mechanism:
    """Compile the assembly of a family for the engine and find its home position.

    units : display units of the file. record : the family record, kept for writing the file.
    is_stage : whether other stages carry it or are on it.
    Raises MechanismError: duplicate or unknown names, loops that cannot be closed at home, wrong
        mobility, coordinates that cannot be controlled.
    """
    check_assembly(assembly, is_stage=is_stage)
    if assembly.stages:
        return _build_chain(assembly, units or {}, record)
    robot = _close_at_home(assembly, units, record)
    is_placed = robot.is_serial and not robot.controlled
    return robot if is_placed else report_over_constraint(robot, _close_at_home)


def _close_at_home(
    assembly: Assembly, units: Mapping[Dimension, str] | None = None, record: Any = None
) -> Mechanism:
    """Return a mechanism of one stage with its loops closed at home, and its mobility checked."""
    table = ParameterTable(assembly.parameters, assembly.common_errors)
    for p in table.entries:
        if not abs(p.nominal) <= LARGEST:
            symbol = SI_SYMBOLS[p.dimension]
            raise MechanismError(
                f"the nominal value of {p.name} is {p.nominal:g} {symbol}, above the limit of "
                f"{LARGEST:g} {symbol}"
            )
    slots = _find_slots(assembly)
    freedoms = tuple(AXES.index(f) for f in AXES if f in assembly.freedoms)
    size, a = compute_characteristic_length(assembly), len(assembly.driven_joints)
    of_bodies = tuple(AXES.index(f) for f in assembly.freedoms_of_bodies)
    others = (of_bodies,) * len(assembly.bodies)
    groups, places, count = _group_limbs(assembly, slots, {})
    guess = _make_first_guess(assembly, groups)
    idle = find_idle_joints(Program(groups, freedoms, size, count, a, others=others), guess)
    _check_drives(assembly, idle)
    if idle:
        groups, places, count = _group_limbs(assembly, slots, idle)
        guess = _make_first_guess(assembly, groups)
    _check_compliances(assembly, freedoms)
    findings = []
    for limb, joint in ((assembly.limbs[i], j) for i in sorted(idle) for j in idle[i]):
        locked = limb.joints[joint]
        findings.append(
            report_finding(
                "mechanism.locked-joint",
                limb=limb.name,
                joint=locked.name,
                turns=locked.dimension is Dimension.ANGLE,
                value=Quantity(locked.start, SI_SYMBOLS[locked.dimension]),
            )
        )
    program = Program(groups, freedoms, size, count, a, others=others)
    assembly, program = _weigh_actuators(assembly, program)
    robot = Mechanism(
        assembly,
        table,
        table.nominal,
        program,
        _map_slots(assembly, table, places, count),
        size,
        guess,
        {d: unit.symbol for d, unit in DISPLAY_UNITS.items()} | dict(units or {}),
        tuple(findings),
        record,
    )
    if robot.is_serial and not robot.controlled:
        loops, home = kinematics.Loops.place(robot), robot.home_state
        return replace(robot, home_state=loops.solve(loops.read(home), home))
    robot = replace(robot, home_state=_find_home(robot))
    mobility = _count_freedoms(assembly, program)
    if has_spare := _has_spare_drives(assembly, mobility):
        refuse_free_bodies(robot, robot.home_state)
        is_redundant = mobility < len(assembly.rows) - len(assembly.couplings)
        robot = replace(robot, program=replace(robot.program, may_stay_open=is_redundant))
    else:
        robot = check_mobility(robot)
    independent = np.arange(len(robot.actuators))
    if robot.program.sigma is not None or robot.has_redundant_sums:
        independent = _choose_readings(robot, robot.home_state)
    robot = replace(robot, independent=independent)
    if has_spare:
        _check_drives_of_pose(robot)
    return robot


def compute_characteristic_length(assembly: Assembly) -> float:
    """Return the root mean square distance [m] between the points where limbs begin on the base or
    another body, those where they end, and each other.

    If all coincide, it is that of links and rods; DEFAULT_SIZE if every length is zero.
    """
    at_home = {BASE: np.eye(4), PLATFORM: assembly.home, **assembly.bodies}
    feet = [(at_home[limb.on] @ limb.links[0].transform)[:3, 3] for limb in assembly.limbs]
    ends = [(at_home[limb.to] @ limb.attachment.transform)[:3, 3] for limb in assembly.limbs]
    gaps = np.subtract(ends, feet)
    reach = [limb.attachment.transform[:3, 3] for limb in assembly.limbs]
    spread = np.concatenate([gaps, reach, np.subtract(feet, np.mean(feet, axis=0))])
    size = float(np.sqrt((spread**2).sum() / len(gaps)))
    steps = [
        link.transform[:3, 3] for limb in assembly.limbs for link in (*limb.links, limb.attachment)
    ]
    lengths = [*np.linalg.norm(steps, axis=1), *(limb.length for limb in assembly.limbs)]
    if size > POINT * max(lengths):
        return size
    return float(np.sqrt(np.mean(np.square(lengths)))) or DEFAULT_SIZE


def _list_addresses(assembly: Assembly) -> tuple[Address, ...]:
    """Return the addresses that parameters change."""
    single = (entry.address for entry in assembly.maps)
    return tuple(dict.fromkeys([*single, *(a for s in assembly.shared for a in s.outputs)]))


def _find_slots(assembly: Assembly) -> dict[str, dict[Address, Slot]]:
    """Return the slots that parameters change, limb by limb; refuse unknown addresses."""
    limbs = {limb.name: limb for limb in assembly.limbs}
    actuators, terms = {a.name for a in assembly.rows}, name_terms(assembly.rows)
    slots: dict[str, dict[Address, Slot]] = {name: {} for name in limbs}
    unknown = []
    for address in _list_addresses(assembly):
        is_term = address.element == "transmission" and address.axis in terms
        if is_term and address.owner in actuators:
            continue
        slot = _find_slot(limbs[address.owner], address) if address.owner in limbs else None
        if slot is None:
            unknown.append(str(address))
        else:
            slots[address.owner][address] = slot
    if unknown:
        raise MechanismError(
            f"a parameter maps onto {min(unknown)}, which this mechanism does not have. "
            "Correct the map"
        )
    return slots


def _find_slot(limb: Limb, address: Address) -> Slot | None:
    """Return the slot of an address in a limb, None if the limb does not have it."""
    joints = [j.name for j in limb.joints]
    if address.axis == "length":
        is_rod = limb.ending == "distance" and address.element == "rod"
        return Slot(len(joints), engine.LENGTH) if is_rod else None
    if address.axis == "pitch":
        turning = [j.name if j.kind == "R" else None for j in limb.joints]
        is_screw = address.element in turning
        return Slot(turning.index(address.element), engine.PITCH) if is_screw else None
    links = [*(link.name for link in limb.links), limb.attachment.name]
    if address.element not in links or address.axis not in AXES:
        return None
    return Slot(links.index(address.element), AXES.index(address.axis))


def _check_drives(assembly: Assembly, idle: Mapping[int, tuple[int, ...]]) -> None:
    """Refuse a limb whose drive moves nothing but the limb itself."""
    coupled = {name for row in assembly.couplings for name in row.driven_joints}
    for i, limb in enumerate(assembly.limbs):
        joints = len(limb.joints) + bool(limb.actuator) - len(idle.get(i, ()))
        joints -= len(coupled.intersection(limb.drives))
        equations = len(assembly.select_rows(limb))
        if limb.drives and joints > equations:
            excess = name_count(joints - equations, "joint")
            raise MechanismError(
                f"limb {limb.name!r} has {joints} joints, but {equations} closure equations: its "
                f"drive moves the limb and not the platform. Leave out {excess}, "
                "or let their axes spin the limb only"
            )


def _group_limbs(
    assembly: Assembly,
    slots_by_limb: Mapping[str, Mapping[Address, Slot]],
    locked: Mapping[int, tuple[int, ...]],
) -> tuple[tuple[Group, ...], dict[Address, int], int]:
    """Group limbs of one structure and of the same locked joints; return also the place of each
    address in e, and the length of e.
    """
    alike: dict[tuple[Any, ...], list[int]] = {}
    numbers = assembly.numbers
    for i, limb in enumerate(assembly.limbs):
        structure = tuple((j.kind, bool(j.actuator)) for j in limb.joints), bool(limb.actuator)
        ends = (min(numbers[name], 1) for name in (limb.on, limb.to))
        shape = limb.ending, assembly.select_rows(limb), structure, locked.get(i, ()), *ends
        alike.setdefault(shape, []).append(i)
    driven = {name: i for i, name in enumerate(assembly.driven_joints)}
    groups, places, count = [], {}, 0
    for (ending, rows, *_), members in alike.items():
        limbs, fixed = [assembly.limbs[i] for i in members], locked.get(members[0], ())
        kinds = "".join(j.kind for j in limbs[0].joints)
        used = {slot for m in limbs for slot in slots_by_limb[m.name].values()}
        slots = tuple(sorted(used, key=lambda s: (s.element, s.axis)))
        column = {slot: i for i, slot in enumerate(slots)}
        # columns of q (J + 1, k) of each joint and rod of the limbs, -1 for passive ones
        names = [(*(j.actuator for j in m.joints), m.actuator) for m in limbs]
        drives = [[driven[name] if name else -1 for name in of_limb] for of_limb in names]
        actuators = np.array(drives, dtype=np.int64).T.reshape(len(kinds) + 1, len(limbs))
        first = count
        for m in limbs:
            places |= {a: count + column[slot] for a, slot in slots_by_limb[m.name].items()}
            count += len(slots)
        transforms = [[link.transform for link in (*m.links, m.attachment)] for m in limbs]
        pitch = np.array([[j.pitch for j in m.joints] for m in limbs])
        groups.append(
            Group(
                tuple(members),
                kinds,
                actuators,
                tuple(j in fixed for j in range(len(kinds))),
                ending,
                rows,
                np.array(transforms),
                pitch.reshape(len(limbs), len(kinds)),
                np.array([m.length for m in limbs]),
                slots,
                slice(first, count),
                tuple(numbers[m.on] for m in limbs),
                tuple(numbers[m.to] for m in limbs),
            )
        )
    return tuple(groups), places, count


def _weigh_actuators(assembly: Assembly, program: Program) -> tuple[Assembly, Program]:
    """Return an assembly and its program that weigh redundant actuators: by relative standard
    deviations where each limb has one of them and one closure equation, else as sums of one joint.
    The largest deviation, an angle at the robot's size, is 1 m, so that residuals are lengths.
    """
    freedoms = max(len(program.freedoms), _count_freedoms(assembly, program))
    if assembly.couplings or len(assembly.rows) <= freedoms:
        return assembly, program
    sigma = [a.sigma if a.sigma is not None else 1.0 for a in assembly.rows]
    if len({a.sigma is None for a in assembly.rows}) > 1 or min(sigma) <= 0:
        raise MechanismError(
            f"{assembly.name} has more actuators than freedoms. Give a positive sigma for every "
            "actuator, or for none"
        )
    driven = ((group, len(group.driven_joints)) for group in program.groups)
    is_simple = all(n == 1 == len(g.rows) - len(g.unknown_joints(False)) for g, n in driven)
    if not is_simple or any(row.weights for row in assembly.rows):
        rows = (replace(a, weights=a.weights or {a.name: 1.0}) for a in assembly.rows)
        actuators = (*rows, *assembly.actuators[len(assembly.rows) :])
        return replace(assembly, actuators=actuators), program
    turns = [a.name in assembly.turning_drives for a in assembly.rows]
    largest = max(s * (program.size if t else 1.0) for s, t in zip(sigma, turns, strict=True))
    return assembly, replace(program, sigma=tuple(s / largest for s in sigma))


def _check_compliances(assembly: Assembly, freedoms: tuple[int, ...]) -> None:
    """Refuse compliances where the load does not determine the forces of the drives."""
    a, m = len(assembly.rows), len(freedoms)
    elastic = [own.name for own in assembly.actuators if own.name.startswith(LOAD)]
    if elastic and (assembly.closure != "exact" or (a > m and not assembly.couplings)):
        why = f"{a} drives for {m} freedoms" if a > m else "over-constrained loops"
        raise MechanismError(
            f"{assembly.name} has {why}, so the load does not determine the forces of its drives; "
            f"leave out the compliance of {elastic[0].removeprefix(LOAD)!r}"
        )


def _map_slots(
    assembly: Assembly, table: ParameterTable, places: dict[Address, int], count: int
) -> SlotMap:
    """Return the linear maps as one matrix and the shared maps with their places."""
    actuators = {a.name: i for i, a in enumerate(assembly.rows)}
    names = name_terms(assembly.rows)

    def place(address: Address) -> int:
        if address in places:
            return places[address]
        return count + terms.shape[1] * actuators[address.owner] + names.index(address.axis)

    terms = nominal_terms(assembly.rows)
    constants = list_constants(assembly.rows, assembly.actuators)
    matrix = np.zeros((count + terms.size, len(table)))
    for entry in assembly.maps:
        matrix[place(entry.address), table.index(entry.parameter)] += entry.coefficient
    shared = tuple(
        (s, tuple(table.index(name) for name in s.inputs), tuple(place(a) for a in s.outputs))
        for s in assembly.shared
    )
    return SlotMap(matrix, shared, table.nominal, count, terms, constants)


def _make_first_guess(assembly: Assembly, groups: tuple[Group, ...]) -> State:
    """Return the start of the search for home: the home pose with every joint at its `start`."""
    joints = (
        [[*(j.start for j in assembly.limbs[i].joints), 0.0] for i in group.limbs]
        for group in groups
    )
    home, *others = (T[None, None] for T in (assembly.home, *assembly.bodies.values()))
    return make_start(home, tuple(np.array([[rows]]) for rows in joints), tuple(others))


def _count_freedoms(assembly: Assembly, program: Program) -> int:
    """Return how many freedoms a machine has with every drive free, of its unknowns less its
    equations.
    """
    equations = program.count_equations(free=True) + program.shared_drive_count
    return len(program.unknown_twists) - equations - len(assembly.couplings)


def _has_spare_drives(assembly: Assembly, freedoms: int) -> bool:
    """Return whether drives set more freedoms, of so many of a machine with bodies, than it names
    controlled coordinates.
    """
    drives = len(assembly.rows) - len(assembly.couplings)
    return bool(assembly.bodies) and len(assembly.controlled) < freedoms <= drives


def _find_home(robot: Mechanism) -> State:
    """Return the closed state at the controlled coordinates of the home pose. With more drives than
    these, some have the `start` of their joints.
    """
    values, movable = robot.values[None], _count_freedoms(robot.assembly, robot.program)
    shared = robot.program.shared_drive_count + len(robot.assembly.couplings)
    has_spare = _has_spare_drives(robot.assembly, movable)
    if len(robot.controlled) < movable and not has_spare:
        raise MechanismError(
            f"{robot.name} moves in {movable} freedoms or more, but names only "
            f"{len(robot.controlled)} controlled coordinates "
            f"({', '.join(robot.controlled)}). Name one for every freedom, or list fewer "
            f"`freedoms:`"
        )
    target = read_coordinates(robot.assembly.home[None, None], robot.controlled)
    if has_spare:
        held = _choose_readings(robot, robot.home_state, still=True)
        state = close_with_free_actuators(robot, values, target, robot.home_state, held=held)
    else:
        state = inverse_trials(robot, values, target)
        if state.closure_sign[0, 0] == 0 and state.status[0, 0] == engine.CONVERGED:
            _refuse_singular_start(robot, target)  # from which rounding led away
    if state.status[0, 0] != engine.CONVERGED:
        if robot.assembly.couplings and movable < len(robot.controlled):
            raise MechanismError(
                f"{robot.name} has {len(robot.assembly.couplings)} couplings, which leave it "
                f"{max(movable, 0)} freedoms for {len(robot.controlled)} controlled coordinates. "
                "Leave out couplings"
            )
        refuse_free_bodies(robot, robot.home_state)
        _refuse_singular_start(robot, target)
        if not shared:
            refuse_uncontrolled(robot, robot.home_state)
        refuse_singular_home(robot, state)
        gap = robot.describe_gap(float(state.residual[0, 0]))
        raise MechanismError(
            f"the loops of {robot.name} do not close at its home pose: {gap} stay open. Check the "
            "joint centers, the lengths and `home:`"
        )
    if shared or has_spare:
        return replace(state, closure_sign=kinematics.compute_closure_sign(robot, values, state))
    return state


def _refuse_singular_start(robot: Mechanism, target: FloatArray) -> None:
    """Refuse `start:` values, or a home pose, from which home is not found, where it is from others
    beside them: at the stated ones limbs or platform are in a singular position. The error proposes
    those of home: values of joints, and coordinates of the platform that are not controlled.
    """
    guess, values = robot.home_state, robot.values[None]
    freedoms, twist = list(robot.program.freedoms), np.zeros(6)
    for seed in range(STARTS):
        turn = np.random.default_rng(seed).uniform(-0.3, 0.3, len(freedoms))
        twist[freedoms] = turn * robot.size / robot.twist_scale[freedoms]
        moved = replace(shake_joints(guess, seed), T=geometry.apply_twist(guess.T, twist))
        state = inverse_trials(robot, values, target, moved)
        if state.status[0, 0] != engine.CONVERGED or abs(state.closure_sign[0, 0]) == 0.0:
            continue
        found: dict[tuple[str, str, float], tuple[str, Quantity]] = {}
        for group, own in zip(robot.program.groups, state.joints, strict=True):
            for i, limb in zip(group.limbs, own[0, 0], strict=True):
                name = robot.assembly.limbs[i].name
                for joint, value in zip(robot.assembly.limbs[i].joints, limb, strict=False):
                    least = STRETCHED * (robot.size if joint.kind == "P" else 1.0)
                    if abs(value - joint.start) > least:
                        shown = robot.to_quantity(float(value), joint.dimension)
                        of_copies = name.rstrip("0123456789"), joint.name, round(value, 6)
                        found.setdefault(of_copies, (f"{name}.{joint.name}", shown))
        poses = (read_coordinates(T, COORDINATES[:6])[0, 0] for T in (guess.T, state.T))
        for i, (name, start, value) in enumerate(zip(COORDINATES[:6], *poses, strict=True)):
            least = STRETCHED * (robot.size if i < 3 else 1.0)
            if name not in robot.controlled and abs(value - start) > least:
                shown = robot.to_quantity(float(value), (Dimension.LENGTH, Dimension.ANGLE)[i // 3])
                found["home", name, 0.0] = f"`home:` {name}", shown
        if found:
            joints, values = zip(*found.values(), strict=True)
            refused = {"name": robot.name, "joints": joints, "values": values}
            raise MechanismError.of("mechanism.singular-start", **refused)


def _build_chain(assembly: Assembly, units: Mapping[Dimension, str], record: Any) -> Mechanism:
    """Return the mechanism of a chain: its stages one by one, then their structures joined."""
    stages = _build_stages(assembly.stages)
    table = ParameterTable(assembly.parameters, assembly.common_errors)
    size = _compute_chain_size(stages)
    program = _join_programs(stages, size)
    # displacements in any order: an engine computes those of the stages
    limbs = {limb.name for limb in assembly.limbs}
    moved = [address for address in _list_addresses(assembly) if address.owner in limbs]
    places = {address: i for i, address in enumerate(moved)}
    robot = Mechanism(
        assembly,
        table,
        table.nominal,
        program,
        _map_slots(assembly, table, places, len(places)),
        size,
        stages[-1].robot.home_state,
        {d: unit.symbol for d, unit in DISPLAY_UNITS.items()} | dict(units),
        tuple(finding for stage in stages for finding in stage.robot.findings),
        record,
        stages,
    )
    home = join_stage_states(robot, [stage.robot.home_state for stage in stages])
    robot = replace(robot, home_state=home, assembly=replace(assembly, home=np.array(home.T[0, 0])))
    _check_drives_of_pose(robot)
    return robot


def _build_stages(attached: Sequence[AttachedStage]) -> tuple[Stage, ...]:
    """Return the compiled stages; an error names its stage."""
    stages: list[Stage] = []
    places = {BASE: -1}
    p = a = g = 0
    for stage in attached:
        try:
            robot = build(stage.assembly, is_stage=True)
        except MechanismError as error:
            raise MechanismError(f"stage {stage.name!r}: {error}") from None
        counts = len(robot.parameters), len(robot.actuators), len(robot.program.groups)
        stages.append(
            Stage(
                stage.name,
                places[stage.on],
                stage.mount,
                robot,
                *(slice(i, i + n) for i, n in zip((p, a, g), counts, strict=True)),
            )
        )
        places[stage.name] = len(stages) - 1
        p, a, g = (i + n for i, n in zip((p, a, g), counts, strict=True))
    return tuple(stages)


def _choose_readings(robot: Mechanism, state: State, still: bool = False) -> IntArray:
    """Return the places (k,) of readings that determine all motions at a state (1, 1), or those
    in which the platform keeps its coordinates (`still`). Joints are preferred to rods.
    """
    from scipy.linalg import qr

    program, sums = robot.program, list_open_sums(robot, robot.values[None])
    blocks, count = linearize_state(robot, state), sums.chosen
    rows = stack_sum_rows(program, blocks, sums.weights[:, count:])[0, 0]
    if still:
        slope = differentiate_coordinates(state.T[0], robot.controlled, robot.size)
        own = np.zeros((len(robot.controlled), rows.shape[1]))
        own[:, : len(program.freedoms)] = slope[0][:, list(program.freedoms)]
        rows = np.concatenate([rows, own])
    lengths = [robot.twist_scale[f] for _, f in program.unknown_twists] + [*robot.joint_units]
    motions = find_null_space(rows / lengths, RANK)[-program.n_joints :].T
    moved = motions / robot.joint_units @ sums.weights[0, :count].T * robot.drive_units[:count]
    rods = {limb.actuator for limb in robot.assembly.limbs}
    is_rod = [not rods.isdisjoint(a.driven_joints) for a in robot.actuators[:count]]
    order = qr(moved * np.where(is_rod, LESS, 1.0), mode="economic", pivoting=True)[-1]
    return np.sort(np.asarray(order[: len(moved)], np.int64))


def _compute_chain_size(stages: Sequence[Stage]) -> float:
    """Return the root mean square distance [m] of the end platform from the bases of the stages at
    home, or the size of the largest stage with a loop, if that is larger.
    """
    bases, platforms = locate_stage_bases(stages, [stage.robot.home for stage in stages])
    arms = np.array([platforms[-1][:3, 3] - base[:3, 3] for base in bases])
    reach = float(np.sqrt((arms**2).sum() / len(arms)))
    loops = [stage.robot.size for stage in stages if not stage.robot.is_serial]
    return max([reach, *loops]) or DEFAULT_SIZE


def _join_programs(stages: Sequence[Stage], size: float) -> Program:
    """Return the structure of all stages, with the platform's six freedoms."""
    groups, limbs, first, joints = [], 0, 0, 0
    for stage in stages:
        own = stage.robot.program
        for group in own.groups:
            driven = np.where(group.actuator >= 0, group.actuator + joints, -1)
            groups.append(
                replace(
                    group,
                    limbs=tuple(limbs + i for i in group.limbs),
                    actuator=driven,
                    columns=slice(first + group.columns.start, first + group.columns.stop),
                )
            )
        limbs += len(stage.robot.assembly.limbs)
        first, joints = first + own.n_displacements, joints + own.n_joints
    others = tuple(body for stage in stages for body in stage.robot.program.others)
    return Program(tuple(groups), tuple(range(len(AXES))), size, first, joints, others=others)


def _check_drives_of_pose(robot: Mechanism) -> None:
    """Refuse actuators that do not set the controlled coordinates one by one at home."""
    home = robot.home_state
    names = [actuator.name for actuator in robot.actuators]
    for held in robot.assembly.held:
        if held not in names:
            hint = suggest_names(held, names)
            raise MechanismError(f"`held:` names {held!r}, which is not an actuator{hint}")
    moving = find_carrying_actuators(robot)
    values = robot.values[None]
    q = kinematics.compute_readings(robot, values, home)
    D = differentiate_pose(robot, values, q, home).readings[0, 0][:, moving]
    scaled = D * robot.twist_scale[:, None] / robot.drive_units[moving]
    freedoms = count_rank(scaled)
    c, a = len(robot.controlled), len(moving)
    if not freedoms <= c <= a:
        raise MechanismError.of(
            "mechanism.chain-controlled", name=robot.name, named=c, actuators=a, freedoms=freedoms
        )
    slope = differentiate_coordinates(home.T[0], robot.controlled, robot.size)
    rates = slope[0] / robot.twist_scale @ scaled
    independent = count_rank(rates)
    if independent < c:
        raise MechanismError.of(
            "mechanism.chain-singular-home",
            name=robot.name,
            controlled=robot.controlled,
            independent=independent,
        )
