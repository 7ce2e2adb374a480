# SPDX-License-Identifier: Apache-2.0
"""A robot as people read it: actuators and parameters, in the units of its file."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np

from loopcal import geometry
from loopcal.findings.wording import name_count
from loopcal.mechanism.transmission import (
    LOAD,
    TABLE,
    TRIANGLE_TERMS,
    WEIGHT,
    complete_triangle,
    compute_range,
)
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    format_in,
    format_list,
    format_number,
    format_with_uncertainty,
    make_table,
    word_column,
)
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    from loopcal.apply.inspection import RobotInspection
    from loopcal.mechanism.assembly import Address
    from loopcal.mechanism.model import Mechanism

DIGITS = 9  # significant digits of nominal values
RESOLUTION = 1e-5  # share of the stroke to which a reading at home is shown


def view_robot(inspection: RobotInspection) -> list[Block]:
    """Return the page of a robot."""
    robot = inspection.robot
    n, free = len(robot.parameters), int(robot.parameters.free.sum())
    commanded = int(robot.is_commanded.sum())
    actuators, parameters = name_count(commanded, "actuator"), name_count(n, "parameter")
    loads, load, length = [], robot.assembly.load, robot.get_unit(Dimension.LENGTH)
    if robot.is_elastic:
        at = ", ".join(format_in(length, x) for x in load.at)
        axes = f"axes of the {'platform' if load.of_platform else 'base'}"
        loads = [f"load: force and moment in {axes}, at [{at}] {length} of the platform"]
    blocks: list[Block] = [
        f"{robot.name}: {actuators}, {parameters}, {free} free",
        f"file: {robot.record.path}",
        f"freedoms: {' '.join(robot.freedoms)}",
        f"commanded in: {' '.join(robot.controlled)}",
        *loads,
        *format_list([(f.severity.value, str(f)) for f in inspection.findings]),
    ]
    tables = (
        _build_actuator_table(inspection),
        _build_triangle_table(robot),
        _build_sum_table(robot),
        _build_parameter_table(robot),
        _build_common_error_table(robot),
    )
    return [*blocks, *(table for table in tables if table.rows)]


def _build_actuator_table(inspection: RobotInspection) -> Table:
    """Return strokes and readings at home."""
    units, rows = inspection.robot.shown_units, []
    for actuator, reading in zip(inspection.robot.actuators, inspection.home_readings, strict=True):
        unit = units[actuator.dimension]
        ends = (*(actuator.stroke or (math.nan, math.nan)), reading)
        low, high, home = (float(v) / unit.factor_to_si for v in ends)
        at_home = format_with_uncertainty(home, RESOLUTION * (high - low), DIGITS)
        rows.append((actuator.name, format_number(low), format_number(high), at_home, str(unit)))
    numbers = map(Column, ("lowest", "highest", "at home"))
    return make_table("Actuators", ("name", *numbers, "unit"), rows)


def _build_triangle_table(robot: Mechanism) -> Table:
    """Return the lengths of triangle drives at their dead points, and the angles there."""
    units, rows = robot.shown_units, []
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    for actuator in (a for a in robot.actuators if a.is_triangle):
        terms = complete_triangle(actuator.terms)
        middle, ends = terms[-1], np.array([-1.0, 1.0]) * terms[-2] * np.pi / 2
        numbers = [format_in(length, float(end)) for end in compute_range(terms)]
        angles = [format_in(angle, end) for end in middle + ends]
        rows.append((actuator.name, *numbers, length.symbol, *angles, angle.symbol))
    lengths = map(Column, ("shortest", "longest"))
    angles = map(Column, ("joint at shortest", "at longest"))
    caption = "Triangles: dead points of a drive"
    return make_table(caption, ("drive", *lengths, "unit", *angles, "unit"), rows)


def _build_sum_table(robot: Mechanism) -> Table:
    """Return what readings and couplings are sums of; no rows where readings are joint values."""
    sums, couplings = robot.assembly.rows, robot.assembly.couplings
    turning, length = robot.assembly.turning_drives, robot.shown_units[Dimension.LENGTH]
    is_sum = any(row.weights not in ({}, {row.name: 1.0}) for row in sums)
    rows = []
    for row in (row for row in sums if is_sum):
        weights = row.weights or dict.fromkeys(row.driven_joints, 1.0)
        is_length = row.dimension is Dimension.LENGTH or not turning.issuperset(weights)
        per_radian = turning if is_length else ()
        rows.append((row.name, format_sum(weights, per_radian, length)))
    caption = "Sums: what the transmission of a reading gives"
    if couplings:
        caption = "Sums: what readings give, and what couplings hold"
    elif is_sum and robot.has_open_sums:
        count = f"{len(robot.actuators)} of {robot.program.n_joints} joints"
        caption = f"Sums: {count}, each of which the pose determines"
    title = "reading or coupling" if couplings else "reading"
    return make_table(caption, (title, word_column("sum of joint values", wraps=True)), rows)


def format_sum(weights: Mapping[str, float], per_radian: Collection[str | None], unit: Unit) -> str:
    """Return a weighted sum as text, such as `m + 2 k + 12 mm/rad pin`, where weights of some
    joints are lengths per radian.
    """
    text = ""
    for name, weight in weights.items():
        if weight:
            size = "" if abs(weight) == 1.0 else f"{format_number(abs(weight), DIGITS)} "
            if name in per_radian:
                size = f"{format_number(abs(weight) / unit.factor_to_si, DIGITS)} {unit}/rad "
            sign = " - " if weight < 0.0 else " + "
            text += f"{sign if text else sign.strip(' +')}{size}{name}"
    return text


def _build_parameter_table(robot: Mechanism) -> Table:
    """Return nominal and present values with spreads."""
    units, rows = robot.shown_units, []
    for entry, value in zip(robot.parameters.entries, robot.values, strict=True):
        unit = units[entry.dimension]
        numbers = [_format(entry.nominal, unit), _format(value, unit)]
        tolerance = math.nan if entry.tolerance is None else entry.tolerance
        numbers.append(format_in(unit, tolerance, 3))
        rows.append((entry.name, *numbers, str(unit), "free" if entry.free else "fixed"))
    titles = map(Column, ("nominal", "value", "expected spread (1 sd)"))
    return make_table("Parameters", ("name", *titles, "unit", ""), rows)


def _build_common_error_table(robot: Mechanism) -> Table:
    """Return the errors that several parameters share in addition to their own."""
    units, table, rows = robot.shown_units, robot.parameters, []
    for error in table.common:
        unit = units[table.entries[table.index(error.parameters[0])].dimension]
        names = " ".join(error.parameters)
        rows.append((error.name, format_in(unit, error.tolerance, 3), str(unit), names))
    columns = ("name", Column("expected spread (1 sd)"), "unit", "parameters")
    return make_table("Common errors", columns, rows)


# The assembly of a robot as people read it: links, joints, transmissions and parameter maps.

Units = Mapping[Dimension, Unit]
JOINTS = {"R": ("turns about z", Dimension.ANGLE), "P": ("slides along z", Dimension.LENGTH)}
POWERS = {"gain": 1, "curve": 2, "compliance": 1}
PLACE = ("x", "y", "z", "roll", "pitch", "yaw")


def view_assembly(robot: Mechanism) -> list[Table]:
    """Return the tables of an assembly."""
    units, assembly = robot.shown_units, robot.assembly
    unit = f"[{units[Dimension.LENGTH]}, {units[Dimension.ANGLE]}]"
    stages = [(stage.name, stage.on, *_place(stage.mount, units)) for stage in assembly.stages]
    links = [
        (limb.name, link.name, *_place(link.transform, units))
        for limb in assembly.limbs
        for link in (*limb.links, limb.attachment)
    ]
    links += [
        ("platform", name, *_place(T, units))
        for name, T in (("home", assembly.home), ("tool", assembly.tool))
    ]
    on, link = ((*words, *map(Column, PLACE)) for words in (("stage", "on"), ("limb", "link")))
    tables = [
        make_table(f"Stages: bases on the platforms {unit}", on, stages),
        make_table(f"Links, from base to platform {unit}", link, links),
        _build_joint_table(robot, units),
        _build_ending_table(robot, units),
        _build_transmission_table(robot, units),
        _build_anchor_table(robot, units),
        _build_map_table(robot, units),
    ]
    optional = ("Stages", "Triangles")
    return [t for t in tables if t.rows or not t.caption.startswith(optional)]


def _build_joint_table(robot: Mechanism, units: Units) -> Table:
    """Return the joints with their values at home."""
    # number of a limb -> values of its joints [m, rad] with the platform at home
    groups = zip(robot.program.groups, robot.home_state.joints, strict=True)
    values = {i: joints[0, 0, k] for group, joints in groups for k, i in enumerate(group.limbs)}
    rows, length = [], units[Dimension.LENGTH]
    for i, limb in enumerate(robot.assembly.limbs):
        for joint, value in zip(limb.joints, values[i], strict=False):
            motion, dimension = JOINTS[joint.kind]
            if joint.pitch:
                motion += f", {_format(joint.pitch, length)} {length}/rad"
            at_home = _format(value, units[dimension])
            driven = joint.actuator or ""
            rows.append((limb.name, joint.name, motion, driven, at_home, str(units[dimension])))
    columns = ("limb", "joint", "motion", "driven by", Column("at home"), "unit")
    return make_table("Joints", columns, rows)


def _build_ending_table(robot: Mechanism, units: Units) -> Table:
    """Return how each limb ends at the platform."""
    rows, unit = [], units[Dimension.LENGTH]
    for limb in robot.assembly.limbs:
        is_rod = limb.ending == "distance"
        length = (_format(limb.length, unit), unit.symbol) if is_rod else (ABSENT, "")
        rows.append((limb.name, limb.ending, *length, limb.actuator or ""))
    columns = ("limb", "ending", Column("rod length"), "unit", "driven by")
    return make_table("Limb ends", columns, rows)


def _build_transmission_table(robot: Mechanism, units: Units) -> Table:
    """Return the terms that are not zero."""
    rows = []
    for actuator in robot.assembly.rows:
        limbs, driven = robot.assembly.limbs, actuator.driven_joints
        named = ((limb.name, joint) for limb in limbs for joint in limb.joints)
        joints = [f"{limb}/{joint.name}" for limb, joint in named if joint.actuator in driven]
        joints += [f"{limb.name}/rod" for limb in limbs if limb.actuator in driven]
        terms = {"gain": 1.0, **actuator.terms}
        shown = {term: x for term, x in terms.items() if x and term not in TRIANGLE_TERMS}
        shown |= {f"{WEIGHT}{joint}": weight for joint, weight in actuator.weights.items()}
        for term, value in shown.items():
            factor, unit = _unit_of_term(robot, actuator.name, term, units)
            at = ""
            if term.startswith(TABLE):
                point = actuator.points[int(term.removeprefix(TABLE)) - 1]
                reading = units[_find_reading(robot, actuator.name, term)]
                at = f" at {_format(point, reading)} {reading}"
            number = format_number(value / factor, DIGITS)
            rows.append((actuator.name, ", ".join(joints), term + at, number, unit))
    drives = word_column("drives", wraps=True)
    columns = ("actuator", drives, "term", Column("value"), "unit")
    return make_table("Transmissions: from reading to joint value", columns, rows)


def _build_anchor_table(robot: Mechanism, units: Units) -> Table:
    """Return the anchors of triangle drives in the frames of their joints, whose axis is z."""
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    rows = []
    for actuator in (a for a in robot.actuators if a.is_triangle):
        terms = complete_triangle(actuator.terms).tolist()
        shown = [_format(value, length) for value in terms[:6]]
        skew = [_format(value, angle) for value in terms[6:8]]
        rows.append((actuator.name, *shown, length.symbol, *skew, angle.symbol))
    shown, skew = map(Column, TRIANGLE_TERMS[:6]), map(Column, TRIANGLE_TERMS[6:8])
    caption = "Triangles: anchors in the frame of the joint, z along its axis"
    return make_table(caption, ("actuator", *shown, "unit", *skew, "unit"), rows)


def _build_map_table(robot: Mechanism, units: Units) -> Table:
    """Return how parameters enter; a shared map has a function instead of a number."""
    rows, table = [], robot.parameters
    for entry in robot.assembly.maps:
        parameter = units[table.dimensions[table.index(entry.parameter)]]
        factor, symbol = _unit_of_address(robot, entry.address, units)
        number = entry.coefficient * parameter.factor_to_si / factor
        per = symbol if "/" not in symbol else f"({symbol})"
        unit = "1" if parameter.symbol == symbol else f"{per}/{parameter}"
        rows.append((entry.parameter, str(entry.address), format_number(number), unit))
    for shared in robot.assembly.shared:
        outputs = ", ".join(str(address) for address in shared.outputs)
        rows.append((" ".join(shared.inputs), outputs, type(shared).__name__, ""))
    words = (word_column(title, wraps=True) for title in ("parameter", "changes"))
    return make_table("Maps: how parameters enter", (*words, Column("by"), "unit"), rows)


def _place(T: np.ndarray, units: Units) -> tuple[str, ...]:
    """Return x y z roll pitch yaw of a transform (4, 4) as text."""
    angles = geometry.matrix_to_euler(T[:3, :3], "xyz")
    lengths = tuple(_format(float(x), units[Dimension.LENGTH]) for x in T[:3, 3])
    return lengths + tuple(_format(float(a), units[Dimension.ANGLE]) for a in angles)


def _unit_of_term(robot: Mechanism, owner: str, term: str, units: Units) -> tuple[float, str]:
    """Return factor to SI and symbol of a term of a transmission, or of a weight of a sum."""
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    if term.startswith(WEIGHT):  # a length per radian: that of an angle in a sum of lengths
        joints = (joint for limb in robot.assembly.limbs for joint in limb.joints)
        turning = {joint.actuator for joint in joints if joint.kind == "R"}
        is_length = _joint_dimension(robot, owner) is Dimension.LENGTH
        is_radius = is_length and term.removeprefix(WEIGHT) in turning
        return (length.factor_to_si, f"{length}/rad") if is_radius else (1.0, "1")
    if term in ("skew.x", "skew.y"):
        return angle.factor_to_si, angle.symbol
    joint, reading = units[_joint_dimension(robot, owner)], units[_find_reading(robot, owner, term)]
    power = POWERS.get(term, 0)
    symbol = f"{joint}/{reading}" + (f"^{power}" if power > 1 else "")
    if power == 0 or (power == 1 and joint == reading):
        symbol = "1" if power else joint.symbol
    return joint.factor_to_si / reading.factor_to_si**power, symbol


def _unit_of_address(robot: Mechanism, address: Address, units: Units) -> tuple[float, str]:
    """Return factor to SI and symbol of what an address changes."""
    length = units[Dimension.LENGTH]
    if address.element == "transmission":
        return _unit_of_term(robot, address.owner, address.axis, units)
    if address.axis == "pitch":
        return length.factor_to_si, f"{length}/rad"
    unit = units[Dimension.ANGLE] if address.axis in ("rx", "ry", "rz") else length
    return unit.factor_to_si, unit.symbol


def _find_reading(robot: Mechanism, name: str, term: str = "") -> Dimension:
    """Return the dimension of the reading of a drive, of its load for the term `compliance`, or of
    the condition of a coupling; without one that of its sum.
    """
    row = next(row for row in robot.assembly.rows if row.name == name)
    column = LOAD + name if term == "compliance" else row.column
    return next((a.dimension for a in robot.actuators if a.name == column), row.dimension)


def _joint_dimension(robot: Mechanism, name: str) -> Dimension:
    """Return the dimension of what the transmission of an actuator gives: a joint or a sum of
    joints, or the length of a triangle.
    """
    actuator = next(row for row in robot.assembly.rows if row.name == name)
    if actuator.column is not None:
        return actuator.dimension
    joints = (joint for limb in robot.assembly.limbs for joint in limb.joints)
    driving = (j.kind for j in joints if j.actuator in actuator.driven_joints)
    return Dimension.LENGTH if actuator.is_triangle else JOINTS[next(driving, "P")][1]


def _format(value: float, unit: Unit) -> str:
    """Return a number in a unit."""
    return format_in(unit, value, DIGITS)
