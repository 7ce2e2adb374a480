# SPDX-License-Identifier: Apache-2.0
"""A robot as people read it: actuators and parameters, in the units of its file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from loopcal import geometry
from loopcal.findings.wording import name_count
from loopcal.mechanism.transmission import TRIANGLE_TERMS, WEIGHT, compute_range
from loopcal.results.tables import (
    ABSENT,
    Block,
    Column,
    Table,
    build_table,
    format_in,
    format_list,
    format_number,
    format_with_uncertainty,
    word_column,
)
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    from loopcal.apply.inspection import RobotInspection
    from loopcal.mechanism.assembly import Actuator, Address
    from loopcal.mechanism.model import Mechanism

DIGITS = 9
"""Significant digits of nominal values."""

RESOLUTION = 1e-5
"""Share of the stroke to which a reading at home is shown."""

NO_NUMBER = float("nan")


def view_robot(inspection: RobotInspection) -> list[Block]:
    """Return the page of a robot."""
    robot = inspection.robot
    n, free = len(robot.parameters), int(robot.parameters.free.sum())
    actuators, parameters = name_count(len(robot.actuators), "actuator"), name_count(n, "parameter")
    return [
        f"{robot.name}: {actuators}, {parameters}, {free} free",
        f"file: {robot.record.path}",
        f"freedoms: {' '.join(robot.freedoms)}",
        f"commanded in: {' '.join(robot.controlled)}",
        *format_list([(f.severity.value, str(f)) for f in inspection.findings]),
        _build_actuator_table(inspection),
        *([_build_triangle_table(robot)] if any(a.is_triangle for a in robot.actuators) else []),
        *([_build_sum_table(robot)] if any(a.weights for a in robot.actuators) else []),
        *([_build_parameter_table(robot)] if len(robot.parameters) else []),
        *([_build_common_error_table(robot)] if robot.parameters.common else []),
    ]


def _build_actuator_table(inspection: RobotInspection) -> Table:
    """Return strokes and readings at home."""
    units = inspection.robot.shown_units
    rows = []
    pairs = zip(inspection.robot.actuators, inspection.home_readings, strict=True)
    for actuator, reading in pairs:
        unit = units[actuator.dimension]
        low, high = actuator.stroke or (NO_NUMBER, NO_NUMBER)
        low, high, home = (float(v) / unit.factor_to_si for v in (low, high, reading))
        at_home = format_with_uncertainty(home, RESOLUTION * (high - low), DIGITS)
        rows.append((actuator.name, format_number(low), format_number(high), at_home, str(unit)))
    numbers = (Column(title) for title in ("lowest", "highest", "at home"))
    columns = (word_column("name"), *numbers, word_column("unit"))
    return Table("Actuators", columns, tuple(rows))


def _build_triangle_table(robot: Mechanism) -> Table:
    """Return the lengths of triangle drives at their dead points, and the angles there."""
    units = robot.shown_units
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    rows = []
    for actuator in robot.actuators:
        if actuator.is_triangle:
            terms = np.array([actuator.terms[term] for term in TRIANGLE_TERMS])
            middle, ends = terms[-1], np.array([-1.0, 1.0]) * terms[-2] * np.pi / 2
            numbers = [format_in(length, float(end), 6) for end in compute_range(terms)]
            angles = [format_in(angle, float(end), 6) for end in middle + ends]
            rows.append((actuator.name, *numbers, length.symbol, *angles, angle.symbol))
    columns = (
        word_column("drive"),
        *(Column(title) for title in ("shortest", "longest")),
        word_column("unit"),
        *(Column(title) for title in ("joint at shortest", "at longest")),
        word_column("unit"),
    )
    return Table("Triangles: dead points, where a drive turns nothing", columns, tuple(rows))


def _build_sum_table(robot: Mechanism) -> Table:
    """Return what each reading is a sum of."""
    rows = [
        (a.name, format_sum(a.weights or dict.fromkeys(a.driven_joints, 1.0)))
        for a in robot.actuators
    ]
    columns = (word_column("reading"), word_column("sum of joint values", wraps=True))
    if robot.has_open_sums:
        count = f"{len(robot.actuators)} of {robot.program.n_joints} joints"
        return Table(f"Sums: {count}, each of which the pose determines", columns, tuple(rows))
    return Table("Sums: what the transmission of a reading gives", columns, tuple(rows))


def format_sum(weights: Mapping[str, float]) -> str:
    """Return a weighted sum as text, such as `m + 2 k`."""
    text = ""
    for name, weight in weights.items():
        if weight:
            size = "" if abs(weight) == 1.0 else f"{format_number(abs(weight), DIGITS)} "
            sign = " - " if weight < 0.0 else " + "
            text += f"{sign if text else sign.strip(' +')}{size}{name}"
    return text


def _build_parameter_table(robot: Mechanism) -> Table:
    """Return nominal and present values with tolerances."""
    units = robot.shown_units
    return build_table(
        "Parameters",
        zip(robot.parameters.entries, robot.values, strict=True),
        ("name", lambda row: row[0].name),
        (Column("nominal"), lambda row: format_in(units[row[0].dimension], row[0].nominal, DIGITS)),
        (Column("value"), lambda row: format_in(units[row[0].dimension], row[1], DIGITS)),
        (
            Column("tolerance (1 sd)"),
            lambda row: format_in(
                units[row[0].dimension],
                NO_NUMBER if row[0].tolerance is None else row[0].tolerance,
                3,
            ),
        ),
        ("unit", lambda row: str(units[row[0].dimension])),
        (word_column(""), lambda row: "free" if row[0].free else "fixed"),
    )


def _build_common_error_table(robot: Mechanism) -> Table:
    """Return the errors that several parameters share in addition to their own."""
    units, table = robot.shown_units, robot.parameters
    rows = []
    for error in table.common:
        unit = units[table.entries[table.index(error.parameters[0])].dimension]
        names = " ".join(error.parameters)
        rows.append((error.name, format_in(unit, error.tolerance, 3), str(unit), names))
    words = (word_column(title) for title in ("unit", "parameters"))
    columns = (word_column("name"), Column("tolerance (1 sd)"), *words)
    return Table("Common errors", columns, tuple(rows))


# --- The assembly of a robot as people read it: links, joints, transmissions and parameter maps.

Units = Mapping[Dimension, Unit]
JOINTS = {"R": ("turns about z", Dimension.ANGLE), "P": ("slides along z", Dimension.LENGTH)}
POWERS = {"gain": 1, "curve": 2}
PLACE = ("x", "y", "z", "roll", "pitch", "yaw")


def view_assembly(robot: Mechanism) -> list[Table]:
    """Return the tables of an assembly."""
    units = robot.shown_units
    return [
        *([_build_stage_table(robot, units)] if robot.stages else []),
        _build_link_table(robot, units),
        _build_joint_table(robot, units),
        _build_ending_table(robot, units),
        _build_transmission_table(robot, units),
        *(
            [_build_anchor_table(robot, units)]
            if any(a.is_triangle for a in robot.actuators)
            else []
        ),
        _build_map_table(robot, units),
    ]


def _build_stage_table(robot: Mechanism, units: Units) -> Table:
    """Return where the bases of the stages of a chain are."""
    rows = [(stage.name, stage.on, *_place(stage.mount, units)) for stage in robot.assembly.stages]
    columns = (word_column("stage"), word_column("on"), *(Column(title) for title in PLACE))
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    return Table(f"Stages: bases on the platforms [{length}, {angle}]", columns, tuple(rows))


def _build_link_table(robot: Mechanism, units: Units) -> Table:
    """Return the transforms of links, attachments, platform and tool."""
    rows = []
    for limb in robot.assembly.limbs:
        rows += [
            (limb.name, link.name, *_place(link.transform, units))
            for link in (*limb.links, limb.attachment)
        ]
    rows += [
        ("platform", "home", *_place(robot.assembly.home, units)),
        ("platform", "tool", *_place(robot.assembly.tool, units)),
    ]
    columns = (word_column("limb"), word_column("link"), *(Column(title) for title in PLACE))
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    return Table(f"Links, from base to platform [{length}, {angle}]", columns, tuple(rows))


def _build_joint_table(robot: Mechanism, units: Units) -> Table:
    """Return the joints with their values at home."""
    values = _joint_values_at_home(robot)
    rows = []
    for i, limb in enumerate(robot.assembly.limbs):
        for j, joint in enumerate(limb.joints):
            motion, dimension = JOINTS[joint.kind]
            length = units[Dimension.LENGTH]
            if joint.pitch:
                motion += f", {_format(joint.pitch, length)} {length}/rad"
            value = _format(float(values[i][j]), units[dimension])
            driven = joint.actuator or ""
            rows.append((limb.name, joint.name, motion, driven, value, str(units[dimension])))
    words = map(word_column, ("limb", "joint", "motion", "driven by"))
    columns = (*words, Column("at home"), word_column("unit"))
    return Table("Joints", columns, tuple(rows))


def _build_ending_table(robot: Mechanism, units: Units) -> Table:
    """Return how each limb ends at the platform."""
    length = units[Dimension.LENGTH]
    return build_table(
        "Limb ends",
        robot.assembly.limbs,
        ("limb", lambda limb: limb.name),
        ("ending", lambda limb: limb.ending),
        (
            Column("rod length"),
            lambda limb: _format(limb.length, length) if limb.ending == "distance" else ABSENT,
        ),
        ("unit", lambda limb: length.symbol if limb.ending == "distance" else ""),
        ("driven by", lambda limb: limb.actuator or ""),
    )


def _build_transmission_table(robot: Mechanism, units: Units) -> Table:
    """Return the terms that are not zero."""
    rows = []
    for actuator in robot.actuators:
        joint_unit = units[_joint_dimension(robot, actuator.name)]
        reading = units[actuator.dimension]
        joints = ", ".join(_driven_joints(robot, actuator))
        for term, value in {"gain": 1.0, **actuator.terms}.items():
            if value and term not in TRIANGLE_TERMS:
                power = POWERS.get(term, 0)
                number = value * reading.factor_to_si**power / joint_unit.factor_to_si
                rows.append(
                    (
                        actuator.name,
                        joints,
                        term,
                        format_number(number, DIGITS),
                        _unit_of_term(joint_unit, reading, power),
                    )
                )
        rows += [
            (actuator.name, joints, f"{WEIGHT}{joint}", format_number(weight, DIGITS), "1")
            for joint, weight in actuator.weights.items()
        ]
    columns = (
        word_column("actuator"),
        word_column("drives", wraps=True),
        word_column("term"),
        Column("value"),
        word_column("unit"),
    )
    return Table("Transmissions: from reading to joint value", columns, tuple(rows))


def _build_anchor_table(robot: Mechanism, units: Units) -> Table:
    """Return the anchors of triangle drives in the frames of their joints, whose axis is z."""
    length, angle = units[Dimension.LENGTH], units[Dimension.ANGLE]
    rows = []
    for actuator in robot.actuators:
        if actuator.is_triangle:
            terms = [actuator.terms[term] for term in TRIANGLE_TERMS]
            shown = [_format(value, length) for value in terms[:6]]
            skew = [_format(value, angle) for value in terms[6:8]]
            rows.append((actuator.name, *shown, length.symbol, *skew, angle.symbol))
    names = [*TRIANGLE_TERMS[:6], "unit", *TRIANGLE_TERMS[6:8], "unit"]
    columns = tuple(word_column(name) if name == "unit" else Column(name) for name in names)
    title = "Triangles: anchors in the frame of the joint, z along its axis"
    return Table(title, (word_column("actuator"), *columns), tuple(rows))


def _build_map_table(robot: Mechanism, units: Units) -> Table:
    """Return how parameters enter; a shared map has a function instead of a number."""
    rows = []
    table = robot.parameters
    for entry in robot.assembly.maps:
        parameter = units[table.dimensions[table.index(entry.parameter)]]
        factor, symbol = _unit_of_address(robot, entry.address, units)
        number = entry.coefficient * parameter.factor_to_si / factor
        if parameter.symbol == symbol:
            unit = "1"
        else:
            unit = f"{symbol}/{parameter}" if "/" not in symbol else f"({symbol})/{parameter}"
        rows.append((entry.parameter, str(entry.address), format_number(number), unit))
    for shared in robot.assembly.shared:
        outputs = ", ".join(str(address) for address in shared.outputs)
        rows.append((" ".join(shared.inputs), outputs, type(shared).__name__, ""))
    columns = (
        word_column("parameter", wraps=True),
        word_column("changes", wraps=True),
        Column("by"),
        word_column("unit"),
    )
    return Table("Maps: how parameters enter", columns, tuple(rows))


def _joint_values_at_home(robot: Mechanism) -> dict[int, np.ndarray]:
    """Return number of a limb -> values of its joints [m, rad] with the platform at home."""
    groups = zip(robot.program.groups, robot.home_state.joints, strict=True)
    return {i: joints[0, 0, k] for group, joints in groups for k, i in enumerate(group.limbs)}


def _driven_joints(robot: Mechanism, actuator: Actuator) -> list[str]:
    """Return the names of the joints and rods that an actuator drives."""
    limbs, driven = robot.assembly.limbs, actuator.driven_joints
    joints = [
        f"{limb.name}/{joint.name}"
        for limb in limbs
        for joint in limb.joints
        if joint.actuator in driven
    ]
    return joints + [f"{limb.name}/rod" for limb in limbs if limb.actuator in driven]


def _place(T: np.ndarray, units: Units) -> tuple[str, ...]:
    """Return x y z roll pitch yaw of a transform (4, 4) as text."""
    angles = geometry.matrix_to_euler(T[:3, :3], "xyz")
    lengths = tuple(_format(float(x), units[Dimension.LENGTH]) for x in T[:3, 3])
    return lengths + tuple(_format(float(a), units[Dimension.ANGLE]) for a in angles)


def _unit_of_term(joint: Unit, reading: Unit, power: int) -> str:
    """Return the unit of a term of a transmission."""
    if power == 0 or (power == 1 and joint == reading):
        return "1" if power else joint.symbol
    return f"{joint}/{reading}" + (f"^{power}" if power > 1 else "")


def _unit_of_address(robot: Mechanism, address: Address, units: Units) -> tuple[float, str]:
    """Return factor to SI and symbol of what an address changes."""
    length = units[Dimension.LENGTH]
    if address.element == "transmission":
        reading = units[next(a.dimension for a in robot.actuators if a.name == address.owner)]
        if address.axis.startswith(WEIGHT):
            return 1.0, "1"
        if address.axis in ("skew.x", "skew.y"):
            return units[Dimension.ANGLE].factor_to_si, units[Dimension.ANGLE].symbol
        joint, power = units[_joint_dimension(robot, address.owner)], POWERS.get(address.axis, 0)
        factor = joint.factor_to_si / reading.factor_to_si**power
        return factor, _unit_of_term(joint, reading, power)
    if address.axis == "pitch":
        return length.factor_to_si, f"{length}/rad"
    unit = units[Dimension.ANGLE] if address.axis in ("rx", "ry", "rz") else length
    return unit.factor_to_si, unit.symbol


def _joint_dimension(robot: Mechanism, name: str) -> Dimension:
    """Return the dimension of what the transmission of an actuator gives: a joint or a sum of
    joints, or the length of a triangle.
    """
    actuator = next(a for a in robot.actuators if a.name == name)
    if actuator.is_triangle:
        return Dimension.LENGTH
    kinds = [
        joint.kind
        for limb in robot.assembly.limbs
        for joint in limb.joints
        if joint.actuator in actuator.driven_joints
    ]
    return JOINTS[kinds[0]][1] if kinds else Dimension.LENGTH


def _format(value: float, unit: Unit) -> str:
    """Return a number in a unit."""
    return format_in(unit, value, DIGITS)
